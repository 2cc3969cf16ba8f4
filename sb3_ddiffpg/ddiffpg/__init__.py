"""DDiffPG: the algorithm and its policy."""

from sb3_ddiffpg.ddiffpg.ddiffpg import DDiffPG
from sb3_ddiffpg.ddiffpg.policies import DiffusionPolicy

__all__ = ["DDiffPG", "DiffusionPolicy"]
