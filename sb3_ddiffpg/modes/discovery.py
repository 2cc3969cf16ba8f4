"""Mode discovery over the buffer's trajectories (algorithm 2 of the paper): clusters, heritage and the failures' modes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.trajectory import NO_MODE, Trajectory
from sb3_ddiffpg.clustering.linkage import without_outliers
from sb3_ddiffpg.clustering.matching import ModeMatching, assign_to_nearest, match_modes, medoid
from sb3_ddiffpg.modes.mode import Mode
from sb3_ddiffpg.modes.settings import ModeSettings


class Counters(NamedTuple):
    """What a re-clustering has found of an old mode: its new ``doubts`` and ``misses``, see ``Mode``."""

    doubts: int
    misses: int


@dataclass(frozen=True)
class Reclustering:
    """
    Outcome of one re-clustering: nothing is changed yet, of the modes or of the buffer.

    :param successes: The goal-reached trajectories that were clustered, N of them
    :param labels: New mode of each, ``NO_MODE`` for outliers, shape [N]
    :param distances: Their DTW distances, shape [N, N]
    :param failures: The failed trajectories
    :param failure_labels: New mode of each
    :param abandoned: Goal-reached trajectories of modes that are retired
    :param matching: Which new mode follows which old one
    :param counters: Of every old mode
    :param off_mode: Trajectories that were told to follow one mode, but took the route of another, and goal-reached ones of
        the first
    """

    successes: list[Trajectory]
    labels: np.ndarray
    distances: np.ndarray
    failures: list[Trajectory]
    failure_labels: np.ndarray
    abandoned: list[Trajectory]
    matching: ModeMatching
    counters: list[Counters]
    off_mode: list[tuple[Trajectory, list[Trajectory]]]

    def continued(self) -> list[int | None]:
        """
        :return: For each cluster the index of the old mode that goes on in it, None if it is a new one
        """
        parents, kept = self.matching.parents, self.matching.kept
        return [parents[new] if kept[new] else None for new in range(_count(self.labels))]

    def describe(self, modes: Sequence[Mode], buffer: ModeReplayBuffer) -> None:
        """
        Bring the modes' statistics up to date, after the trajectories were handed over.

        :param modes: The new modes
        :param buffer: Holds the trajectories
        """
        for index, mode in enumerate(modes):
            members = [i for i in np.flatnonzero(self.labels == index) if self.successes[i].trains]
            if not members:
                continue  # dormant
            mode.n_trajectories = len(members)
            mode.mean_length = float(np.mean([self.successes[i].length for i in members]))
            mode.mean_return = float(np.mean([self.successes[i].episode_return for i in members]))
            central = members[medoid(self.distances[np.ix_(members, members)])]
            mode.representative = buffer.full_path(self.successes[central])


def find_modes(
    buffer: ModeReplayBuffer,
    modes: Sequence[Mode],
    cluster: Callable[[np.ndarray], np.ndarray],
    settings: ModeSettings,
    births: bool,
    retired: Sequence[int] = (),
) -> Reclustering:
    """
    :param buffer: Holds the trajectories
    :param modes: The modes so far
    :param cluster: Maps distances [N, N] to labels [N]
    :param settings: How modes are found and kept
    :param births: Whether modes may be born; the first always may
    :param retired: Indices of modes that end, see ``retired_modes``
    :return: The new modes
    """
    found, failures = buffer.trajectories(success=True), buffer.trajectories(success=False)
    abandoned = [trajectory for trajectory in found if trajectory.mode in retired]
    successes = [trajectory for trajectory in found if trajectory.mode not in retired]
    distances = np.zeros((len(successes), len(successes)), dtype=np.float32)
    labels = np.full(len(successes), NO_MODE)
    if not modes and not successes and buffer.has_hindsight:
        return _before_any_success(failures, abandoned)
    if len(successes) >= (settings.min_size if buffer.has_outliers else 1):
        distances = buffer.success_distances(successes)
        labels = cluster(distances)
        if not buffer.has_outliers:
            # The best so far is a way to begin with, as single and unlike the others as it may be
            labels = without_outliers(labels, distances)

    rng = np.random.RandomState(np.random.randint(2**31))
    dormant = [mode for mode in _dormant(found, len(modes)) if mode not in retired]
    old_labels = _old_labels(buffer, successes, modes, dormant, rng)
    labels, doubts = _defend(modes, distances, old_labels, labels, settings.patience, settings.max_modes)
    labels = _fewest(modes, old_labels, labels, settings.max_modes)
    if modes and not births:
        labels = _without_births(modes, old_labels, labels)
    matching = _with_dormant(_match(modes, old_labels, labels), modes, dormant, settings.max_modes)

    heirs = {modes[old].number: new for new, old in enumerate(matching.parents) if old is not None and matching.kept[new]}
    misses = [mode.misses + mode.unjudged for mode in modes]
    for trajectory, label in zip(successes, labels.tolist(), strict=True):
        if trajectory.mode == NO_MODE and label != NO_MODE and _assigned(heirs, trajectory) == label:
            misses[matching.parents[label]] = 0
    counters = [Counters(*each) for each in zip(doubts, misses, strict=True)]
    failure_labels = _share_out(buffer, failures, successes, labels, heirs, rng)
    outcome = Reclustering(successes, labels, distances, failures, failure_labels, abandoned, matching, counters, [])
    return _off_mode_apart(outcome, heirs) if buffer.goals_are_told else outcome


def retired_modes(modes: Sequence[Mode], trials: int) -> list[int]:
    """
    :param modes: The modes so far
    :param trials: Commanded episodes in a row that must miss a mode's route before it is retired
    :return: Indices of modes that cannot be commanded: a clump of wanderings, or a copy of another mode. None if that is true
        of all
    """
    missing = [index for index, mode in enumerate(modes) if mode.misses >= trials and not mode.frozen]
    return missing if len(missing) < len(modes) else []


def surpassed_modes(modes: Sequence[Mode], trials: int, buffer: ModeReplayBuffer) -> list[int]:
    """
    Where nobody says what a success is, only the best episodes are of modes.

    :param modes: The modes so far
    :param trials: Commanded episodes in a row that must not have been among the best
    :param buffer: Holds the trajectories
    :return: Indices of modes that have none among the best any more. None if that is true of all
    """
    among_best = {trajectory.mode for trajectory in buffer.trajectories(success=True)}
    return [index for index in retired_modes(modes, trials) if index not in among_best] if among_best - {NO_MODE} else []


def readmit_homeless(buffer: ModeReplayBuffer, numbers: set[int]) -> None:
    """
    Off-mode successes count as failures of their mode while it lives, and are successes like any other when it has ended.

    :param buffer: Holds the trajectories
    :param numbers: Of the modes that live
    """
    homeless = [
        each for each in buffer.trajectories(success=False) if each.off_mode_success and each.assigned_mode not in numbers
    ]
    for trajectory in homeless:
        buffer.readmit(trajectory)


def _before_any_success(failures: list[Trajectory], abandoned: list[Trajectory]) -> Reclustering:
    """One mode of all failures, if there are any: they have all reached some goal, if not the one that was meant."""
    n_modes = min(len(failures), 1)
    matching = ModeMatching(parents=[None] * n_modes, kept=[False] * n_modes, merged={}, retired=[])
    labels, distances = np.zeros(0, dtype=int), np.zeros((0, 0), dtype=np.float32)
    return Reclustering(
        [], labels, distances, failures, np.zeros(len(failures), dtype=int), abandoned, matching, counters=[], off_mode=[]
    )


def _count(labels: np.ndarray) -> int:
    return int(labels.max(initial=NO_MODE)) + 1


def _match(modes: Sequence[Mode], old_labels: np.ndarray, labels: np.ndarray) -> ModeMatching:
    """Who continues whom, when each frozen mode has a cluster."""
    frozen = [index for index, mode in enumerate(modes) if mode.frozen]
    return match_modes(old_labels, labels, len(modes), _count(labels), frozen)


def _assigned(heirs: dict[int, int], trajectory: Trajectory) -> int:
    """New index of the mode that the trajectory was told to follow, ``NO_MODE`` if there was none or it has ended."""
    return NO_MODE if trajectory.assigned_mode is None else heirs.get(trajectory.assigned_mode, NO_MODE)


def _share_out(
    buffer: ModeReplayBuffer,
    failures: list[Trajectory],
    successes: list[Trajectory],
    labels: np.ndarray,
    heirs: dict[int, int],
    rng: np.random.RandomState,
) -> np.ndarray:
    """New mode of every failure. A mode must see its own; those of nobody are shared out by likeness, as in the paper."""
    failure_labels = np.array([_assigned(heirs, failure) for failure in failures], dtype=int)
    strayed = np.flatnonzero([failure.assigned_mode not in heirs and not failure.off_mode_success for failure in failures])
    if not _count(labels) and len(heirs) == 1 and buffer.has_hindsight:
        failure_labels[strayed] = next(iter(heirs.values()))
    elif _count(labels) and len(strayed):
        members = [[buffer.path(successes[i]) for i in np.flatnonzero(labels == mode)] for mode in range(_count(labels))]
        failure_labels[strayed] = assign_to_nearest([buffer.path(failures[i]) for i in strayed], members, rng)
    return failure_labels


def _defend(
    modes: Sequence[Mode],
    distances: np.ndarray,
    old_labels: np.ndarray,
    labels: np.ndarray,
    patience: int,
    max_modes: int,
) -> tuple[np.ndarray, list[int]]:
    """
    Labels in which a mode that was found no cluster of its own keeps its members: for a while if they lie within another
    mode's cluster, until it is given up if they lie in none. Near the border between one cluster and two, or none, the
    answer changes with every new trajectory, and a mode that ends takes its critics with it. Also how many times in a row each
    mode was found within another, by now.

    A new trajectory in a cluster of which a part is defended goes to the mode of its nearest old one.
    """
    n_new = _count(labels)
    inheritance = match_modes(old_labels, labels, len(modes), n_new)
    labels, doubts = labels.copy(), [mode.doubts for mode in modes]
    for old in sorted([*inheritance.merged, *inheritance.retired]):
        members = np.flatnonzero(old_labels == old)
        within_another = old in inheritance.merged
        doubts[old] += within_another
        gives_way = doubts[old] >= max(1, patience) or n_new >= max_modes
        if not len(members) or (gives_way and not modes[old].frozen):
            continue
        if within_another:
            host = labels == inheritance.merged[old]
            settled, newcomers = np.flatnonzero(host & (old_labels != NO_MODE)), np.flatnonzero(host & (old_labels == NO_MODE))
            nearest = settled[distances[np.ix_(newcomers, settled)].argmin(axis=1)]
            labels[newcomers[old_labels[nearest] == old]] = n_new
        labels[members] = n_new
        n_new += 1
    for old in set(range(len(modes))) - set(inheritance.merged) - set(inheritance.retired):
        doubts[old] = 0
    return labels, doubts


def _fewest(modes: Sequence[Mode], old_labels: np.ndarray, labels: np.ndarray, max_modes: int) -> np.ndarray:
    """Labels without the smallest of too many clusters. Frozen modes stay."""
    match = _match(modes, old_labels, labels)
    frozen = [new for new, old in enumerate(match.parents) if old is not None and match.kept[new] and modes[old].frozen]
    others = [new for new in range(_count(labels)) if new not in frozen]
    others.sort(key=lambda new: -np.count_nonzero(labels == new))
    stay = sorted([*frozen, *others[: max(0, max_modes - len(frozen))]])
    numbers = np.full(_count(labels) + 1, NO_MODE)  # the last for NO_MODE itself
    numbers[stay] = np.arange(len(stay))
    return numbers[labels]


def _without_births(modes: Sequence[Mode], old_labels: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """
    Labels without clusters that continue no mode: a part of a mode goes back to it, the rest are outliers. A mode that is
    born when exploration is over would have too little time to learn.
    """
    inheritance = _match(modes, old_labels, labels)
    heirs = {parent: new for new, parent in enumerate(inheritance.parents) if inheritance.kept[new]}
    goes_to = np.array([heirs.get(parent, NO_MODE) for parent in inheritance.parents] + [NO_MODE])  # the last for NO_MODE
    labels = goes_to[labels]
    labels[labels != NO_MODE] = np.unique(labels[labels != NO_MODE], return_inverse=True)[1]
    return labels


def _off_mode_apart(found: Reclustering, heirs: dict[int, int]) -> Reclustering:
    """
    The new trajectories that were told to follow one mode, but took the route of another, made failures of the first. Seen as
    successes they would tell its critic that any route will do, and the policy of a longer route would drift to the
    shorter one beside it; unseen they would tell it nothing.

    Those on the route of no mode so far have discovered one. They stay with it, or it would be born without trajectories.
    """
    successes, labels = found.successes, found.labels
    established = {new for new, is_kept in enumerate(found.matching.kept) if is_kept}
    off_mode: dict[int, int] = {}
    marks = []
    for i, trajectory in enumerate(successes):
        mode = _assigned(heirs, trajectory)
        has_route = mode != NO_MODE and mode in labels  # a dormant mode has none yet that one could leave
        if trajectory.mode == NO_MODE and has_route and labels[i] in established - {mode}:
            off_mode[i] = mode
            marks.append((trajectory, [successes[j] for j in np.flatnonzero(labels == mode)]))
    failures = [*found.failures, *(successes[i] for i in off_mode)]
    failure_labels = np.concatenate((found.failure_labels, list(off_mode.values()))).astype(int)
    order = np.argsort([failure.serial for failure in failures])
    own = np.array([i for i in range(len(successes)) if i not in off_mode], dtype=int)
    return replace(
        found,
        successes=[successes[i] for i in own],
        labels=labels[own],
        distances=found.distances[np.ix_(own, own)],
        failures=[failures[i] for i in order],
        failure_labels=failure_labels[order],
        off_mode=marks,
    )


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
    """Mode of every success so far. New ones nearest to a dormant mode are lent to it, so that it may find itself again."""
    labels = np.array([trajectory.mode for trajectory in successes], dtype=int)
    unowned = np.flatnonzero(labels == NO_MODE)
    known = [mode for mode in range(len(modes)) if len(modes[mode].representative)]
    if len(unowned) and set(dormant) & set(known):
        members = [[buffer.resample(modes[mode].representative)] for mode in known]
        nearest = assign_to_nearest([buffer.path(successes[i]) for i in unowned], members, rng, n_samples=1)
        labels[unowned] = [mode if mode in dormant else NO_MODE for mode in np.asarray(known)[nearest].tolist()]
    elif len(modes) == 1 and not known and buffer.has_hindsight:
        labels[unowned] = 0  # the first successes of a mode that began without
    return labels


def _with_dormant(inheritance: ModeMatching, modes: Sequence[Mode], dormant: list[int], max_modes: int) -> ModeMatching:
    """A mode without data stays as it is until it has some, where there is room: it can still be commanded."""
    heirs = {parent for parent, kept in zip(inheritance.parents, inheritance.kept, strict=True) if kept}
    waiting = sorted((mode for mode in dormant if mode not in heirs), key=lambda mode: not modes[mode].frozen)
    n_frozen = sum(modes[mode].frozen for mode in waiting)
    waiting = waiting[: max(n_frozen, max_modes - len(inheritance.parents))]
    return ModeMatching(
        parents=[*inheritance.parents, *waiting],
        kept=[*inheritance.kept, *(True for _ in waiting)],
        merged={old: new for old, new in inheritance.merged.items() if old not in waiting},
        retired=[old for old in inheritance.retired if old not in waiting],
    )
