"""The replay buffer: rows, trajectories, and the modes to which they belong."""

from sb3_ddiffpg.buffers.batch import ModeBatch
from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.trajectory import NO_MODE, Trajectory

__all__ = ["NO_MODE", "ModeBatch", "ModeReplayBuffer", "Trajectory"]
