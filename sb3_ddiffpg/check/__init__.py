"""What this package makes of an environment before anything is trained: a few random episodes, and a page about them."""

from sb3_ddiffpg.check.findings import EnvCheck
from sb3_ddiffpg.check.probe import check_env

__all__ = ["EnvCheck", "check_env"]
