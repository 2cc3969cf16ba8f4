"""What the modes know: the cells where they go, and which episodes have come along their routes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch as th
from scipy.spatial import cKDTree

from sb3_ddiffpg.exploration.novelty import TABLE_SIZE, CellTable

NO_ROUTE = -1
#: Equal parts of a route, and the share of them in which an episode must have been to have come along it
N_PARTS, SHARE_GONE = 10, 0.8


@dataclass(frozen=True)
class KnownRoute:
    """
    Where the trajectories of a mode go.

    :param number: The mode's number, which nothing changes
    :param paths: Resampled to equal distances, shape [K, n_points, dim]
    :param radius: How far from them is on the route still, in their unit
    """

    number: int
    paths: np.ndarray
    radius: float

    @property
    def n_parts(self) -> int:
        """Of the route."""
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
        :return: The part of the route that each is in, as a bit; 0 for none, shape [N]
        """
        distances, nearest = self._tree.query(positions - self._corner, distance_upper_bound=self.radius)
        n_points = self.paths.shape[1]
        bits = np.int64(1) << (nearest % n_points * self.n_parts // n_points)
        return np.where(np.isfinite(distances), bits, 0)

    def is_gone(self, been: np.ndarray) -> np.ndarray:
        """
        :param been: Bits of the parts that episodes have been in, any shape
        :return: Whether they have come along the route, same shape
        """
        return np.bitwise_count(been) >= SHARE_GONE * self.n_parts


def come_along(routes: Sequence[KnownRoute], positions: np.ndarray) -> np.ndarray:
    """
    :param routes: Which an episode may have come along
    :param positions: The whole episode, shape [N, dim]
    :return: Number of the route that it had come along by then, the first if several, ``NO_ROUTE`` for none, shape [N]
    """
    followed = np.full(len(positions), NO_ROUTE, dtype=np.int32)
    gone = [route.is_gone(np.bitwise_or.accumulate(route.parts(positions))) for route in routes]
    starts = [int(each.argmax()) if each.any() else len(positions) for each in gone]
    if starts:
        first = int(np.argmin(starts))
        followed[starts[first] :] = routes[first].number
    return followed


class KnownRoutes:
    """
    Follows the running episodes along the routes of the modes.

    :param n_envs: Number of environments
    """

    def __init__(self, n_envs: int) -> None:
        self.n_envs = n_envs
        self.routes: list[KnownRoute] = []
        self._been = np.zeros((0, n_envs), dtype=np.int64)  # a bit for each part of a route
        #: Number of the route that a running episode has come along, ``NO_ROUTE`` for none, shape [n_envs]
        self.followed = np.full(n_envs, NO_ROUTE, dtype=np.int32)

    def numbers(self) -> list[int]:
        """
        :return: Of the routes that are known
        """
        return [route.number for route in self.routes]

    def include(self, numbers: np.ndarray) -> np.ndarray:
        """
        :param numbers: Of routes, any shape
        :return: Which of them are known, same shape
        """
        return np.isin(numbers, self.numbers())

    def replace(self, routes: Sequence[KnownRoute], remembered: Sequence[int] = ()) -> None:
        """
        :param routes: The routes that are known from now on. Where the running episodes have been must be told again
        :param remembered: Environments whose episodes cannot be told from their beginning: what they have been in of a route
            that was known before, they have been in of what it is now
        """
        kept = list(remembered)
        before = dict(zip(self.numbers(), self._been[:, kept], strict=True))
        followed = np.where(np.isin(self.followed[kept], [route.number for route in routes]), self.followed[kept], NO_ROUTE)
        self.routes = list(routes)
        self._been = np.zeros((len(routes), self.n_envs), dtype=np.int64)
        for been, route in zip(self._been, routes, strict=True):
            been[kept] = before.get(route.number, 0)
        self.followed = np.full(self.n_envs, NO_ROUTE, dtype=np.int32)
        self.followed[kept] = followed

    def observe(self, positions: np.ndarray) -> None:
        """
        :param positions: Reached by one further step of each environment, shape [n_envs, dim]
        """
        for been, route in zip(self._been, self.routes, strict=True):
            been |= route.parts(positions)
            self.followed[(self.followed == NO_ROUTE) & route.is_gone(been)] = route.number

    def replay(self, env: int, positions: np.ndarray) -> None:
        """
        Follow a running episode as ``observe`` would have, step by step.

        :param env: Its environment
        :param positions: All that it has reached, but for what is remembered, shape [length, dim]
        """
        for been, route in zip(self._been, self.routes, strict=True):
            been[env] |= np.bitwise_or.reduce(route.parts(positions))
        if self.followed[env] == NO_ROUTE:
            self.followed[env] = come_along(self.routes, positions)[-1]
        gone = [route.number for been, route in zip(self._been, self.routes, strict=True) if route.is_gone(been[env])]
        if self.followed[env] == NO_ROUTE and gone:
            self.followed[env] = gone[0]

    def remember(self, env: int, been: np.ndarray, followed: int) -> None:
        """
        :param env: Environment whose episode was saved
        :param been: What ``memory`` gave of it
        :param followed: And this
        """
        self._been[:, env] |= been
        self.followed[env] = followed

    def memory(self, env: int) -> tuple[np.ndarray, int]:
        """
        :param env: Environment
        :return: Parts of each route in which its episode has been, as bits, shape [number of routes], and what it has followed
        """
        return self._been[:, env].copy(), int(self.followed[env])

    def forget(self, env: int) -> None:
        """
        :param env: Environment whose episode has ended
        """
        self._been[:, env] = 0
        self.followed[env] = NO_ROUTE


class KnownCells(CellTable):
    """
    The cells where modes go that know their route.

    :param edge: Of a cell, in the unit of the positions, until ``resize`` says others
    """

    known: th.Tensor

    def __init__(self, edge: float = 1.0) -> None:
        super().__init__(edge, "known", th.zeros(TABLE_SIZE, dtype=th.bool))
        #: Entries of the cells of each mode, by its number
        self.by_mode: dict[int, np.ndarray] = {}
        #: Whether any cell is known; asking the table would wait for the device
        self.any = False

    def resize(self, edges: np.ndarray) -> None:
        """
        Forget all cells: they are others now.

        :param edges: Of a cell along each component, in the unit of the positions, shape [dim]
        """
        super().resize(edges)
        self.by_mode, self.any = {}, False

    def replace(self, positions: dict[int, th.Tensor | None]) -> None:
        """
        :param positions: Numbers of the modes that know their route, and where they go, shape [N, dim]; None: where they went
            before
        """
        # Of a file of version 0.1 it is not known whose they are: they stay until every mode has told its own
        nobodys = self.known.nonzero()[:, 0].cpu().numpy() if self.any and not self.by_mode else np.empty(0, np.int64)
        before = self.by_mode
        self.by_mode = {
            number: before.get(number, nobodys) if each is None else self._entries(each).unique().cpu().numpy()
            for number, each in positions.items()
        }
        self.known.zero_()
        for entries in self.by_mode.values():
            self.known[th.from_numpy(entries).to(self.known.device)] = True
        self.any = any(map(len, self.by_mode.values()))

    def _load_from_state_dict(self, *args: Any) -> None:
        super()._load_from_state_dict(*args)
        self.any = bool(self.known.any())

    def contain(self, positions: th.Tensor) -> th.Tensor:
        """
        :param positions: Shape [N, dim]
        :return: Whether their cells are known, shape [N]
        """
        return self.known[self._entries(positions)]
