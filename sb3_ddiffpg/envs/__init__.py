"""Environments with several ways to the goal. Importing this module registers them with gymnasium."""

from dataclasses import replace
from importlib import import_module
from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import make_vec_env as make_sb3_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_ddiffpg.envs.mazes import LISTED_ROUTES, MAZES, HomotopyTracker, Maze, reduce_word
from sb3_ddiffpg.envs.point import PointMazeEnv, PointMazeVecEnv
from sb3_ddiffpg.envs.wrappers import HideGoal

__all__ = [
    "LISTED_ROUTES",
    "MAZES",
    "HideGoal",
    "HomotopyTracker",
    "Maze",
    "PointMazeEnv",
    "PointMazeVecEnv",
    "make_vec_env",
    "reduce_word",
]

_POINT_MAZE = "sb3_ddiffpg.envs.point:PointMazeEnv"

for _name in MAZES:
    gym.register(f"PointMaze{_name}-v0", entry_point=_POINT_MAZE, max_episode_steps=150, kwargs={"maze_map": _name})


def make_vec_env(env_id: str, n_envs: int = 1, seed: int | None = None, **env_kwargs: Any) -> VecEnv:
    """
    Many environments as SB3 wants them: in one process, with ``info["episode"]`` at the end of each episode.

    The point mazes are stepped together as a :class:`PointMazeVecEnv`; for every other id this is SB3's
    ``make_vec_env``. Both give the same numbers.

    :param env_id: id of a registered environment, perhaps with the module that registers it: ``"module:id"``
    :param n_envs: number of environments
    :param seed: environment i is seeded with ``seed + i`` at the first reset
    :param env_kwargs: arguments of ``gym.make``, such as ``max_episode_steps`` or ``maze_map``
    :return: the vectorised environment, with monitor
    """
    module, _, name = env_id.rpartition(":")
    if module:
        import_module(module)
    spec = gym.spec(name)
    if spec.entry_point != _POINT_MAZE:
        return make_sb3_vec_env(env_id, n_envs, seed=seed, env_kwargs=env_kwargs)
    limit = env_kwargs.pop("max_episode_steps", spec.max_episode_steps)
    kwargs = {"render_mode": "rgb_array", **spec.kwargs, **env_kwargs}
    point_mazes = PointMazeVecEnv(n_envs, max_episode_steps=limit, **kwargs)
    point_mazes.spec = replace(spec, max_episode_steps=limit, kwargs=kwargs)
    if seed is not None:
        point_mazes.action_space.seed(seed)
    point_mazes.seed(seed)
    return VecMonitor(point_mazes)
