"""DDiffPG for Stable-Baselines3: find several solutions of one task, keep them, name them and choose one."""

from typing import TYPE_CHECKING

import lazy_loader

import sb3_ddiffpg.envs  # noqa: F401 - registers the environments
from sb3_ddiffpg.saving import _legacy

if TYPE_CHECKING:
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

# The rest is imported when it is asked for: a worker process needs none of PyTorch
__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    ["buffers", "callbacks", "check", "clustering", "common", "ddiffpg", "evaluation", "exploration", "modes", "networks"],
    {
        "buffers": ["ModeReplayBuffer"],
        "callbacks": [
            "ClusteringCallback",
            "EvaluateModesCallback",
            "LiveCallback",
            "ModeEvalCallback",
            "ModeFigureCallback",
        ],
        "check": ["EnvCheck", "check_env"],
        "ddiffpg": ["DDiffPG", "DiffusionPolicy"],
        "modes": ["Mode", "ModeTable"],
    },
)

_legacy.install()
