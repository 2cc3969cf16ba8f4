"""
DDiffPG in the RL zoo: ``ddiffpg train``, ``ddiffpg enjoy`` and ``ddiffpg record_video``, with all options of the zoo's own
scripts (https://rl-baselines3-zoo.readthedocs.io) and DDiffPG where nothing else is asked for.
"""

try:
    import rl_zoo3.train  # noqa: F401
except ImportError as error:
    raise ImportError(f"the RL zoo is an extra ({error}); install it with: pip install 'sb3_ddiffpg[zoo]'") from error

from sb3_ddiffpg.zoo.commands import main
from sb3_ddiffpg.zoo.manager import ModeExperimentManager
from sb3_ddiffpg.zoo.registration import register
from sb3_ddiffpg.zoo.settings import ALGO, ALGOS, check_hyperparameters, config_file

__all__ = ["ALGO", "ALGOS", "ModeExperimentManager", "check_hyperparameters", "config_file", "main", "register"]
