"""What the networks see of an observation."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor
from torch import nn

from sb3_ddiffpg.serialization.codec import registered

# Bounds beyond this say "finite", not "this is the range"
LARGEST_USEFUL_BOUND = 1e4
# Standard deviation of what the networks see: what is spread evenly fills [-3, 3], and in a narrower interval they tell places
# apart less well. And how far from the mean all is the same: one broken number must not decide
SPREAD, FARTHEST = 3**0.5, 10.0
# What is measured of observations
_MEASURED = ("offset", "scale", "is_fixed")


@registered("sb3_ddiffpg.features.ScaledFlattenExtractor")
class ScaledFlattenExtractor(FlattenExtractor):
    """
    Flattens the observation. If told to, maps every component with declared finite bounds to ``[-half_width, half_width]``, so
    that what the networks see does not depend on the unit. In a narrow interval they tell places apart less well; in a wide
    one, what critics learn at one place says little about the next, and explorers may stop.

    :param observation_space: Any space but a dict
    :param half_width: Where the bounds come to lie; None leaves all components as they are
    :raises ValueError: If it is not positive
    """

    offset: th.Tensor
    scale: th.Tensor

    def __init__(self, observation_space: spaces.Space, half_width: float | None = None) -> None:
        if half_width is not None and not (isinstance(half_width, int | float) and 0 < half_width < np.inf):
            raise ValueError(f"features_extractor_kwargs['half_width'] must be positive, finite or None, got {half_width!r}")
        super().__init__(observation_space)
        self.scales = False
        if half_width is None or not isinstance(observation_space, spaces.Box) or is_image_space(observation_space):
            return
        self.scales = True
        low, high = observation_space.low.ravel().astype(np.float64), observation_space.high.ravel().astype(np.float64)
        bounded = (np.abs(low) < LARGEST_USEFUL_BOUND) & (np.abs(high) < LARGEST_USEFUL_BOUND) & (low < high)
        offset, scale = np.zeros(self.features_dim), np.ones(self.features_dim)
        offset[bounded] = (low[bounded] + high[bounded]) / 2
        scale[bounded] = 2 * half_width / (high[bounded] - low[bounded])
        self.register_buffer("offset", th.as_tensor(offset, dtype=th.float32), persistent=False)
        self.register_buffer("scale", th.as_tensor(scale, dtype=th.float32), persistent=False)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: Shape ``[N, *observation_space.shape]``
        :return: Shape [N, features_dim]
        """
        flat = super().forward(observations)
        return (flat - self.offset) * self.scale if self.scales else flat


@registered("sb3_ddiffpg.networks.StandardizedExtractor")
class StandardizedExtractor(FlattenExtractor):
    """
    Flattens the observation, and maps each component so that what has been seen has mean 0 and standard deviation ``SPREAD``:
    what the networks see does not depend on the unit. ``adapt`` says what has been seen; before that,
    and in models of version 0.1, the components are as they are.

    :param observation_space: Any space but a dict
    """

    offset: th.Tensor
    scale: th.Tensor
    is_fixed: th.Tensor

    def __init__(self, observation_space: spaces.Space) -> None:
        super().__init__(observation_space)
        self.register_buffer("offset", th.zeros(self.features_dim))
        self.register_buffer("scale", th.ones(self.features_dim))
        self.register_buffer("is_fixed", th.zeros(()))  # 1: what has been seen changes nothing

    @th.no_grad()
    def adapt(self, observations: th.Tensor) -> None:
        """
        :param observations: From all over where the run has been, shape ``[N, *observation_space.shape]``, N at least 2
        """
        if self.is_fixed > 0:
            return
        flat = super().forward(observations).double()
        size = flat.abs().amax(dim=0)
        deviation = flat.std(dim=0)
        moved = deviation > 1e-6 * size
        # What has not moved yet is measured by its size: it may move later
        scale = th.where(moved, deviation, th.where(size > 0, size, 1.0))
        self.offset.copy_(flat.mean(dim=0))
        self.scale.copy_(SPREAD / scale)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: Shape ``[N, *observation_space.shape]``
        :return: Shape [N, features_dim], within 10 of 0
        """
        return ((super().forward(observations) - self.offset) * self.scale).clamp(-FARTHEST, FARTHEST)

    def as_it_is(self) -> dict[str, th.Tensor]:
        """
        :return: The state of one that leaves the components as they are, for good
        """
        return {
            "offset": th.zeros_like(self.offset),
            "scale": th.ones_like(self.scale),
            "is_fixed": th.ones_like(self.is_fixed),
        }

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        if not any(f"{prefix}{name}" in state_dict for name in _MEASURED):  # of version 0.1
            state_dict.update({f"{prefix}{name}": each for name, each in self.as_it_is().items()})
        super()._load_from_state_dict(state_dict, prefix, *args)


@registered("sb3_ddiffpg.networks.StandardizedCombinedExtractor")
class StandardizedCombinedExtractor(CombinedExtractor):
    """
    SB3's for observations that are dicts, of which the vectors go through a ``StandardizedExtractor`` each.

    :param observation_space: A dict
    :param kwargs: Of ``CombinedExtractor``
    """

    def __init__(self, observation_space: spaces.Dict, **kwargs: Any) -> None:
        super().__init__(observation_space, **kwargs)
        for key, space in observation_space.spaces.items():
            if _is_measured(space):
                self.extractors[key] = StandardizedExtractor(space)


def _is_measured(space: spaces.Space) -> bool:
    """Whether it holds numbers with a unit."""
    return isinstance(space, spaces.Box) and not is_image_space(space)


def unknown_to_0_1(networks: nn.Module) -> dict[str, th.Tensor]:
    """
    :param networks: Networks
    :return: Of their state dict what version 0.1 had not, as it is for networks of its files
    """
    extractors = [(name, each) for name, each in networks.named_modules() if isinstance(each, StandardizedExtractor)]
    return {f"{name}.{key}": value for name, each in extractors for key, value in each.as_it_is().items()}


def adapt_extractors(networks: nn.Module, observations: Any) -> None:
    """
    :param networks: All extractors in them are told what has been seen
    :param observations: As an extractor takes them: a tensor [N, ...], or a dict of such
    """
    for module in networks.modules():
        if isinstance(module, StandardizedCombinedExtractor):
            for key, extractor in module.extractors.items():
                if isinstance(extractor, StandardizedExtractor):
                    extractor.adapt(observations[key])
        elif isinstance(module, StandardizedExtractor) and isinstance(observations, th.Tensor):
            module.adapt(observations)


def default_extractor(observation_space: spaces.Space, kwargs: dict[str, Any] | None) -> type[BaseFeaturesExtractor]:
    """
    :param observation_space: Observation space
    :param kwargs: Keyword arguments of the extractor
    :return: What flattens observations, or combines the parts of a dict, of which images go through a convolution; numbers
        with a unit are standardised
    """
    if isinstance(observation_space, spaces.Dict):
        return StandardizedCombinedExtractor
    if kwargs:
        return ScaledFlattenExtractor
    return StandardizedExtractor if _is_measured(observation_space) else FlattenExtractor
