"""Robot descriptions (URDF) made of boxes."""

Triple = tuple[float, float, float]
Color = tuple[float, float, float, float]

#: Red, green, blue and opacity
WOOD, STEEL, GOAL = (0.76, 0.6, 0.42, 1.0), (0.45, 0.5, 0.56, 1.0), (0.36, 0.72, 0.44, 0.6)
OBSTACLE = (0.59, 0.41, 0.26, 1.0)


def link(name: str, size: Triple, center: Triple, color: Color) -> str:
    """A box-shaped link of a robot description, its centre relative to its joint."""
    edges, at, rgba = (" ".join(map(str, values)) for values in (size, center, color))
    shape = f"<origin xyz='{at}'/><geometry><box size='{edges}'/></geometry>"
    return (
        f"<link name='{name}'><inertial><origin xyz='{at}'/><mass value='1'/><inertia ixx='0.01' ixy='0' ixz='0' iyy='0.01' "
        f"iyz='0' izz='0.01'/></inertial><visual>{shape}<material name='{name}'><color rgba='{rgba}'/></material></visual>"
        f"<collision>{shape}</collision></link>"
    )


def box(size: Triple, color: Color) -> str:
    """A robot that is a box, by its edges in metres."""
    return f"<robot name='box'>{link('box', size, (0.0, 0.0, 0.0), color)}</robot>"


def joint(kind: str, child: str, axis: Triple, at: Triple, upper: float) -> str:
    """A joint between the base and a link, from 0 to ``upper`` (m or rad)."""
    xyz, direction = (" ".join(map(str, values)) for values in (at, axis))
    return (
        f"<joint name='{child}_joint' type='{kind}'><parent link='base'/><child link='{child}'/><origin xyz='{xyz}'/>"
        f"<axis xyz='{direction}'/><limit lower='0' upper='{upper}' effort='100' velocity='10'/></joint>"
    )
