"""
Other people's mazes with a goal that is not observed, for the suite ``strangers``: importing this module registers
``PointMaze_UMaze_HiddenGoal-v3`` and ``PointMaze_Medium_HiddenGoal-v3``.
"""

from functools import partial
from typing import Any

import gymnasium as gym
import gymnasium_robotics
import numpy as np

from sb3_ddiffpg.envs import HideGoal
from sb3_ddiffpg.envs.mazes.maze import CELL_SIZE, Maze


class RouteLabel(gym.Wrapper):
    """
    Says at the goal in ``info["mode"]`` which way round the walls it was reached; None elsewhere.

    :param env: A maze of gymnasium-robotics with one goal and one start cell
    :param listed_modes: Labels of the routes that pass no cell twice
    """

    def __init__(self, env: HideGoal, listed_modes: tuple[str, ...]) -> None:
        super().__init__(env)
        self.listed_modes = listed_modes
        base: Any = env.unwrapped
        cells = [["#" if str(cell) == "1" else "." for cell in row] for row in base.maze.maze_map]
        for (i, j), symbol in ((env.reset_cell, "r"), (env.goal_cell, "g")):
            cells[i][j] = symbol
        self._maze = Maze(cells)
        self._origin = base.maze.cell_rowcol_to_xy(np.array(env.reset_cell))
        self._scale = CELL_SIZE / base.maze.maze_size_scaling
        self._path: list[np.ndarray] = []

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """
        :param kwargs: Of the environment
        :return: Observation and info
        """
        observation, info = self.env.reset(**kwargs)
        self._path = [observation[:2]]
        return observation, info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """
        :param action: The environment's
        :return: Observation, reward, terminated, truncated, info with ``mode``
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._path.append(observation[:2])
        there = self._scale * (np.array(self._path) - self._origin)
        info["mode"] = self._maze.label(there, 0) if info["is_success"] else None
        return observation, reward, terminated, truncated, info


def _hidden(name: str, listed_modes: tuple[str, ...], **kwargs: Any) -> gym.Env:
    return RouteLabel(HideGoal(gym.make(name, **kwargs)), listed_modes)


gym.register_envs(gymnasium_robotics)
# Of Medium the shorter one first, above the block of walls in its middle; then the one below
for _name, _listed in (("UMaze", ("0:-",)), ("Medium", ("0:A", "0:-"))):
    gym.register(f"PointMaze_{_name}_HiddenGoal-v3", entry_point=partial(_hidden, f"PointMaze_{_name}-v3", _listed))
