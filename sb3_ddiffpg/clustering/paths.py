"""Paths made comparable: loops erased, resampled to equal steps."""

import numpy as np
from scipy.spatial.distance import cdist

# Defaults of what is compared
N_PATH_POINTS, LOOP_SHARE = 48, 0.05


def erase_loops(path: np.ndarray, radius: float) -> np.ndarray:
    """
    The path without its loops: from each point it goes on where the path was last within ``radius`` of that point. Wandering
    along the path says nothing about the route.

    :param path: shape ``[length, dims]``
    :param radius: in the unit of the path
    :return: shape ``[at most length, dims]``; begins and ends as the path does
    """
    kept = [0]
    while (current := kept[-1]) < len(path) - 1:
        # One row at a time: all of them would be a matrix
        near = np.flatnonzero(cdist(path[current : current + 1], path[current:])[0] <= radius)
        kept.append(current + max(1, int(near[-1])))
    return path[kept]


def resample_path(path: np.ndarray, n_points: int, arc_length: float | None = None) -> np.ndarray:
    """
    Points at equal distances of arc length along the polyline through ``path``: what is left of a trajectory when
    its speed, its pauses and its number of steps are forgotten. The first and last points are kept.

    :param path: points in the order they were visited, shape ``[length, dims]``, length at least 1
    :param n_points: number of points returned, at least 1 (a single one is the first point)
    :param arc_length: of the end of the path, which alone is resampled: it begins that far before the last point. None, or
        more than there is: the whole path
    :return: float32 array of shape ``[n_points, dims]``; a path that never moves gives copies of its first point
    :raises ValueError: if ``path`` is not of that shape or not finite, ``n_points`` is less than 1, or ``arc_length`` is not
        positive
    """
    if n_points < 1:
        raise ValueError(f"n_points must be at least 1, got {n_points}")
    if arc_length is not None and not arc_length > 0:
        raise ValueError(f"arc_length must be positive, or None, got {arc_length}")
    points = np.asarray(_check_path(path, "path"), dtype=np.float64)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    start = 0.0 if arc_length is None else max(0.0, travelled[-1] - arc_length)
    targets = np.linspace(start, travelled[-1], n_points)
    # A repeated point is a segment of length zero; np.interp wants increasing abscissae, so each stays once.
    moved = np.concatenate([[True], np.diff(travelled) > 0.0])
    columns = [np.interp(targets, travelled[moved], column) for column in points[moved].T]
    return np.stack(columns, axis=1).astype(np.float32)


def comparable_path(
    path: np.ndarray, n_points: int = N_PATH_POINTS, loop_share: float = LOOP_SHARE, arc_length: float | None = None
) -> np.ndarray:
    """
    What clustering compares of a path: without its loops, resampled.

    :param path: shape ``[length, dims]``
    :param n_points: see ``resample_path``
    :param loop_share: radius of ``erase_loops``, as a share of the path's extent
    :param arc_length: see ``resample_path``
    :return: shape ``[n_points, dims]``
    """
    extent = float(np.linalg.norm(np.ptp(path, axis=0)))
    return resample_path(erase_loops(path, loop_share * extent), n_points, arc_length)


def _check_path(path: np.ndarray, name: str) -> np.ndarray:
    points = np.asarray(path)
    if points.ndim != 2 or 0 in points.shape:
        raise ValueError(f"{name} must have shape [length, dims] with at least one point, got shape {points.shape}")
    with np.errstate(over="ignore"):
        finite = np.isfinite(points.astype(np.float32)).all()
    if not finite:
        raise ValueError(f"{name} holds values that are NaN, infinite or too large for float32")
    return points


def extent(positions: np.ndarray) -> float:
    """
    :param positions: Shape [..., dim]
    :return: Diagonal of the box round them
    """
    return float(np.linalg.norm(np.ptp(positions.reshape(-1, positions.shape[-1]), axis=0)))
