"""The mode features: the part of an observation in which modes differ."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_wrapper

Observation = np.ndarray | dict[str, np.ndarray]


def declared_mode_features(env: VecEnv) -> Any:
    """
    What an environment itself says about its mode features, as found in the observations of the outermost wrapper.

    :param env: The environments
    :return: Their ``mode_features``, else ``"achieved_goal"`` of a goal environment, else None
    :raises ValueError: If a wrapper has changed the observations so that the declared indices say nothing about them
    """
    # Asked first: a worker process would die of an attribute that its environment does not have
    if not env.has_attr("mode_features"):
        is_goal_env = isinstance(env.observation_space, spaces.Dict) and "achieved_goal" in env.observation_space.spaces
        return "achieved_goal" if is_goal_env else None
    declared = env.get_attr("mode_features", indices=0)[0]
    inner: Any = env.get_attr("observation_space", indices=0)[0].shape
    outer: Any = env.observation_space.shape
    if isinstance(declared, str) or callable(declared) or inner == outer:
        return declared
    if unwrap_vec_wrapper(env, VecFrameStack) is not None and len(inner) == len(outer) == 1:
        return np.asarray(declared) + outer[0] - inner[0]  # the newest frame comes last
    raise ValueError(
        f"The environment declares mode_features={declared} of its observations of shape {inner}, but a wrapper made their "
        f"shape {outer}: say with mode_features= where they are now"
    )


def declared_cell_size(env: VecEnv | None, name: str = "cell_size") -> float:
    """
    :param env: The environments
    :param name: What to ask for: ``"cell_size"`` of the map of visits, or ``"novelty_cell_size"`` of novelty by visit counts
    :return: The edge of a cell that they declare, else 0.5
    :raises ValueError: If they declare something else
    """
    if env is None or not env.has_attr(name):
        return 0.5
    declared: Any = env.get_attr(name, indices=0)[0]
    try:
        size = float(declared)
    except (TypeError, ValueError):
        size = float("nan")
    if not 0 < size < float("inf"):
        raise ValueError(f"The environment declares {name}={declared!r}: it must be a positive number")
    return size


def describe_env(env: VecEnv) -> str | None:
    """
    :param env: The environments
    :return: Their specification as JSON, from which ``gymnasium.make`` makes another; None if they have none
    """
    spec = env.get_attr("spec", indices=0)[0] if env.has_attr("spec") else None
    try:
        return None if spec is None else spec.to_json()
    except ValueError:  # arguments that JSON cannot hold
        return None


def same_selection(first: Any, second: Any) -> bool:
    """
    :param first: A selection of mode features
    :param second: Another
    :return: Whether they select the same; callables, which cannot be compared, are taken at their word
    """
    if callable(first) or callable(second):
        return callable(first) and callable(second)
    return bool(np.array_equal(first, second))


class ModeFeatures:
    """
    Selects the part of an observation in which modes differ, usually a position in metres.

    :param observation_space: Observation space of the environment
    :param selection: Indices of a flat observation, a key of a dict observation, a callable that maps a batch of
        observations to an array [N, d], or None for the whole observation
    :raises ValueError: If the selection does not fit the observation space
    """

    def __init__(
        self, observation_space: spaces.Space, selection: Sequence[int] | np.ndarray | str | Callable | None = None
    ) -> None:
        self.selection: Any = selection
        self._indices: th.Tensor | None = None  # the selection, on the device where it was asked for last
        self.whole_observation = selection is None
        if isinstance(selection, str):
            keys = list(observation_space.spaces) if isinstance(observation_space, spaces.Dict) else []
            if selection not in keys:
                raise ValueError(f"mode_features={selection!r} is not a key of the observation; keys: {keys}")
        elif selection is not None and not callable(selection):
            indices = np.asarray(selection)
            if isinstance(observation_space, spaces.Dict):
                raise ValueError("mode_features must be a key or a callable for dict observations, got indices")
            size = int(np.prod(observation_space.shape or (1,)))
            if indices.ndim != 1 or indices.size == 0 or indices.dtype.kind not in "iu":
                raise ValueError(f"mode_features must be a non-empty list of indices, a key or a callable, got {selection!r}")
            if indices.min() < 0 or indices.max() >= size:
                raise ValueError(f"mode_features={indices.tolist()} exceeds the observation's {size} components")
            self.selection = indices
        sample = observation_space.sample()
        batch = {key: value[None] for key, value in sample.items()} if isinstance(sample, dict) else np.asarray(sample)[None]
        features = self(batch)
        if features.ndim != 2 or features.shape[0] != 1:
            raise ValueError(f"mode_features must map N observations to an array [N, d], got shape {features.shape} for N=1")
        self.dim = features.shape[1]

    def __call__(self, observations: Observation) -> np.ndarray:
        """
        :param observations: Batch of N observations
        :return: Shape [N, dim], float32
        """
        if callable(self.selection):
            return np.asarray(self.selection(observations)).astype(np.float32)
        if isinstance(observations, dict):
            return self.of_tensors({key: self._copy(value) for key, value in observations.items()}).numpy()
        return self.of_tensors(self._copy(observations)).numpy()

    @staticmethod
    def _copy(array: np.ndarray) -> th.Tensor:
        """Environments may write into their arrays later, and have other byte orders than torch."""
        return th.from_numpy(np.array(array, dtype=array.dtype.newbyteorder("="), order="C"))

    def of_tensors(self, observations: th.Tensor | dict[str, th.Tensor]) -> th.Tensor:
        """
        The same for tensors, on their device. A callable selects in the main memory.

        :param observations: Batch of N observations
        :return: Shape [N, dim], float32
        """
        if callable(self.selection):
            if isinstance(observations, dict):
                device = next(iter(observations.values())).device
                return th.from_numpy(self({key: value.cpu().numpy() for key, value in observations.items()})).to(device)
            return th.from_numpy(self(observations.cpu().numpy())).to(observations.device)
        if isinstance(observations, dict):
            keys = sorted(observations) if self.selection is None else [self.selection]
            return th.cat([observations[key].reshape(len(observations[key]), -1).float() for key in keys], dim=1)
        flat = observations.reshape(len(observations), -1)
        if self.selection is None:
            return flat.float()
        if self._indices is None or self._indices.device != flat.device:
            self._indices = th.as_tensor(self.selection, device=flat.device)
        return flat.index_select(1, self._indices).float()
