"""Mode discovery over the buffer's trajectories (algorithm 2 of the paper): clusters, heritage and the failures' modes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sb3_ddiffpg.buffers import ModeReplayBuffer
from sb3_ddiffpg.clustering import Inheritance, assign_to_nearest, match_modes, medoid
from sb3_ddiffpg.modes import Mode
from sb3_ddiffpg.trajectories import NO_MODE, Trajectory


@dataclass(frozen=True)
class Reclustering:
    """
    Outcome of one re-clustering; nothing is changed yet.

    :param successes: The goal-reached trajectories that were clustered, N of them
    :param labels: New mode of each, ``NO_MODE`` for outliers, shape [N]
    :param distances: Their DTW distances, shape [N, N]
    :param failures: The failed trajectories
    :param failure_labels: New mode of each
    :param inheritance: Which new mode follows which old one
    """

    successes: list[Trajectory]
    labels: np.ndarray
    distances: np.ndarray
    failures: list[Trajectory]
    failure_labels: np.ndarray
    inheritance: Inheritance

    def describe(self, modes: Sequence[Mode], buffer: ModeReplayBuffer) -> None:
        """
        Bring the modes' statistics up to date, after the trajectories were handed over.

        :param modes: The new modes
        :param buffer: Holds the trajectories
        """
        for index, mode in enumerate(modes):
            members = [i for i in np.flatnonzero(self.labels == index) if self.successes[i].mode == index]
            if not members:
                continue  # dormant
            mode.n_trajectories = len(members)
            mode.mean_length = float(np.mean([self.successes[i].length for i in members]))
            mode.mean_return = float(np.mean([self.successes[i].episode_return for i in members]))
            central = members[medoid(self.distances[np.ix_(members, members)])]
            mode.representative = buffer.full_path(self.successes[central])


def find_modes(
    buffer: ModeReplayBuffer, modes: Sequence[Mode], cluster: Callable[[np.ndarray], np.ndarray], min_size: int
) -> Reclustering | None:
    """
    :param buffer: Holds the trajectories
    :param modes: The modes so far
    :param cluster: Maps distances [N, N] to labels [N]
    :param min_size: Fewest goal-reached trajectories worth clustering
    :return: The new modes, or None when nothing could take the place of the old ones
    """
    successes, failures = buffer.trajectories(success=True), buffer.trajectories(success=False)
    distances = np.zeros((len(successes), len(successes)), dtype=np.float32)
    labels = np.full(len(successes), NO_MODE)
    if len(successes) >= min_size:
        distances = buffer.success_distances(successes)
        labels = cluster(distances)
    n_new = int(labels.max(initial=NO_MODE)) + 1
    if n_new == 0 and modes:
        return None
    rng = np.random.RandomState(np.random.randint(2**31))
    dormant = _dormant(successes, len(modes))
    old_labels = _old_labels(buffer, successes, modes, dormant, rng)
    inheritance = _with_dormant(match_modes(old_labels, labels, len(modes), n_new), dormant)
    failure_labels = np.full(len(failures), NO_MODE)
    if n_new and failures:
        members = [[buffer.path(successes[i]) for i in np.flatnonzero(labels == mode)] for mode in range(n_new)]
        failure_labels = assign_to_nearest([buffer.path(failure) for failure in failures], members, rng)
    return Reclustering(successes, labels, distances, failures, failure_labels, inheritance)


def _dormant(successes: list[Trajectory], n_modes: int) -> list[int]:
    """Modes without any trajectory: those of a model that was loaded without its replay buffer."""
    return sorted(set(range(n_modes)) - {trajectory.mode for trajectory in successes})


def _old_labels(
    buffer: ModeReplayBuffer,
    successes: list[Trajectory],
    modes: Sequence[Mode],
    dormant: list[int],
    rng: np.random.RandomState,
) -> np.ndarray:
    """Mode of every success so far. New ones are lent to the nearest dormant mode, so that it may find itself again."""
    labels = np.array([trajectory.mode for trajectory in successes], dtype=int)
    unowned = np.flatnonzero(labels == NO_MODE)
    if dormant and len(unowned):
        members = [[buffer.resample(modes[mode].representative)] for mode in dormant]
        nearest = assign_to_nearest([buffer.path(successes[i]) for i in unowned], members, rng, n_samples=1)
        labels[unowned] = np.asarray(dormant)[nearest]
    return labels


def _with_dormant(inheritance: Inheritance, dormant: list[int]) -> Inheritance:
    """A mode without data stays as it is until it has some: it can still be commanded."""
    heirs = {parent for parent, kept in zip(inheritance.parents, inheritance.kept, strict=True) if kept}
    waiting = [mode for mode in dormant if mode not in heirs]
    return Inheritance(
        parents=[*inheritance.parents, *waiting],
        kept=[*inheritance.kept, *(True for _ in waiting)],
        merged={old: new for old, new in inheritance.merged.items() if old not in waiting},
        retired=[old for old in inheritance.retired if old not in waiting],
    )
