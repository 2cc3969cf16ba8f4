"""Which new mode continues which old one, and which is nearest."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from sb3_ddiffpg.clustering.dtw import dtw_distances
from sb3_ddiffpg.clustering.linkage import _check_distances


def assign_to_nearest(
    paths: Sequence[np.ndarray],
    members: Sequence[Sequence[np.ndarray]],
    rng: np.random.Generator | np.random.RandomState,
    n_samples: int = 3,
) -> np.ndarray:
    """
    For each trajectory, most often one that failed, the mode it comes nearest to: the smallest mean DTW distance to a
    few members of the mode, drawn once for all ``paths``.

    :param paths: the trajectories to assign, each of shape ``[length, dims]``
    :param members: for each mode its trajectories
    :param rng: draws the members
    :param n_samples: members drawn per mode, without replacement; all of a mode that has fewer
    :return: int array of shape ``[len(paths)]``, indices into ``members``; of equally near modes the first
    :raises ValueError: if there is no mode, or a mode without members, or ``n_samples`` is less than 1
    """
    if n_samples < 1:
        raise ValueError(f"n_samples must be at least 1, got {n_samples}")
    if len(members) == 0:
        raise ValueError("members is empty: there is no mode to assign to")
    for index, mode in enumerate(members):
        if len(mode) == 0:
            raise ValueError(f"members[{index}] is empty: a mode needs at least one trajectory")
    if len(paths) == 0:
        return np.zeros(0, dtype=np.int64)
    drawn = [rng.choice(len(mode), size=min(n_samples, len(mode)), replace=False) for mode in members]
    samples = [mode[index] for mode, indices in zip(members, drawn, strict=True) for index in indices]
    distances = dtw_distances(paths, samples)
    ends = np.cumsum([len(indices) for indices in drawn])[:-1]
    means = [part.mean(axis=1) for part in np.split(distances, ends, axis=1)]
    return np.argmin(means, axis=0)


@dataclass(frozen=True)
class ModeMatching:
    """
    How the clusters of one clustering continue the modes of the one before.

    :param parents: for each new cluster the old mode whose critic it takes over; None if it shares no trajectory with any
    :param kept: for each new cluster whether it also *is* that mode, with its name and embedding; at most one is
    :param merged: for each old mode that ended, but whose trajectories live on, the new cluster that has most of them
    :param retired: the old modes of which no trajectory is in any new cluster
    """

    parents: list[int | None]
    kept: list[bool]
    merged: dict[int, int]
    retired: list[int]


def match_modes(
    old_labels: np.ndarray, new_labels: np.ndarray, n_old: int, n_new: int, frozen: Sequence[int] = ()
) -> ModeMatching:
    """
    Match new clusters to old modes by the trajectories they share: one to one, such that the matched pairs share as
    many as possible. Among equally good matchings the one that pairs low indices with low indices is taken.

    :param old_labels: mode of each trajectory before, shape ``[n]``, from -1 (none) to ``n_old - 1``
    :param new_labels: cluster of the same trajectories now, shape ``[n]``, from -1 (none) to ``n_new - 1``
    :param n_old: number of old modes
    :param n_new: number of new clusters
    :param frozen: old modes that come before all others: each is kept if it shares a trajectory with any cluster
    :return: who continues whom; every old mode is kept once, merged or retired
    :raises ValueError: if the labels differ in shape or lie outside their range
    """
    old_labels = _check_labels(old_labels, n_old, "old_labels")
    new_labels = _check_labels(new_labels, n_new, "new_labels")
    if old_labels.shape != new_labels.shape:
        raise ValueError(f"old_labels and new_labels must have one shape, got {old_labels.shape} and {new_labels.shape}")
    both = (old_labels >= 0) & (new_labels >= 0)
    overlap = np.zeros((n_old, n_new), dtype=np.int64)
    np.add.at(overlap, (old_labels[both], new_labels[both]), 1)
    # Small enough in sum never to outweigh one trajectory, and largest for low with low: it decides ties only.
    preference = np.outer(np.arange(n_old, 0, -1), np.arange(n_new, 0, -1))
    weight = overlap * (n_old * n_new * min(n_old, n_new) + 1) + preference * (overlap > 0)
    weight[list(frozen)] += (overlap[list(frozen)] > 0) * (weight.sum() + 1)
    successor = {
        int(old): int(new)
        for old, new in zip(*linear_sum_assignment(weight, maximize=True), strict=True)
        if overlap[old, new] > 0
    }
    predecessor = {new: old for old, new in successor.items()}
    parents: list[int | None] = []
    for new in range(n_new):
        shares = overlap[:, new]
        parents.append(predecessor.get(new, int(shares.argmax()) if shares.any() else None))
    ended = [old for old in range(n_old) if old not in successor]
    return ModeMatching(
        parents=parents,
        kept=[new in predecessor for new in range(n_new)],
        merged={old: int(overlap[old].argmax()) for old in ended if overlap[old].any()},
        retired=[old for old in ended if not overlap[old].any()],
    )


def medoid(distances: np.ndarray) -> int:
    """
    The most central trajectory of a group.

    :param distances: matrix of shape ``[n, n]`` with ``n`` at least 1, as in :func:`cluster`
    :return: index of the member whose mean distance to the others is smallest, the first of several
    :raises ValueError: if the matrix is empty or not one of distances
    """
    distances = _check_distances(distances)
    if len(distances) == 0:
        raise ValueError("distances is empty: a medoid needs at least one member")
    return int(distances.mean(axis=1).argmin())


def _check_labels(labels: np.ndarray, n_modes: int, name: str) -> np.ndarray:
    labels = np.asarray(labels)
    if labels.ndim != 1:
        raise ValueError(f"{name} must be one-dimensional, got shape {labels.shape}")
    if labels.size and (labels.min() < -1 or labels.max() >= n_modes):
        raise ValueError(f"{name} must lie between -1 and {n_modes - 1}, got {labels.min()} to {labels.max()}")
    return labels.astype(np.int64)
