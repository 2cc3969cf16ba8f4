"""Places and the ways between them: against a slow search, and by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_ddiffpg.planning.place_graph import EDGE, UNTRIED, PlaceGraph
from sb3_ddiffpg.planning.travels import Travel


def travel(path, success=True):
    path = np.array(path, dtype=np.float32)
    n = len(path) - 1
    return Travel(np.zeros((n, 1), np.float32), path, np.zeros((n, 1), np.float32), success)


def line(start, end, n):
    return np.linspace(start, end, n)


def slowest(n, edges, costs, targets):
    """Steps left from each place: every way is tried until nothing becomes shorter."""
    left = np.full(n, np.inf)
    left[targets] = 0.0
    for _ in range(n):
        for (before, after), cost in zip(edges, costs, strict=True):
            left[before] = min(left[before], cost + left[after])
    return left


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_plans_are_the_shortest(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 9))
    edges = np.unique(rng.integers(0, n, (12, 2)), axis=0)
    edges = edges[edges[:, 0] != edges[:, 1]]
    steps, penalty = rng.uniform(0.5, 5.0, len(edges)), rng.uniform(0.0, 9.0, n)
    targets = np.unique(rng.integers(0, n, 2))
    graph = PlaceGraph(rng.uniform(size=(n, 2)), 0.1, edges, steps, np.zeros((0, 2)))
    for penalised in (None, penalty):
        costs = (
            steps if penalised is None else [c + (penalty[a] + penalty[b]) / 2 for c, (a, b) in zip(steps, edges, strict=True)]
        )
        plan = graph.plan(targets, penalised)
        np.testing.assert_allclose(plan.left, slowest(n, edges.tolist(), costs, targets))
        for place in range(n):
            ahead = plan.ahead(place, n + 1)
            if np.isfinite(plan.left[place]):
                assert ahead[-1] in targets and (np.diff(plan.left[ahead]) < 0).all()
            else:
                assert ahead == [place]


def test_a_way_by_hand():
    """Along one line of 26 places: to the end one step of a place takes as long as it took, and back twice that."""
    graph = PlaceGraph.of([travel(line([0, 0], [25, 0], 51))], np.ones(2))
    assert graph.spacing == pytest.approx(1.0) and len(graph) == 26
    plan = graph.plan(graph.nearest(np.array([[25.0, 0.0]])))
    start = int(graph.nearest(np.array([[0.0, 0.0]]))[0])
    # Half a place a step. Of the four neighbours of a place two are known, of the first and the last one
    middle, end = 1 + EDGE * 2 / 4, 1 + EDGE * 3 / 4
    positions = np.sort(graph.positions[:, 0])
    slow = np.array([end, *[middle] * 24, end])
    expected = (np.diff(positions) / 0.5 * (slow[1:] + slow[:-1]) / 2).sum()
    assert plan.left[start] == pytest.approx(expected)
    back = graph.plan(np.array([start]))
    assert back.left[int(graph.nearest(np.array([[25.0, 0.0]]))[0])] == pytest.approx(UNTRIED * expected)


def test_the_end_of_an_episode_does_not_lead_to_the_beginning_of_the_next():
    two = [travel(line([0, 0], [10, 0], 31)), travel(line([0, 10], [10, 10], 31))]
    graph = PlaceGraph.of(two, np.ones(2))
    first, second = graph.nearest(np.array([[10.0, 0.0], [0.0, 10.0]]))
    assert not np.isfinite(graph.plan(np.array([second])).left[first])


def test_where_one_got_on_slowly_is_avoided():
    """Two ways of the same length, on one of which an episode stood still for long."""
    detour = [line([0, 0], [0, 5], 11), line([0, 5], [10, 5], 21), line([10, 5], [10, 0], 11)]
    other = [part * [1, -1] for part in detour]
    still = np.repeat([[5.0, -5.0]], 200, axis=0)
    slow = [other[0], other[1][:11], still, other[1][11:], other[2]]
    for a, b in ((detour, slow), (slow, detour)):
        graph = PlaceGraph.of([travel(np.concatenate(a)), travel(np.concatenate(b))], np.ones(2))
        plan = graph.plan(np.unique(graph.goal_places))
        way = graph.positions[plan.ahead(int(graph.nearest(np.array([[0.0, 0.0]]))[0]), 100)]
        assert way[:, 1].max() > 4 and way[:, 1].min() > -1


def test_straight_lines_keep_to_known_places():
    corner = np.concatenate((line([0, 0], [10, 0], 41), line([10, 0], [10, 10], 41)))
    graph = PlaceGraph.of([travel(corner)], np.ones(2))
    targets = np.array([[5.0, 0.0], [9.9, 0.1], [10.0, 10.0], [10.0, 3.0]])
    assert graph.sees(np.array([0.0, 0.0]), targets).tolist() == [True, True, False, False]
    assert graph.sees(np.array([10.0, 0.0]), targets).all()


def test_goals_are_where_successes_ended():
    graph = PlaceGraph.of([travel(line([0, 0], [9, 0], 19)), travel(line([0, 0], [0, 9], 19), success=False)], np.full(2, 3.0))
    np.testing.assert_allclose(graph.goals, [[3.0, 0.0]])


def test_comes_back_from_plain_values_and_refuses_others():
    graph = PlaceGraph.of([travel(line([0, 0], [9, 3], 19))], np.ones(2))
    state = graph.state_dict()
    again = PlaceGraph.from_state(state, 2)
    np.testing.assert_array_equal(again.plan(again.goal_places).left, graph.plan(graph.goal_places).left)
    beyond, negative = state["edges"].copy(), -state["steps"]
    beyond[0, 0] = len(graph)
    for name, value, message in (
        ("edges", beyond, "accepted are the places"),
        ("steps", negative, "not negative"),
        ("positions", state["positions"] * np.nan, "finite"),
        ("positions", state["positions"][:, :1], "shape"),
        ("spacing", 0.0, "accepted are places"),
        ("colour", 1, "unknown field"),
    ):
        with pytest.raises(ValueError, match=message):
            PlaceGraph.from_state({**state, name: value}, 2)
