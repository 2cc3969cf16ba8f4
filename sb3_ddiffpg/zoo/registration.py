"""Makes this package's algorithms known to the zoo."""

from functools import partial

import rl_zoo3.exp_manager
import rl_zoo3.train
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.callbacks.evaluation import ModeEvalCallback
from sb3_ddiffpg.ddiffpg.ddiffpg import DDiffPG
from sb3_ddiffpg.zoo.manager import ModeExperimentManager
from sb3_ddiffpg.zoo.search import convert_params, sample_params
from sb3_ddiffpg.zoo.settings import ALGO, ALGOS


def register() -> None:
    """
    Make DDiffPG and the baselines known to the zoo, with their samplers for Optuna and the :class:`ModeExperimentManager`.
    Call it before the zoo's functions; they read the names of the algorithms when they start.
    """
    ALGOS[ALGO] = DDiffPG
    ALGOS.update(BASELINES)
    for name in (ALGO, *BASELINES):
        HYPERPARAMS_SAMPLER[name] = partial(sample_params, name)
        HYPERPARAMS_CONVERTER[name] = convert_params
    rl_zoo3.train.ExperimentManager = ModeExperimentManager  # type: ignore[misc]
    rl_zoo3.exp_manager.EvalCallback = ModeEvalCallback  # type: ignore[misc, assignment]
