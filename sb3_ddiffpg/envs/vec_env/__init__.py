"""Vectorised environments that say where an error was raised: in this process, in workers, or on a Ray cluster."""

from typing import TYPE_CHECKING, Any

from sb3_ddiffpg.utils.lazy import Lazy

if TYPE_CHECKING:
    from sb3_ddiffpg.envs.vec_env.ray_actors import RayVecEnv
    from sb3_ddiffpg.envs.vec_env.tracing import TracingDummyVecEnv
    from sb3_ddiffpg.envs.vec_env.workers import WorkerVecEnv

__all__ = ["RayVecEnv", "TracingDummyVecEnv", "WorkerVecEnv"]

_lazy = Lazy(
    __name__,
    {"RayVecEnv": "ray_actors", "TracingDummyVecEnv": "tracing", "WorkerVecEnv": "workers"},
)


def __getattr__(name: str) -> Any:
    return _lazy(name)
