"""Measures of diversity under the names of those who made them, from counts of episodes by route."""

from collections import Counter
from collections.abc import Sequence
from math import comb, log

import numpy as np


def behavior_entropy(counts: Sequence[int], n_behaviors: int) -> float:
    """
    Tell how evenly the successes are spread over the routes (D3IL, Jia et al., 2024): ``-sum_k p_k log_N p_k``.

    :param counts: Successes by route
    :param n_behaviors: Number N of routes that there are, the base of the logarithm
    :return: 0 where all take the same route or there are none, 1 where all N routes are taken alike; NaN if N is less than 2
    """
    if n_behaviors < 2:
        return float("nan")
    total = sum(counts)
    shares = [count / total for count in counts if count]
    return abs(sum(share * log(share) for share in shares)) / log(n_behaviors)


def multi_goal_score(counts: Sequence[int], n_goals: int, n_episodes: int) -> float:
    """
    Tell how many goals are reached, each as often as its share (DrAC, Wang et al., 2025): ``sum_i min(n_i / n, 1 / N)``.

    :param counts: Successes by goal
    :param n_goals: Number N of goals that there are
    :param n_episodes: Number n of episodes, failures included
    :return: 1 where each of the N goals is reached by an N-th of all episodes, 0 where none is reached
    """
    return float(sum(min(count / n_episodes, 1 / n_goals) for count in counts))


def success_after_removal(n_goals: int, n_reached: int, n_removed: int) -> float:
    """
    Tell how likely it is that one of the goals that were reached is left when some are taken away (DrAC).

    :param n_goals: Number N of goals that there are
    :param n_reached: Number R of different ones that were reached
    :param n_removed: Number k of those that are taken away, all sets of k being equally likely
    :return: ``1 - C(k, R) / C(N, R)``
    """
    return 1.0 - comb(n_removed, n_reached) / comb(n_goals, n_reached)


def few_shot_robustness(counts: Sequence[int], n_goals: int, n_episodes: int, n_removed: int, n_trials: int = 5) -> float:
    """
    Tell how likely it is that one of a few trials reaches a goal when some goals are taken away (DrAC's few-shot robustness).
    It is the mean of ``success_after_removal`` over all choices of the trials among the episodes, not over some that were
    drawn.

    :param counts: Successes by goal
    :param n_goals: Number of goals that there are
    :param n_episodes: Number of episodes, failures included
    :param n_removed: Number of goals that are taken away
    :param n_trials: Number of trials; all episodes, if there are fewer
    :return: The probability
    """
    n_trials = min(n_trials, n_episodes)
    # ways[r, t]: choices of t episodes that reach r different goals
    # Whole numbers, which may be larger than floats can be
    ways = np.zeros((len(counts) + 1, n_trials + 1), dtype=object)
    ways[0] = [comb(n_episodes - sum(counts), t) for t in range(n_trials + 1)]
    for count in counts:
        own = np.array([0] + [comb(count, t) for t in range(1, n_trials + 1)], dtype=object)
        more = np.stack([np.convolve(before, own)[: n_trials + 1] for before in ways[:-1]])
        ways[1:] += more
    shares = [int(each) / comb(n_episodes, n_trials) for each in ways[:, n_trials]]
    return sum(share * success_after_removal(n_goals, r, n_removed) for r, share in enumerate(shares) if share)


def qd_archive(
    solutions: Sequence[Sequence[tuple[str | None, float]]], cells: Sequence[str], corrected: bool = True
) -> dict[str, float]:
    """
    Keep the best solution of each cell, as quality-diversity libraries (pyribs, QDax) do. Evaluated once, a lucky solution
    stays in a cell where it seldom comes; corrected for that, it is where it comes most often, with its median objective.

    :param solutions: Evaluations of each solution: the cell in which it came to lie, None for none, and its objective
    :param cells: Names of the cells that there are
    :param corrected: Whether all evaluations of a solution count, or only the first
    :return: Objective of the best solution in each cell that is filled
    """
    archive: dict[str, float] = {}
    for evaluations in solutions:
        counted = list(evaluations) if corrected else list(evaluations[:1])
        if not counted:
            continue
        # Of several that are as frequent the one that came first
        cell = Counter(cell for cell, _ in counted).most_common(1)[0][0]
        objective = float(np.median([objective for _, objective in counted]))
        if cell in cells:
            archive[str(cell)] = max(objective, archive.get(str(cell), -np.inf))
    return archive
