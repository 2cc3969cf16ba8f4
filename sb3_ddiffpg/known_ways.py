"""Which episodes have come along the way of a mode."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

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
    def n_parts(self) -> int:
        """Of the way."""
        return min(N_PARTS, self.paths.shape[1])

    @cached_property
    def _corner(self) -> np.ndarray:
        # Counted from a corner at 1: where numbers next to 0 are rounded to 0 (``set_flush_denormal``), a tree whose points
        # have zeros splits for ever and takes the process with it
        return self.paths.min(axis=(0, 1)) - 1.0

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree((self.paths - self._corner).reshape(-1, self.paths.shape[-1]))

    def parts(self, positions: np.ndarray) -> np.ndarray:
        """
        :param positions: Shape [N, dim]
        :return: The part of the way that each is in, as a bit; 0 for none, shape [N]
        """
        distances, nearest = self._tree.query(positions - self._corner, distance_upper_bound=self.radius)
        n_points = self.paths.shape[1]
        bits = np.int64(1) << (nearest % n_points * self.n_parts // n_points)
        return np.where(np.isfinite(distances), bits, 0)

    def is_gone(self, been: np.ndarray) -> np.ndarray:
        """
        :param been: Bits of the parts that episodes have been in, any shape
        :return: Whether they have come along the way, same shape
        """
        return np.bitwise_count(been) >= SHARE_GONE * self.n_parts


def come_along(ways: Sequence[Way], positions: np.ndarray) -> np.ndarray:
    """
    :param ways: Which an episode may have come along
    :param positions: The whole episode, shape [N, dim]
    :return: Number of the way that it had come along by then, the first if several, ``NO_WAY`` for none, shape [N]
    """
    followed = np.full(len(positions), NO_WAY, dtype=np.int32)
    gone = [way.is_gone(np.bitwise_or.accumulate(way.parts(positions))) for way in ways]
    starts = [int(each.argmax()) if each.any() else len(positions) for each in gone]
    if starts:
        first = int(np.argmin(starts))
        followed[starts[first] :] = ways[first].number
    return followed


class KnownWays:
    """
    Follows the running episodes along the ways of the modes.

    :param n_envs: Number of environments
    """

    def __init__(self, n_envs: int) -> None:
        self.n_envs = n_envs
        self.ways: list[Way] = []
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
        self.ways = list(ways)
        self._been = np.zeros((len(ways), self.n_envs), dtype=np.int64)
        self.followed = np.full(self.n_envs, NO_WAY, dtype=np.int32)

    def observe(self, envs: np.ndarray, positions: np.ndarray) -> None:
        """
        :param envs: Environments whose episodes have gone on, each any number of times, shape [N]
        :param positions: Where to, shape [N, dim]
        """
        for been, way in zip(self._been, self.ways, strict=True):
            np.bitwise_or.at(been, envs, way.parts(positions))
            self.followed[(self.followed == NO_WAY) & way.is_gone(been)] = way.number

    def forget(self, env: int) -> None:
        """
        :param env: Environment whose episode has ended
        """
        self._been[:, env] = 0
        self.followed[env] = NO_WAY
