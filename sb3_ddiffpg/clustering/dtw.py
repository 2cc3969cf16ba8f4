"""Dynamic time warping between many trajectories at once, and resampling of one trajectory by arc length."""

from collections.abc import Sequence

import numba
import numpy as np

from sb3_ddiffpg.clustering.paths import _check_path

# Pairs that share one pass of the recursion: one path against this many others, side by side in the vector registers.
# Measured against 32 and 64: as fast on short paths, faster on long ones (the rows stay in cache), and fewer idle lanes.
LANES = 16

# Infinity marks the border of the warping table, so "ninf" must stay out; inputs are checked, so there is no NaN to keep.
_FLOAT_FLAGS = {"contract", "nnan", "nsz"}


def dtw_distances(
    paths_a: Sequence[np.ndarray], paths_b: Sequence[np.ndarray] | None = None, normalize: bool = True
) -> np.ndarray:
    """
    Dynamic-time-warping distances between trajectories of any lengths,

    .. math:: d(a, b) = \\sqrt{\\min_w \\sum_{(i, j) \\in w} \\lVert a_i - b_j \\rVert^2},

    over all monotone alignments ``w`` that match first with first and last with last point.

    :param paths_a: trajectories, each of shape ``[length, dims]`` with length at least 1 and one ``dims`` for all
    :param paths_b: the trajectories to compare with; None compares ``paths_a`` with itself, at half the work
    :param normalize: divide each distance by the square root of the longer length: about the root mean square of the
        gap between aligned points, in the unit of the features, whatever the episode's length
    :return: float32 array of shape ``[len(paths_a), len(paths_b)]``; with ``paths_b=None`` a symmetric one, zero on the
        diagonal. A pair's value depends on that pair alone, not on what it was computed with.
    :raises ValueError: if a path has another shape, no points, or values that are not finite in float32, or if a distance
        is not
    """
    rows = _check_paths(paths_a, "paths_a")
    if paths_b is None:
        distances = _symmetric(rows)
        columns = rows
    else:
        columns = _check_paths(paths_b, "paths_b")
        _check_dims(rows, columns)
        # The longer list fills the lanes: three paths against a thousand would leave most of them idle.
        distances = _rectangle(rows, columns) if len(columns) >= len(rows) else _rectangle(columns, rows).T
    if not np.isfinite(distances).all():
        raise ValueError("paths_a, paths_b: there are paths farther apart than float32 can tell")
    if normalize and distances.size:
        longest = np.maximum.outer(_lengths(rows), _lengths(columns))
        distances = distances / np.sqrt(longest.astype(np.float32))
    return np.ascontiguousarray(distances, dtype=np.float32)


def _symmetric(paths: list[np.ndarray]) -> np.ndarray:
    """Un-normalised distances within one list: each block of lanes meets only the paths sorted up to its own end."""
    order, blocks = _pack(paths)
    points, starts, lengths = _flatten([paths[index] for index in order])
    sorted_distances = np.zeros((len(paths), len(paths)), dtype=np.float32)
    for first, block, lane_lengths in blocks:
        stop = first + len(lane_lengths)
        sorted_distances[:stop, first:stop] = _align(points, starts[:stop], lengths[:stop], block, lane_lengths)
    lower = np.tril_indices(len(paths), k=-1)
    sorted_distances[lower] = sorted_distances.T[lower]
    distances = np.empty_like(sorted_distances)
    distances[np.ix_(order, order)] = sorted_distances
    return distances


def _rectangle(rows: list[np.ndarray], columns: list[np.ndarray]) -> np.ndarray:
    """Un-normalised distances between two lists, ``columns`` in the lanes."""
    distances = np.empty((len(rows), len(columns)), dtype=np.float32)
    if not rows:
        return distances
    order, blocks = _pack(columns)
    points, starts, lengths = _flatten(rows)
    for first, block, lane_lengths in blocks:
        lanes = order[first : first + len(lane_lengths)]
        distances[:, lanes] = _align(points, starts, lengths, block, lane_lengths)
    return distances


def _pack(paths: list[np.ndarray]) -> tuple[np.ndarray, list[tuple[int, np.ndarray, np.ndarray]]]:
    """
    Lay paths of similar length side by side, so that neighbouring lanes are neighbours in memory.

    :return: the order by length, and per block: its first position in that order, the points ``[dims, length * LANES]``
        padded with zeros to the longest of the block, and the paths' own lengths
    """
    lengths = _lengths(paths)
    order = np.argsort(lengths, kind="stable")
    blocks = []
    for first in range(0, len(paths), LANES):
        members = order[first : first + LANES]
        block = np.zeros((_padded_dims(paths), lengths[members[-1]], LANES), dtype=np.float32)
        for lane, index in enumerate(members):
            dims = paths[index].shape[1]
            block[:dims, : lengths[index], lane] = paths[index].T
        blocks.append((first, block.reshape(len(block), -1), lengths[members]))
    return order, blocks


