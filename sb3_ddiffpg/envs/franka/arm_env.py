"""An arm with a task, as gymnasium wants it."""

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import msgspec
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_ddiffpg.envs.franka.arm import FloatArray, PandaArm
from sb3_ddiffpg.envs.franka.bodies import OBSTACLE, Color, Triple, box
from sb3_ddiffpg.envs.world_change import WorldChange
from sb3_ddiffpg.serialization.random_states import restore_generator
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert

Image = npt.NDArray[np.uint8]

# Deeper, in metres, an arm is flung out of what it begins in
_TOUCH = 1e-3
_METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}


class _State(msgspec.Struct, forbid_unknown_fields=True):
    start: np.ndarray | None
    actions: np.ndarray
    random: Any


class FrankaEnv(gym.Env[npt.NDArray[Any], npt.NDArray[Any]]):
    """
    A Panda arm with a task. The observation is position and velocity of the point between the fingertips, then what the task
    adds; an action turns the seven joints. The reward is 1 when the task is done, which ends the episode, and 0 before.
    ``info`` holds on every step ``is_success`` and ``mode`` (the route by which it was done; None before). The time limit is
    the registration's (100 steps of 0.04 s).

    :param render_mode: None or ``"rgb_array"``
    :param obs_joints: whether the seven joint angles are observed too
    :param start_noise: largest deviation of each joint's angle at the start, in rad; the task's own when None
    :param changes: what is different in the world, a dict or a :class:`~sb3_ddiffpg.envs.WorldChange`
    :raises ValueError: if an argument is out of its range, or an obstacle stands where the arm begins
    """

    metadata = _METADATA

    base_x: ClassVar[float]
    start_angles: ClassVar[tuple[float, ...]]
    default_start_noise: ClassVar[float] = 0.0
    #: Where in the observation routes differ: the fingertips' position
    feature_indices: ClassVar[tuple[int, ...]] = (0, 1, 2)
    #: Edge of the cells in which visits are counted, for maps and for novelty, in metres
    cell_size: ClassVar[float] = 0.05
    #: The routes by which it can be done
    listed_modes: ClassVar[tuple[str, ...]]
    #: Those that can be closed
    closable: ClassVar[tuple[str, ...]] = ()
    force_scale: ClassVar[float] = 1.0
    tool: ClassVar[str] = ""
    #: What stands in the middle of a picture
    looks_at: ClassVar[tuple[float, float, float]]
    #: Number of values that the task adds to the observation
    n_extra: ClassVar[int] = 0

    def __init__(
        self,
        render_mode: str | None = None,
        obs_joints: bool = False,
        start_noise: float | None = None,
        changes: WorldChange | Mapping[str, Any] | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: {render_mode!r} given; accepted are None and 'rgb_array'")
        self.render_mode = render_mode
        self.obs_joints = obs_joints
        self.start_noise = self.default_start_noise if start_noise is None else start_noise
        if not 0 <= self.start_noise <= np.pi:
            raise ValueError(f"start_noise: {start_noise} given; accepted are 0 to pi rad, and None")
        self.changes = WorldChange.of(changes)
        self._check_changes()
        self.mode_features = np.array(self.feature_indices)
        self.novelty_cell_size = self.cell_size
        size = 6 + self.n_extra + 7 * obs_joints
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (7,), dtype=np.float32)
        # How the running episode began, and what was done since
        self._start: FloatArray | None = None
        self._actions: list[FloatArray] = []
        self._make_world()

    def _check_changes(self) -> None:
        possible = ["motor_strength", "friction", "gravity", "joint_range", "obstacle"]
        self.changes.check(f"{type(self).__name__}'s arm", [*possible, "closed"] if self.closable else possible)
        for name in ("motor_strength", "joint_range"):
            self.changes.shares(name, 7)
        closed = set(self.changes.closed)
        if not closed <= set(self.closable) or (closed and closed == set(self.closable)):
            raise ValueError(f"changes.closed: {sorted(closed)} given; accepted are some of {self.closable}, but not all")

    def _make_world(self) -> None:
        self.arm = PandaArm(self.base_x, self.render_mode is not None, self.force_scale, self.tool)
        start = np.array(self.start_angles)
        self.arm.change(self.changes, start)
        self._build()
        self.arm.reset(start)
        if self.changes.obstacle is not None:
            x, y, z, *edges = self.changes.obstacle
            self._add_box((x, y, z), (edges[0], edges[1], edges[2]), OBSTACLE)
            if self.arm.penetration() > _TOUCH:
                self.arm.close()
                raise ValueError(f"changes.obstacle: {self.changes.obstacle} given, but the arm begins there")
        # Contacts of an earlier episode must not reach into the next
        self._fresh = self.arm.client.saveState()

    def __getstate__(self) -> dict[str, Any]:
        """A world stays in its process: what is pickled or copied is how the episode has gone so far."""
        return {name: value for name, value in self.__dict__.items() if name not in ("arm", "_fresh")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        actions = state["_actions"]
        self.__dict__.update(state)
        self._make_world()
        if self._start is not None:
            self._start_episode(self._start)
            for action in actions:  # bullet forgets contacts when it saves a world: going the way again is exact
                self._move(action)

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
        """The route by which the task is done, None if it is not."""
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
        self._check_open()
        for _ in range(100):  # a start within something else would be flung out of it
            noise = self.start_noise * self.np_random.uniform(-1.0, 1.0, 7)
            self._start_episode(np.clip(np.array(self.start_angles) + noise, self.arm.low, self.arm.high))
            if self.arm.penetration() < _TOUCH:
                break
        return self._observation(), {}

    def state_dict(self) -> dict[str, Any]:
        """
        :return: how the episode has gone so far, and the state of ``np_random``, for ``load_state_dict``
        """
        actions = np.array(self._actions).reshape(-1, 7)
        return {"start": self._start, "actions": actions, "random": self.np_random.bit_generator.state}

    def load_state_dict(self, state: Any) -> None:
        """
        Go the episode's way again: that is exact, and bullet's own pictures of a world in contact are not.

        :param state: what ``state_dict`` gave
        :raises ValueError: if it is of another environment
        """
        known = convert(state, _State, "environment")
        actions = check_array(known.actions, np.float64, [None, 7], "environment.actions")
        if known.start is not None:
            check_array(known.start, np.float64, [7], "environment.start")
        if not np.isfinite(actions).all() or not np.isfinite(0.0 if known.start is None else known.start).all():
            raise ValueError("environment: angles or actions are not finite")
        restore_generator(self.np_random, known.random)
        self._start, self._actions = None, []
        if known.start is not None:
            self._start_episode(known.start)
            for action in actions:
                self._move(action)

    def _start_episode(self, angles: FloatArray) -> None:
        self._start, self._actions = angles, []
        self.arm.client.restoreState(self._fresh)
        self.arm.reset(angles)
        self._begin()

    def _check_open(self) -> None:
        if not self.arm.client.isConnected():
            raise RuntimeError(f"{type(self).__name__} is closed: make another")

    def step(self, action: npt.NDArray[Any]) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """
        :param action: change of the joints' targets, in units of 0.05 rad, shape (7,)
        :return: observation, reward, terminated, truncated (never), info
        :raises ValueError: if the action is not a number or its shape is wrong
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (7,) or not np.isfinite(action).all():
            raise ValueError(f"action: {action.tolist()} given; accepted are finite numbers of shape (7,)")
        self._check_open()
        self._move(np.clip(action, -1.0, 1.0))
        mode = self._done_by()
        done = mode is not None
        return self._observation(), float(done), done, False, {"is_success": done, "mode": mode}

    def _move(self, action: FloatArray) -> None:
        self._actions.append(action)
        before, _ = self.arm.end_effector()
        self.arm.step(action)
        after, _ = self.arm.end_effector()
        self._follow(before, after)

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

    def _add_box(self, center: Triple, size: Triple, color: Color) -> None:
        """A box that does not move, by its centre and edges in metres."""
        self.arm.load(box(size, color), center)

    def _brake(self, body: int, joint: int, force: float) -> None:
        """Hold a joint that nothing drives, by at most so many N or Nm."""
        client = self.arm.client
        client.setJointMotorControl2(body, joint, client.VELOCITY_CONTROL, targetVelocity=0.0, force=force)
