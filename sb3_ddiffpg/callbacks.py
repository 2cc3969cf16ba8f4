"""When to re-cluster, and what evaluation during training shows of the modes."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import Figure
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_ddiffpg.checkpoints import nested_callbacks
from sb3_ddiffpg.episodes import run_episodes
from sb3_ddiffpg.evaluation import evaluate_modes
from sb3_ddiffpg.full_disk import missed_if_full
from sb3_ddiffpg.history import ModeEvent
from sb3_ddiffpg.mode_evaluation import ModeEvaluation
from sb3_ddiffpg.rng import preserved_rng
from sb3_ddiffpg.safe_files import convert
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
        if recluster_freq is not None and not (isinstance(recluster_freq, int) and recluster_freq >= 1):
            raise ValueError(f"recluster_freq must be an integer of at least 1, got {recluster_freq!r}")
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
    return any(isinstance(each, ClusteringCallback) for each in nested_callbacks(callback))


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
        goes_on = True
        with preserved_rng(), missed_if_full("What the evaluation found"):
            goes_on = super()._on_step()
        return goes_on


class _PeriodicCallback(BaseCallback):
    """After every so many environment steps, at the end of a rollout."""

    def __init__(self, name: str, period: int) -> None:
        super().__init__()
        if period < 1:
            raise ValueError(f"{name} must be at least 1, got {period}")
        self._period = period
        self._next = 0
        self._resumed = False

    def _on_training_start(self) -> None:
        if not self._resumed:
            self._next = self.model.num_timesteps + self._period
        self._resumed = False

    def state_dict(self) -> dict[str, Any]:
        """
        :return: What a resumed run must know, for ``load_state_dict``
        """
        return {"next": self._next}

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: What ``state_dict`` gave
        :raises ValueError: If it is something else
        """
        self._next = convert(state.get("next"), int, "callback.next")
        self._resumed = True

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps >= self._next:
            self._next = self.num_timesteps + self._period
            self._on_period()

    def _on_period(self) -> None:
        raise NotImplementedError


def score(found: ModeEvaluation) -> tuple[float, int, float]:
    """
    :param found: What ``evaluate_modes`` found
    :return: By which models are compared: their ``commanded_modes``, the number of modes, and uncommanded success. A model
        whose modes fail yet is more than luck without any
    """
    return found.commanded_modes, len(found.commanded), found.uncommanded.success_rate


