"""A trajectory as a way through the features: without its loops, in equal steps, as far as it compares with others."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.distance import cdist


def erase_loops(path: np.ndarray, radius: float) -> np.ndarray:
    """
    The path without its loops: from each point it goes on where the path was last within ``radius`` of that point. Wandering
    on the way says nothing about the way.

    :param path: shape ``[length, dims]``
    :param radius: in the unit of the path
    :return: shape ``[at most length, dims]``; begins and ends as the path does
    """
    last_near = len(path) - 1 - (cdist(path, path) <= radius)[:, ::-1].argmax(axis=1)
    kept = [0]
    while kept[-1] < len(path) - 1:
        current = kept[-1]
        kept.append(int(max(last_near[current], current + 1)))
    return path[kept]


def resample_path(path: np.ndarray, n_points: int, last: float = np.inf) -> np.ndarray:
    """
    Points at equal distances of arc length along the polyline through ``path``: what is left of a trajectory when
    its speed, its pauses and its number of steps are forgotten. The first and last points are kept.

    :param path: points in the order they were visited, shape ``[length, dims]``, length at least 1
    :param n_points: number of points returned, at least 1 (a single one is the first point)
    :param last: take only the end of the path, of this arc length; all of it where it is shorter
    :return: float32 array of shape ``[n_points, dims]``; a path that never moves gives copies of its first point
    :raises ValueError: if ``path`` is not of that shape or not finite, ``n_points`` is less than 1 or ``last`` negative
    """
    if n_points < 1:
        raise ValueError(f"n_points must be at least 1, got {n_points}")
    if not last >= 0.0:
        raise ValueError(f"last must not be negative, got {last}")
    points = np.asarray(check_path(path, "path"), dtype=np.float64)
    travelled = _travelled(points)
    targets = np.linspace(max(0.0, travelled[-1] - last), travelled[-1], n_points)
    # A repeated point is a segment of length zero; np.interp wants increasing abscissae, so each stays once.
    moved = np.concatenate([[True], np.diff(travelled) > 0.0])
    columns = [np.interp(targets, travelled[moved], column) for column in points[moved].T]
    return np.stack(columns, axis=1).astype(np.float32)


def comparable_ends(paths: Sequence[np.ndarray], ratio: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """
    What can be compared of some trajectories: what a wanderer did before it took a way says nothing about the way. A path
    from ``a`` to ``b`` is known to be possible in the length of any other one and the straight lines between the beginnings
    and the ends of the two; of one that is longer than ``ratio`` times the shortest so possible, the end counts.

    :param paths: each of shape ``[length, dims]``
    :param ratio: at least 1
    :return: arc lengths of the parts that count, shape ``[len(paths)]``, infinite where it is all of the path, else in steps
        of 10 %, so that a slightly shorter path does not change those of all others; and these parts, each again of shape
        ``[length, dims]`` in equal steps
    :raises ValueError: if ``ratio`` is less than 1
    """
    if not ratio >= 1.0:
        raise ValueError(f"ratio must be at least 1, got {ratio}")
    if len(paths) == 0:
        return np.zeros(0), []
    arcs = np.array([_travelled(path)[-1] for path in paths])
    starts, ends = np.stack([path[0] for path in paths]), np.stack([path[-1] for path in paths])
    possible = (cdist(starts, starts) + arcs + cdist(ends, ends)).min(axis=1)
    known = possible > 0.0  # a way that begins where it ends may be of any length
    limits = np.full(len(paths), np.inf)
    limits[known] = 1.1 ** np.ceil(np.log(ratio * possible[known]) / np.log(1.1))
    limits[arcs <= limits] = np.inf
    parts = [
        path if limit == np.inf else resample_path(path, len(path), limit) for path, limit in zip(paths, limits, strict=True)
    ]
    return limits, parts


def check_path(path: np.ndarray, name: str) -> np.ndarray:
    """
    :param path: To be of shape ``[length, dims]``, length and dims at least 1
    :param name: What it is, for the message
    :return: The same as an array
    :raises ValueError: if it has another shape, or values that are not finite in float32
    """
    points = np.asarray(path)
    if points.ndim != 2 or 0 in points.shape:
        raise ValueError(f"{name} must have shape [length, dims] with at least one point, got shape {points.shape}")
    with np.errstate(over="ignore"):
        finite = np.isfinite(points.astype(np.float32)).all()
    if not finite:
        raise ValueError(f"{name} holds values that are NaN, infinite or too large for float32")
    return points


def _travelled(points: np.ndarray) -> np.ndarray:
    """Arc length up to each point, shape ``[length]``."""
    steps = np.linalg.norm(np.diff(np.asarray(points, dtype=np.float64), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
