"""Vectorised environments that say where an error was raised: in this process, in workers, or on a Ray cluster."""

from sb3_ddiffpg.envs.vec_env.ray_actors import RayVecEnv
from sb3_ddiffpg.envs.vec_env.tracing import TracingDummyVecEnv
from sb3_ddiffpg.envs.vec_env.workers import WorkerVecEnv

__all__ = ["RayVecEnv", "TracingDummyVecEnv", "WorkerVecEnv"]
