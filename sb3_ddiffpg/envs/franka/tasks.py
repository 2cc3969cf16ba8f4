"""The tasks: what stands around the arm, what counts as done, and by which of several ways."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_ddiffpg.envs.franka.arm import FloatArray, PandaArm

Image = npt.NDArray[np.uint8]

_METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}
_WOOD, _STEEL, _GOAL = (0.76, 0.6, 0.42, 1.0), (0.45, 0.5, 0.56, 1.0), (0.36, 0.72, 0.44, 0.6)


class FrankaEnv(gym.Env[npt.NDArray[Any], npt.NDArray[Any]]):
    """
    A Panda arm with a task. The observation is position and velocity of the point between the fingertips, then what the task
    adds; an action turns the seven joints. The reward is 1 when the task is done, which ends the episode, and 0 before.
    ``info`` holds on every step ``is_success`` and ``mode`` (the way it was done; None before). The time limit is the
    registration's (100 steps of 0.04 s).

    :param render_mode: None or ``"rgb_array"``
    :param obs_joints: whether the seven joint angles are observed too
    """

    metadata = _METADATA

    base_x: ClassVar[float]
    start_angles: ClassVar[tuple[float, ...]]
    start_noise: ClassVar[float] = 0.0
    force_scale: ClassVar[float] = 1.0
    tool: ClassVar[str] = ""
    #: What stands in the middle of a picture
    looks_at: ClassVar[tuple[float, float, float]]
    #: Number of values that the task adds to the observation
    n_extra: ClassVar[int] = 0

    def __init__(self, render_mode: str | None = None, obs_joints: bool = False) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: {render_mode!r} given; accepted are None and 'rgb_array'")
        self.render_mode = render_mode
        self.obs_joints = obs_joints
        self.mode_features = np.arange(3)
        size = 6 + self.n_extra + 7 * obs_joints
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (7,), dtype=np.float32)
        self._make_world()

    def _make_world(self) -> None:
        self.arm = PandaArm(self.base_x, self.render_mode is not None, self.force_scale, self.tool)
        self._build()
        self.arm.reset(np.array(self.start_angles))
        # Contacts of an earlier episode must not reach into the next
        self._fresh = self.arm.client.saveState()

    def __getstate__(self) -> dict[str, Any]:
        raise TypeError(f"{type(self).__name__} cannot be copied: a pybullet world stays in its process; make another")

    # ------------------------------------------------------------------ what a task is

    def _build(self) -> None:
        """Put things around the arm."""
        raise NotImplementedError

    def _begin(self) -> None:
        """Bring them to where an episode begins."""

    def _extra(self) -> FloatArray:
        """What they add to the observation, shape (n_extra,)."""
        return np.zeros(0)

    def _follow(self, before: FloatArray, after: FloatArray) -> None:
        """Take note of a movement of the fingertips."""

    def _done_by(self) -> str | None:
        """The way by which the task is done, None if it is not."""
        raise NotImplementedError

    # ------------------------------------------------------------------ gymnasium

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """
        :param seed: new seed of ``np_random``
        :param options: none are accepted
        :return: observation and an empty info
        :raises ValueError: if there are options
        """
        super().reset(seed=seed)
        if options:
            raise ValueError(f"options: {sorted(options)} given; there are none")
        self.arm.client.restoreState(self._fresh)
        noise = self.start_noise * self.np_random.uniform(-1.0, 1.0, 7)
        self.arm.reset(np.clip(np.array(self.start_angles) + noise, self.arm.low, self.arm.high))
        self._begin()
        return self._observation(), {}

    def step(self, action: npt.NDArray[Any]) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """
        :param action: change of the joints' targets, in units of 0.05 rad, shape (7,)
        :return: observation, reward, terminated, truncated (never), info
        :raises ValueError: if the action is not a number or its shape is wrong
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (7,) or not np.isfinite(action).all():
            raise ValueError(f"action: shape {action.shape} given; accepted are finite numbers of shape (7,)")
        before, _ = self.arm.end_effector()
        self.arm.step(np.clip(action, -1.0, 1.0))
        after, _ = self.arm.end_effector()
        self._follow(before, after)
        mode = self._done_by()
        done = mode is not None
        return self._observation(), float(done), done, False, {"is_success": done, "mode": mode}

    def _observation(self) -> npt.NDArray[np.float32]:
        position, velocity = self.arm.end_effector()
        joints = [self.arm.angles()] if self.obs_joints else []
        return np.concatenate([position, velocity, self._extra(), *joints]).astype(np.float32)

    def render(self) -> Image | None:
        """
        :return: RGB image, shape (480, 480, 3), if the render mode is ``"rgb_array"``
        """
        if self.render_mode is None:
            return None
        client = self.arm.client
        x, y, z = self.looks_at
        view = client.computeViewMatrixFromYawPitchRoll([x, y, z], 1.5, -60.0, -25.0, 0.0, 2)
        projection = client.computeProjectionMatrixFOV(50.0, 1.0, 0.05, 5.0)
        _, _, pixels, *_ = client.getCameraImage(480, 480, view, projection, renderer=client.ER_TINY_RENDERER)
        return np.reshape(np.asarray(pixels, dtype=np.uint8), (480, 480, 4))[..., :3].copy()

    def close(self) -> None:
        """Release the world."""
        self.arm.close()

    def _add_box(
        self, center: tuple[float, float, float], size: tuple[float, float, float], color: tuple[float, float, float, float]
    ) -> int:
        """A box that does not move, by its centre and edges in metres."""
        return self.arm.load(_box_urdf(size, color), center)


