"""DDiffPG for Stable-Baselines3: find several solutions of one task, keep them, name them and choose one."""

import sb3_ddiffpg.envs  # noqa: F401 - registers the environments
from sb3_ddiffpg.buffers import ModeReplayBuffer
from sb3_ddiffpg.callbacks import (
    ClusteringCallback,
    EvaluateModesCallback,
    LiveCallback,
    ModeEvalCallback,
    ModeFigureCallback,
)
from sb3_ddiffpg.check import EnvCheck, check_env
from sb3_ddiffpg.ddiffpg import DDiffPG, DiffusionPolicy
from sb3_ddiffpg.modes import Mode, ModeTable
from sb3_ddiffpg.saving import _legacy

__version__ = "0.2.0"

__all__ = [
    "ClusteringCallback",
    "DDiffPG",
    "DiffusionPolicy",
    "EnvCheck",
    "EvaluateModesCallback",
    "LiveCallback",
    "Mode",
    "ModeEvalCallback",
    "ModeFigureCallback",
    "ModeReplayBuffer",
    "ModeTable",
    "check_env",
]

_legacy.install()
