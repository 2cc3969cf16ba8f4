"""Replay buffer that knows where episodes went: windows of their steps, and paths that can be compared."""

from numbers import Real
from typing import Any

import numpy as np

from sb3_ddiffpg.buffers.batch import VisitedSteps
from sb3_ddiffpg.buffers.features import ModeFeatures
from sb3_ddiffpg.buffers.trajectory import Trajectory
from sb3_ddiffpg.buffers.trajectory_buffer import TrajectoryReplayBuffer
from sb3_ddiffpg.clustering.distance_cache import DistanceCache
from sb3_ddiffpg.clustering.paths import LOOP_SHARE, N_PATH_POINTS, comparable_path
from sb3_ddiffpg.utils.settings import FLAG, NOT_NEGATIVE, Accepted, at_least

# Steps from which positions are standardised, at most
_MEASURED = 50_000
_LENGTH = Accepted("be a positive and finite number", lambda value: _is_real(value) and 0 < value < np.inf).or_none()


def _is_real(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


class PathReplayBuffer(TrajectoryReplayBuffer):
    """
    A ``TrajectoryReplayBuffer`` whose trajectories are paths of mode features.

    :param args: Of ``TrajectoryReplayBuffer``
    :param n_path_points: Points to which a trajectory's path is resampled for clustering
    :param normalize_distances: Whether DTW distances are divided by the square root of the path's length, which makes them
        about the mean distance along the path; False for the root of the summed squares, to which the paper's thresholds refer
    :param compared_length: Arc length of a path's end, without its loops, that alone is compared; None: all of it. What an
        explorer did before it took a route says nothing about the route. In the unit of the mode features, of a whole
        observation in standard deviations
    :param standardize: Whether positions are divided by their standard deviation where paths are compared; None: those of a
        whole observation. Not those that have one unit, in which distances are given
    :param loop_share: Radius within which a path that comes back has made a loop, as a share of the path's extent
    :param kwargs: Of ``TrajectoryReplayBuffer``
    :raises ValueError: If an argument is out of its range
    """

    def __init__(
        self,
        *args: Any,
        n_path_points: int = N_PATH_POINTS,
        normalize_distances: bool = True,
        compared_length: float | None = None,
        standardize: bool | None = None,
        loop_share: float = LOOP_SHARE,
        **kwargs: Any,
    ) -> None:
        for name, accepted, value in (
            ("n_path_points", at_least(2), n_path_points),
            ("normalize_distances", FLAG, normalize_distances),
            ("compared_length", _LENGTH, compared_length),
            ("standardize", FLAG.or_none(), standardize),
            ("loop_share", NOT_NEGATIVE, loop_share),
        ):
            accepted.check(name, value)
        self.n_path_points = n_path_points
        self.normalize_distances = normalize_distances
        self.compared_length = None if compared_length is None else float(compared_length)
        self.standardize, self.loop_share = standardize, loop_share
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        """Forget everything and release the storage."""
        super().reset()
        if self.standardize is None:
            self.standardize = self.features.whole_observation
        unit = np.ones(self.features.dim, dtype=np.float32)  # declared positions keep theirs
        self.feature_scale = None if self.standardize else unit
        self.distances = DistanceCache(self.normalize_distances)

    # ------------------------------------------------------------------ windows

    def sample_windows(self, batch_size: int, n_steps: int) -> np.ndarray:
        """
        :param batch_size: Number of windows B, drawn from all transitions
        :param n_steps: Steps of each, at most
        :return: Rows, -1 beyond an episode's end, [B, n_steps]
        """
        return self._windows(self.stored_rows.sample(batch_size)[None], n_steps, 1)[0]

    def _windows(self, rows: np.ndarray, exploration_n_steps: int, mode_n_steps: int) -> np.ndarray:
        """The rows that follow each row in its trajectory, itself first, -1 beyond its end, [G, n, n_steps]."""
        n_steps = max(exploration_n_steps, mode_n_steps if len(rows) > 1 else 1)
        windows = np.empty((*rows.shape, n_steps), dtype=np.int32)
        windows[..., 0], following = rows, rows
        for k in range(1, n_steps):
            following = windows[..., k] = np.where(following >= 0, self.next_row[following], -1)
        windows[0, :, exploration_n_steps:] = -1
        windows[1:, :, mode_n_steps:] = -1
        return windows

    def visited(self, windows: np.ndarray) -> VisitedSteps:
        """
        :param windows: Rows, [G, n, n_steps], -1 where there is none
        :return: The steps that there are
        """
        present = windows >= 0
        rows = windows[present]
        observations, next_observations = self.read_observations(rows)
        return VisitedSteps(
            present=present,
            observations=observations,
            next_observations=next_observations,
            positions=self.features.of_tensors(observations),
            next_positions=self.features.of_tensors(next_observations),
            first_visits=self.first_visits[rows],
            followed=self.followed[rows],
        )

    # ------------------------------------------------------------------ paths

    def episodes(self) -> list[np.ndarray]:
        """
        :return: Rows of every stored episode, in order, also of those in progress
        """
        running = [self.running.of(env) for env in np.flatnonzero(self.running.lengths).tolist()]
        return [*(each.rows for each in self.finished_trajectories()), *running]

    def reached(self, rows: np.ndarray) -> np.ndarray:
        """
        :param rows: Shape [N]
        :return: Mode features that were reached there, as paths are compared, shape [N, dim]
        """
        return self.positions(self.nexts, "next_observations", rows) / self.measured_scale()

    def measured_scale(self) -> np.ndarray:
        """
        Declared positions keep their unit; a whole observation is standardised once, or cached distances would age.

        :return: What positions are divided by where paths are compared, [dim]
        """
        if self.feature_scale is None:
            self.feature_scale = self._deviations()
        return self.feature_scale

    def _deviations(self) -> np.ndarray:
        """Standard deviation of each mode feature, [dim]; of what has not moved its size, whatever the unit."""
        positions = self.positions(self.steps, "observations", self.stored_rows.spread(_MEASURED)).astype(np.float64)
        size = np.abs(positions).max(axis=0)
        moved = positions.std(axis=0) > 1e-6 * size
        return np.where(moved, positions.std(axis=0), np.where(size > 0, size, 1.0)).astype(np.float32)

    def use_features(self, selection: Any) -> None:
        """
        Compare paths in other mode features from now on.

        :param selection: See ``ModeFeatures``
        :raises ValueError: If it does not fit the observation space
        """
        self.features = ModeFeatures(self.observation_space, selection)
        self.standardize, self.feature_scale = True, None
        self.forget_paths()

    def review_scale(self) -> bool:
        """
        Standardise anew if the run has gone so much farther that one component of the positions would decide all.

        :return: Whether paths are compared in another way now
        """
        if not self.standardize or self.feature_scale is None:
            return False
        ratios = self._deviations() / self.feature_scale
        if 0.5 < ratios.min() and ratios.max() < 2.0:
            return False
        self.feature_scale = self._deviations()
        self.forget_paths()
        return True

    def forget_paths(self) -> None:
        """Paths are compared in another way now."""
        self.distances = DistanceCache(self.normalize_distances)
        for trajectory in [*self.trajectories(success=True), *self.trajectories(success=False)]:
            trajectory.path = None

    def path(self, trajectory: Trajectory) -> np.ndarray:
        """
        :param trajectory: A stored trajectory
        :return: What clustering compares of it: mode features, terminal state included, resampled; shape [n_path_points, dim]
        """
        if trajectory.path is None:
            trajectory.path = self.resample(self.full_path(trajectory))
        return trajectory.path

    def resample(self, full_path: np.ndarray) -> np.ndarray:
        """
        :param full_path: Mode features along a trajectory, shape [L, dim]
        :return: What clustering compares, shape [n_path_points, dim]
        """
        path = full_path / self.measured_scale()
        return comparable_path(path, self.n_path_points, self.loop_share, self.compared_length)

    def full_path(self, trajectory: Trajectory) -> np.ndarray:
        """
        :param trajectory: A stored trajectory
        :return: Its mode features, terminal state included, shape [length + 1, dim]
        """
        first = self.positions(self.steps, "observations", trajectory.rows)
        last = self.positions(self.nexts, "next_observations", trajectory.rows[-1:])
        return np.concatenate((first, last))

    def success_distances(self, successes: list[Trajectory]) -> np.ndarray:
        """
        Pairwise DTW distances. Only pairs with a trajectory that was not there the last time are computed.

        :param successes: The trajectories to compare, in order of finishing
        :return: Shape [N, N]
        """
        serials = np.array([trajectory.serial for trajectory in successes], dtype=np.int64)
        return self.distances(serials, [self.path(trajectory) for trajectory in successes])
