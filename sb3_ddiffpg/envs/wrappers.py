"""Mazes of other packages, made into tasks whose goal is not observed."""

from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from sb3_ddiffpg.envs.mazes.maze import cell_distances

Observation = npt.NDArray[np.float32]


class HideGoal(gym.Wrapper, RecordConstructorArgs):
    """
    A maze of gymnasium-robotics (``PointMaze_*-v3``, ``AntMaze_*-v5``) with one fixed goal that is not observed.

    The observation is a flat float32 array: the environment's own ``observation``, with the position (x, y) before it
    if it does not begin with that already. The reward is 1 at the goal and 0 elsewhere, and the episode terminates there:
    ``reward_type`` and ``continuing_task`` of the wrapped environment are set so. ``info["is_success"]`` repeats
    ``info["success"]``. gymnasium-robotics draws start and goal anew in every episode and moves both by noise; here the
    goal is the exact centre of one cell, and the start one cell with the environment's noise.
    ``reset(options={"goal_cell": ..., "reset_cell": ...})`` changes them for one episode.

    :param env: the maze
    :param goal_cell: row and column of the goal; None: the goal cell of the map that is farthest from the start (where
        the map marks none, any open cell)
    :param reset_cell: row and column of the start; None: the first start cell of the map in reading order (where the
        map marks none, the first open cell)
    :raises ValueError: if ``env`` is no such maze, or a cell is a wall, outside the map, or out of reach
    """

    def __init__(
        self,
        env: gym.Env,
        goal_cell: tuple[int, int] | None = None,
        reset_cell: tuple[int, int] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, goal_cell=goal_cell, reset_cell=reset_cell)
        gym.Wrapper.__init__(self, env)
        base: Any = env.unwrapped
        if not isinstance(env.observation_space, spaces.Dict) or not hasattr(getattr(base, "maze", None), "maze_map"):
            raise ValueError(f"env: {env} given; accepted are the PointMaze and AntMaze environments of gymnasium-robotics")
        self._free = np.array([[str(cell) != "1" for cell in row] for row in base.maze.maze_map])
        if reset_cell is None:
            reset_cell = self._cell_at(base.maze.unique_reset_locations[0])
        self.reset_cell = self._checked("reset_cell", reset_cell)
        distances = cell_distances(self._free, self.reset_cell)
        if goal_cell is None:
            goal_cell = max(map(self._cell_at, base.maze.unique_goal_locations), key=lambda cell: int(distances[cell]))
        self.goal_cell = self._checked("goal_cell", goal_cell)
        if distances[self.goal_cell] < 1:
            raise ValueError(f"goal_cell: {self.goal_cell} given, but there is no way to it from reset_cell {self.reset_cell}")

        # Set within, and not done in step(), because SB3's make_vec_env puts its Monitor between that and this wrapper
        base.reward_type, base.continuing_task = "sparse", False
        # Whether the position is in the observation differs between the two families and is declared nowhere
        observation, _ = env.reset()
        self._prepend = not np.array_equal(observation["observation"][:2], observation["achieved_goal"])
        #: Indices of the position in the observation.
        self.mode_features = np.array([0, 1])
        self.observation_space = self._bounds(len(observation["observation"]) + 2 * self._prepend)

    def _cell_at(self, position: npt.NDArray[np.float64]) -> tuple[int, int]:
        i, j = self._base.maze.cell_xy_to_rowcol(position).tolist()
        return i, j

    @property
    def _base(self) -> Any:
        return self.env.unwrapped

    def _checked(self, name: str, cell: Any) -> tuple[int, int]:
        i, j = (int(index) for index in cell)
        n_rows, n_columns = self._free.shape
        if not (0 <= i < n_rows and 0 <= j < n_columns and self._free[i, j]):
            raise ValueError(
                f"{name}: {(i, j)} given; accepted are the open cells (row, column) of a {n_rows}x{n_columns} map"
            )
        return i, j

    def _bounds(self, size: int) -> spaces.Box:
        """
        :param size: length of the observation
        :return: the map's outer edges for the position, no bounds for the rest
        """
        edge = np.full(size, np.inf, dtype=np.float32)
        edge[:2] = self._base.maze.x_map_center, self._base.maze.y_map_center
        return spaces.Box(-edge, edge, dtype=np.float32)

    def _flat(self, observation: dict[str, npt.NDArray[np.float64]]) -> Observation:
        parts = [observation["achieved_goal"], observation["observation"]] if self._prepend else [observation["observation"]]
        return np.concatenate(parts).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """
        :param seed: new seed of ``np_random``
        :param options: ``goal_cell`` and ``reset_cell`` of this episode
        :return: observation and info, without ``success``: gymnasium-robotics judges it by the goal before it is fixed
        :raises ValueError: if a cell is a wall or outside the map
        """
        options = {"goal_cell": self.goal_cell, "reset_cell": self.reset_cell, **(options or {})}
        for name in ("goal_cell", "reset_cell"):
            options[name] = np.array(self._checked(name, options[name]))
        observation, info = self.env.reset(seed=seed, options=options)
        self._base.goal = self._base.maze.cell_rowcol_to_xy(options["goal_cell"])
        self._base.update_target_site_pos()
        info.pop("success", None)
        return self._flat(observation), info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """
        :param action: the environment's
        :return: observation, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        info["is_success"] = bool(info["success"])
        return self._flat(observation), float(reward), terminated, truncated, info
