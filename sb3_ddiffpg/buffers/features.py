"""The mode features: the part of an observation in which modes differ."""

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_wrapper

from sb3_ddiffpg.buffers.wrapped_features import wrapped_mode_features
from sb3_ddiffpg.utils.vec_envs import env_attribute

# Parts of an image along each side
_IMAGE_PARTS = 4
Observation = np.ndarray | dict[str, np.ndarray]


def declared_mode_features(env: VecEnv) -> Any:
    """
    What an environment itself says about its mode features, as found in the observations of the outermost wrapper.

    :param env: The environments
    :return: Their ``mode_features``, else ``"achieved_goal"`` of a goal environment, else None
    :raises ValueError: If a wrapper has changed the observations so that the declared indices say nothing about them
    """
    declared = env_attribute(env, "mode_features")
    if declared is None:
        is_goal_env = isinstance(env.observation_space, spaces.Dict) and "achieved_goal" in env.observation_space.spaces
        return "achieved_goal" if is_goal_env else None
    declared = wrapped_mode_features(env)
    outer: Any = env.observation_space.shape
    within: Any = env_attribute(env, "observation_space", env.observation_space)
    inner: Any = within.shape
    if isinstance(declared, str) and isinstance(within, spaces.Dict):
        # An entry is where it was, unless its frames are stacked, or it is taken out
        inner = getattr(within.spaces.get(declared), "shape", None)
        spaces_now = env.observation_space.spaces if isinstance(env.observation_space, spaces.Dict) else {}
        outer = getattr(spaces_now.get(declared), "shape", None)
    if callable(declared) or inner == outer:
        return declared
    if not isinstance(declared, str) and unwrap_vec_wrapper(env, VecFrameStack) and len(inner) == len(outer) == 1:
        return np.asarray(declared) + outer[0] - inner[0]  # the newest frame comes last
    raise ValueError(
        f"The environment declares mode_features={declared} of its observations of shape {inner}, but a wrapper made their "
        f"shape {outer}: say with mode_features= where they are now"
    )


def declared_cell_size(env: VecEnv | None, name: str = "cell_size") -> float | None:
    """
    :param env: The environments
    :param name: What to ask for: ``"cell_size"`` of the map of visits, or ``"novelty_cell_size"`` of novelty by visit counts
    :return: The edge of a cell that they declare, None if none
    :raises ValueError: If they declare something else
    """
    declared = None if env is None else env_attribute(env, name)
    if declared is None:
        return None
    try:
        size = float(declared)
    except (TypeError, ValueError):
        size = float("nan")
    if not 0 < size < float("inf"):
        raise ValueError(f"The environment declares {name}={declared!r}: it must be a positive number")
    return size


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
    :param selection: Indices of a flat observation (of a dict the parts one after the other, sorted by key), a key of a dict
        observation, a callable that maps a batch of observations to an array [N, d], or None for the whole observation. Of
        an image the whole is its brightness in 4 x 4 parts
    :raises ValueError: If the selection does not fit the observation space
    """

    def __init__(
        self, observation_space: spaces.Space, selection: Sequence[int] | np.ndarray | str | Callable | None = None
    ) -> None:
        self.dim: int
        self.selection: Any = selection
        self._space = observation_space
        self._indices: th.Tensor | None = None  # the selection, on the device where it was asked for last
        self.whole_observation = selection is None
        if isinstance(selection, str):
            keys = list(observation_space.spaces) if isinstance(observation_space, spaces.Dict) else []
            if selection not in keys:
                raise ValueError(f"mode_features={selection!r} is not a key of the observation; keys: {keys}")
        elif selection is not None and not callable(selection):
            indices = np.asarray(selection)
            size = int(np.prod(observation_space.shape or (1,)))
            if isinstance(observation_space, spaces.Dict):
                size = ModeFeatures(observation_space).dim
            if indices.ndim != 1 or indices.size == 0 or indices.dtype.kind not in "iu":
                raise ValueError(f"mode_features must be a non-empty list of indices, a key or a callable, got {selection!r}")
            if indices.min() < 0 or indices.max() >= size:
                raise ValueError(f"mode_features={indices.tolist()} exceeds the observation's {size} components")
            self.selection = indices
        sample = deepcopy(observation_space).sample()  # an environment may draw from its own space
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
            if isinstance(self.selection, str):
                return observations[self.selection].reshape(len(observations[self.selection]), -1).float()
            spaces_of: Any = self._space
            flat = th.cat([_measured(observations[key], spaces_of[key]) for key in sorted(observations)], dim=1)
        elif self.selection is None:
            flat = _measured(observations, self._space)
        else:
            flat = observations.reshape(len(observations), -1)
        if self.selection is None:
            return flat
        if self._indices is None or self._indices.device != flat.device:
            self._indices = th.as_tensor(self.selection, device=flat.device)
        return flat.index_select(1, self._indices).float()


def _measured(observations: th.Tensor, space: spaces.Space) -> th.Tensor:
    """An observation, or a part of one, as a row of numbers, [N, d]; of an image the brightness of its parts."""
    if is_image_space(space):
        channels_first = is_image_space_channels_first(space)  # type: ignore[arg-type]
        gray = observations.float().mean(dim=1 if channels_first else -1)
        return th.nn.functional.adaptive_avg_pool2d(gray[:, None], _IMAGE_PARTS).flatten(1)
    return observations.reshape(len(observations), -1).float()
