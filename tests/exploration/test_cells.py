"""Cells that follow what is seen: the same places whatever their unit, against counting from the start."""

import itertools
import warnings
from collections import Counter

import numpy as np
import pytest
import torch as th
from environments import AnySpaces, TwoEnds, copied, fill, merged, small_model
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg.exploration.cells import CellGrid
from sb3_ddiffpg.exploration.novelty import VisitCounts
from sb3_ddiffpg.exploration.visit_map import VisitMap


def walks(seed, dim, n=600, n_walks=6, step=0.3):
    """Where some random walks have been."""
    rng = np.random.default_rng(seed)
    return rng.normal(scale=step, size=(n_walks, n // n_walks, dim)).cumsum(axis=1).reshape(-1, dim).astype(np.float32)


def quiet_fit(grid, positions):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return grid.fit(positions)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.lists(st.integers(-40, 40), min_size=6, max_size=6))
def test_cells_are_the_same_in_any_power_of_two(seed, dim, powers):
    """Exactly: each component in a unit of its own."""
    positions, units = walks(seed, dim), np.float32(2.0) ** np.array(powers[:dim], dtype=np.float32)
    grids = [CellGrid(dim), CellGrid(dim)]
    for grid, each in zip(grids, (positions, positions * units), strict=True):
        assert quiet_fit(grid, each)
        assert grid.edges.dtype == np.float64  # as it is saved
    np.testing.assert_array_equal(grids[1].edges, grids[0].edges * units)
    np.testing.assert_array_equal(grids[1].cells(positions * units), grids[0].cells(positions))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.sampled_from([1e-3, 1e3]))
def test_cells_are_the_same_in_millimetres_and_kilometres(seed, dim, unit):
    """But for the few positions that rounding takes over a border."""
    positions = walks(seed, dim).astype(np.float64)
    units = np.where(np.arange(dim) % 2 == 0, unit, 1.0)
    here, there = CellGrid(dim), CellGrid(dim)
    quiet_fit(here, positions)
    quiet_fit(there, positions * units)
    np.testing.assert_allclose(there.edges, here.edges * units, rtol=1e-9)
    same = (here.cells(positions) == there.cells(positions * units)).all(axis=1)
    assert same.mean() > 0.99


@pytest.mark.parametrize(("dim", "along"), [(1, 32), (2, 16), (3, 8), (4, 5), (5, 4), (8, 4)])
def test_a_component_has_so_many_cells(dim, along):
    """Of what lies between 0 and 1, without the rarest: by hand."""
    grid = CellGrid(dim)
    corners = np.random.default_rng(0).uniform(size=(300, dim))
    assert quiet_fit(grid, np.repeat(corners, 40, axis=0))
    np.testing.assert_allclose(grid.edges, 0.985 / along, rtol=0.03)


def test_nothing_has_a_size_until_enough_has_been_seen():
    grid, positions = CellGrid(2), walks(0, 2)
    assert not grid.fit(positions[:199]) and grid.edges is None
    assert quiet_fit(grid, positions[:200]) and grid.edges is not None


