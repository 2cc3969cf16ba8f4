"""The environments of an evaluation, in whatever form they are given."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_ddiffpg.evaluation.task import Task

# Environments that are made for an id, at most
_MOST_MADE = 25


def vectorized(env: Any) -> Any:
    """
    As SB3's ``evaluate_policy`` takes environments.

    :param env: A single environment, which gets a ``Monitor``, with SB3's warning, if it has none; or anything else
    :return: The same vectorised; anything else as it is
    """
    if not isinstance(env, gym.Env):
        return env
    if not is_wrapped(env, Monitor):
        warnings.warn(
            "Evaluation environment is not wrapped with a ``Monitor`` wrapper. Returns and lengths of episodes are those that "
            "its outermost wrapper gives: consider wrapping the environment first with ``Monitor``.",
            UserWarning,
        )
        env = Monitor(env)
    return DummyVecEnv([lambda: env])


@contextmanager
def evaluation_environments(
    model: Any, env: Any, n_episodes: int, seed: int | None = None, **env_kwargs: Any
) -> Iterator[VecEnv]:
    """
    Use environments, and close those that were made for it.

    :param model: That is evaluated
    :param env: Vectorised environments, a single one, the id of one, or None: see ``Task.of``
    :param n_episodes: How many there will be
    :param seed: Of environments that are made
    :param env_kwargs: Arguments of ``gym.make``, or a dict of them as ``env_kwargs``, if ``env`` is an id or None
    :return: Vectorised environments
    :raises ValueError: If ``env`` is none of these
    """
    if env is None or isinstance(env, str):
        given = {**(env_kwargs.pop("env_kwargs", None) or {}), **env_kwargs}
        made = Task.of(model, env, given).make(min(n_episodes, _MOST_MADE), seed)
        try:
            yield made
        finally:
            made.close()
        return
    env = vectorized(env)
    if not isinstance(env, VecEnv):
        raise ValueError(f"env must be a VecEnv, a gymnasium.Env or the id of one, got {env!r}")
    if env_kwargs:
        raise ValueError(f"{sorted(env_kwargs)} given; accepted beside an env that is made already are none")
    yield env


@contextmanager
def frozen_statistics(env: VecEnv) -> Iterator[VecNormalize | None]:
    """
    Test episodes are not what a normaliser's statistics are of.

    :param env: Vectorised environments
    :return: Their normaliser, which learns nothing inside; None if they have none
    """
    normalizer = unwrap_vec_normalize(env)
    if normalizer is None:
        yield None
        return
    was_training, normalizer.training = normalizer.training, False
    try:
        yield normalizer
    finally:
        normalizer.training = was_training