def _link(name: str, size: tuple[float, float, float], center: tuple[float, float, float], color: tuple[float, ...]) -> str:
    """A box-shaped link of a robot description, its centre relative to its joint."""
    edges, at, rgba = (" ".join(map(str, values)) for values in (size, center, color))
    shape = f"<origin xyz='{at}'/><geometry><box size='{edges}'/></geometry>"
    return (
        f"<link name='{name}'><inertial><origin xyz='{at}'/><mass value='1'/><inertia ixx='0.01' ixy='0' ixz='0' iyy='0.01' "
        f"iyz='0' izz='0.01'/></inertial><visual>{shape}<material name='{name}'><color rgba='{rgba}'/></material></visual>"
        f"<collision>{shape}</collision></link>"
    )


def _box_urdf(size: tuple[float, float, float], color: tuple[float, float, float, float]) -> str:
    """A robot that is a box, by its edges in metres."""
    return f"<robot name='box'>{_link('box', size, (0.0, 0.0, 0.0), color)}</robot>"


class FrankaReach(FrankaEnv):
    """
    Reach a point behind a cross of two plates: through one of the four quarters.

    The mode is the quarter in which the fingertips last crossed the cross's plane: ``"left-up"``, ``"left-down"``,
    ``"right-up"``, ``"right-down"`` (left: positive y).
    """

    base_x = -0.6
    start_angles = (0.0, -1.5, 0.0, -3.0, 0.0, 2.26, 0.79)
    looks_at = (-0.3, 0.0, 0.5)
    CROSS = (-0.22, 0.0, 0.67)
    GOAL = (-0.05, 0.0, 0.65)
    RADIUS = 0.1

    def _build(self) -> None:
        self._add_box(self.CROSS, (0.04, 0.01, 0.4), _WOOD)
        self._add_box(self.CROSS, (0.04, 0.4, 0.01), _WOOD)
        if self.render_mode is not None:
            client = self.arm.client
            marker = client.createVisualShape(client.GEOM_SPHERE, radius=self.RADIUS, rgbaColor=_GOAL)
            client.createMultiBody(baseVisualShapeIndex=marker, basePosition=self.GOAL)

    def _begin(self) -> None:
        self._quarter = ""

    def _follow(self, before: FloatArray, after: FloatArray) -> None:
        plane, _, height = self.CROSS
        if (before[0] < plane) != (after[0] < plane):
            share = (plane - before[0]) / (after[0] - before[0])
            crossing = before + share * (after - before)
            self._quarter = f"{'left' if crossing[1] > 0 else 'right'}-{'up' if crossing[2] > height else 'down'}"

    def _done_by(self) -> str | None:
        position, _ = self.arm.end_effector()
        return self._quarter if np.linalg.norm(position - self.GOAL) <= self.RADIUS else None


