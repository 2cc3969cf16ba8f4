"""
Which wrappers of Gymnasium change observations. Workers are asked whether they have such: neither SB3 nor PyTorch is imported.
"""

from abc import ABC

import gymnasium as gym
from gymnasium import wrappers

#: Of these the observation is that of the environment within, component by component: later, scaled, or of another type
SAME_COMPONENTS = (
    *(wrappers.NormalizeObservation, wrappers.RescaleObservation, wrappers.DtypeObservation, wrappers.ReshapeObservation),
    wrappers.DelayObservation,
)
#: Made to change observations
CHANGES = gym.ObservationWrapper, wrappers.FrameStackObservation, wrappers.MaxAndSkipObservation


class ChangesComponents(ABC):  # noqa: B024
    """The wrappers, by their classes, behind which an index of an observation may mean something else."""

    @classmethod
    def __subclasshook__(cls, kind: type) -> bool:
        """
        :param kind: Of a wrapper
        :return: Whether it is one
        """
        return issubclass(kind, CHANGES) and not issubclass(kind, SAME_COMPONENTS)
