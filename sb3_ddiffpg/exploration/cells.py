"""Cells of a grid, by which places are told apart: how large they are follows from where the run has been."""

import warnings

import numpy as np

#: Cells along each component when positions are first measured, by the number of components (from 1, and from 5 on): with
#: twice as many a thousand cells or so, of which a run comes back to each
_CELLS_ALONG = (32, 16, 8, 5, 4)
# Of so many positions the extent is measured between these quantiles: a single jump far away must not blur all places
_LEAST, _QUANTILES = 200, (0.005, 0.995)
# Cells in a sample for each of its positions, from which on (almost) every step is new, and by which (almost) none is
_ALL_NEW, _NONE_NEW = 0.5, 2
# Doublings of the cells until not every step is new, at most
_MOST_DOUBLINGS = 8


class CellGrid:
    """
    A grid without bounds. If no edge is given, the cells of each component are a part of its extent, whatever its unit. They
    double when it does, so that they settle, and two cells that were one stay one.

    :param dim: Number of components of a position
    :param edge: Of all cells, in the unit of the positions; None: it follows from what is seen
    :raises ValueError: If it is not positive
    """

    def __init__(self, dim: int, edge: float | None = None) -> None:
        if edge is not None and not 0 < edge < np.inf:
            raise ValueError(f"novelty.kwargs['cell_size'] must be positive, got {edge}")
        self.dim, self.adapts = dim, edge is None
        #: Of each component, [dim]; None until enough has been seen. Infinite where nothing has moved
        self.edges: np.ndarray | None = None if edge is None else np.full(dim, edge, dtype=np.float64)
        self._warned = False

    def fit(self, positions: np.ndarray) -> bool:
        """
        :param positions: From all over where the run has been, shape [N, dim]
        :return: Whether the cells are others now
        """
        if len(positions) < _LEAST:
            return False
        before = self.edges
        if self.adapts:
            self.edges = self._grown(_extents(positions))
            for _ in range(_MOST_DOUBLINGS):
                if self.count(positions) <= _ALL_NEW * len(positions):
                    break
                self.edges = 2 * self.edges
        self._say_if_useless(positions)
        return before is None or self.edges is None or not np.array_equal(before, self.edges)

    def _grown(self, extents: np.ndarray) -> np.ndarray:
        """Edges for such extents, [dim]: those of now, doubled as often as it takes."""
        along = _CELLS_ALONG[min(self.dim, len(_CELLS_ALONG)) - 1]
        wanted = np.where(extents > 0, extents / along, np.inf)
        if self.edges is None:
            return wanted
        with np.errstate(invalid="ignore"):
            ratios = wanted / self.edges  # from 2 on it is worth it
            doublings = np.floor(np.log2(np.where(ratios > 1, ratios, 1.0)))
        known = np.isfinite(self.edges)
        grown = np.where(np.isfinite(wanted) & known, self.edges * 2.0 ** np.where(known, doublings, 0.0), self.edges)
        return np.where(known, grown, wanted)  # what has not moved before is measured anew

    def cells(self, positions: np.ndarray) -> np.ndarray:
        """
        :param positions: Shape [N, dim]
        :return: Numbers of their cells along each component, shape [N, dim]
        """
        assert self.edges is not None, "the cells have no size yet"
        return np.floor(positions / self.edges).astype(np.int64)

    def count(self, positions: np.ndarray) -> int:
        """
        :param positions: Shape [N, dim]
        :return: Number of different cells that they are in
        """
        return len(np.unique(self.cells(positions), axis=0))

    def _say_if_useless(self, positions: np.ndarray) -> None:
        count = self.count(positions)
        if self._warned or _NONE_NEW < count <= _ALL_NEW * len(positions):
            return
        self._warned = True
        what, least = ("almost every step is new", "fewer") if count > _NONE_NEW else ("almost no step is new", "other")
        size = "" if self.adapts else f" of novelty.kwargs['cell_size']={self.edges[0]:g}"  # type: ignore[index]
        warnings.warn(
            f"{len(positions)} positions lie in {count} cells{size}: {what}, and novelty says nothing. Name {least} "
            f"mode_features than these {self.dim}" + ("" if self.adapts else ", or leave the cell's size out: it follows")
        )


def _extents(positions: np.ndarray) -> np.ndarray:
    """Of each component, without the rarest positions unless these alone have moved, [dim]."""
    low, high = np.quantile(positions, _QUANTILES, axis=0)
    return np.where(high > low, high - low, np.ptp(positions, axis=0))
