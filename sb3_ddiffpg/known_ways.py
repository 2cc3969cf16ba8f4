"""Which running episodes have come along the way of a mode."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

NO_WAY = -1
#: Equal parts of a way, and the share of them in which an episode must have been to have come along it
N_PARTS, SHARE_GONE = 10, 0.8


@dataclass(frozen=True)
class Way:
    """
    Where the trajectories of a mode go.

    :param number: The mode's number, which nothing changes
    :param paths: Resampled to equal distances, shape [K, n_points, dim]
    :param radius: How far from them is on the way still, in their unit
    """

    number: int
    paths: np.ndarray
    radius: float

    @property
    def points(self) -> np.ndarray:
        """All of them, shape [K * n_points, dim]"""
        return self.paths.reshape(-1, self.paths.shape[-1])


class KnownWays:
    """
    Follows the running episodes along the ways of the modes.

    :param n_envs: Number of environments
    """

    def __init__(self, n_envs: int) -> None:
        self.n_envs = n_envs
        self.ways: list[Way] = []
        self._trees: list[cKDTree] = []
        self._corners: list[np.ndarray] = []
        self._been = np.zeros((0, n_envs), dtype=np.int64)  # a bit for each part of a way
        #: Number of the way that a running episode has come along, ``NO_WAY`` for none, shape [n_envs]
        self.followed = np.full(n_envs, NO_WAY, dtype=np.int32)

    def numbers(self) -> list[int]:
        """
        :return: Of the ways that are known
        """
        return [way.number for way in self.ways]

    def include(self, numbers: np.ndarray) -> np.ndarray:
        """
        :param numbers: Of ways, any shape
        :return: Which of them are known, same shape
        """
        return np.isin(numbers, self.numbers())

    def replace(self, ways: Sequence[Way]) -> None:
        """
        :param ways: The ways that are known from now on. Where the running episodes have been must be told again
        """
        # Counted from a corner at 1: where numbers next to 0 are rounded to 0 (``set_flush_denormal``), a tree whose points
        # have zeros splits for ever and takes the process with it
        self._corners = [way.points.min(axis=0) - 1.0 for way in ways]
        self._trees = [cKDTree(way.points - corner) for way, corner in zip(ways, self._corners, strict=True)]
        self.ways = list(ways)
        self._been = np.zeros((len(ways), self.n_envs), dtype=np.int64)
        self.followed = np.full(self.n_envs, NO_WAY, dtype=np.int32)

    def observe(self, envs: np.ndarray, positions: np.ndarray) -> None:
        """
        :param envs: Environments whose episodes have gone on, each any number of times, shape [N]
        :param positions: Where to, shape [N, dim]
        """
        for been, tree, corner, way in zip(self._been, self._trees, self._corners, self.ways, strict=True):
            n_points = way.paths.shape[1]
            n_parts = min(N_PARTS, n_points)
            distances, nearest = tree.query(positions - corner, distance_upper_bound=way.radius)
            near = np.isfinite(distances)
            np.bitwise_or.at(been, envs[near], 1 << (nearest[near] % n_points * n_parts // n_points))
            came = (self.followed == NO_WAY) & (np.bitwise_count(been) >= SHARE_GONE * n_parts)
            self.followed[came] = way.number

    def forget(self, env: int) -> None:
        """
        :param env: Environment whose episode has ended
        """
        self._been[:, env] = 0
        self.followed[env] = NO_WAY
