"""Callbacks: when to re-cluster, evaluation and pictures during training, checkpoints."""

from sb3_ddiffpg.callbacks.checkpoint import RunCheckpointCallback
from sb3_ddiffpg.callbacks.clustering import ClusteringCallback
from sb3_ddiffpg.callbacks.evaluation import EvaluateModesCallback, ModeEvalCallback
from sb3_ddiffpg.callbacks.figures import ModeFigureCallback
from sb3_ddiffpg.callbacks.live import LiveCallback

__all__ = [
    "ClusteringCallback",
    "EvaluateModesCallback",
    "LiveCallback",
    "ModeEvalCallback",
    "ModeFigureCallback",
    "RunCheckpointCallback",
]
