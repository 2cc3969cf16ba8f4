"""What the networks see of an observation."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor

from sb3_ddiffpg.serialization.codec import registered

# Bounds beyond this say "finite", not "this is the range"
LARGEST_USEFUL_BOUND = 1e4


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
        :param observations: Shape [N, *observation_space.shape]
        :return: Shape [N, features_dim]
        """
        flat = super().forward(observations)
        return (flat - self.offset) * self.scale if self.scales else flat


def default_extractor(observation_space: spaces.Space, kwargs: dict[str, Any] | None) -> type[BaseFeaturesExtractor]:
    """
    :param observation_space: Observation space
    :param kwargs: Keyword arguments of the extractor
    :return: What flattens observations, or combines those of a dict
    """
    if isinstance(observation_space, spaces.Dict):
        return CombinedExtractor
    return ScaledFlattenExtractor if kwargs else FlattenExtractor
