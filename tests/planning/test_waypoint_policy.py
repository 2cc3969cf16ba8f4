"""A policy that goes somewhere: what it learns from, and that it does."""

import numpy as np
import pytest
import torch as th

from sb3_ddiffpg.planning.travels import Travel
from sb3_ddiffpg.planning.waypoint_policy import WaypointPolicy, _in_all_directions


def test_what_a_step_shows_by_hand():
    """Where the episode was two steps later, in scale; of the last step, half of that is known, and doubled."""
    policy = WaypointPolicy(1, 1, 1, horizon=2)
    path = np.array([[0.0], [2.0], [6.0], [14.0]], dtype=np.float32)
    actions = np.array([[0.1], [0.2], [0.3]], dtype=np.float32)
    travel = Travel(np.array([[7.0], [8.0], [9.0]], dtype=np.float32), path, actions, True)
    seen, moves, shown = policy._lessons(travel, np.array([2.0]))
    assert seen.tolist() == [[7.0], [8.0], [9.0]] and moves.tolist() == [[3.0], [6.0], [8.0]]
    np.testing.assert_array_equal(shown, actions)


def test_directions_that_are_rare_count_as_much():
    moves = np.array([[1.0, 0.0]] * 6 + [[-1.0, 0.2]] * 2 + [[0.1, 3.0]])
    weights = _in_all_directions(moves, np.ones(9))
    assert weights[:6].sum() == pytest.approx(1.0) and weights[6:8].sum() == pytest.approx(1.0)
    assert weights[8] == pytest.approx(1.0)


def test_goes_where_it_is_told_and_as_fast_as_was_seen():
    """The world turns actions by a quarter, and half of the steps go nowhere, which is not what it learns."""
    rng, turn = np.random.default_rng(0), np.array([[0.0, 1.0], [-1.0, 0.0]])
    travels = []
    for _ in range(60):
        heading = rng.normal(size=2)
        actions = np.repeat((heading / np.linalg.norm(heading))[None], 40, axis=0) * (0.9 if rng.random() < 0.5 else 0.01)
        path = np.concatenate((np.zeros((1, 2)), np.cumsum(actions @ turn, axis=0)))
        travels.append(Travel(np.zeros((40, 1), np.float32), path.astype(np.float32), actions.astype(np.float32), False))
    th.manual_seed(0)
    np.random.seed(0)
    policy = WaypointPolicy(1, 2, 2, horizon=5)
    policy.fit(travels, np.ones(2), 400)
    directions = rng.normal(size=(100, 2)) * 10.0 ** rng.uniform(-2, 2, (100, 1))  # however far it is
    moved = policy(np.zeros((100, 1), np.float32), directions) @ turn
    cosine = (moved * directions).sum(axis=1) / np.linalg.norm(moved, axis=1) / np.linalg.norm(directions, axis=1)
    assert cosine.min() > 0.95 and np.linalg.norm(moved, axis=1).mean() == pytest.approx(0.9, abs=0.1)


def test_comes_back_from_plain_values_and_refuses_others():
    policy, other = WaypointPolicy(3, 2, 1, horizon=4), WaypointPolicy(3, 2, 1, horizon=1)
    policy.pace = 2.0
    state = policy.state_dict()
    other.load_state_dict(state)
    inputs, directions = np.ones((5, 3), np.float32), np.random.default_rng(0).normal(size=(5, 2))
    np.testing.assert_array_equal(policy(inputs, directions), other(inputs, directions))
    assert other.horizon == 4
    for changed, message in (
        ({"net": {}}, "weights"),
        ({"horizon": 0}, "horizon"),
        ({"mean": state["mean"][:2]}, "shape"),
        ({"pace": float("nan")}, "finite"),
        ({"deviation": 0 * state["deviation"]}, "above 0"),
    ):
        with pytest.raises(ValueError, match=message):
            other.load_state_dict({**state, **changed})
