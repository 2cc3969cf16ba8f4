"""Mode discovery over the buffer's trajectories (algorithm 2 of the paper): clusters, heritage and the failures' modes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sb3_ddiffpg.buffers import ModeReplayBuffer
from sb3_ddiffpg.clustering import Inheritance, assign_to_nearest, match_modes, medoid
from sb3_ddiffpg.modes import Mode
from sb3_ddiffpg.trajectories import NO_MODE, Trajectory


@dataclass(frozen=True)
class Reclustering:
    """
    Outcome of one re-clustering. But for the marks of foreign trajectories nothing is changed yet.

    :param successes: The goal-reached trajectories that were clustered, N of them
    :param labels: New mode of each, ``NO_MODE`` for outliers, shape [N]
    :param distances: Their DTW distances, shape [N, N]
    :param failures: The failed trajectories
    :param failure_labels: New mode of each
    :param abandoned: Goal-reached trajectories of modes that were given up
    :param inheritance: Which new mode follows which old one
    """

    successes: list[Trajectory]
    labels: np.ndarray
    distances: np.ndarray
    failures: list[Trajectory]
    failure_labels: np.ndarray
    abandoned: list[Trajectory]
    inheritance: Inheritance

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
    min_size: int,
    max_modes: int,
    patience: int,
    trials: int,
    births: bool,
    min_return_ratio: float = 0.0,
) -> Reclustering:
    """
    :param buffer: Holds the trajectories
    :param modes: The modes so far
    :param cluster: Maps distances [N, N] to labels [N]
    :param min_size: Fewest goal-reached trajectories worth clustering
    :param max_modes: Most modes at a time
    :param patience: Re-clusterings in a row that must find a mode within another before it is merged
    :param trials: Commanded episodes in a row that must miss a mode's route before it is given up
    :param births: Whether modes may be born; the first always may
    :param min_return_ratio: Least mean return of a mode, as a share of the best mode's
    :return: The new modes
    """
    given_up = _given_up(modes, trials) if buffer.has_success_signal else []
    found, failures = _trajectories(buffer, {mode.number for index, mode in enumerate(modes) if index not in given_up})
    abandoned = [trajectory for trajectory in found if trajectory.mode in given_up]
    successes = [trajectory for trajectory in found if trajectory.mode not in given_up]
    distances = np.zeros((len(successes), len(successes)), dtype=np.float32)
    labels = np.full(len(successes), NO_MODE)
    if len(successes) >= min_size:
        distances = buffer.success_distances(successes)
        labels = cluster(distances)

    rng = np.random.RandomState(np.random.randint(2**31))
    dormant = [mode for mode in _dormant(found, len(modes)) if mode not in given_up]
    old_labels = _old_labels(buffer, successes, modes, dormant, rng)
    labels = _defend(modes, distances, old_labels, labels, patience, max_modes)
    returns = np.array([trajectory.episode_return for trajectory in successes])
    labels = _worth_keeping(modes, returns, old_labels, labels, min_return_ratio, max_modes)
    if modes and not births:
        labels = _without_births(modes, old_labels, labels)
    inheritance = _with_dormant(_match(modes, old_labels, labels), modes, dormant, max_modes)

    for mode in modes:
        mode.misses, mode.unjudged = mode.misses + mode.unjudged, 0
    told = {modes[old].number: new for new, old in enumerate(inheritance.parents) if old is not None and inheritance.kept[new]}
    for trajectory, label in zip(successes, labels.tolist(), strict=True):
        if trajectory.mode == NO_MODE and label != NO_MODE and _told(told, trajectory) == label:
            modes[inheritance.parents[label]].misses = 0
    failure_labels = _share_out(buffer, failures, successes, labels, told, rng)
    found_modes = Reclustering(successes, labels, distances, failures, failure_labels, abandoned, inheritance)
    return _foreign_apart(buffer, found_modes, told) if buffer.has_success_signal else found_modes


def _count(labels: np.ndarray) -> int:
    return int(labels.max(initial=NO_MODE)) + 1


def _match(modes: Sequence[Mode], old_labels: np.ndarray, labels: np.ndarray) -> Inheritance:
    """Who continues whom, when each frozen mode has a cluster."""
    frozen = [index for index, mode in enumerate(modes) if mode.frozen]
    return match_modes(old_labels, labels, len(modes), _count(labels), frozen)


def _told(told: dict[int, int], trajectory: Trajectory) -> int:
    """New index of the mode that the trajectory was told to follow, ``NO_MODE`` if there was none or it has ended."""
    return NO_MODE if trajectory.commanded is None else told.get(trajectory.commanded, NO_MODE)


def _share_out(
    buffer: ModeReplayBuffer,
    failures: list[Trajectory],
    successes: list[Trajectory],
    labels: np.ndarray,
    told: dict[int, int],
    rng: np.random.RandomState,
) -> np.ndarray:
    """New mode of every failure. A mode must see its own; those of nobody are shared out by likeness, as in the paper."""
    failure_labels = np.array([_told(told, failure) for failure in failures], dtype=int)
    strayed = np.flatnonzero([failure.commanded not in told and not failure.foreign for failure in failures])
    if _count(labels) and len(strayed):
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
) -> np.ndarray:
    """
    Labels in which a mode that was found no cluster of its own keeps its members: for a while if they lie within another
    mode's cluster, until it is given up if they lie in none. Near the border between one cluster and two, or none, the
    answer changes with every new trajectory, and a mode that ends takes its critics with it.

    A new trajectory in a cluster of which a part is defended goes to the mode of its nearest old one.
    """
    n_new = _count(labels)
    inheritance = match_modes(old_labels, labels, len(modes), n_new)
    labels = labels.copy()
    for old in sorted([*inheritance.merged, *inheritance.retired]):
        members = np.flatnonzero(old_labels == old)
        within_another = old in inheritance.merged
        modes[old].doubts += within_another
        gives_way = modes[old].doubts > patience or n_new >= max_modes
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
        modes[old].doubts = 0
    return labels


def _worth_keeping(
    modes: Sequence[Mode],
    returns: np.ndarray,
    old_labels: np.ndarray,
    labels: np.ndarray,
    min_return_ratio: float,
    max_modes: int,
) -> np.ndarray:
    """Labels without the clusters that return too little, nor the smallest of too many. Frozen modes stay."""
    kept = _match(modes, old_labels, labels)
    frozen = [new for new, old in enumerate(kept.parents) if old is not None and kept.kept[new] and modes[old].frozen]
    others = [new for new in range(_count(labels)) if new not in frozen]
    mean = {new: returns[labels == new].mean() for new in [*frozen, *others]}
    best = max(mean.values(), default=0.0)
    worth = [new for new in others if best <= 0 or mean[new] >= min_return_ratio * best]
    worth.sort(key=lambda new: -np.count_nonzero(labels == new))
    stay = sorted([*frozen, *worth[: max(0, max_modes - len(frozen))]])
    numbers = np.full(_count(labels) + 1, NO_MODE)  # the last for NO_MODE itself
    numbers[stay] = np.arange(len(stay))
    return numbers[labels]


def _trajectories(buffer: ModeReplayBuffer, numbers: set[int]) -> tuple[list[Trajectory], list[Trajectory]]:
    """Goal-reached and failed trajectories, in order of finishing; those foreign to a mode count as failed while it lives."""
    successes, failures = buffer.trajectories(success=True), buffer.trajectories(success=False)
    homeless = [trajectory for trajectory in failures if trajectory.foreign and trajectory.commanded not in numbers]
    for trajectory in homeless:
        buffer.readmit(trajectory)
    successes = sorted([*successes, *homeless], key=lambda trajectory: trajectory.serial)
    return successes, [trajectory for trajectory in failures if trajectory not in homeless]


def _given_up(modes: Sequence[Mode], trials: int) -> list[int]:
    """Modes that cannot be commanded: a clump of wanderings, or a copy of another mode. Unless that is true of all."""
    missing = [index for index, mode in enumerate(modes) if mode.misses >= trials and not mode.frozen]
    return missing if len(missing) < len(modes) else []


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


def _foreign_apart(buffer: ModeReplayBuffer, found: Reclustering, told: dict[int, int]) -> Reclustering:
    """
    The new trajectories that were told to follow one mode, but took the route of another, made failures of the first. Seen as
    successes they would tell its critic that any route will do, and the policy of a longer route would drift to the
    shorter one beside it; unseen they would tell it nothing.

    Those on the route of no mode so far have discovered one. They stay with it, or it would be born without trajectories.
    """
    successes, labels = found.successes, found.labels
    established = {new for new, is_kept in enumerate(found.inheritance.kept) if is_kept}
    foreign: dict[int, int] = {}
    for i, trajectory in enumerate(successes):
        mode = _told(told, trajectory)
        has_route = mode != NO_MODE and mode in labels  # a dormant mode has none yet that one could leave
        if trajectory.mode == NO_MODE and has_route and labels[i] in established - {mode}:
            foreign[i] = mode
            buffer.mark_off_route(trajectory, [successes[j] for j in np.flatnonzero(labels == mode)])
    failures = [*found.failures, *(successes[i] for i in foreign)]
    failure_labels = np.concatenate((found.failure_labels, list(foreign.values()))).astype(int)
    order = np.argsort([failure.serial for failure in failures])
    own = np.array([i for i in range(len(successes)) if i not in foreign], dtype=int)
    return replace(
        found,
        successes=[successes[i] for i in own],
        labels=labels[own],
        distances=found.distances[np.ix_(own, own)],
        failures=[failures[i] for i in order],
        failure_labels=failure_labels[order],
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
    return labels


def _with_dormant(inheritance: Inheritance, modes: Sequence[Mode], dormant: list[int], max_modes: int) -> Inheritance:
    """A mode without data stays as it is until it has some, where there is room: it can still be commanded."""
    heirs = {parent for parent, kept in zip(inheritance.parents, inheritance.kept, strict=True) if kept}
    waiting = sorted((mode for mode in dormant if mode not in heirs), key=lambda mode: not modes[mode].frozen)
    n_frozen = sum(modes[mode].frozen for mode in waiting)
    waiting = waiting[: max(n_frozen, max_modes - len(inheritance.parents))]
    return Inheritance(
        parents=[*inheritance.parents, *waiting],
        kept=[*inheritance.kept, *(True for _ in waiting)],
        merged={old: new for old, new in inheritance.merged.items() if old not in waiting},
        retired=[old for old in inheritance.retired if old not in waiting],
    )
