"""What agents around a model share: the observations that they are given, and those that the environment made."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, maybe_transpose
from stable_baselines3.common.utils import is_vectorized_observation
from stable_baselines3.common.vec_env import VecNormalize


def normalizer_of(model: Any, given: VecNormalize | None) -> VecNormalize | None:
    """
    :param model: That an agent acts by
    :param given: Statistics by which its observations are normalised; None: those of its environment
    :return: These, None if its observations are not normalised
    :raises ValueError: If there are none, but should be
    """
    found = model.get_vec_normalize_env() if given is None else given
    if found is None and model.is_normalized:
        raise ValueError("normalizer: None given, but the model was trained on normalised observations and has no environment")
    return found


def unnormalized(observation: Any, normalizer: VecNormalize | None) -> Any:
    """
    :param observation: As a model sees it
    :param normalizer: By which it is normalised; None: it is not
    :return: As the environment made it
    """
    return observation if normalizer is None else normalizer.unnormalize_obs(observation)


def _as_stored(observation: Any, space: spaces.Space) -> Any:
    """Images of an environment by itself have their channels last, those of a model's first."""
    return maybe_transpose(np.asarray(observation), space) if is_image_space(space) else observation


def as_batch(space: spaces.Space, observation: Any) -> tuple[Any, bool]:
    """
    :param space: Of the model
    :param observation: One observation or a batch of N
    :return: The batch, images with their channels as the model has them, and whether one was given
    """
    if isinstance(observation, dict):
        parts: Any = space
        observation = {key: _as_stored(value, parts[key]) for key, value in observation.items()}
    else:
        observation = _as_stored(observation, space)
    if is_vectorized_observation(observation, space):
        return observation, False
    if isinstance(observation, dict):
        return {key: np.asarray(value)[None] for key, value in observation.items()}, True
    return np.asarray(observation)[None], True
