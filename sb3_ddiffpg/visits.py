"""Where a run has been: visits by cell, and how many cells were known when."""

from collections import Counter

import numpy as np

_BITS = 21  # of each coordinate in a key
_OFFSET = 1 << (_BITS - 1)


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
        #: Environment steps and known cells, from time to time
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
        self.coverage.append((step, len(self)))

    def cells(self) -> tuple[np.ndarray, np.ndarray]:
        """
        :return: The cells' centres, shape [number of cells, dim], and their visits
        """
        keys = np.fromiter(self._counts.keys(), dtype=np.int64, count=len(self))
        visits = np.fromiter(self._counts.values(), dtype=np.int64, count=len(self))
        parts = [(keys >> (_BITS * axis)) & ((1 << _BITS) - 1) for axis in reversed(range(self.dim))]
        return (np.stack(parts, axis=1) - _OFFSET + 0.5) * self.cell_size, visits
