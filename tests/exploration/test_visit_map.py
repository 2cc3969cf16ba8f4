"""Visits by cell, against counting by hand."""

from collections import Counter

import numpy as np
import pytest
import torch as th
from environments import AnySpaces, TwoEnds, small_model
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.exploration.visit_map import VisitMap


@given(
    st.integers(1, 3).flatmap(lambda dim: arrays(float, (20, dim), elements=st.floats(-500, 500))),
    st.sampled_from([0.05, 1.0, 3.0]),
)
def test_like_counting_by_hand(positions, cell_size):
    visits = VisitMap(positions.shape[1], cell_size)
    for part in np.array_split(positions, 3):
        visits.observe(part)
    expected = Counter(tuple(np.floor(position / cell_size).astype(int).tolist()) for position in positions)
    centres, counts = visits.cells()
    cells = np.round(centres / cell_size - 0.5).astype(int)
    assert dict(zip(map(tuple, cells.tolist()), counts.tolist(), strict=True)) == dict(expected)
    assert len(visits) == len(expected)


@given(st.lists(st.integers(0, 2), max_size=40))
def test_coverage_keeps_its_curve_and_no_more(gains):
    visits, noted = VisitMap(1, 1.0), []
    for step, gain in enumerate(gains):
        visits.observe(np.arange(len(visits) + gain, dtype=float).reshape(-1, 1))
        visits.note(step)
        noted.append((step, len(visits)))
    if noted:
        steps, known = zip(*noted, strict=True)
        np.testing.assert_allclose(np.interp(steps, *zip(*visits.coverage, strict=True)), known)
    assert len(visits.coverage) <= 2 * (1 + len(visits))


def test_a_run_counts_where_it_has_been(tmp_path):
    model = small_model(DummyVecEnv([TwoEnds] * 4)).learn(400)
    assert model.visits.cells()[1].sum() == model.num_timesteps
    steps, known = zip(*model.visits.coverage, strict=True)
    assert list(steps) == sorted(steps) and list(known) == sorted(known) and known[-1] <= len(model.visits)
    model.save(tmp_path / "model")
    loaded = DDiffPG.load(tmp_path / "model")
    np.testing.assert_array_equal(loaded.visits.cells()[0], model.visits.cells()[0])
    assert loaded.visits.coverage == model.visits.coverage


def test_cells_are_those_of_the_environment():
    assert small_model(make_vec_env("PointMazeV1-v0", 2)).visits.cell_size.tolist() == [1.0, 1.0]
    assert small_model(DummyVecEnv([TwoEnds])).visits.cell_size.tolist() == [0.5]
    for name, dim in (("Pendulum-v1", 3), ("MountainCarContinuous-v0", 2)):  # they declare none: it follows
        model = small_model(name, modes={"max_modes": 2})
        assert model.visits is None and model.learn(400).visits.dim == dim


class Tiny(TwoEnds):
    def __init__(self, cell=0.02, **kwargs):
        super().__init__(**kwargs)
        self.novelty_cell_size = cell


def cells_of(model):
    """The edge of all cells by which places are told apart, None if it follows from what is seen."""
    bonus = model.bonus
    if bonus.grid.edges is None:
        return None
    edges = {float(each) for each in bonus.grid.edges}
    for table in (bonus.novelty_model, bonus.known_cells):
        th.testing.assert_close(table.edges, th.as_tensor(bonus.grid.edges, dtype=th.float32))
    assert len(edges) == 1 and not bonus.grid.adapts
    return edges.pop()


def test_novelty_counts_in_the_cells_that_the_environment_declares(tmp_path):
    model = small_model(DummyVecEnv([Tiny]))
    assert cells_of(model) == 0.02
    assert cells_of(small_model(DummyVecEnv([Tiny]), novelty={"kwargs": {"cell_size": 0.3}})) == 0.3
    assert cells_of(small_model(DummyVecEnv([AnySpaces]))) is None
    # It belongs to the environment's own features, not to yours
    assert cells_of(small_model(DummyVecEnv([Tiny]), mode_features=[1])) is None
    # Also where there is no environment that says it, or one that says something else: what was counted stays
    model.save(tmp_path / "model")
    model.export(tmp_path / "model.safetensors")
    for loaded in (DDiffPG.load(tmp_path / "model"), DDiffPG.load(tmp_path / "model.safetensors", safe=True)):
        assert cells_of(loaded) == 0.02
    assert cells_of(DDiffPG.load(tmp_path / "model", env=DummyVecEnv([TwoEnds]))) == 0.02


@pytest.mark.parametrize("declared", [0, -1.0, "wide", float("inf"), float("nan")])
def test_cells_that_cannot_be_are_refused_by_the_name_of_who_declared_them(declared):
    with pytest.raises(ValueError, match=r"The environment declares novelty_cell_size=.*: it must be a positive number"):
        small_model(DummyVecEnv([lambda: Tiny(declared)]))


@pytest.mark.parametrize(
    ("dim", "cell_size", "message"), [(4, 1.0, "dim must be 1 to 3, got 4"), (2, 0.0, "cell_size must be")]
)
def test_bad_arguments(dim, cell_size, message):
    with pytest.raises(ValueError, match=message):
        VisitMap(dim, cell_size)