class FrankaPegInHole(FrankaEnv):
    """
    Put the peg that the hand holds into one of two holes. The mode is the hole: ``"left"`` (positive y) or ``"right"``.

    Done is when the peg's tip is within the hole's half-width of its axis, and below the block's top.
    """

    base_x = -0.6
    start_angles = (0.0, 0.41, 0.0, -1.85, 0.0, 2.26, 0.79)
    start_noise = 0.1
    looks_at = (-0.1, 0.0, 0.2)
    HOLES = {"left": (0.05, 0.15), "right": (0.05, -0.15)}  # noqa: RUF012 - never changed
    HALF_WIDTH, TOP, DEPTH = 0.0203, 0.03, 0.025
    PEG_RADIUS, PEG_BACK, PEG_TIP = 0.0127, -0.04, 0.0965  # along the hand, from between the fingertips
    tool = (
        f"<link name='peg'><inertial><mass value='0.05'/><inertia ixx='1e-5' ixy='0' ixz='0' iyy='1e-5' iyz='0' izz='1e-5'/>"
        f"</inertial><visual><geometry><cylinder radius='{PEG_RADIUS}' length='{PEG_TIP - PEG_BACK}'/></geometry>"
        f"<material name='p'><color rgba='0.84 0.24 0.17 1'/></material></visual><collision><geometry>"
        f"<cylinder radius='{PEG_RADIUS}' length='{PEG_TIP - PEG_BACK}'/></geometry></collision></link>"
        f"<joint name='peg_joint' type='fixed'>"
        f"<parent link='panda_grasptarget'/><child link='peg'/><origin xyz='0 0 {(PEG_TIP + PEG_BACK) / 2}'/></joint>"
    )

    def _build(self) -> None:
        self._add_box((0.0, 0.0, -0.025), (0.8, 1.0, 0.05), _WOOD)
        inner, outer = self.HALF_WIDTH, 0.06
        wall = outer - inner
        for x, y in self.HOLES.values():
            for side in (-1, 1):
                self._add_box((x + side * (inner + wall / 2), y, self.TOP / 2), (wall, 2 * outer, self.TOP), _STEEL)
                self._add_box((x, y + side * (inner + wall / 2), self.TOP / 2), (2 * inner, wall, self.TOP), _STEEL)

    def tip(self) -> FloatArray:
        """
        :return: position of the peg's tip, in metres
        """
        return self.arm.end_effector()[0] + self.PEG_TIP * self.arm.hand_direction()

    def _done_by(self) -> str | None:
        x, y, z = self.tip()
        for name, (hole_x, hole_y) in self.HOLES.items():
            if np.hypot(x - hole_x, y - hole_y) <= self.HALF_WIDTH and z < self.DEPTH:
                return name
        return None


def _joint(kind: str, child: str, axis: tuple[float, float, float], at: tuple[float, float, float], upper: float) -> str:
    """A joint between the base and a link, from 0 to ``upper`` (m or rad)."""
    xyz, direction = (" ".join(map(str, values)) for values in (at, axis))
    return (
        f"<joint name='{child}_joint' type='{kind}'><parent link='base'/><child link='{child}'/><origin xyz='{xyz}'/>"
        f"<axis xyz='{direction}'/><limit lower='0' upper='{upper}' effort='100' velocity='10'/></joint>"
    )


class FrankaDrawerClose(FrankaEnv):
    """
    Close one of four open drawers. The mode is the drawer: ``"left-up"``, ``"left-down"``, ``"right-up"`` or ``"right-down"``
    (left: positive y). The four openings (m) are observed.
    """

    base_x = -1.2
    start_angles = (0.0, -1.5, 0.0, -3.0, 0.0, 2.26, 0.79)
    start_noise = 0.1
    n_extra = 4
    looks_at = (-0.6, 0.0, 0.5)
    DRAWERS = {  # noqa: RUF012 - never changed
        f"{side}-{level}": (-0.35, y, z)
        for side, y in (("left", 0.185), ("right", -0.185))
        for level, z in (("up", 0.68), ("down", 0.48))
    }
    SIZE = (0.3, 0.33, 0.16)
    OPENING, CLOSED, BRAKE = 0.17, 0.03, 2.0

    def _build(self) -> None:
        # The back wall carries the drawers
        parts = [_link("base", (0.02, 0.75, 0.42), (0.0, 0.0, 0.0), _WOOD)]
        for name, (x, y, z) in self.DRAWERS.items():
            parts.append(_link(name, self.SIZE, (0.0, 0.0, 0.0), _STEEL))
            parts.append(_joint("prismatic", name, (-1.0, 0.0, 0.0), (x + 0.17, y, z - 0.58), 0.2))
        self._chest = self.arm.load(f"<robot name='chest'>{''.join(parts)}</robot>", (-0.17, 0.0, 0.58))
        for drawer in range(4):
            self._brake(self._chest, drawer, self.BRAKE)

    def _brake(self, body: int, joint: int, force: float) -> None:
        client = self.arm.client
        client.setJointMotorControl2(body, joint, client.VELOCITY_CONTROL, targetVelocity=0.0, force=force)

    def _begin(self) -> None:
        for drawer in range(4):
            self.arm.client.resetJointState(self._chest, drawer, self.OPENING)

    def _extra(self) -> FloatArray:
        return np.array([state[0] for state in self.arm.client.getJointStates(self._chest, range(4))])

    def _done_by(self) -> str | None:
        openings = self._extra()
        return list(self.DRAWERS)[int(openings.argmin())] if openings.min() <= self.CLOSED else None
