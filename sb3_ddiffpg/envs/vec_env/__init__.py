"""Vectorised environments that say where an error was raised: in this process, in workers, or on a Ray cluster."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from sb3_ddiffpg.envs.vec_env.ray_actors import RayVecEnv
    from sb3_ddiffpg.envs.vec_env.tracing import TracingDummyVecEnv
    from sb3_ddiffpg.envs.vec_env.workers import WorkerVecEnv

__all__ = ["RayVecEnv", "TracingDummyVecEnv", "WorkerVecEnv"]

# Each alone: a worker process needs none of SB3
__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={"ray_actors": ["RayVecEnv"], "tracing": ["TracingDummyVecEnv"], "workers": ["WorkerVecEnv"]},
)
