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
    cell_size: float
    keys: np.ndarray
    visits: np.ndarray
    coverage: np.ndarray


class VisitMap:
    """
    Counts visits of cells of a grid without bounds.

    :param dim: Number of coordinates, at most 3
    :param cell_size: Edge of a cell, in their unit
    :raises ValueError: If an argument is out of its range
    """

    def __init__(self, dim: int, cell_size: float) -> None:
        if not 1 <= dim <= 3:
            raise ValueError(f"dim must be 1 to 3, got {dim}")
        if not cell_size > 0:
            raise ValueError(f"cell_size must be positive, got {cell_size}")
        self.dim, self.cell_size = dim, cell_size
        self._counts: Counter[int] = Counter()
        #: Environment steps and known cells, from time to time; while nothing new is found, when that began and the latest
        self.coverage: list[tuple[int, int]] = []

    def __len__(self) -> int:
        """Number of known cells."""
        return len(self._counts)

    def observe(self, positions: np.ndarray) -> None:
        """
        :param positions: Shape [N, dim]
        """
        cells = np.clip(np.floor(positions / self.cell_size), -_OFFSET, _OFFSET - 1).astype(np.int64) + _OFFSET
        keys = cells[:, 0]
        for axis in range(1, self.dim):
            keys = (keys << _BITS) | cells[:, axis]
        self._counts.update(keys.tolist())

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
        return (np.stack(parts, axis=1) - _OFFSET + 0.5) * self.cell_size, visits

    def state_dict(self) -> dict[str, Any]:
        """
        :return: All that it knows, for ``from_state``
        """
        return {
            "dim": self.dim,
            "cell_size": float(self.cell_size),
            "keys": np.fromiter(self._counts.keys(), dtype=np.int64, count=len(self)),
            "visits": np.fromiter(self._counts.values(), dtype=np.int64, count=len(self)),
            "coverage": np.array(self.coverage, dtype=np.int64).reshape(-1, 2),
        }

    @classmethod
    def from_state(cls, state: Any) -> "VisitMap":
        """
        :param state: What ``state_dict`` gave
        :return: A map that knows the same
        :raises ValueError: If it is something else
        """
        known = convert(state, _State, "visits")
        made = cls(known.dim, known.cell_size)
        check_array(known.keys, np.int64, [None], "visits.keys")
        check_array(known.visits, np.int64, known.keys.shape, "visits.visits")
        check_array(known.coverage, np.int64, [None, 2], "visits.coverage")
        if (known.keys < 0).any() or (known.keys >> (_BITS * known.dim)).any() or (known.visits < 1).any():
            raise ValueError("visits: there are cells or counts that cannot be")
        made.restore(known.keys, known.visits, known.coverage)
        return made

    def restore(self, keys: np.ndarray, visits: np.ndarray, coverage: np.ndarray) -> None:
        """
        :param keys: Of cells, as ``state_dict`` gives them, shape [N]
        :param visits: Of each, shape [N]
        :param coverage: Steps and known cells, from time to time, shape [K, 2]
        """
        self._counts.update(dict(zip(keys.tolist(), visits.tolist(), strict=True)))
        self.coverage = [(step, cells) for step, cells in coverage.tolist()]
