"""The ant in its maze as a MuJoCo model."""

from functools import lru_cache
from importlib.resources import files
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from sb3_ddiffpg.envs.mazes.maze import CELL_SIZE, Maze

#: Seconds of one step of the simulator.
TIMESTEP = 0.02
INTEGRATORS = {"rk4": mujoco.mjtIntegrator.mjINT_RK4, "euler": mujoco.mjtIntegrator.mjINT_EULER}

# D4RL's ant (Fu et al., 2020): weaker motors and softer contacts than gymnasium's
_GEAR = 30.0
_SOLIMP = (0.8, 0.8, 0.01)
_WALL_HEIGHT = 2.0
_ANT_COLOR, _FLOOR_COLOR = (0.84, 0.24, 0.17, 1.0), (0.93, 0.92, 0.89, 1.0)
# Where the box of a gap cell waits until it is needed. A static body that is moved while the simulation runs does not
# block anything (its bounding volume stays where it was), so each set of obstacles is a model of its own.
_UNDERGROUND = -10.0

Cell = tuple[int, int]


class AntPhysics(NamedTuple):
    """Factors on each motor's torque, on the friction of all that touches, and on gravity."""

    motors: tuple[float, ...] = (1.0,) * 8
    friction: float = 1.0
    gravity: float = 1.0


_UNCHANGED = AntPhysics()


def wall_boxes(walls: npt.NDArray[np.bool_]) -> list[tuple[Cell, Cell]]:
    """
    Few rectangles that together are the walls: a simulator checks each pair of body and box.

    :param walls: wall cells, shape (rows, columns)
    :return: first and last cell (row, column) of each rectangle
    """
    left = walls.copy()
    boxes = []
    while left.any():
        # The largest rectangle that begins at the first cell which is left
        i, j = (int(index) for index in np.argwhere(left)[0])
        candidates = []
        for width in range(1, walls.shape[1] - j + 1):
            if not left[i, j : j + width].all():
                break
            height = 1
            while i + height < walls.shape[0] and left[i + height, j : j + width].all():
                height += 1
            candidates.append((width * height, width, height))
        _, width, height = max(candidates)
        left[i : i + height, j : j + width] = False
        boxes.append(((i, j), (i + height - 1, j + width - 1)))
    return boxes


@lru_cache(maxsize=64)
def ant_model(
    rows: tuple[str, ...],
    goal_radius: float,
    integrator: str,
    blocked: tuple[Cell, ...] | None,
    physics: AntPhysics = _UNCHANGED,
) -> mujoco.MjModel:
    """
    Models are compiled once in a process and shared.

    :param rows: of the maze, as in ``Maze.rows``
    :param goal_radius: in metres, for the picture
    :param integrator: one of ``INTEGRATORS``
    :param blocked: gap cells that are walled; None: this maze's obstacles never change, and need no boxes of their own
    :param physics: what is different of the body and its world
    :return: the model, its sizes the same whichever cells are blocked
    """
    maze = Maze(rows)
    spec = mujoco.MjSpec.from_file(str(files("gymnasium.envs.mujoco") / "assets" / "ant.xml"))
    spec.option.timestep = TIMESTEP
    spec.option.integrator = INTEGRATORS[integrator]
    spec.option.gravity *= physics.gravity
    for actuator, strength in zip(spec.actuators, physics.motors, strict=True):
        actuator.gear[0] = _GEAR * strength
    spec.default.geom.solimp[:3] = _SOLIMP
    for geom in spec.geoms:
        geom.solimp[:3] = _SOLIMP
        geom.rgba = _ANT_COLOR
    # Against its own checkerboard a small ant cannot be seen
    floor = spec.geom("floor")
    floor.material, floor.rgba = "", _FLOOR_COLOR
    for first, last in wall_boxes(maze.walls):
        _add_wall(spec, maze, first, last)
    for cell in maze.gap_cells if blocked is not None else ():
        _add_wall(spec, maze, cell, cell, sunk=cell not in (blocked or ()), color=(0.59, 0.41, 0.26, 1.0))
    for goal in maze.goals:
        _add_disc(spec, goal, goal_radius, (0.36, 0.72, 0.44, 1.0))
    _add_disc(spec, maze.start, 0.5, (0.4, 0.6, 0.9, 1.0))
    for geom in spec.geoms:
        geom.friction *= physics.friction
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 640, 640
    return spec.compile()


def _add_wall(
    spec: mujoco.MjSpec,
    maze: Maze,
    first: Cell,
    last: Cell,
    sunk: bool = False,
    color: tuple[float, float, float, float] = (0.35, 0.38, 0.43, 1.0),
) -> None:
    low, high = maze.cell_center((last[0], first[1])), maze.cell_center((first[0], last[1]))
    size = (high - low) / 2 + CELL_SIZE / 2
    height = _UNDERGROUND if sunk else _WALL_HEIGHT / 2
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(*((low + high) / 2), height),
        size=(*size, _WALL_HEIGHT / 2),
        contype=1,
        conaffinity=1,
        rgba=color,
    )


def _add_disc(
    spec: mujoco.MjSpec, center: npt.NDArray[np.float64], radius: float, color: tuple[float, float, float, float]
) -> None:
    """To look at: it touches nothing."""
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=(*center, 0.01),
        size=(radius, 0.01, 0.0),
        contype=0,
        conaffinity=0,
        rgba=color,
    )
