"""Which trajectories keep to the route of a mode, and which of their steps do not."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.distance import cdist

from sb3_ddiffpg.buffers.trajectory import Trajectory
from sb3_ddiffpg.clustering.paths import extent

#: Distance from a mode's paths beyond which a step is off its route, as a share of their extent
ROUTE_SHARE = 0.1


def split_detours(
    trajectories: Sequence[Trajectory], max_length_ratio: float, min_direct: int
) -> tuple[list[Trajectory], list[Trajectory]]:
    """
    A mode's trajectories, and apart from them the detours: successes that nobody told to follow the mode and that are much
    longer than its shortest one. From detours a critic would piece together a better route than the mode's own, and the modes
    would become one. What the mode itself did slowly it must see, or it would never get better there.

    :param trajectories: Of a mode
    :param max_length_ratio: A success longer than this times the shortest is a detour
    :param min_direct: The shortest successes, so many, are none
    :return: The direct ones and the detours, in the same order
    """
    lengths = np.sort([t.length for t in trajectories if t.success and not t.off_mode_success])
    if not len(lengths):
        return list(trajectories), []
    limit = max(max_length_ratio * lengths[0], lengths[:min_direct][-1])
    is_detour = [t.success and t.assigned_mode is None and t.length > limit for t in trajectories]
    direct = [t for t, detour in zip(trajectories, is_detour, strict=True) if not detour]
    return direct, [t for t, detour in zip(trajectories, is_detour, strict=True) if detour]


def off_route(
    path: np.ndarray,
    routes: Sequence[np.ndarray],
    loop_share: float,
    compared_length: float | None,
) -> np.ndarray:
    """
    :param path: Where a trajectory went, terminal state included, shape [length + 1, dim]
    :param routes: Paths of a mode's goal-reached trajectories, resampled, each [n_path_points, dim]
    :param loop_share: Distance of the last step from the routes' ends beyond which it is another goal, as a share of their
        extent
    :param compared_length: Arc length of the trajectory's end before which the routes are not known; None: they are
    :return: Which of the trajectory's steps lead off the route, shape [length]
    """
    route, reached = np.concatenate(routes), path[1:]
    size = extent(route)
    off = cdist(reached, route).min(axis=1) > ROUTE_SHARE * size
    if compared_length is not None:
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        off &= steps.sum() - steps.cumsum() <= compared_length
    ends = np.stack([each[-1] for each in routes])
    off[-1] |= cdist(reached[-1:], ends).min() > loop_share * size
    return off
