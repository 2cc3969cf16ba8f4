"""The parts of the replay buffer: trajectories, sets of rows, what counts as a success, and cached distances."""

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sb3_ddiffpg.clustering import dtw_distances

SUCCESS_KEYS = ("is_success", "success")
NO_MODE = -1


@dataclass(eq=False)
class Trajectory:
    """
    A finished episode in the buffer.

    :param rows: Rows of its transitions in order, shape [length], int32
    :param success: Whether it reached the goal
    :param episode_return: Sum of its rewards
    :param serial: Running number in order of finishing
    :param mode: Index of the mode that owns it, ``NO_MODE`` before the first clustering or for an outlier
    :param trains: Whether the mode learns from it, or only remembers it for the next clustering
    :param commanded: Number of the mode that it was told to follow, None if none
    :param foreign: It followed a command to its mode, but reached the goal by another mode's route: its mode is shown it as
        a failure, so that it learns to keep to its own
    :param label: Ground truth of the way it took, ``info["mode"]`` of its last step, None if there is none; for evaluation,
        no part of the algorithm sees it
    :param path: What clustering compares: mode features resampled to equal steps, shape [n_path_points, dim]; made when first
        needed
    """

    rows: np.ndarray
    success: bool
    episode_return: float
    serial: int
    mode: int = NO_MODE
    trains: bool = False
    commanded: int | None = None
    foreign: bool = False
    label: str | None = None
    path: np.ndarray | None = field(default=None, repr=False)

    @property
    def length(self) -> int:
        """Number of transitions."""
        return len(self.rows)


class RowSet:
    """
    A set of rows that is sampled, extended and reduced in time independent of its size. Sets that never share a row may
    share one ``position`` array.

    :param position: Where each row stands in ``rows``, shape [capacity], int32
    """

    def __init__(self, position: np.ndarray) -> None:
        self.position = position
        self.rows = np.empty(64, dtype=np.int32)
        self.size = 0

    def __getstate__(self) -> dict[str, Any]:
        """The shared array is its owner's to pickle, and to put back."""
        return {"rows": self.rows[: self.size], "size": self.size}

    def add(self, rows: np.ndarray) -> None:
        """
        :param rows: Rows that are in no set yet
        """
        new_size = self.size + len(rows)
        if new_size > len(self.rows):
            self.rows = np.concatenate((self.rows[: self.size], np.empty(max(new_size, len(self.rows)), dtype=np.int32)))
        self.rows[self.size : new_size] = rows
        self.position[rows] = np.arange(self.size, new_size, dtype=np.int32)
        self.size = new_size

    def remove(self, rows: np.ndarray) -> None:
        """
        :param rows: Rows of this set; the holes they leave are filled from the end
        """
        new_size = self.size - len(rows)
        holes = self.position[rows]
        in_tail = np.zeros(len(rows), dtype=bool)
        in_tail[holes[holes >= new_size] - new_size] = True
        movers = self.rows[new_size : self.size][~in_tail]
        holes = holes[holes < new_size]
        self.rows[holes] = movers
        self.position[movers] = holes
        self.size = new_size

    def sample(self, n: int) -> np.ndarray:
        """
        :param n: Number of rows to draw with replacement
        :return: Shape [n]
        """
        return self.rows[np.random.randint(0, self.size, size=n)]


def read_success(info: dict[str, Any], success_key: str | None = None) -> bool | None:
    """
    :param info: Of an episode's last step
    :param success_key: Key that marks a success; None looks for ``SUCCESS_KEYS``
    :return: Whether the goal was reached, None if the environment does not say
    :raises ValueError: If what it says is no truth value
    """
    for key in SUCCESS_KEYS if success_key is None else (success_key,):
        if key in info:
            said = np.asarray(info[key])
            if said.size != 1 or said.dtype.kind not in "biuf":
                raise ValueError(f"info[{key!r}]: {str(info[key])[:100]} given; accepted is True or False")
            return bool(said.item())
    return None


class SuccessRule:
    """
    Tells whether a finished episode reached its goal: by the environment's word, or, where no environment ever gives it, by
    a return in the top fifth of those seen lately, so that the algorithm also learns on an ordinary dense-reward task.

    :param success_key: Key of ``info``; None looks for ``SUCCESS_KEYS``
    """

    def __init__(self, success_key: str | None = None) -> None:
        self.success_key = success_key
        self.has_signal = False
        self.recent_returns: deque[float] = deque(maxlen=500)

    def __call__(self, info: dict[str, Any], episode_return: float) -> bool:
        """
        :param info: Of the episode's last step
        :param episode_return: Sum of its rewards
        :raises ValueError: If ``success_key`` was given and is not there
        """
        success = read_success(info, self.success_key)
        if success is not None:
            self.has_signal = True
            return success
        if self.success_key is not None:
            raise ValueError(f"success_key={self.success_key!r} is not in an episode's last info; its keys: {sorted(info)}")
        if self.has_signal:
            return False
        self.recent_returns.append(episode_return)
        if len(self.recent_returns) < 5:
            return False
        return bool(episode_return >= np.quantile(self.recent_returns, 0.8) and episode_return > min(self.recent_returns))


class DistanceCache:
    """
    Pairwise DTW distances of the last set of paths: of the next set only the new pairs are computed.

    :param normalize: See ``dtw_distances``
    """

    def __init__(self, normalize: bool = True) -> None:
        self.normalize = normalize
        self.serials = np.zeros(0, dtype=np.int64)
        self.distances = np.zeros((0, 0), dtype=np.float32)

    def __call__(self, serials: np.ndarray, paths: list[np.ndarray]) -> np.ndarray:
        """
        :param serials: Ascending numbers that identify the paths, shape [N]
        :param paths: Each [n_path_points, dim]
        :return: Shape [N, N]
        """
        known = np.isin(serials, self.serials)
        old = np.searchsorted(self.serials, serials[known])
        distances = np.zeros((len(serials), len(serials)), dtype=np.float32)
        distances[np.ix_(known, known)] = self.distances[np.ix_(old, old)]
        if not known.all():
            new = [path for path, is_known in zip(paths, known, strict=True) if not is_known]
            distances[np.ix_(~known, ~known)] = dtw_distances(new, normalize=self.normalize)
            if known.any():
                seen = [path for path, is_known in zip(paths, known, strict=True) if is_known]
                across = dtw_distances(new, seen, self.normalize)
                distances[np.ix_(~known, known)] = across
                distances[np.ix_(known, ~known)] = across.T
        self.serials, self.distances = serials, distances
        return distances
