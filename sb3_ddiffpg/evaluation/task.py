"""Where a model is put to the test: an environment by its id, or the one that it remembers."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_ddiffpg.envs import is_ours, make_vec_env, registered_id
from sb3_ddiffpg.envs.description import RememberedEnv


@dataclass(frozen=True)
class Task:
    """
    The environment in which a model is evaluated and shown.

    :param id: Of the environment, perhaps with the module that registers it: ``"module:id"``
    :param kwargs: Arguments of ``gym.make``
    :param wrapper: What is put around each
    :param statistics: A ``VecNormalize`` that was saved, if the model was trained on normalised observations
    """

    id: str
    kwargs: dict[str, Any]
    wrapper: Callable[[gym.Env], gym.Env] | None = None
    statistics: Path | None = None

    @staticmethod
    def of(model: Any, env_id: str | None = None, env_kwargs: dict[str, Any] | None = None) -> "Task":
        """
        No module is imported on behalf of a model, whose file may be a stranger's: whoever trusts one names it or imports it.

        :param model: A trained model, which remembers where; or what acts by one, such as a ``Replanner``
        :param env_id: Of an environment, perhaps with the module that registers it; where the model was trained when None
        :param env_kwargs: Arguments of ``gym.make``; when ``env_id`` is None, beside those that the model remembers
        :return: The task, behind the wrappers of the training if it was there; one of this package from one fixed start
        :raises ValueError: If there is no such environment, or nobody knows which
        """
        remembered, kwargs = _remembered(model), {}
        if env_id is None:
            if remembered is None:
                raise ValueError("env: not given, and the model does not remember the environment in which it was trained")
            remembered.check()
            env_id, kwargs = remembered.id, remembered.kwargs
        was_there = registered_id(env_id) == (None if remembered is None else remembered.id)
        if is_ours(env_id):
            kwargs = {**kwargs, "start_noise": 0.0}
        wrapper = remembered.wrapper() if remembered is not None and was_there else None
        return Task(env_id, {**kwargs, **(env_kwargs or {})}, wrapper)

    def make(self, n_envs: int, seed: int | None, **kwargs: Any) -> VecEnv:
        """
        :param n_envs: Number of environments
        :param seed: Of the first
        :param kwargs: Further arguments of ``gym.make``
        :return: The environments
        """
        env = make_vec_env(self.id, n_envs, seed=seed, wrapper_class=self.wrapper, env_kwargs={**self.kwargs, **kwargs})
        if self.statistics is None:
            return env
        normalizer = VecNormalize.load(str(self.statistics), env)
        normalizer.training = normalizer.norm_reward = False
        return normalizer

    def check(self, model: Any) -> None:
        """
        :param model: That is to be shown in it
        :raises ValueError: If it cannot be
        """
        if model.is_normalized and self.statistics is None:
            raise ValueError("--vec-normalize: not given, but the model was trained on normalised observations")
        try:
            # As SB3 shows images to a model
            env = BaseAlgorithm._wrap_env(self.make(1, 0), 0)
        except (gym.error.Error, TypeError, ValueError) as error:
            raise ValueError(f"env: {self.id} cannot be made with {self.kwargs}: {error}") from error
        ours, theirs = (model.observation_space, model.action_space), (env.observation_space, env.action_space)
        env.close()
        if ours != theirs:
            raise ValueError(
                f"env: {self.id} has observations and actions {theirs}, the model was trained on {ours}; a wrapper that "
                "changes them must be part of a registered environment, or around each environment in training, not around all"
            )


def _remembered(model: Any) -> RememberedEnv | None:
    env_spec = getattr(model, "env_spec", None) or getattr(getattr(model, "model", None), "env_spec", None)
    return None if env_spec is None else RememberedEnv.of(env_spec)