def _flatten(paths: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All points below one another, with each path's first row and length."""
    lengths = _lengths(paths)
    # One row more than there are points: the recursion reads two at a time, also at the end of an odd path.
    points = np.zeros((lengths.sum() + 1, _padded_dims(paths)), dtype=np.float32)
    if paths:
        points[:-1, : paths[0].shape[1]] = np.concatenate(paths)
    return points, np.cumsum(lengths) - lengths, lengths


def _padded_dims(paths: list[np.ndarray]) -> int:
    """The recursion takes two coordinates itself; a path on a line gets a second one that is zero."""
    return max(2, paths[0].shape[1]) if paths else 2


def _lengths(paths: list[np.ndarray]) -> np.ndarray:
    return np.array([len(path) for path in paths], dtype=np.int64)


def _check_paths(paths: Sequence[np.ndarray], name: str) -> list[np.ndarray]:
    checked = [_check_path(path, f"{name}[{index}]").astype(np.float32) for index, path in enumerate(paths)]
    for index, path in enumerate(checked):
        if path.shape[1] != checked[0].shape[1]:
            raise ValueError(f"{name}[{index}] has {path.shape[1]} dims where {name}[0] has {checked[0].shape[1]}")
    return checked


def _check_dims(rows: list[np.ndarray], columns: list[np.ndarray]) -> None:
    if rows and columns and rows[0].shape[1] != columns[0].shape[1]:
        raise ValueError(f"paths_a have {rows[0].shape[1]} dims and paths_b {columns[0].shape[1]}: they must agree")


@numba.njit(cache=True, nogil=True, fastmath=_FLOAT_FLAGS, error_model="numpy")
def _add_squares(first: float, second: float, column: np.ndarray, cost_first: np.ndarray, cost_second: np.ndarray) -> None:
    """Add one coordinate's squared gaps, from two points of the row path to every point of every lane."""
    for k in range(column.size):
        gap_first = first - column[k]
        gap_second = second - column[k]
        cost_first[k] += gap_first * gap_first
        cost_second[k] += gap_second * gap_second


@numba.njit(cache=True, nogil=True, fastmath=_FLOAT_FLAGS, error_model="numpy")
def _advance(
    points: np.ndarray,
    block: np.ndarray,
    cost_first: np.ndarray,
    cost_second: np.ndarray,
    above: np.ndarray,
    middle: np.ndarray,
    below: np.ndarray,
) -> None:
    """
    Two rows of the warping table for all lanes: ``middle`` and ``below`` from ``above``, and from their own left
    neighbours, which lie ``LANES`` places earlier. So the loop is one flat run that the compiler turns into vector
    instructions, and two rows at a time read the block once instead of twice.

    :param points: the row path's two points, ``[2, dims]``
    :param block: points of the lanes, ``[dims, length * LANES]``
    :param cost_first: squared gaps of the coordinates from the third on, to the first of the two points
    :param cost_second: the same, to the second
    :param above: the row before, ``[LANES + length * LANES]``, the first ``LANES`` being the border
    :param middle: the first point's row, filled here
    :param below: the second point's row, filled here
    """
    # Scalars, because the compiler cannot know that writing to the rows leaves ``points`` as it is.
    x_first, y_first, x_second, y_second = points[0, 0], points[0, 1], points[1, 0], points[1, 1]
    x_lanes, y_lanes = block[0], block[1]
    for k in range(x_lanes.size):
        x, y = x_lanes[k], y_lanes[k]
        left = middle[k]
        cost = cost_first[k] + (x_first - x) * (x_first - x) + (y_first - y) * (y_first - y)
        value = cost + min(min(above[k], above[k + LANES]), left)
        middle[k + LANES] = value
        cost = cost_second[k] + (x_second - x) * (x_second - x) + (y_second - y) * (y_second - y)
        below[k + LANES] = cost + min(min(left, value), below[k])


@numba.njit(cache=True, nogil=True)
def _align(
    points: np.ndarray, starts: np.ndarray, lengths: np.ndarray, block: np.ndarray, lane_lengths: np.ndarray
) -> np.ndarray:
    """
    Distances of every row path to every lane of one block.

    :param points: all row paths below one another, as :func:`_flatten` lays them
    :param starts: first point of each row path, ``[n_rows]``
    :param lengths: number of points of each row path, even or odd
    :param block: points of the lanes, ``[dims, length * LANES]``
    :param lane_lengths: number of points of each lane in use, ``[n_lanes]``
    :return: ``[n_rows, n_lanes]``
    """
    distances = np.empty((starts.size, lane_lengths.size), dtype=np.float32)
    width = block.shape[1]
    # Five allocations, not one cut up: the compiler vectorises only over arrays that it can tell apart.
    above = np.empty(width + LANES, dtype=np.float32)
    middle = np.empty(width + LANES, dtype=np.float32)
    below = np.empty(width + LANES, dtype=np.float32)
    cost_first = np.zeros(width, dtype=np.float32)
    cost_second = np.zeros(width, dtype=np.float32)
    for row in range(starts.size):
        above[:] = np.inf
        above[:LANES] = 0.0
        for start in range(starts[row], starts[row] + lengths[row], 2):
            middle[:LANES] = np.inf
            below[:LANES] = np.inf
            if block.shape[0] > 2:
                cost_first[:] = 0.0
                cost_second[:] = 0.0
            for dim in range(2, block.shape[0]):
                _add_squares(points[start, dim], points[start + 1, dim], block[dim], cost_first, cost_second)
            _advance(points[start : start + 2], block, cost_first, cost_second, above, middle, below)
            above, below = below, above
        # A path of odd length ends in the first of the last two rows; what the second one held does not matter.
        last = middle if lengths[row] % 2 else above
        for lane in range(lane_lengths.size):
            distances[row, lane] = np.sqrt(last[lane_lengths[lane] * LANES + lane])
    return distances
