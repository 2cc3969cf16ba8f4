"""Environments with several routes to the goal. Importing this module registers them with gymnasium."""

from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, load_env_creator
from stable_baselines3.common.env_util import make_vec_env as make_sb3_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_ddiffpg.envs.mazes.homotopy import HomotopyTracker
from sb3_ddiffpg.envs.mazes.maze import LISTED_ROUTES, MAZES, Maze, reduce_word
from sb3_ddiffpg.envs.mazes.point import PointMazeEnv, PointMazeVecEnv
from sb3_ddiffpg.envs.vec_env.tracing import TracingDummyVecEnv
from sb3_ddiffpg.envs.vec_env.workers import WorkerVecEnv
from sb3_ddiffpg.envs.wrappers import HideGoal

__all__ = [
    "LISTED_ROUTES",
    "MAZES",
    "HideGoal",
    "HomotopyTracker",
    "Maze",
    "PointMazeEnv",
    "PointMazeVecEnv",
    "is_ours",
    "make_vec_env",
    "reduce_word",
]

# Single environment -> the class that steps many of them together. Strings, so that simulators are imported when needed
_VEC_ENVS = {
    "sb3_ddiffpg.envs.mazes.point:PointMazeEnv": "sb3_ddiffpg.envs.mazes.point:PointMazeVecEnv",
    "sb3_ddiffpg.envs.mazes.ant:AntMazeEnv": "sb3_ddiffpg.envs.mazes.ant:AntMazeVecEnv",
}
_POINT_MAZE, _ANT_MAZE = _VEC_ENVS

for _name in MAZES:
    _ant_limit = 500 if _name in ("V1", "V2") else 700
    gym.register(f"PointMaze{_name}-v0", entry_point=_POINT_MAZE, max_episode_steps=150, kwargs={"maze_map": _name})
    gym.register(f"AntMaze{_name}-v0", entry_point=_ANT_MAZE, max_episode_steps=_ant_limit, kwargs={"maze_map": _name})
_random: dict[str, Any] = {"maze_map": "V3", "n_blocked": 2}
gym.register("PointMazeRandom-v0", entry_point=_POINT_MAZE, max_episode_steps=150, kwargs=_random)
gym.register("AntMazeRandom-v0", entry_point=_ANT_MAZE, max_episode_steps=700, kwargs=_random)
_FRANKA = "sb3_ddiffpg.envs.franka.tasks:Franka"
for _name in ("Reach", "PegInHole", "DrawerClose", "CabinetOpen"):
    gym.register(f"Franka{_name}-v0", entry_point=f"{_FRANKA}{_name}", max_episode_steps=100)


def is_ours(env_id: str) -> bool:
    """
    :param env_id: id of a registered environment, perhaps with the module that registers it: ``"module:id"``
    :return: whether it is a task of this package
    """
    return str(_spec(env_id).entry_point).startswith("sb3_ddiffpg.")


def _spec(env_id: str) -> EnvSpec:
    module, _, name = env_id.rpartition(":")
    if module:
        import_module(module)
    return gym.spec(name)


def make_vec_env(
    env_id: str, n_envs: int = 1, seed: int | None = None, n_threads: int | None = None, **env_kwargs: Any
) -> VecEnv:
    """
    Many environments as SB3 wants them: in one process, with ``info["episode"]`` at the end of each episode.

    The mazes are stepped together as a :class:`~sb3_ddiffpg.envs.mazes.env.MazeVecEnv`, the arm's tasks in a few processes
    (:class:`~sb3_ddiffpg.envs.vec_env.WorkerVecEnv`); for every other id this is SB3's ``make_vec_env``. All give the numbers
    of environments that are stepped one after the other.

    :param env_id: id of a registered environment, perhaps with the module that registers it: ``"module:id"``
    :param n_envs: number of environments
    :param seed: environment i is seeded with ``seed + i`` at the first reset
    :param n_threads: threads of the ants' simulator, processes of the arm's; None: one per processor
    :param env_kwargs: arguments of ``gym.make``, such as ``max_episode_steps`` or ``maze_map``
    :return: the vectorised environment, with monitor
    """
    spec = _spec(env_id)
    if n_envs < 1:
        raise ValueError(f"n_envs: {n_envs} given; accepted are whole numbers from 1 up")
    if str(spec.entry_point).startswith(_FRANKA):
        # The spec, not the id: the workers do not know what was registered here
        makers: list[Any] = [partial(gym.make, spec, **env_kwargs)] * n_envs
        workers: VecEnv = WorkerVecEnv(makers, n_threads) if n_envs > 1 else TracingDummyVecEnv(makers)
        if seed is not None:
            workers.action_space.seed(seed)
        workers.seed(seed)
        return VecMonitor(workers)
    if spec.entry_point not in _VEC_ENVS:
        return make_sb3_vec_env(env_id, n_envs, seed=seed, env_kwargs=env_kwargs, vec_env_cls=TracingDummyVecEnv)
    limit = env_kwargs.pop("max_episode_steps", None) or spec.max_episode_steps
    kwargs = {"render_mode": "rgb_array", **spec.kwargs, **env_kwargs}
    threads = {} if n_threads is None or spec.entry_point == _POINT_MAZE else {"n_threads": n_threads}
    make: Any = load_env_creator(_VEC_ENVS[spec.entry_point])
    mazes = make(n_envs, max_episode_steps=limit, **kwargs, **threads)
    mazes.spec = replace(spec, max_episode_steps=limit, kwargs=kwargs)
    if seed is not None:
        mazes.action_space.seed(seed)
    mazes.seed(seed)
    return VecMonitor(mazes)
