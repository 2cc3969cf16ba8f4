"""What an update is given: one batch, split evenly over the exploratory group and the modes."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch as th


@dataclass(frozen=True)
class VisitedSteps:
    """
    Steps of windows of consecutive rows, for the exploration bonus. ``present`` [G, n, n_steps] says which there are, N of
    them. Observations and next observations (tensors [N, ...] or dicts of such) are not normalised; ``positions`` and
    ``next_positions`` [N, dim] are their mode features. ``first_visits`` and ``followed`` [N] are what the bonus has noted.


    No tuple: what networks are given of a batch are its tensors, and none of these.
    """

    present: np.ndarray
    observations: Any
    next_observations: Any
    positions: th.Tensor
    next_positions: th.Tensor
    first_visits: np.ndarray
    followed: np.ndarray


class ModeBatch(NamedTuple):
    """
    One batch, split evenly over G groups: the exploratory one first, then every mode. N = G * n rows, group by group.

    Observations are [N, ...] (or dicts of such), ``actions``, ``target_actions`` [G, n, k * action_dim], those of k steps one
    after the other, of which ``executed``, of the same shape, says which there were (None: all), ``rewards`` and ``discounts``
    [G, n]. ``active`` [G] is False for a mode without any transition, whose rows are a stand-in that must not train it.
    ``imitated`` [G, n] is False for these and for steps of off-mode successes, which the policy must not learn.
    ``new_routes`` [n] are the exploratory group's returns from goals reached by routes of which a mode has not its fill.
    ``rows`` [G, n] say where in the buffer the transitions lie, ``chunks`` [G, n, k] where those of all k steps do, -1 where
    the episode was over (None: k is 1), ``dormant`` which groups are not active, ``visited`` what novelty is paid for,
    ``relabelled`` [G, n] which of them were given another goal (None: none).
    """

    observations: Any
    actions: th.Tensor
    target_actions: th.Tensor
    next_observations: Any
    rewards: th.Tensor
    discounts: th.Tensor
    active: th.Tensor
    imitated: th.Tensor
    new_routes: th.Tensor
    rows: np.ndarray
    dormant: list[int]
    visited: VisitedSteps
    relabelled: np.ndarray | None = None
    chunks: np.ndarray | None = None
    executed: th.Tensor | None = None
