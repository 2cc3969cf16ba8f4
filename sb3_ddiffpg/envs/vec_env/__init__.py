"""Vectorised environments that say where an error was raised, in this process or in workers."""

from sb3_ddiffpg.envs.vec_env.tracing import TracingDummyVecEnv
from sb3_ddiffpg.envs.vec_env.workers import WorkerVecEnv

__all__ = ["TracingDummyVecEnv", "WorkerVecEnv"]
