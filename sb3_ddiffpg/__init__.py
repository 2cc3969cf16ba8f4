"""DDiffPG for Stable-Baselines3: find several solutions of one task, keep them, name them and choose one."""

from typing import TYPE_CHECKING, Any

import sb3_ddiffpg.envs  # noqa: F401 - registers the environments
from sb3_ddiffpg.saving import _legacy
from sb3_ddiffpg.utils.lazy import Lazy

if TYPE_CHECKING:
    from sb3_ddiffpg.buffers import ModeReplayBuffer
    from sb3_ddiffpg.callbacks import ClusteringCallback, EvaluateModesCallback, ModeEvalCallback, ModeFigureCallback
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
    "Mode",
    "ModeEvalCallback",
    "ModeFigureCallback",
    "ModeReplayBuffer",
    "ModeTable",
    "check_env",
]

_lazy = Lazy(
    __name__,
    {
        **dict.fromkeys(
            ("ClusteringCallback", "EvaluateModesCallback", "ModeEvalCallback", "ModeFigureCallback"), "callbacks"
        ),
        **dict.fromkeys(("DDiffPG", "DiffusionPolicy"), "ddiffpg"),
        **dict.fromkeys(("EnvCheck", "check_env"), "check"),
        **dict.fromkeys(("Mode", "ModeTable"), "modes"),
        "ModeReplayBuffer": "buffers",
    },
    ("buffers", "callbacks", "check", "clustering", "common", "ddiffpg", "evaluation", "exploration", "modes", "networks"),
)


def __getattr__(name: str) -> Any:
    return _lazy(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


_legacy.install()
