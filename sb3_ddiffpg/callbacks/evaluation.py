"""What evaluation during training shows of the modes."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_ddiffpg.buffers.success import GoalWatch, Outcome
from sb3_ddiffpg.callbacks.periodic import _PeriodicCallback
from sb3_ddiffpg.evaluation.environments import vectorized
from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.evaluation.rollout import knows_success
from sb3_ddiffpg.serialization.safetensors_tree import convert
from sb3_ddiffpg.utils.disk import missed_if_full, written_whole
from sb3_ddiffpg.utils.rng import preserved_rng
from sb3_ddiffpg.utils.vec_envs import labels_routes


class ModeEvalCallback(EvalCallback):
    """
    SB3's ``EvalCallback``, which also logs ``eval/n_modes``: the number of different ground-truth labels (``info["mode"]``)
    among the episodes that reached the goal, at their last step or before. It is as lucky as their number is small; start the
    episodes from one place.

    :param eval_env: The environment used for evaluation
    :param kwargs: Further arguments of ``EvalCallback``; ``deterministic`` is False unless given
    """

    def __init__(self, eval_env: gym.Env | VecEnv, **kwargs: Any) -> None:
        super().__init__(eval_env, **{"deterministic": False, **kwargs})
        self._labels: set[str] = set()
        self._labelled = labels_routes(self.eval_env)
        self._watch = GoalWatch(self.eval_env.num_envs)
        self._outcomes: list[Outcome] = []

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        # Not SB3's, which knows only the last step and only info["is_success"]
        env, info = locals_["i"], locals_["info"]
        self._watch.observe_one(env, info)
        if not locals_["done"]:
            return
        outcome = self._watch.so_far(env, info)
        self._watch.end(env)
        self._outcomes.append(outcome)
        if self._watch.has_signal:  # perhaps only now: those before have failed
            self._is_success_buffer = [bool(each.success) for each in self._outcomes]
        if outcome.label is not None and outcome.success:
            self._labels.add(outcome.label)
        if self._labelled:
            self.logger.record("eval/n_modes", len(self._labels))

    def _on_step(self) -> bool:
        self._labels, self._outcomes = set(), []
        self._watch = GoalWatch(self.eval_env.num_envs, getattr(self.model, "success_key", None), self._labelled)
        self._watch.has_signal = knows_success(self.model)
        goes_on = True
        with preserved_rng(), missed_if_full("What the evaluation found"):
            goes_on = super()._on_step()
        return goes_on


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

    :param eval_env: Environments used for evaluation, or a single one
    :param eval_freq: Environment steps between two evaluations
    :param n_episodes: Episodes for each command, and twice as many without
    :param path: Of a file to which each evaluation is appended, one line of JSON each
    :param best_model_path: Of a .zip file, where the model is saved (and ``vecnormalize.pkl`` beside it) whenever its
        ``score`` is as high as ever before. Before you report it, evaluate it in fresh episodes: it was chosen for these
    :param kwargs: Further arguments of ``evaluate_modes``
    """

    def __init__(
        self,
        eval_env: gym.Env | VecEnv,
        eval_freq: int = 10_000,
        n_episodes: int = 20,
        path: str | Path | None = None,
        best_model_path: str | Path | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__("eval_freq", eval_freq)
        self.eval_env, self.n_episodes, self.kwargs = vectorized(eval_env), n_episodes, kwargs
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
            with written_whole(self.best_model_path) as unfinished:
                self.model.save(unfinished)
            self._best, self.best_step = reached, self.num_timesteps
            normalizer = self.model.get_vec_normalize_env()
            if normalizer is not None:
                normalizer.save(str(self.best_model_path.with_name("vecnormalize.pkl")))
