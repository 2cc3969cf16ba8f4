"""When to re-cluster, and what evaluation during training shows of the modes."""

from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.history import ModeEvent
from sb3_ddiffpg.trajectories import read_success


class ClusteringCallback(BaseCallback):
    """
    Re-clusters the goal-reached trajectories every few rollouts, and says what became of the modes. ``DDiffPG.learn``
    installs one by itself; pass one's own (or a subclass) to replace it.

    The rollouts are counted by the model, so that a resumed run keeps the rhythm.

    :param recluster_freq: Rollouts between two re-clusterings; the model's own setting when None
    :param verbose: 1 prints a line when modes were born, split, merged or retired; the model's verbosity when None
    """

    def __init__(self, recluster_freq: int | None = None, verbose: int | None = None) -> None:
        super().__init__(0 if verbose is None else verbose)
        if recluster_freq is not None and recluster_freq < 1:
            raise ValueError(f"recluster_freq must be at least 1, got {recluster_freq}")
        self.recluster_freq = recluster_freq
        self._inherit_verbosity = verbose is None

    def _init_callback(self) -> None:
        if self._inherit_verbosity:
            self.verbose = self.model.verbose

    def _on_rollout_end(self) -> None:
        # Not _on_step: SB3 calls that one before the transition is stored
        model = self.model
        model.n_rollouts += 1  # type: ignore[attr-defined]
        frequency = self.recluster_freq or model.recluster_freq  # type: ignore[attr-defined]
        if model.n_rollouts % frequency == 0:  # type: ignore[attr-defined]
            self.on_recluster(model.recluster())  # type: ignore[attr-defined]

    def on_recluster(self, events: list[ModeEvent]) -> None:
        """
        :param events: One entry for every mode that was born, split, merged or retired
        """
        if events and self.verbose >= 1:
            print(f"[modes] step {self.num_timesteps}: {'; '.join(map(str, events))} -> {len(self.model.modes)} mode(s)")  # type: ignore[attr-defined]

    def _on_step(self) -> bool:
        return True


def contains_clustering(callback: BaseCallback) -> bool:
    """
    :param callback: A callback, perhaps with others inside
    :return: Whether one of them is a ``ClusteringCallback``
    """
    if isinstance(callback, ClusteringCallback):
        return True
    children = getattr(callback, "callbacks", []) or [getattr(callback, "callback", None)]
    return any(contains_clustering(child) for child in children if isinstance(child, BaseCallback))


class ModeEvalCallback(EvalCallback):
    """
    SB3's ``EvalCallback``, which also logs ``eval/n_modes``: the number of different ground-truth labels (``info["mode"]``)
    among the episodes that reached the goal. It is as lucky as their number is small; start the episodes from one place.

    :param eval_env: The environment used for evaluation
    :param kwargs: Further arguments of ``EvalCallback``; ``deterministic`` is False unless given
    """

    def __init__(self, eval_env: gym.Env | VecEnv, **kwargs: Any) -> None:
        super().__init__(eval_env, **{"deterministic": False, **kwargs})
        self._labels: set[Any] = set()

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        super()._log_success_callback(locals_, globals_)
        info = locals_["info"]
        if locals_["done"] and "mode" in info:
            if read_success(info, getattr(self.model, "success_key", None)) and info["mode"] is not None:
                self._labels.add(info["mode"])
            self.logger.record("eval/n_modes", len(self._labels))

    def _on_step(self) -> bool:
        self._labels = set()
        return super()._on_step()
