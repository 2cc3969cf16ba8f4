"""The unit in which critics learn values: it follows the returns that are met, so that nobody need know them before."""

from typing import Any

import msgspec
import numpy as np
import torch as th

from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.serialization.safetensors_tree import Count, convert

# Of the explorers' targets, how much may lie at the upper end of their values; where it is more, the unit grows by this factor
_MOST_AT_TOP, _GROWTH = 0.02, 1.5
# Updates after which that is asked again: at once the values would lie there still, for they grow with the unit
_SETTLES = 300


class _State(msgspec.Struct, forbid_unknown_fields=True):
    low: float | None
    high: float | None
    novelty_unit: float
    at_top: float
    n_updates: Count


class ValueRange:
    """
    Lets critics represent values in [0, 1]: 0 is the smallest return that was met from any step of any episode, 1 the largest.
    When a new one is met, the unit grows. All values change with it by the same factor and term, so that the better action
    stays the better one. Values of novelty have a unit of their own, which grows when they reach its end.

    The idea is that of PopArt (van Hasselt et al., 2016) and of scaling rewards by the returns (Lee et al., 2025).

    :param adapts: False: values are what they are; which were met is noted all the same
    :param notes: False: it is not
    :param novelty_unit: First value of novelty that is 1
    :param most_novelty: The largest value that novelty can have
    """

    def __init__(
        self, adapts: bool, novelty_unit: float = 1.0, most_novelty: float = float("inf"), notes: bool = True
    ) -> None:
        self.adapts, self.notes, self.most_novelty = adapts, notes, most_novelty
        self.novelty_unit = min(novelty_unit, most_novelty)
        self.low: float | None = None
        self.high: float | None = None
        self._at_top, self._n_updates = 0.0, 0

    @property
    def unit(self) -> float:
        """What a value of 1 is more than one of 0; 1 while all returns were the same."""
        if not self.adapts or self.low is None or self.high is None or not self.high > self.low:
            return 1.0
        return self.high - self.low

    @property
    def worst(self) -> float:
        """The smallest return that was met, 0 if none was below: what it is worth to fail for good."""
        return min(0.0, self.low or 0.0)

    @property
    def grows(self) -> bool:
        """Whether values of novelty may be larger yet."""
        return self.adapts and self.novelty_unit < self.most_novelty

    def observe(self, returns: np.ndarray) -> None:
        """
        :param returns: Discounted, from steps of an episode that has ended, shape [length]
        """
        if not self.notes:
            return
        low, high = float(returns.min()), float(returns.max())
        self.low = low if self.low is None else min(low, self.low)
        self.high = high if self.high is None else max(high, self.high)

    def observe_targets(self, share_at_top: float, n_updates: int) -> None:
        """
        :param share_at_top: Of the explorers' targets, how much lay at the upper end of their values
        :param n_updates: In so many updates
        """
        if not self.grows:
            return
        self._at_top += share_at_top * n_updates
        self._n_updates += n_updates
        if self._n_updates < _SETTLES:
            return
        if self._at_top > _MOST_AT_TOP * self._n_updates:
            self.novelty_unit = min(_GROWTH * self.novelty_unit, self.most_novelty)
        self._at_top, self._n_updates = 0.0, 0

    def scaled(self, rewards: th.Tensor, discounts: th.Tensor) -> th.Tensor:
        """
        :param rewards: Of transitions of all groups, the exploratory first; perhaps of several steps each, [G, n]
        :param discounts: What the value after each counts, 0 where there is none, same shape
        :return: With which rewards the critics learn values in [0, 1], same shape
        """
        if not self.adapts:
            return rewards
        low = 0.0 if self.low is None else self.low
        # V = low + unit * v and V = r + discount * V' give v = (r - (1 - discount) * low) / unit + discount * v'
        scaled = (rewards - (1.0 - discounts) * low) / self.unit
        scaled[EXPLORATORY_GROUP] = rewards[EXPLORATORY_GROUP] / self.novelty_unit
        return scaled

    def values(self, values: np.ndarray) -> np.ndarray:
        """
        :param values: As the modes' critics say them, any shape
        :return: As returns, same shape
        """
        return values * self.unit + (self.low or 0.0) if self.adapts else values

    def state_dict(self) -> dict[str, Any]:
        """
        :return: What was met, for ``load_state_dict``
        """
        met = {"low": self.low, "high": self.high, "novelty_unit": self.novelty_unit}
        return {**met, "at_top": self._at_top, "n_updates": self._n_updates}

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: What ``state_dict`` gave
        :raises ValueError: If it is something else
        """
        known = convert(state, _State, "values")
        ends = [each for each in (known.low, known.high) if each is not None]
        are_ends = len(ends) != 1 and ends == sorted(ends)
        finite = np.isfinite([known.novelty_unit, known.at_top, *ends]).all()
        if not (finite and are_ends and known.novelty_unit > 0 and known.at_top >= 0):
            raise ValueError("values: there is a range that cannot be")
        self.low, self.high, self.novelty_unit = known.low, known.high, known.novelty_unit
        self._at_top, self._n_updates = known.at_top, known.n_updates
