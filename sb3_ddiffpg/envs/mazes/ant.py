"""An ant in a maze (MuJoCo)."""

import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer
from mujoco.rollout import Rollout

from sb3_ddiffpg.envs.mazes.ant_model import INTEGRATORS, AntPhysics, ant_model
from sb3_ddiffpg.envs.mazes.drawing import Image
from sb3_ddiffpg.envs.mazes.env import MazeEnv, MazeVecEnv
from sb3_ddiffpg.envs.mazes.maze import FloatArray, MazeMap
from sb3_ddiffpg.envs.mazes.simulation import MazeSimulation
from sb3_ddiffpg.envs.world_change import WorldChange
from sb3_ddiffpg.utils.processors import n_processors

#: Steps of the simulator in one step of the environment, which so takes 0.1 s.
FRAME_SKIP = 5

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_N_QPOS, _N_QVEL = 15, 14


# Upward component of a torso that lies upside down; on its side it is 0
_ON_ITS_BACK = -0.5


class AntSimulation(MazeSimulation):
    """
    n ants, each in a copy of one maze of its own, moved together by MuJoCo's thread pool.

    The body is D4RL's ant: gymnasium's with gear 30, time step 0.02 s and softer contacts. It begins with straight legs, at
    rest, without noise; nothing ends when it falls over, unless asked for.

    :param n: number of ants
    :param maze_map: name or map of a :class:`~sb3_ddiffpg.envs.mazes.maze.Maze`
    :param start_noise: an ant begins uniformly within this distance of the start, in x and y; one number or a pair.
        None: (1, 2) in maze V1, 0 in every other
    :param goal_rewards: reward for reaching each goal, in reading order of the map.
        None: (2, 1) in maze V2, 1 for every goal elsewhere
    :param goal_radius: a goal is reached when the torso's centre is within this distance of its centre, in metres
    :param integrator: ``"rk4"``, as D4RL, or ``"euler"``, two to three times faster and close to it, but not the same
    :param n_blocked: gap cells that are walled in each episode, see :class:`MazeSimulation`
    :param ends_on_fall: whether an episode ends, without success, when the ant lies on its back, from where it does not get
        up: for training, which is spared the rest of it
    :param n_threads: threads that step the ants; None: one per processor this process may use, 0 for a single ant
    :param changes: what is different in the world, a dict or a :class:`~sb3_ddiffpg.envs.WorldChange`
    :raises ValueError: if an argument is out of its range or the start box overlaps a wall
    """

    half_size = 0.9
    action_dim = 8
    body = "an ant"
    changeable = ("motor_strength", "friction", "gravity", "n_blocked", "ends_at_goal")

    def __init__(
        self,
        n: int,
        maze_map: MazeMap = "V1",
        start_noise: float | tuple[float, float] | None = None,
        goal_rewards: Sequence[float] | None = None,
        goal_radius: float = 0.5,
        integrator: str = "rk4",
        n_blocked: int = 0,
        ends_on_fall: bool = False,
        n_threads: int | None = None,
        changes: WorldChange | Mapping[str, Any] | None = None,
    ) -> None:
        if integrator not in INTEGRATORS:
            raise ValueError(f"integrator: {integrator!r} given; accepted are {', '.join(map(repr, INTEGRATORS))}")
        if n_threads is None:
            n_threads = 0 if n == 1 else n_processors()
        if n_threads < 0:
            raise ValueError(f"n_threads: {n_threads} given; accepted are whole numbers from 0 up")
        if start_noise is None:
            start_noise = (1.0, 2.0) if isinstance(maze_map, str) and maze_map == "V1" else 0.0
        super().__init__(n, maze_map, start_noise, goal_rewards, goal_radius, n_blocked, changes)
        self.integrator = integrator
        self.ends_on_fall = ends_on_fall
        self.n_threads = n_threads
        model = self._model(0)
        self._begin = np.zeros(mujoco.mj_stateSize(model, _STATE))
        data = mujoco.MjData(model)
        mujoco.mj_getState(model, data, self._begin, _STATE)
        self._state = np.tile(self._begin, (n, 1))
        self._models = [model] * n
        self._pool: Rollout | None = None
        self._datas: list[mujoco.MjData] = []
        self._viewer: OffScreenViewer | None = None

    def _model(self, i: int) -> mujoco.MjModel:
        blocked = self.blocked[i] if self.has_obstacles else None
        physics = AntPhysics(
            self.changes.shares("motor_strength", self.action_dim), self.changes.friction, self.changes.gravity
        )
        return ant_model(self.maze.rows, self.goal_radius, self.integrator, blocked, physics)

    def __getstate__(self) -> dict[str, Any]:
        """Threads, their scratch memory and windows stay behind; models are compiled again."""
        return self.__dict__ | {"_pool": None, "_datas": [], "_viewer": None, "_models": []}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._models = [self._model(i) for i in range(self.n)]

    def observation_space(self) -> spaces.Box:
        """
        :return: 15 positions (x, y, z of the torso in metres, its orientation as a quaternion, 8 joint angles in rad) and
            14 velocities; x and y within the map, the rest without bounds
        """
        low = np.full(_N_QPOS + _N_QVEL, -np.inf, dtype=np.float32)
        high = -low
        low[0], high[0], low[1], high[1] = self.maze.extent
        return spaces.Box(low, high, dtype=np.float32)

    def observations(self) -> npt.NDArray[np.float32]:
        """
        :return: positions and velocities of every ant, shape (n, 29)
        """
        # The first number is the time
        return self._state[:, 1 : 1 + _N_QPOS + _N_QVEL].astype(np.float32)

    def positions(self) -> FloatArray:
        """
        :return: (x, y) of every torso, shape (n, 2)
        """
        return self._state[:, 1:3]

    def lost(self) -> npt.NDArray[np.bool_]:
        """
        :return: whether each ant lies on its back, if that ends an episode, shape (n,)
        """
        # The z component of the torso's own upward axis, from the quaternion's x and y behind time and position
        upward = 1.0 - 2.0 * (self._state[:, 5:7] ** 2).sum(axis=1)
        return self.ends_on_fall & (upward < _ON_ITS_BACK)

    def _place(self, indices: Sequence[int] | npt.NDArray[np.intp], positions: FloatArray) -> None:
        self._state[indices] = self._begin
        self._state[indices, 1:3] = positions
        if self.has_obstacles:
            for i in indices:
                self._models[i] = self._model(i)

    def _move(self, actions: npt.NDArray[Any]) -> None:
        if self._pool is None:
            self._pool = Rollout(nthread=self.n_threads)
            self._datas = [mujoco.MjData(self._models[0]) for _ in range(max(1, self.n_threads))]
        controls = np.repeat(actions[:, None], FRAME_SKIP, axis=1)
        # Each step begins without the solver's memory of the last one, so that a state is all there is to know
        states, _ = self._pool.rollout(self._models, self._datas, self._state, controls)
        self._state = states[:, -1].copy()

    def draw(self, i: int) -> Image:
        """
        :param i: index of an ant
        :return: RGB image of the maze and this ant from above, shape (480, 480, 3)
        :raises RuntimeError: if the machine has nothing to draw with
        """
        model = self._models[i]
        if self._viewer is None or self._viewer.model is not model:
            self._close_viewer()
            self._viewer = _make_viewer(model)
            x_min, x_max, y_min, y_max = self.maze.extent
            camera = self._viewer.cam
            camera.lookat[:] = (x_min + x_max) / 2, (y_min + y_max) / 2, 0.0
            camera.azimuth, camera.elevation = 90.0, -75.0
            camera.distance = 1.35 * max(x_max - x_min, y_max - y_min)
        mujoco.mj_setState(model, self._viewer.data, self._state[i], _STATE)
        mujoco.mj_forward(model, self._viewer.data)
        return self._viewer.render("rgb_array")

    def close(self) -> None:
        """Release threads and what pictures needed; both are made anew when they are needed again."""
        if self._pool is not None:
            self._pool.close()
            self._pool, self._datas = None, []
        self._close_viewer()

    def _close_viewer(self) -> None:
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None


def _make_viewer(model: mujoco.MjModel) -> OffScreenViewer:
    # Without a screen, and unless the user has chosen
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        return OffScreenViewer(model, mujoco.MjData(model), 480, 480)
    except Exception as error:
        raise RuntimeError(
            f"MuJoCo cannot draw on this machine (MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}): {error}. "
            "Install EGL (Debian: libegl1) or OSMesa, and set MUJOCO_GL to 'egl' or 'osmesa'"
        ) from error


class AntMazeEnv(MazeEnv):
    """A :class:`MazeEnv` whose body is an ant: 29 observations, 8 torques in [-1, 1]. See :class:`AntSimulation`."""

    simulation_class = AntSimulation


class AntMazeVecEnv(MazeVecEnv):
    """Many :class:`AntMazeEnv`, stepped together in native threads."""

    simulation_class = AntSimulation
