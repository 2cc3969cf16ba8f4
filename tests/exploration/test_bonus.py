"""The exploration bonus alone: arrays in place of a replay buffer, and steps made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from environments import copied

from sb3_ddiffpg.buffers.batch import VisitedSteps
from sb3_ddiffpg.buffers.trajectory import StepRecord
from sb3_ddiffpg.exploration.bonus import ExplorationBonus
from sb3_ddiffpg.exploration.bonus_factory import make_bonus
from sb3_ddiffpg.exploration.cells import CellGrid
from sb3_ddiffpg.exploration.known_regions import NO_ROUTE, KnownRoute
from sb3_ddiffpg.exploration.novelty import RandomNetworkDistillation, VisitCounts
from sb3_ddiffpg.exploration.settings import ExplorationSettings, NoveltySettings
from sb3_ddiffpg.serialization.safetensors_tree import read, write
from sb3_ddiffpg.utils.divergence import DivergenceWatch

#: From 0 to 10, of a mode with this number
ROUTE = KnownRoute(5, np.linspace(0, 10, 20, dtype=np.float32).reshape(1, 20, 1), 0.6)
WATCH = DivergenceWatch(th.device("cpu"))


class Alone:
    """A bonus in cells of edge 1 on a line, and what is noted of each row."""

    def __init__(self, n_envs=2, novelty_model=None, exploration=None, **settings):
        self.bonus = ExplorationBonus(
            VisitCounts(1, 1, cell_size=1.0) if novelty_model is None else novelty_model,
            dim=1,
            settings=NoveltySettings(**{"normalize": False, "scale": 0.0, "coef": 1.0, **settings}),
            exploration=ExplorationSettings() if exploration is None else exploration,
            n_envs=n_envs,
            grid=CellGrid(1, 1.0),
        )
        self.notes = SimpleNamespace(
            has_modes=True,
            first_visits=np.zeros(100, dtype=bool),
            followed=np.full(100, -7, np.int32),
            counted=np.zeros(100, dtype=bool),
        )
        self.n_rows, self.began = 0, [False] * n_envs

    def step(self, *positions, start=(), end=()):
        """Environments come to these places; those that begin there come from ``start``, those in ``end`` end there."""
        n = len(positions)
        started = np.flatnonzero(~np.array(self.began))
        rows = np.arange(self.n_rows, self.n_rows + n)
        record = StepRecord(
            rows=rows,
            positions=np.array(positions, dtype=np.float32)[:, None],
            scale=np.ones(1, dtype=np.float32),
            started=started,
            start_positions=np.array(start, dtype=np.float32).reshape(-1, 1),
            finished=[(env, None) for env in end],
        )
        assert len(start) == len(started)
        self.bonus.observe(record, self.notes)
        self.n_rows += n
        self.began = [env not in end for env in range(n)]
        return rows

    def noted(self, rows):
        return [getattr(self.notes, name)[rows].tolist() for name in ("first_visits", "followed", "counted")]


def steps(present, positions, next_positions=None, first_visits=True, followed=NO_ROUTE):
    """What a batch has visited; all positions in one list."""
    present = np.array(present, dtype=bool)
    n = int(present.sum())
    before = th.as_tensor(positions, dtype=th.float32).reshape(-1, 1)
    after = before if next_positions is None else th.as_tensor(next_positions, dtype=th.float32).reshape(-1, 1)
    assert len(before) == len(after) == n
    return VisitedSteps(
        present, before, after, before, after, np.broadcast_to(first_visits, n).copy(), np.broadcast_to(followed, n).copy()
    )


def test_places_that_an_episode_sees_first():
    """Of each environment its own, where it began included, and anew in its next episode."""
    alone = Alone()
    first = [alone.notes.first_visits[rows].tolist() for rows in (
        alone.step(1.5, 0.2, start=(0.5, 0.5)),  # the second stays where it began
        alone.step(0.1, 1.1),  # the first comes back there
        alone.step(2.5, 0.9, end=(0,)),
        alone.step(1.5, 1.5, start=(2.5,)),  # its next episode, which has been at 2.5 alone
        alone.step(2.2, 2.2),
    )]  # fmt: skip
    assert first == [[True, False], [False, True], [True, False], [True, False], [False, True]]


def test_all_places_pay_where_nothing_is_episodic():
    alone = Alone(episodic=False)
    for _ in range(3):
        rows = alone.step(0.5, 0.5, start=() if alone.n_rows else (0.5, 0.5))
        assert alone.notes.first_visits[rows].all()


def test_visits_are_counted_but_for_those_past_a_known_route():
    alone = Alone(exploration=ExplorationSettings(past_modes=False))
    bonus = alone.bonus
    bonus.routes.replace([ROUTE])
    for x in range(12):  # one along the route, the other to and fro
        start = () if x else (0.0, 3.4)
        rows = alone.step(x + 0.5, 3.5 - x % 2, start=start)
        past = x >= 7  # in the eighth tenth
        assert alone.noted(rows)[1:] == [[5 if past else NO_ROUTE, NO_ROUTE], [not past, True]]
    assert bonus.novelty_model.counts.sum() == 12 + 7
    assert bonus.visit_map.cells()[1].sum() == 24  # the map is of all visits
    alone.step(12.5, 3.5, end=(0, 1))
    rows = alone.step(0.5, 0.5, start=(0.0, 0.0))
    assert alone.noted(rows)[1:] == [[NO_ROUTE] * 2, [True] * 2]


def test_nothing_is_observed_where_nothing_counts():
    """The mean of nothing is NaN."""
    alone = Alone(n_envs=1, novelty_model=RandomNetworkDistillation(1, 1))
    alone.bonus.routes.replace([ROUTE])
    alone.step(0.5, start=(0.0,))
    alone.bonus.routes.followed[:] = 5
    before = {name: value.clone() for name, value in alone.bonus.novelty_model.state_dict().items()}
    assert alone.noted(alone.step(1.5))[1:] == [[5], [False]]
    assert all(th.equal(value, before[name]) for name, value in alone.bonus.novelty_model.state_dict().items())


def test_forgotten_episodes_have_been_nowhere():
    alone = Alone()
    alone.bonus.routes.replace([ROUTE])
    alone.step(0.5, 1.5, start=(0.2, 1.2))
    alone.bonus.routes.followed[:] = 5
    alone.bonus.forget_episodes()
    assert alone.bonus.routes.followed.tolist() == [NO_ROUTE] * 2
    alone.began = [False] * 2
    assert alone.noted(alone.step(0.5, 1.5, start=(7.0, 7.0)))[0] == [True, True]


# ---------------------------------------------------------------------- what is paid


def test_rewards_by_hand():
    """1 / sqrt(1 + n) less half of that of the place before, discounted along the window, where it is paid."""
    alone = Alone(scale=0.5, coef=2.0)
    alone.bonus.novelty_model.observe(th.full((3, 1), 0.5))  # the cell at 0 three times: its novelty is 0.5
    visited = steps([[[True, True], [True, False]]], [0.5, 1.5, 5.5], [1.5, 0.5, 6.5], first_visits=[True, True, False])
    rewards, metrics = alone.bonus.reward(visited, 0.9, 0.5, WATCH)
    # From 0 to 1: 1 - 0.25; from 1 to 0: 0.5 - 0.5; the last was no first visit
    np.testing.assert_allclose(rewards, [[2.0 * 0.75, 0.0]], rtol=1e-6)
    assert metrics["intrinsic_reward"].item() == pytest.approx(0.75 / 3) and metrics.keys() == {"intrinsic_reward"}


def test_each_group_has_its_discount_and_modes_are_paid_what_is_more_than_ordinary():
    alone = Alone()
    visited = steps(np.ones((2, 1, 2)), [1.5, 2.5, 1.5, 2.5])
    alone.bonus.novelty_model.observe(th.full((3, 1), 2.5))  # novelties 1 and 0.5, of which the mean is 0.75
    rewards, _ = alone.bonus.reward(visited, 0.9, 0.5, WATCH)
    np.testing.assert_allclose(rewards, [[1 + 0.9 * 0.5], [0.25 + 0.5 * -0.25]], rtol=1e-6)
    assert alone.bonus.moments.mean.item() == pytest.approx(0.75) and alone.bonus.moments.count.item() == 4


@pytest.mark.parametrize("normalize", [True, False])
def test_the_running_mean_pays_a_mode_nothing(normalize):
    alone = Alone(normalize=normalize)
    alone.bonus.moments.load_state_dict({"mean": th.ones(1), "var": th.full((1,), 0.04), "count": th.full((1,), 1e5)})
    rewards, _ = alone.bonus.reward(steps(np.ones((2, 3, 1)), [1.5, 2.5, 3.5] * 2), 0.9, 0.9, WATCH)
    np.testing.assert_allclose(rewards[1], 0.0, atol=1e-5)
    assert (rewards[0] > 0.9).all()


def test_rewards_are_in_deviations_and_limited():
    alone = Alone(normalize=True, clip=3.0)
    alone.bonus.moments.load_state_dict({"mean": th.zeros(1), "var": th.full((1,), 0.25), "count": th.full((1,), 1e5)})
    alone.bonus.novelty_model.observe(th.full((3, 1), 2.5))
    rewards, _ = alone.bonus.reward(steps(np.ones((1, 2, 1)), [1.5, 2.5]), 0.9, 0.9, WATCH)
    np.testing.assert_allclose(rewards, [[2.0, 1.0]], rtol=1e-3)
    alone.bonus.moments.var.fill_(0.01)
    rewards, _ = alone.bonus.reward(steps(np.ones((1, 2, 1)), [1.5, 2.5]), 0.9, 0.9, WATCH)
    np.testing.assert_allclose(rewards, [[3.0, 3.0]], rtol=1e-3)


@pytest.mark.parametrize("groups", [1, 2])
def test_where_nothing_asks_for_the_mean_no_statistics_are_gathered(groups):
    alone = Alone()
    alone.bonus.reward(steps(np.ones((groups, 2, 1)), [1.5, 2.5] * groups), 0.9, 0.9, WATCH)
    assert (alone.bonus.moments.count.item() > 0) == (groups > 1)


def test_a_measure_learns_after_it_was_asked():
    th.manual_seed(0)
    alone = Alone(novelty_model=RandomNetworkDistillation(1, 1))
    alone.bonus.novelty_model.observe(th.linspace(-3, 3, 20)[:, None])
    visited = steps(np.ones((1, 2, 1)), [1.5, 2.5])
    before = alone.bonus.novelty_model.novelty(visited.next_positions, visited.next_positions)
    rewards, metrics = alone.bonus.reward(visited, 0.9, 0.9, WATCH)
    th.testing.assert_close(rewards[0], before)
    again = alone.bonus.novelty_model.novelty(visited.next_positions, visited.next_positions)
    assert metrics["novelty_loss"] > 0 and not th.equal(again, before)


def test_a_measure_that_sees_observations_sees_them_encoded():
    alone = Alone(novelty_model=RandomNetworkDistillation(1, 3, with_observation=True))
    alone.bonus.novelty_model.observe(th.linspace(-3, 3, 20)[:, None])
    asked = []

    def encode(observations):
        asked.append(observations)
        return th.cat([observations] * 3, dim=1)

    visited = steps(np.ones((1, 2, 1)), [1.5, 2.5], [2.5, 3.5])
    alone.bonus.reward(visited, 0.9, 0.9, WATCH, encode)
    assert len(asked) == 2 and asked[0] is visited.observations and asked[1] is visited.next_observations


@pytest.mark.parametrize("off_modes", [True, False])
def test_known_cells_pay_explorers_nothing(off_modes):
    alone = Alone()
    if off_modes:
        alone.bonus.known_cells.replace({3: th.tensor([[2.5]])})
    rewards, _ = alone.bonus.reward(steps(np.ones((2, 2, 1)), [1.5, 2.5] * 2), 0.9, 0.9, WATCH)
    assert (rewards[0] > 0).tolist() == [True, not off_modes]
    ordinary = alone.bonus.moments.mean.item()
    np.testing.assert_allclose(rewards[1] + ordinary, [1.0, 1.0])  # modes go where they know


def test_past_a_known_route_explorers_are_paid_nothing_and_their_returns_end():
    alone = Alone()
    visited = steps(np.ones((2, 2, 2)), np.arange(8) + 0.5, followed=[NO_ROUTE, 5, NO_ROUTE, 4, NO_ROUTE, 5, 5, 5])
    alone.bonus.routes.replace([ROUTE])
    rewards, _ = alone.bonus.reward(visited, 1.0, 1.0, WATCH)
    ordinary = 2 * alone.bonus.moments.mean.item()
    np.testing.assert_allclose(rewards[0], [1.0, 2.0])  # 4 is a route that is known no more
    np.testing.assert_allclose(rewards[1] + ordinary, [2.0, 2.0])
    batch = SimpleNamespace(visited=visited, discounts=th.full((2, 2), 0.9))
    batch._replace = lambda discounts: discounts
    np.testing.assert_allclose(alone.bonus.end_past_routes(batch), [[0.0, 0.9], [0.9, 0.9]])
    np.testing.assert_allclose(batch.discounts, 0.9)  # the batch itself is as it was
    alone.bonus.forget_routes()
    assert alone.bonus.end_past_routes(batch) is batch


# ---------------------------------------------------------------------- known cells


def test_cells_of_a_mode_that_tells_nothing_stay():
    cells = Alone().bonus.known_cells
    cells.replace({3: th.tensor([[0.5], [1.5], [0.6]]), 4: th.tensor([[1.5], [7.5]])})
    assert [len(cells.by_mode[number]) for number in (3, 4)] == [2, 2] and cells.any
    places = th.tensor([[0.5], [1.5], [7.5], [3.5]])
    cells.replace({3: None, 4: th.tensor([[3.5]])})  # as after loading without the buffer
    assert cells.contain(places).tolist() == [True, True, False, True]
    cells.replace({4: None})  # 3 was deleted
    assert cells.contain(places).tolist() == [False, False, False, True]
    cells.replace({6: None})  # of which nothing was ever known
    assert not cells.known.any() and not cells.any


def test_cells_of_an_older_file_stay_until_all_modes_have_told_theirs():
    cells, older = Alone().bonus.known_cells, Alone().bonus.known_cells
    older.replace({3: th.tensor([[0.5], [1.5]])})
    cells.load_state_dict(older.state_dict())
    assert cells.any and not cells.by_mode
    places = th.tensor([[0.5], [1.5], [7.5]])
    cells.replace({3: None, 4: th.tensor([[7.5]])})
    assert cells.contain(places).tolist() == [True, True, True]
    cells.replace({3: th.tensor([[1.5]]), 4: None})
    assert cells.contain(places).tolist() == [False, True, True]


# ---------------------------------------------------------------------- saving


def known():
    alone = Alone()
    alone.bonus.routes.replace([ROUTE])
    alone.bonus.known_cells.replace({3: th.tensor([[0.5], [1.5]]), 5: th.tensor([[7.5]])})
    for x in range(3):
        alone.step(x + 0.5, 5.5, start=() if x else (0.0, 5.0))
    alone.bonus.visit_map.note(6)
    return alone.bonus


def test_what_a_bonus_knows_is_kept(tmp_path):
    bonus = known()
    state = bonus.state_dict()
    write(tmp_path / "bonus", "bonus", state)
    for tree in (copied(state), read(tmp_path / "bonus", "bonus")):
        other = Alone().bonus
        other.load_state_dict(tree)
        for part in ("novelty_model", "moments", "known_cells"):  # parameters have their own file
            getattr(other, part).load_state_dict(getattr(bonus, part).state_dict())
        assert str(other.state_dict()) == str(state)
        assert other.routes.numbers() == [5] and other.routes.routes[0].radius == ROUTE.radius
        np.testing.assert_array_equal(other.routes.routes[0].paths, ROUTE.paths)
        assert other.known_cells.any and th.equal(other.known_cells.known, bonus.known_cells.known)
        assert {number: each.tolist() for number, each in other.known_cells.by_mode.items()} == {
            number: each.tolist() for number, each in bonus.known_cells.by_mode.items()
        }
        np.testing.assert_array_equal(other.visit_map.cells()[0], bonus.visit_map.cells()[0])
        visited = steps(np.ones((2, 4, 1)), [0.5, 1.5, 7.5, 9.5] * 2, followed=[5, -1, -1, -1] * 2)
        assert th.equal(bonus.reward(visited, 0.9, 0.9, WATCH)[0], other.reward(visited, 0.9, 0.9, WATCH)[0])
        bonus.moments.load_state_dict(Alone().bonus.moments.state_dict())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state["routes"][0].update(radius=-1.0), "a route that cannot be"),
        (lambda state: state["routes"][0].update(paths=np.zeros((1, 4, 2), np.float32)), "bonus.routes"),
        (lambda state: state["cells"][0].update(entries=np.array([2**60])), "a cell that cannot be"),
        (lambda state: state["cells"][0].update(entries=np.array([-1])), "a cell that cannot be"),
        (lambda state: state["cells"][0].update(entries=np.zeros(2, np.float32)), "bonus.cells"),
        (lambda state: state["visits"].update(cell_size=-1.0), "cell_size"),
        (lambda state: state.pop("cells"), "cells"),
        (lambda state: state.update(more=1), "more"),
    ],
)
def test_what_cannot_be_is_refused(change, message):
    state = copied(known().state_dict())
    change(state)
    with pytest.raises(ValueError, match=message):
        Alone().bonus.load_state_dict(state)


# ---------------------------------------------------------------------- how it is made


def made_of(settings, exploration, dims, counted_cell, seen_cell):
    return make_bonus(
        lambda kind, *dims, **kwargs: kind(*dims, **kwargs), settings, exploration, dims, 4, counted_cell, seen_cell
    )


def test_what_a_bonus_is_made_of():
    made = made_of(NoveltySettings(), None, (2, 3), 0.2, 1.5)
    assert isinstance(made.novelty_model, VisitCounts) and not made.grid.adapts
    np.testing.assert_array_equal(made.grid.edges, [0.2, 0.2])
    th.testing.assert_close(made.novelty_model.edges, th.tensor([0.2, 0.2]))
    assert made.known_cells is None and made.visit_map.dim == 2 and made.visit_map.cell_size.tolist() == [1.5, 1.5]
    made.load_state_dict(copied(made.state_dict()))
    own = NoveltySettings(kwargs={"cell_size": 0.7})
    exploration = ExplorationSettings()
    made = made_of(own, exploration, (4, 3), 0.2, 1.5)
    assert made.visit_map is None and made.grid.edges.tolist() == [0.7] * 4
    for table in (made.novelty_model, made.known_cells):
        th.testing.assert_close(table.edges, th.full((4,), 0.7))
    rnd = NoveltySettings(measure="rnd", kwargs={"net_arch": (8, 4)})
    made = made_of(rnd, exploration, (2, 3), 0.2, 1.5)
    assert isinstance(made.novelty_model, RandomNetworkDistillation) and made.grid.edges.tolist() == [1.5, 1.5]
    with pytest.raises(ValueError, match=r"novelty.kwargs\['cell_size'\] must be positive, got 0"):
        made_of(NoveltySettings(kwargs={"cell_size": 0}), None, (2, 3), 0.2, 1.5)


def test_where_nobody_says_a_size_there_are_no_cells_yet():
    made = made_of(NoveltySettings(), ExplorationSettings(), (2, 3), None, None)
    assert made.grid.adapts and made.grid.edges is None and made.visit_map is None and made.n_cells == 0
    # A map for pictures has cells of its own, but begins when places are told apart
    assert made_of(NoveltySettings(), ExplorationSettings(), (2, 3), None, 1.0).visit_map is None
