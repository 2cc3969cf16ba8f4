"""Which components of an observation tell places apart, where neither environment nor user say it."""

from collections.abc import Sequence

import numpy as np

#: Most components that are chosen: counting visits needs few
MOST_FEATURES = 3
# Of the farthest-going component's travel, how much one must have
_TRAVELS = 0.4
# Correlation from which on two components say the same
_ALIKE = 0.99
# Points at which paths are laid side by side
_N_POINTS = 32


def travels(episodes: Sequence[np.ndarray]) -> np.ndarray:
    """
    How far each component goes, in its own steps. A position goes on from where it was, and comes far by many small steps; a
    velocity or a contact goes to and fro. Nothing depends on a component's unit.

    :param episodes: Observations of each, shape [length, D]
    :return: Mean over the episodes of the largest distance from the start, by the mean step, shape [D]; 0 for what does not
        change within an episode
    """
    long = [each for each in episodes if len(each) > 1]
    if not long:
        return np.zeros(episodes[0].shape[1] if len(episodes) else 0)
    steps = np.concatenate([np.abs(np.diff(each, axis=0)) for each in long]).mean(axis=0)
    farthest = np.mean([np.abs(each - each[0]).max(axis=0) for each in long], axis=0)
    size = np.max([np.abs(each).max(axis=0) for each in long], axis=0)
    moves = steps > 1e-6 * size
    return np.divide(farthest, steps, out=np.zeros(len(steps)), where=moves)


def parts(paths: Sequence[np.ndarray], deviations: np.ndarray) -> np.ndarray:
    """
    How far paths that begin alike part along each component.

    :param paths: Of episodes that reached the goal, shape [length, D]
    :param deviations: Standard deviation of each component over all that was seen, shape [D]
    :return: Largest standard deviation over the paths at one share of their length, less that at the start, shape [D]
    """
    shares = np.linspace(0, 1, _N_POINTS)
    side_by_side = np.stack([_at_shares(each, shares) for each in paths]) / deviations
    spread = side_by_side.std(axis=0)
    return spread.max(axis=0) - spread[0]


def _at_shares(path: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Where it was after these shares of its steps, [len(shares), D]."""
    times = np.linspace(0, 1, len(path))
    return np.stack([np.interp(shares, times, column) for column in path.T], axis=1)


def choose_features(episodes: Sequence[np.ndarray], goal_reached: Sequence[np.ndarray] = ()) -> np.ndarray:
    """
    :param episodes: Observations of each, shape [length, D]
    :param goal_reached: Those of them that reached the goal, if any
    :return: Indices of the components that go far, in all episodes or in these, at most ``MOST_FEATURES``: if more do, those
        along which the goal-reached paths part most, else the farthest-going. Of those that say the same one is taken
    """
    shares = np.stack([_shares_of_farthest(each) for each in (episodes, goal_reached) if len(each)])
    if not shares.any():
        return np.arange(min(shares.shape[1], MOST_FEATURES))
    seen = np.concatenate(list(episodes))
    deviations = seen.std(axis=0)
    candidates = np.flatnonzero((shares.max(axis=0) >= _TRAVELS) & (deviations > 0))
    rank = shares.max(axis=0)[candidates]
    if len(candidates) > MOST_FEATURES and len(goal_reached) > 1:
        rank = parts([each[:, candidates] for each in goal_reached], deviations[candidates])
    standardized = (seen - seen.mean(axis=0)) / np.where(deviations > 0, deviations, 1.0)
    chosen: list[int] = []
    for each in candidates[np.argsort(-rank, kind="stable")].tolist():
        alike = [abs(float((standardized[:, each] * standardized[:, other]).mean())) for other in chosen]
        if len(chosen) < MOST_FEATURES and max(alike, default=0.0) < _ALIKE:
            chosen.append(each)
    return np.sort(np.array(chosen, dtype=np.int64))


def _shares_of_farthest(episodes: Sequence[np.ndarray]) -> np.ndarray:
    """How far each component goes, as a share of the one that goes farthest, [D]."""
    far = travels(episodes)
    return far / far.max() if far.max(initial=0.0) > 0 else far
