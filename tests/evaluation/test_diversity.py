"""Others' measures of diversity, beside cases counted by hand, by enumeration, and by SciPy."""

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import entropy

from sb3_ddiffpg.evaluation.diversity import (
    behavior_entropy,
    few_shot_robustness,
    multi_goal_score,
    qd_archive,
    success_after_removal,
)
from sb3_ddiffpg.evaluation.results import CommandResult, ModeEvaluation
from sb3_ddiffpg.evaluation.rollout import EpisodeResult


def evaluation(labels, n_episodes, listed):
    uncommanded = CommandResult(None, n_episodes, sum(labels.values()), 10.0, 1.0, labels)
    return ModeEvaluation("Maze-v0", "environment", listed, 0.0, uncommanded, (), ())


@given(st.lists(st.integers(0, 50), min_size=1, max_size=24).filter(any), st.integers(2, 24))
def test_entropy_is_scipys(counts, n_behaviors):
    assert behavior_entropy(counts, n_behaviors) == pytest.approx(entropy(counts, base=n_behaviors), abs=1e-12)


def test_entropy_by_hand():
    assert behavior_entropy([4] * 24, 24) == pytest.approx(1.0)  # D3IL's demonstrations: four of each of 24 routes
    assert behavior_entropy([50, 50], 4) == pytest.approx(0.5)
    assert behavior_entropy([7], 24) == behavior_entropy([], 24) == 0.0
    assert math.isnan(behavior_entropy([7], 1))


def test_multi_goal_score_by_hand():
    assert multi_goal_score([25, 25, 25, 25], 4, 100) == pytest.approx(1.0)
    assert multi_goal_score([100], 4, 100) == pytest.approx(0.25)
    assert multi_goal_score([10, 60], 4, 100) == pytest.approx(0.1 + 0.25)
    assert multi_goal_score([], 4, 100) == 0.0


@pytest.mark.parametrize("n_goals", [1, 3, 5])
def test_removal_is_that_of_all_sets(n_goals):
    for n_reached in range(n_goals + 1):
        for n_removed in range(n_goals + 1):
            sets = [set(removed) for removed in combinations(range(n_goals), n_removed)]
            left = [bool(set(range(n_reached)) - removed) for removed in sets]
            assert success_after_removal(n_goals, n_reached, n_removed) == pytest.approx(np.mean(left))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 3), max_size=3), st.integers(0, 3), st.integers(0, 4), st.integers(1, 5))
def test_few_shots_are_all_choices_of_trials_and_goals(counts, n_failed, n_removed, n_trials):
    n_goals, episodes = 4, np.repeat([*range(len(counts)), -1], [*counts, n_failed]).tolist()
    if not episodes:
        return
    n_trials = min(n_trials, len(episodes))
    succeeds = [
        any(goal >= 0 and goal not in removed for goal in trials)
        for trials in combinations(episodes, n_trials)
        for removed in combinations(range(n_goals), n_removed)
    ]
    assert few_shot_robustness(counts, n_goals, len(episodes), n_removed, n_trials) == pytest.approx(np.mean(succeeds))


def test_of_an_evaluation():
    """Routes that are not listed count as none of these measures' goals."""
    found = evaluation({"a": 60, "b": 20, "by the way": 10}, 100, ("a", "b", "c", "d"))
    assert found.behavior_entropy == pytest.approx(entropy([60, 20], base=4))
    assert (found.reachable_modes, found.multi_goal_score) == (2, pytest.approx(0.25 + 0.2))
    assert found.few_shot_robustness(4) == 0.0
    assert found.few_shot_robustness(0) == pytest.approx(1 - math.comb(20, 5) / math.comb(100, 5))
    summary = found.to_dict()["summary"]
    assert summary["few_shot_robustness"] == [found.few_shot_robustness(k) for k in range(5)]
    with pytest.raises(ValueError, match="n_removed: 5 given; accepted are 0 to 4"):
        found.few_shot_robustness(5)
    with pytest.raises(ValueError, match="n_trials: 0 given"):
        found.few_shot_robustness(1, 0)


def test_without_listed_routes():
    found = evaluation({"a": 9}, 10, ())
    assert all(map(math.isnan, (found.behavior_entropy, found.reachable_modes, found.multi_goal_score)))
    assert math.isnan(found.few_shot_robustness(1))
    assert found.to_dict()["summary"]["multi_goal_score"] is None


def test_robustness_of_many_trials():
    """Numbers of choices beyond what a float holds: 600 trials of 2000 episodes that reach all goals leave one of two."""
    assert few_shot_robustness([1000, 500], 2, 2000, 1, n_trials=600) == pytest.approx(1.0)
    assert few_shot_robustness([1500, 0], 2, 2000, 1, n_trials=600) == pytest.approx(0.5)


ARCHIVE = [
    [("up", 3.0), ("down", 1.0), ("down", 2.0), (None, 0.0)],  # was lucky once
    [("up", 1.0), ("up", 1.5), ("up", 5.0)],
    [("up", 2.0), ("up", 1.0)],
    [(None, 0.0), ("left", 9.0), ("left", 9.0)],
    [("elsewhere", 7.0)],
    [],
]


@pytest.mark.parametrize(("corrected", "expected"), [(False, {"up": 3.0}), (True, {"down": 1.5, "up": 1.5, "left": 9.0})])
def test_archive_by_hand(corrected, expected):
    assert qd_archive(ARCHIVE, ["up", "down", "left", "right"], corrected) == expected


def test_score_of_an_evaluation_by_hand():
    """Failures lie in no cell, whatever the environment calls their route."""

    def runs(*labels):
        return [EpisodeResult(label != "lost", 5, value, label, np.zeros((6, 2))) for label, value in labels]

    episodes = {"a": runs(("up", 1.0), ("up", 3.0), ("lost", 0.0)), "b": runs(("lost", 0.0), ("lost", -2.0), ("down", 1.0))}
    commanded = tuple(CommandResult(name, 3, 2, 5.0, 1.0, {}) for name in episodes)
    uncommanded = CommandResult(None, 1, 0, 5.0, 0.0, {})
    found = ModeEvaluation("Maze-v0", "environment", ("up", "down", "lost"), 0.0, uncommanded, commanded, (), True, episodes)
    assert found.qd_archive() == {"up": 1.0} and found.qd_score(offset=0.5) == 1.5
    assert found.qd_archive(corrected=False) == {"up": 1.0} and found.qd_score(corrected=False) == 1.0
    with pytest.raises(ValueError, match="from a file"):
        ModeEvaluation.from_dict(found.to_dict()).qd_score()
