"""Measures of diversity under the names of those who made them, from counts of episodes by route."""

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
    ways = np.zeros((len(counts) + 1, n_trials + 1))
    ways[0] = [comb(n_episodes - sum(counts), t) for t in range(n_trials + 1)]
    for count in counts:
        own = [0.0] + [float(comb(count, t)) for t in range(1, n_trials + 1)]
        more = np.stack([np.convolve(before, own)[: n_trials + 1] for before in ways[:-1]])
        ways[1:] += more
    share = ways[:, n_trials] / comb(n_episodes, n_trials)
    return float(sum(p * success_after_removal(n_goals, r, n_removed) for r, p in enumerate(share) if p))
