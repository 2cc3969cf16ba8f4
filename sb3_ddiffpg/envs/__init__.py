"""Environments with several routes to the goal. Importing this module registers them with gymnasium."""

import contextlib
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import lazy_loader
from gymnasium.envs.registration import EnvSpec, load_env_creator

from sb3_ddiffpg.envs.changed_env import ChangedEnv
from sb3_ddiffpg.envs.mazes.homotopy import HomotopyTracker
from sb3_ddiffpg.envs.mazes.maze import LISTED_ROUTES, MAZES, Maze, reduce_word
from sb3_ddiffpg.envs.world_change import WorldChange
from sb3_ddiffpg.envs.wrappers import HideGoal

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

    from sb3_ddiffpg.envs.mazes.point import PointMazeEnv, PointMazeVecEnv

__all__ = [
    "LISTED_ROUTES",
    "MAZES",
    "ChangedEnv",
    "HideGoal",
    "HomotopyTracker",
    "Maze",
    "PointMazeEnv",
    "PointMazeVecEnv",
    "WorldChange",
    "import_packages",
    "is_ours",
    "make_vec_env",
    "reduce_word",
    "registered_id",
    "registered_spec",
]

# The rest is imported when it is asked for: a worker process needs none of PyTorch
__getattr__, __dir__, _ = lazy_loader.attach(
    __name__, ["description", "snapshots", "vec_env"], {"mazes.point": ["PointMazeEnv", "PointMazeVecEnv"]}
)

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
    :param env_id: id of an environment, perhaps with the module that registers it, which is not imported: ``"module:id"``
    :return: whether it is a task of this package
    """
    spec = gym.registry.get(env_id.rpartition(":")[2])
    return spec is not None and str(spec.entry_point).startswith("sb3_ddiffpg.")


def registered_spec(env_id: str) -> EnvSpec:
    """
    What is registered by an id, also by gymnasium-robotics, which has to be imported for that.

    :param env_id: id of a registered environment, perhaps with the module that registers it: ``"module:id"``
    :return: what is registered
    :raises ImportError: if there is no such module
    :raises gymnasium.error.Error: if there is no such environment
    """
    module, _, name = env_id.rpartition(":")
    if module:
        import_module(module)
    elif name not in gym.registry:
        with contextlib.suppress(ImportError):
            gym.register_envs(import_module("gymnasium_robotics"))
    try:
        return gym.spec(name)
    except gym.error.Error as error:
        if not module:
            error.add_note(f'An environment that another package or file registers needs its module: "module:{name}"')
        raise


def registered_id(env_id: str) -> str:
    """
    :param env_id: id of an environment, perhaps with the module that registers it: ``"module:id"``
    :return: the id by which it is registered
    :raises ValueError: if it is not, or there is no such module
    """
    try:
        return registered_spec(env_id).id
    except (gym.error.Error, ImportError) as error:
        accepted = "accepted is the id of a registered environment, or module:id with the module that registers it"
        raise ValueError(f"env: {env_id!r} is not registered ({error}); {accepted}") from None


def import_packages(names: Sequence[str]) -> None:
    """
    :param names: of modules that register environments, or hold wrappers
    :raises ValueError: if there is no such module
    """
    for name in names:
        try:
            import_module(name)
        except (ImportError, ValueError, TypeError) as error:  # the last two: of a name that is none
            raise ValueError(f"--gym-packages: {name!r} cannot be imported ({error})") from None


def make_vec_env(
    env_id: str | Callable[..., gym.Env],
    n_envs: int = 1,
    seed: int | None = None,
    start_index: int = 0,
    monitor_dir: str | None = None,
    wrapper_class: Callable[..., gym.Env] | None = None,
    env_kwargs: dict[str, Any] | None = None,
    vec_env_cls: "Callable[..., VecEnv] | str | None" = None,
    vec_env_kwargs: dict[str, Any] | None = None,
    monitor_kwargs: dict[str, Any] | None = None,
    wrapper_kwargs: dict[str, Any] | None = None,
    *,
    n_threads: int | None = None,
    **more_env_kwargs: Any,
) -> "VecEnv":
    """
    Many environments as SB3 wants them: in one process, with ``info["episode"]`` at the end of each episode. Takes what SB3's
    ``make_vec_env`` takes.

    The mazes are stepped together as a :class:`~sb3_ddiffpg.envs.mazes.env.MazeVecEnv`, the arm's tasks in a few processes
    (:class:`~sb3_ddiffpg.envs.vec_env.WorkerVecEnv`); everything else, and whatever is to be wrapped or vectorised in another
    way, is made by SB3's ``make_vec_env``. All give the numbers of environments that are stepped one after the other.

    :param env_id: id of a registered environment, perhaps with the module that registers it: ``"module:id"``; or a class
        or function that makes one
    :param n_envs: number of environments
    :param seed: environment i is seeded with ``seed + i`` at the first reset
    :param start_index: number of the first environment, for its action space's seed and its monitor's file
    :param monitor_dir: folder of the monitors' files; None: no file is written
    :param wrapper_class: what is put around each environment and its monitor
    :param env_kwargs: arguments of ``gym.make``, such as ``max_episode_steps`` or ``maze_map``
    :param vec_env_cls: a class of SB3's, such as ``SubprocVecEnv``; or ``"ray"`` for the machines of a Ray cluster
        (:class:`~sb3_ddiffpg.envs.vec_env.RayVecEnv`)
    :param vec_env_kwargs: further arguments of ``vec_env_cls``
    :param monitor_kwargs: further arguments of each ``Monitor``
    :param wrapper_kwargs: further arguments of ``wrapper_class``
    :param n_threads: threads of the ants' simulator, processes of the arm's; None: one per processor
    :param more_env_kwargs: the same as ``env_kwargs``, for arguments that are not called as one of these here
    :return: the vectorised environment, with monitor
    :raises ValueError: if ``n_envs`` is less than 1, an argument of the environment is given twice, or ``vec_env_cls`` is no
        class and another word
    """
    # Only now: a worker imports this module too, and needs none of them
    from stable_baselines3.common.env_util import make_vec_env as make_sb3_vec_env
    from stable_baselines3.common.vec_env import VecMonitor

    from sb3_ddiffpg.envs.vec_env import RayVecEnv, TracingDummyVecEnv

    if n_envs < 1:
        raise ValueError(f"n_envs: {n_envs} given; accepted are whole numbers from 1 up")
    if twice := sorted(set(env_kwargs or {}) & set(more_env_kwargs)):
        raise ValueError(f"env_kwargs: {twice} given beside the same as an argument of its own; accepted is one or the other")
    kwargs = {**(env_kwargs or {}), **more_env_kwargs}
    kind = str(registered_spec(env_id).entry_point) if isinstance(env_id, str) else ""
    if vec_env_cls == "ray":
        vec_env_cls = RayVecEnv
        if isinstance(env_id, str):
            env_id = partial(gym.make, registered_spec(env_id))  # the machines do not know what was registered here
    elif isinstance(vec_env_cls, str):
        raise ValueError(f"vec_env_cls: {vec_env_cls!r} given; accepted are a class, and 'ray'")
    one_by_one = any(each is not None for each in (wrapper_class, vec_env_cls, vec_env_kwargs, monitor_kwargs, wrapper_kwargs))
    if one_by_one or not (kind in _VEC_ENVS or kind.startswith(_FRANKA)):
        return make_sb3_vec_env(
            env_id,
            n_envs,
            seed,
            start_index,
            monitor_dir,
            wrapper_class,
            kwargs,
            TracingDummyVecEnv if vec_env_cls is None else vec_env_cls,  # type: ignore[arg-type]
            vec_env_kwargs,
            monitor_kwargs,
            wrapper_kwargs,
        )
    make = _arms if kind.startswith(_FRANKA) else _mazes
    env = make(registered_spec(str(env_id)), n_envs, n_threads, kwargs)
    if seed is not None:
        env.action_space.seed(seed + start_index)
    env.seed(seed)
    return VecMonitor(env, None if monitor_dir is None else os.path.join(monitor_dir, str(start_index)))


def _arms(spec: EnvSpec, n_envs: int, n_workers: int | None, kwargs: dict[str, Any]) -> "VecEnv":
    from sb3_ddiffpg.envs.vec_env import TracingDummyVecEnv, WorkerVecEnv

    # The spec, not the id: the workers do not know what was registered here
    makers: list[Any] = [partial(gym.make, spec, **kwargs)] * n_envs
    return WorkerVecEnv(makers, n_workers) if n_envs > 1 else TracingDummyVecEnv(makers)


def _mazes(spec: EnvSpec, n_envs: int, n_threads: int | None, kwargs: dict[str, Any]) -> "VecEnv":
    limit = kwargs.pop("max_episode_steps", None) or spec.max_episode_steps
    kwargs = {"render_mode": "rgb_array", **spec.kwargs, **kwargs}
    threads = {} if n_threads is None or spec.entry_point == _POINT_MAZE else {"n_threads": n_threads}
    make: Any = load_env_creator(_VEC_ENVS[str(spec.entry_point)])
    mazes: Any = make(n_envs, max_episode_steps=limit, **kwargs, **threads)
    mazes.spec = replace(spec, max_episode_steps=limit, kwargs=kwargs)
    return mazes