def test_cells_double_when_the_extent_does_and_two_that_were_one_stay_one():
    grid = CellGrid(2)
    small = np.random.default_rng(0).uniform(size=(5000, 2))
    assert grid.fit(small)
    edges, before = grid.edges, grid.cells(small)
    assert not grid.fit(small * [1.9, 1.0])  # not yet
    np.testing.assert_array_equal(grid.edges, edges)
    assert grid.fit(small * [2.1, 1.0])
    np.testing.assert_array_equal(grid.edges, edges * [2.0, 1.0])
    np.testing.assert_array_equal(grid.cells(small), before // [2, 1])  # two cells became one, exactly
    assert grid.fit(small * [2.1, 9.0])
    np.testing.assert_array_equal(grid.edges, edges * [2.0, 8.0])
    assert not grid.fit(small)  # they never shrink: what was one place stays one
    np.testing.assert_array_equal(grid.edges, edges * [2.0, 8.0])


def test_a_component_that_has_not_moved_has_one_cell_until_it_moves():
    rng = np.random.default_rng(0)
    still = np.stack([rng.uniform(size=2000), np.full(2000, 7.3)], axis=1)
    grid = CellGrid(2)
    assert grid.fit(still) and grid.edges[1] == np.inf and np.isfinite(grid.edges[0])
    for value in (7.3, -7.3, 0.0):
        assert set(grid.cells(np.array([[0.5, value]]))[:, 1]) == {0}
    moves = still + rng.uniform(size=(2000, 2)) * [0, 3]
    edge = grid.edges[0]
    assert grid.fit(moves) and grid.edges[0] == edge and grid.edges[1] == pytest.approx(3 / 16, rel=0.05)
    # And where nothing moves at all there is nothing to tell apart
    nowhere = CellGrid(2)
    with pytest.warns(UserWarning, match="almost no step is new"):
        nowhere.fit(np.ones((300, 2)))
    assert np.isinf(nowhere.edges).all() and nowhere.count(np.ones((300, 2))) == 1


def test_a_jump_far_away_does_not_blur_all_places():
    positions = np.random.default_rng(0).uniform(size=(2000, 2))
    plain, jumped = CellGrid(2), CellGrid(2)
    plain.fit(positions)
    jumped.fit(np.concatenate([positions, [[1e6, -1e6]]]))
    np.testing.assert_allclose(jumped.edges, plain.edges, rtol=0.01)
    # But a component of which only the rarest positions move has these
    rare = np.zeros((2000, 1))
    rare[:3, 0] = [1.0, 2.0, 3.2]
    grid = CellGrid(1)
    grid.fit(rare)
    assert grid.edges[0] == pytest.approx(3.2 / 32)


def test_cells_grow_until_not_every_step_is_new():
    """Six components that all move: four cells along each were thousands."""
    positions = np.random.default_rng(0).uniform(size=(1000, 6))
    grid = CellGrid(6)
    quiet_fit(grid, positions)
    assert grid.count(positions) <= 500
    halves = CellGrid(6, edge=1.0)
    halves.edges = grid.edges / 2
    assert halves.count(positions) > 500  # no larger than it takes
    np.testing.assert_allclose(grid.edges / grid.edges[0], 1.0, rtol=0.05)


def test_what_is_useless_is_told_once():
    positions = np.random.default_rng(0).uniform(size=(400, 2))
    for edge, said in ((1e-6, "almost every step is new.*Name fewer"), (50.0, "almost no step is new.*Name other")):
        grid = CellGrid(2, edge)
        with pytest.warns(UserWarning, match=said) as told:
            for _ in range(3):
                assert not grid.fit(positions)
        assert len(told) == 1 and f"novelty.kwargs['cell_size']={edge:g}" in str(told[0].message)
        assert "leave the cell's size out" in str(told[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        CellGrid(2, 0.1).fit(positions)
        CellGrid(2).fit(np.repeat(positions, 4, axis=0))


@pytest.mark.parametrize("edge", [0, -1.0, float("inf"), float("nan")])
def test_a_size_that_cannot_be(edge):
    with pytest.raises(ValueError, match=r"novelty.kwargs\['cell_size'\] must be positive"):
        CellGrid(2, edge)


# ---------------------------------------------------------------------- the map


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.lists(st.integers(0, 4), min_size=3, max_size=3))
def test_a_map_in_larger_cells_is_that_of_counting_from_scratch(seed, dim, doublings):
    positions = walks(seed, dim).astype(np.float64)
    edges = np.random.default_rng(seed).uniform(0.01, 3.0, dim)
    larger = edges * 2.0 ** np.array(doublings[:dim])
    resized, scratch = VisitMap(dim, edges), VisitMap(dim, larger)
    for each in (resized, scratch):
        each.observe(positions)
    resized.note(600)
    resized.resize(larger)
    np.testing.assert_array_equal(resized.cell_size, larger)
    counted = [Counter(dict(zip(map(tuple, each.cells()[0].tolist()), each.cells()[1].tolist(), strict=True)))
               for each in (resized, scratch)]  # fmt: skip
    assert counted[0] == counted[1] and counted[0].total() == 600
    assert resized.coverage == [(600, len(scratch))]


def test_a_map_knows_where_a_component_that_had_not_moved_was():
    """Before it moved it was at 7.3, not at 0."""
    visits = VisitMap(2, np.array([1.0, np.inf]))
    visits.observe(np.array([[0.5, 7.3]] * 4 + [[1.5, 7.3]] * 2))
    assert len(visits) == 2
    visits = VisitMap.from_state(copied(visits.state_dict()))
    visits.observe(np.array([[0.5, 7.3]]))
    visits.resize(np.array([1.0, 0.5]))
    expected = VisitMap(2, np.array([1.0, 0.5]))
    expected.observe(np.array([[0.5, 7.3]] * 5 + [[1.5, 7.3]] * 2))
    assert dict(visits._counts) == dict(expected._counts)


# ---------------------------------------------------------------------- the bonus


def adaptive_model(**changes):
    """Places are told apart in two components that nobody has measured; nothing is learned."""
    settings = {"mode_features": [0, 1], "buffer_size": 5000, "modes": {"distance_threshold": 2.0, "patience": 0}}
    return small_model(AnySpaces(spaces.Box(-200.0, 200.0, (2,))), **merged(settings, changes))


def roam(model, n, size, seed, bonus=True):
    rng = np.random.default_rng(seed)
    paths = [rng.normal(scale=0.3 * size, size=(30, 2)).cumsum(axis=0).astype(np.float32) for _ in range(n)]
    fill(model.replay_buffer, paths, success=False, bonus=model.bonus if bonus else None)
    return paths


@pytest.mark.parametrize("episodic", [True, False])
def test_counting_again_is_counting_from_the_start(episodic):
    """When cells have another size: counts, first visits, where the running episode has been, and the map."""
    model = adaptive_model(novelty={"episodic": episodic})
    bonus, buffer = model.bonus, model.replay_buffer
    paths = roam(model, 20, 1.0, 0)
    assert bonus.grid.edges is None and bonus.n_cells == 0 and bonus.novelty_model.counts.sum() == 0
    assert buffer.first_visits[: buffer.size()].all()
    sizes = []
    for number in range(3):
        bonus.review(buffer, {})
        sizes.append(bonus.grid.edges.copy())
        again = adaptive_model(novelty={"episodic": episodic, "kwargs": {"cell_size": 1.0}})
        again.bonus.grid.edges = sizes[-1]
        again.bonus.visit_map = None
        again.bonus._use_edges()
        fill(again.replay_buffer, paths, success=False, bonus=again.bonus)
        assert th.equal(again.bonus.novelty_model.counts, bonus.novelty_model.counts)
        rows = slice(0, buffer.size())
        np.testing.assert_array_equal(again.replay_buffer.first_visits[rows], buffer.first_visits[rows])
        assert 0 < buffer.first_visits[rows].mean() < 1 or not episodic
        assert again.bonus.visit_map._counts == bonus.visit_map._counts and bonus.n_cells == len(bonus.visit_map)
        paths += roam(model, 20, 10.0**number, number + 1)  # and so on, with steps ten times as long
    doubled = np.log2(sizes[2] / sizes[0])
    np.testing.assert_array_equal(doubled, np.round(doubled))
    assert (doubled >= 1).all()


def test_a_running_episode_knows_where_it_has_been_when_cells_are_others():
    model = adaptive_model()
    bonus, buffer = model.bonus, model.replay_buffer
    roam(model, 20, 1.0, 0)
    there, line = np.array([[0.3, 0.3]], dtype=np.float32), np.linspace(0, 3, 8, dtype=np.float32)

    def step(before, after):
        record = buffer.add(before, after, np.zeros((1, 2), np.float32), np.zeros(1), np.zeros(1), [{}])
        bonus.observe(record, buffer)
        return bool(buffer.first_visits[record.rows[0]])

    for x, following in itertools.pairwise(line):
        step(there * x, there * following)
    bonus.review(buffer, {})
    assert not step(there * 3, there * 1) and not step(there * 1, there * 3)  # it has been at both
    assert step(there * 3, there * 40)


def test_known_cells_are_told_again():
    """In cells of another size: those of the mode that knows its route."""
    model = adaptive_model()
    bonus, buffer = model.bonus, model.replay_buffer
    roam(model, 20, 1.0, 0)
    line = np.stack([np.linspace(0, 4, 12), np.zeros(12)], axis=1).astype(np.float32)
    fill(buffer, [line + 0.01 * k for k in range(8)], True, bonus=bonus)
    model.recluster()
    assert len(model.modes) == 1
    mastered = {0: model.modes[0].number}
    bonus.review(buffer, mastered)
    places = th.as_tensor(np.concatenate([(line + 0.01 * k)[1:] for k in range(8)]))
    for _ in range(2):
        assert bonus.known_cells.contain(places).all() and not bonus.known_cells.contain(th.tensor([[-50.0, 50.0]])).any()
        cells = {tuple(cell) for cell in bonus.grid.cells(places.numpy().astype(np.float32)).tolist()}
        assert abs(int(bonus.known_cells.known.sum()) - len(cells)) <= 2  # single precision at a border
        roam(model, 30, 30.0, 1)
        before = bonus.grid.edges
        bonus.review(buffer, mastered)
    assert (bonus.grid.edges >= 2 * before).any() or (bonus.grid.edges == before).all()


def test_what_is_told_apart_by_others_begins_anew():
    model = adaptive_model()
    roam(model, 20, 1.0, 0)
    bonus, buffer = model.bonus, model.replay_buffer
    bonus.review(buffer, {})
    buffer.use_features([1])
    bonus.restart(1)
    assert bonus.grid.edges is None and bonus.visit_map is None and not bonus.known_cells.any
    bonus.review(buffer, {})
    assert bonus.grid.edges.shape == (1,) and bonus.visit_map.cells()[1].sum() == buffer.size()
    expected = VisitCounts(1, 1)
    expected.use_edges(bonus.grid.edges)
    rows = buffer.stored_rows.rows[: buffer.size()]
    expected.observe(th.as_tensor(buffer.positions(buffer.nexts, "next_observations", rows)))
    assert th.equal(expected.counts, bonus.novelty_model.counts)


def test_cells_are_saved_and_a_file_of_others_is_refused():
    model = adaptive_model()
    roam(model, 20, 1.0, 0)
    model.bonus.review(model.replay_buffer, {})
    state, other = copied(model.bonus.state_dict()), adaptive_model().bonus
    other.load_state_dict(state)
    assert other.grid.adapts and str(other.state_dict()) == str(model.bonus.state_dict())
    th.testing.assert_close(other.novelty_model.edges, model.bonus.novelty_model.edges)
    for wrong in (
        np.array([1.0, 0.0]),
        np.array([1.0, -1.0]),
        np.array([1.0, np.nan]),
        np.ones(2, np.float32),
        np.ones((2, 2)),
    ):
        untouched = adaptive_model().bonus
        before = str(untouched.state_dict())
        with pytest.raises(ValueError, match="bonus.edges"):
            untouched.load_state_dict({**copied(state), "edges": wrong})
        assert str(untouched.state_dict()) == before
    # Those of other mode features say nothing
    other = adaptive_model().bonus
    other.load_state_dict({**copied(state), "edges": np.ones(3), "visits": None})
    assert other.grid.edges is None


def test_a_run_without_a_declared_size_counts_all_of_its_steps():
    class Unmeasured(TwoEnds):
        def __init__(self):
            super().__init__()
            del self.cell_size, self.novelty_cell_size

    model = small_model(DummyVecEnv([Unmeasured] * 4))
    assert model.visits is None
    model.learn(400)
    assert model.bonus.grid.adapts and model.visits.cells()[1].sum() == model.num_timesteps
    assert model.bonus.novelty_model.counts.sum() == model.replay_buffer.counted[: model.replay_buffer.size()].sum()
