"""Trained models put to the test: episodes, modes counted by ground truth, replanning."""

from sb3_ddiffpg.evaluation.best_of import BestOf
from sb3_ddiffpg.evaluation.ensemble import PolicyEnsemble, evaluate_ensemble
from sb3_ddiffpg.evaluation.evaluate import clustering_agreement, evaluate_modes
from sb3_ddiffpg.evaluation.replanner import Replanner
from sb3_ddiffpg.evaluation.results import CommandResult, ModeEvaluation, RouteResult
from sb3_ddiffpg.evaluation.robustness import RobustnessCurve, robustness_curve
from sb3_ddiffpg.evaluation.rollout import EpisodeResult, run_episodes

__all__ = [
    "BestOf",
    "CommandResult",
    "EpisodeResult",
    "ModeEvaluation",
    "PolicyEnsemble",
    "Replanner",
    "RobustnessCurve",
    "RouteResult",
    "clustering_agreement",
    "evaluate_ensemble",
    "evaluate_modes",
    "robustness_curve",
    "run_episodes",
]
