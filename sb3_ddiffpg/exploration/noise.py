"""Exploration noise."""

import copy
from collections.abc import Iterable
from typing import Any

import numpy as np
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise

from sb3_ddiffpg.serialization.codec import registered
from sb3_ddiffpg.utils.rng import preserved_rng


@registered("sb3_ddiffpg.noise.SpreadNormalActionNoise", objects=True)
class SpreadNormalActionNoise(VectorizedActionNoise):
    """
    Gaussian noise whose standard deviation differs between episodes: some environments follow the policy closely while
    others search widely. Each episode draws its own, so that one environment sees all of them in time.

    :param n_envs: Number of environments
    :param action_dim: Size of the action
    :param low: Smallest standard deviation
    :param high: Largest standard deviation
    """

    def __init__(self, n_envs: int, action_dim: int, low: float = 0.05, high: float = 0.6) -> None:
        if not 0 <= low <= high:
            raise ValueError(f"low and high must satisfy 0 <= low <= high, got low={low}, high={high}")
        # Not VectorizedActionNoise's constructor: it copies one noise object per environment
        self.shape = (n_envs, action_dim)
        self.low, self.high = low, high
        self.sigma = np.full(n_envs, low)

    def reset(self, indices: Iterable[int] | None = None) -> None:
        """
        Draw new standard deviations.

        :param indices: Environments whose episode ended; all when None
        """
        chosen = np.arange(self.shape[0]) if indices is None else np.fromiter(indices, dtype=int)
        self.sigma[chosen] = np.random.uniform(self.low, self.high, size=len(chosen))

    def __call__(self) -> np.ndarray:
        """
        :return: Noise for actions in [-1, 1], shape [n_envs, action_dim]
        """
        return (np.random.standard_normal(self.shape) * self.sigma[:, None]).astype(np.float32)

    def __repr__(self) -> str:
        return f"SpreadNormalActionNoise(low={self.low}, high={self.high})"


def noise_for(noise: ActionNoise | None, n_envs: int, action_dim: int) -> ActionNoise:
    """
    :param noise: As it was given; None: a ``SpreadNormalActionNoise``
    :param n_envs: Number of environments
    :param action_dim: Size of an action
    :return: The same for so many environments
    """
    if noise is None or (isinstance(noise, SpreadNormalActionNoise) and noise.shape[0] != n_envs):
        # None given, or loaded with another number of environments
        deviations = {} if noise is None else {"low": noise.low, "high": noise.high}
        return SpreadNormalActionNoise(n_envs, action_dim, **deviations)
    if type(noise) is VectorizedActionNoise and noise.n_envs != n_envs:
        return VectorizedActionNoise(noise.base_noise, n_envs)
    return noise


def check_noise(noise: Any, n_envs: int, size: int) -> None:
    """
    :param noise: Whose attributes come from a file
    :param n_envs: Number of environments
    :param size: Size of an action; the noise may be for one environment, until ``learn`` makes one for each of it
    :raises ValueError: If it draws nothing that can be added to actions
    """
    if not isinstance(noise, ActionNoise):
        raise ValueError(f"noise: {str(noise)[:100]!r} is none")
    if isinstance(noise, SpreadNormalActionNoise) and getattr(noise, "shape", None) != (n_envs, size):
        raise ValueError(f"noise: of another shape than {n_envs} actions of size {size}")
    try:
        with preserved_rng():
            tried = copy.deepcopy(noise)
            drawn = [np.asarray(tried(), dtype=np.float64)]
            tried.reset()
            drawn.append(np.asarray(tried(), dtype=np.float64))
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError) as error:
        raise ValueError(f"noise: it draws nothing: {error!r}") from None
    if any(each.size not in (size, size * n_envs) or not np.isfinite(each).all() for each in drawn):
        raise ValueError(f"noise: what it draws is no noise for {n_envs} actions")
