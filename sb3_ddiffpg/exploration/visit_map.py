"""Where a run has been: visits by cell, and how many cells were known when."""

from collections import Counter
from typing import Any

import msgspec
import numpy as np

from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert

_BITS = 21  # of each coordinate in a key
_OFFSET = 1 << (_BITS - 1)


class _State(msgspec.Struct, forbid_unknown_fields=True):
    dim: int
    cell_size: Any  # a number in version 0.1
    keys: np.ndarray
    visits: np.ndarray
    coverage: np.ndarray
    first: np.ndarray | None = None  # unknown of older files


class VisitMap:
    """
    Counts visits of cells of a grid without bounds.

    :param dim: Number of coordinates, at most 3
    :param cell_size: Edge of a cell, or one for each coordinate, in their unit
    :raises ValueError: If an argument is out of its range
    """

    def __init__(self, dim: int, cell_size: float | np.ndarray) -> None:
        if not 1 <= dim <= 3:
            raise ValueError(f"dim must be 1 to 3, got {dim}")
        #: Edges of a cell, [dim]
        self.cell_size = np.broadcast_to(np.asarray(cell_size, dtype=np.float64), (dim,))
        if not (self.cell_size > 0).all():
            raise ValueError(f"cell_size must be positive, got {cell_size}")
        self.dim = dim
        self._counts: Counter[int] = Counter()
        #: The first position, [dim]: there are the components that have not moved since
        self.first: np.ndarray | None = None
        #: Environment steps and known cells, from time to time; while nothing new is found, when that began and the latest
        self.coverage: list[tuple[int, int]] = []

    def __setstate__(self, state: dict[str, Any]) -> None:  # of version 0.1: a number
        self.__dict__.update(
            state, first=state.get("first"), cell_size=np.broadcast_to(np.float64(state["cell_size"]), (state["dim"],))
        )

    def __len__(self) -> int:
        """Number of known cells."""
        return len(self._counts)

    def observe(self, positions: np.ndarray) -> None:
        """
        :param positions: Shape [N, dim]
        """
        if self.first is None and len(positions):
            self.first = np.array(positions[0], dtype=np.float64)
        self._counts.update(self._keys(positions).tolist())

    def _keys(self, positions: np.ndarray) -> np.ndarray:
        cells = np.clip(np.floor(positions / self.cell_size), -_OFFSET, _OFFSET - 1).astype(np.int64) + _OFFSET
        keys = cells[:, 0]
        for axis in range(1, self.dim):
            keys = (keys << _BITS) | cells[:, axis]
        return keys

    def resize(self, cell_size: np.ndarray) -> None:
        """
        Count in larger cells. Where each visit was is known to one of the cells so far.

        :param cell_size: Edges of a cell, [dim]
        """
        (centres, visits), before = self.cells() if len(self) else (np.empty((0, self.dim)), np.empty(0, int)), len(self)
        self.cell_size = np.asarray(cell_size, dtype=np.float64)
        self._counts = Counter()
        for key, visited in zip(self._keys(centres).tolist(), visits.tolist(), strict=True):
            self._counts[key] += visited
        # As if they had been so large before
        self.coverage = [(step, round(known * len(self) / before)) for step, known in self.coverage] if before else []

    def note(self, step: int) -> None:
        """
        :param step: Environment steps so far
        """
        latest = [known for _, known in self.coverage[-2:]]
        if latest == [len(self)] * 2:
            self.coverage.pop()
        self.coverage.append((step, len(self)))

    def cells(self) -> tuple[np.ndarray, np.ndarray]:
        """
        :return: The cells' centres, shape [number of cells, dim], and their visits
        """
        keys = np.fromiter(self._counts.keys(), dtype=np.int64, count=len(self))
        visits = np.fromiter(self._counts.values(), dtype=np.int64, count=len(self))
        parts = [(keys >> (_BITS * axis)) & ((1 << _BITS) - 1) for axis in reversed(range(self.dim))]
        centres = np.stack(parts, axis=1) - _OFFSET + 0.5
        # A component that has not moved has one cell, without end
        there = np.zeros(self.dim) if self.first is None else self.first
        return np.where(np.isfinite(self.cell_size), centres * self.cell_size, there), visits

    def state_dict(self) -> dict[str, Any]:
        """
        :return: All that it knows, for ``from_state``
        """
        return {
            "dim": self.dim,
            "cell_size": self.cell_size.copy(),
            "keys": np.fromiter(self._counts.keys(), dtype=np.int64, count=len(self)),
            "visits": np.fromiter(self._counts.values(), dtype=np.int64, count=len(self)),
            "coverage": np.array(self.coverage, dtype=np.int64).reshape(-1, 2),
            "first": self.first,
        }

    @classmethod
    def from_state(cls, state: Any) -> "VisitMap":
        """
        :param state: What ``state_dict`` gave
        :return: A map that knows the same
        :raises ValueError: If it is something else
        """
        known = convert(state, _State, "visits")
        if isinstance(known.cell_size, np.ndarray):
            check_array(known.cell_size, np.float64, [known.dim], "visits.cell_size")
        else:
            known.cell_size = convert(known.cell_size, float, "visits.cell_size")
        made = cls(known.dim, known.cell_size)
        check_array(known.keys, np.int64, [None], "visits.keys")
        check_array(known.visits, np.int64, known.keys.shape, "visits.visits")
        check_array(known.coverage, np.int64, [None, 2], "visits.coverage")
        if known.first is not None:
            check_array(known.first, np.float64, [known.dim], "visits.first")
            if not np.isfinite(known.first).all():
                raise ValueError("visits.first: there are numbers that are not finite")
        if (known.keys < 0).any() or (known.keys >> (_BITS * known.dim)).any() or (known.visits < 1).any():
            raise ValueError("visits: there are cells or counts that cannot be")
        made.restore(known.keys, known.visits, known.coverage)
        made.first = known.first
        return made

    def restore(self, keys: np.ndarray, visits: np.ndarray, coverage: np.ndarray) -> None:
        """
        :param keys: Of cells, as ``state_dict`` gives them, shape [N]
        :param visits: Of each, shape [N]
        :param coverage: Steps and known cells, from time to time, shape [K, 2]
        """
        self._counts.update(dict(zip(keys.tolist(), visits.tolist(), strict=True)))
        self.coverage = [(step, cells) for step, cells in coverage.tolist()]