class EvaluateModesCallback(_PeriodicCallback):
    """
    Runs :func:`~sb3_ddiffpg.evaluation.evaluate_modes` during training and logs what follows from it under ``eval_modes/``.
    Give it environments with one fixed start.

    :param eval_env: Environments used for evaluation
    :param eval_freq: Environment steps between two evaluations
    :param n_episodes: Episodes for each command, and twice as many without
    :param path: Of a file to which each evaluation is appended, one line of JSON each
    :param best_model_path: Of a .zip file, where the model is saved (and ``vecnormalize.pkl`` beside it) whenever its
        ``score`` is as high as ever before. Before you report it, evaluate it in fresh episodes: it was chosen for these
    :param kwargs: Further arguments of ``evaluate_modes``
    """

    def __init__(
        self,
        eval_env: VecEnv,
        eval_freq: int = 10_000,
        n_episodes: int = 20,
        path: str | Path | None = None,
        best_model_path: str | Path | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__("eval_freq", eval_freq)
        self.eval_env, self.n_episodes, self.kwargs = eval_env, n_episodes, kwargs
        self.path = None if path is None else Path(path)
        self.best_model_path = None if best_model_path is None else Path(best_model_path)
        if self.best_model_path is not None and self.best_model_path.suffix != ".zip":
            raise ValueError(f"best_model_path: {best_model_path} given; accepted is the path of a .zip file")
        #: Environment steps at which the best model was saved, None: not yet
        self.best_step: int | None = None
        self._best = (-1.0, -1, -1.0)
        #: Environment steps and what was found, without the episodes
        self.evaluations: list[tuple[int, ModeEvaluation]] = []

    def _init_callback(self) -> None:
        for path in (self.path, self.best_model_path):
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)

    def state_dict(self) -> dict[str, Any]:
        """
        :return: What a resumed run must know, for ``load_state_dict``
        """
        evaluations = [[step, found.to_dict()] for step, found in self.evaluations]
        return {**super().state_dict(), "best": list(self._best), "best_step": self.best_step, "evaluations": evaluations}

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: What ``state_dict`` gave
        :raises ValueError: If it is something else
        """
        super().load_state_dict(state)
        self._best = convert(state.get("best"), tuple[float, int, float], "callback.best")
        self.best_step = convert(state.get("best_step"), int | None, "callback.best_step")
        evaluations = convert(state.get("evaluations"), list[tuple[int, dict[str, Any]]], "callback.evaluations")
        self.evaluations = [(step, ModeEvaluation.from_dict(each)) for step, each in evaluations]
        if self.path is not None:  # what was written after the checkpoint is about to be done again
            self.path.write_text("".join(self._line(*each) for each in self.evaluations))

    @staticmethod
    def _line(step: int, found: ModeEvaluation) -> str:
        return json.dumps({"step": step, **found.to_dict()}) + "\n"

    def _on_period(self) -> None:
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        with preserved_rng():
            found = evaluate_modes(self.model, self.eval_env, self.n_episodes, **self.kwargs)
        self.evaluations.append((self.num_timesteps, replace(found, episodes={})))
        values = {
            "commanded_modes": found.commanded_modes,
            "expected_modes": found.expected_modes(),
            "robust_modes": found.robust_modes,
            "effective_modes": found.effective_modes,
            "coverage": found.coverage,
            "control_accuracy": found.control_accuracy,
            "success_rate": found.uncommanded.success_rate,
            **{f"{each.mode}/success_rate": each.success_rate for each in found.commanded},
        }
        for name, value in values.items():
            self.logger.record(f"eval_modes/{name}", value)
        self.logger.dump(self.num_timesteps)
        if self.path is not None:
            with missed_if_full("What the evaluation found"), self.path.open("a") as file:
                file.write(self._line(self.num_timesteps, found))
        with missed_if_full("The best model"):
            self._keep_if_best(found)

    def _keep_if_best(self, found: ModeEvaluation) -> None:
        # Of equals the later one has seen more
        reached = score(found)
        if self.best_model_path is not None and reached >= self._best:
            unfinished = self.best_model_path.with_name(f".{self.best_model_path.stem}.zip")
            self.model.save(unfinished)
            os.replace(unfinished, self.best_model_path)  # whole, or the one before
            self._best, self.best_step = reached, self.num_timesteps
            normalizer = self.model.get_vec_normalize_env()
            if normalizer is not None:
                normalizer.save(str(self.best_model_path.with_name("vecnormalize.pkl")))


class ModeFigureCallback(_PeriodicCallback):
    """
    Shows the pictures of :mod:`~sb3_ddiffpg.plots` in TensorBoard during training. Needs the extra ``plots``.

    :param figure_freq: Environment steps between two sets of pictures
    :param eval_env: Environments in which the modes' routes are run, with one fixed start; None: no picture of routes
    :param n_episodes: Episodes for each mode's routes
    """

    def __init__(self, figure_freq: int = 50_000, eval_env: VecEnv | None = None, n_episodes: int = 5) -> None:
        super().__init__("figure_freq", figure_freq)
        # Not at the top: matplotlib is not needed to train
        from sb3_ddiffpg import pictures

        self._draw: Callable[..., dict[str, Any]] = pictures.draw_all
        self.eval_env, self.n_episodes = eval_env, n_episodes

    def _on_period(self) -> None:
        with preserved_rng():
            figures = self._figures()
        for name, figure in figures.items():
            self.logger.record(f"figures/{name}", Figure(figure, close=True), exclude=("stdout", "log", "json", "csv"))
        self.logger.dump(self.num_timesteps)

    def _figures(self) -> dict[str, Any]:
        episodes = None
        model: Any = self.model
        if self.eval_env is not None and len(model.modes):
            if model.get_vec_normalize_env() is not None:
                sync_envs_normalization(self.training_env, self.eval_env)
            episodes = {name: run_episodes(model, self.eval_env, self.n_episodes, mode=name) for name in model.modes.names}
        maze = self.training_env.get_attr("maze", indices=0)[0] if self.training_env.has_attr("maze") else None
        observation: Any = model._last_original_obs if model.get_vec_normalize_env() is not None else model._last_obs
        first = None if observation is None or isinstance(observation, dict) else np.asarray(observation)[0]
        return self._draw(model, maze, first, episodes)
