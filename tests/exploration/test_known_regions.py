"""Which episodes have come along a mode's route, against going through their positions one by one, and what follows."""

import numpy as np
import pytest
import torch as th
import yaml
from environments import TwoEnds, fill, small_model
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from planar import planar_model, walk
from stable_baselines3.common.vec_env import DummyVecEnv
from test_novelty import intrinsic_rewards, make_able

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.state import buffer_state, restore_buffer
from sb3_ddiffpg.clustering.paths import N_PATH_POINTS
from sb3_ddiffpg.exploration.bonus import ExplorationBonus
from sb3_ddiffpg.exploration.cells import CellGrid
from sb3_ddiffpg.exploration.known_regions import NO_ROUTE, KnownRoute, KnownRoutes, come_along
from sb3_ddiffpg.exploration.novelty import VisitCounts
from sb3_ddiffpg.exploration.settings import ExplorationSettings, NoveltySettings
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.zoo import config_file

LINE, ACTION = spaces.Box(-np.inf, np.inf, (1,)), spaces.Box(-1.0, 1.0, (1,))


def slow_followed_at_each(routes, positions):
    """Number of the route of which an episode came through eight tenths, by position; the first if several at once."""
    numbers = []
    for n in range(1, len(positions) + 1):
        before = numbers[-1] if numbers else NO_ROUTE
        numbers.append(before if before >= 0 else followed_now(routes, positions[:n]))
    return numbers


def followed_now(routes, positions):
    for route in routes:
        parts = set()
        for position in positions:
            nearest = min(
                (float(np.linalg.norm(point - position)), number) for path in route.paths for number, point in enumerate(path)
            )
            if nearest[0] < route.radius:
                n_parts = min(10, route.paths.shape[1])
                parts.add(nearest[1] * n_parts // route.paths.shape[1])
        if parts and len(parts) / n_parts >= 0.8:
            return route.number
    return NO_ROUTE


def random_routes(rng, n_routes, dim, n_points):
    walks = [rng.normal(size=(2, n_points, dim)).cumsum(axis=1) for _ in range(n_routes)]
    return [KnownRoute(7 + number, each, rng.uniform(0.5, 2.0)) for number, each in enumerate(walks)]


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 2), st.sampled_from([2, 7, 20]))
def test_followed_as_told_one_by_one(seed, n_routes, dim, n_points):
    rng = np.random.default_rng(seed)
    n_envs = 3
    routes = random_routes(rng, n_routes, dim, n_points)
    known = KnownRoutes(n_envs)
    known.replace(routes)
    been, told = [[] for _ in range(n_envs)], [NO_ROUTE] * n_envs
    for _ in range(25):
        route = routes[rng.integers(n_routes)].paths[0]
        positions = route[rng.integers(n_points, size=n_envs)] + rng.normal(scale=0.3, size=(n_envs, dim))
        known.observe(positions)
        for env, position in enumerate(positions):
            been[env].append(position)
            told[env] = told[env] if told[env] >= 0 else followed_now(routes, been[env])
        if rng.random() < 0.1:
            env = int(rng.integers(n_envs))
            known.forget(env)
            been[env], told[env] = [], NO_ROUTE
        np.testing.assert_array_equal(known.followed, told)


def along_some(rng, routes, dim):
    """An episode along one of the routes for some time, or for all of it, or all about."""
    if not routes:
        return rng.normal(size=(12, dim))
    along = np.concatenate([routes[rng.integers(len(routes))].paths[0], routes[0].paths[1]])
    return along[np.sort(rng.integers(len(along), size=25))] + rng.normal(scale=0.2, size=(25, dim))


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3), st.integers(1, 2), st.sampled_from([2, 7, 20]))
def test_a_whole_episode_as_told_one_by_one(seed, n_routes, dim, n_points):
    rng = np.random.default_rng(seed)
    routes = random_routes(rng, n_routes, dim, n_points)
    positions = along_some(rng, routes, dim)
    told = come_along(routes, positions)
    np.testing.assert_array_equal(told, slow_followed_at_each(routes, positions))


def assert_replayed_as_observed(routes, positions):
    """At each step of an episode: whoever is told all of it knows the same as who has seen it, and goes on alike."""
    seen, told = KnownRoutes(2), KnownRoutes(2)
    for each in (seen, told):
        each.replace(routes)
    for step, position in enumerate(positions):
        seen.observe(np.stack([position, positions[0]]))
        told.replace(routes)
        told.replay(0, positions[: step + 1])
        told.replay(1, positions[np.zeros(step + 1, dtype=int)])
        np.testing.assert_array_equal(told.followed, seen.followed)
        np.testing.assert_array_equal(told._been, seen._been)
    return seen.followed[0]


@settings(deadline=None, max_examples=200)
@given(st.integers(0, 2**32 - 1), st.integers(1, 2), st.sampled_from([2, 7, 20]))
def test_replayed_as_observed_step_by_step(seed, dim, n_points):
    """Resuming, and each re-clustering, tell the running episodes again; with two routes the order of both matters."""
    rng = np.random.default_rng(seed)
    routes = random_routes(rng, 2, dim, n_points)
    # Along the second of the list, then along the first
    both = np.concatenate([routes[1].paths[0], routes[0].paths[0]]) + rng.normal(scale=0.1, size=(2 * n_points, dim))
    for positions in (along_some(rng, routes, dim), rng.normal(size=(40, dim)).cumsum(axis=0), both):
        assert_replayed_as_observed(routes, positions)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_route_that_was_completed_first_is_followed_whatever_its_place_in_the_list(order):
    """Both are completed within one episode."""
    paths = [np.linspace((0, 0), end, 20)[None] for end in ((10, 0), (0, 10))]
    routes = [KnownRoute(7 + number, path, 0.5) for number, path in enumerate(paths)]
    episode = np.concatenate([paths[number][0] for number in order])
    assert assert_replayed_as_observed(routes, episode) == 7 + order[0]


def test_a_route_with_zeros_where_denormal_numbers_are_flushed():
    """Training flushes them, see ``set_flush_denormal``: scipy's trees crash the process there."""
    if not th.set_flush_denormal(True):
        pytest.skip("this processor does not flush them")
    try:
        path = np.append(np.zeros(12), np.linspace(0, 40, 88)).reshape(1, -1, 1).astype(np.float32)
        known = KnownRoutes(1)
        known.replace([KnownRoute(0, np.repeat(path, 20, axis=0), 1.0)])
        for position in np.arange(40.0):
            known.observe(np.array([[position]]))
        assert known.followed.tolist() == [0]
    finally:
        th.set_flush_denormal(False)


class Line:
    """A buffer with one mode that goes from 0 to 10, and the bonus that has seen each step."""

    def __init__(self, n_envs=1):
        self.buffer = ModeReplayBuffer(500, LINE, ACTION, device="cpu", n_envs=n_envs)
        counts, exploration = VisitCounts(1, 1, cell_size=1.0), ExplorationSettings(past_modes=False)
        self.bonus = ExplorationBonus(counts, 1, NoveltySettings(), exploration, n_envs, CellGrid(1, 1.0))
        for _ in range(4):
            for x in range(10):
                self.add([x] * n_envs, [x + 1] * n_envs, x == 9)
        successes = self.buffer.trajectories(True)
        self.buffer.assign_modes(successes, np.zeros(len(successes), dtype=int), [], np.zeros(0, dtype=int), [None])

    def add(self, now, then, done, success=True):
        """One step of each environment; the positions whose visits count."""
        n = self.buffer.n_envs
        positions = [np.array(each, dtype=np.float32).reshape(n, 1) for each in (now, then)]
        infos = [{"is_success": done and success}] * n
        record = self.buffer.add(*positions, np.zeros((n, 1)), np.zeros(n), np.full(n, done), infos)
        before = self.bonus.novelty_model.counts.clone()
        self.bonus.observe(record, self.buffer)
        counted = record.positions[self.buffer.counted[record.rows]]
        assert (self.bonus.novelty_model.counts - before).sum() == len(counted)
        return counted

    def go_on(self, success=False, steps=14):
        """Each environment along the mode's route and past its end."""
        for step in range(steps):
            n = self.buffer.n_envs
            self.add([step - 0.5] * n, [step + 0.5] * n, step == 13, success)

    def watch(self, mastered):
        """From now on the routes of these modes are known; rows whose visits were taken back."""
        rows = self.stored()
        counted, counts = self.buffer.counted[rows].copy(), self.bonus.novelty_model.counts.sum()
        self.bonus.on_modes_changed(self.buffer, mastered)
        taken_back = rows[counted & ~self.buffer.counted[rows]]
        assert counts - self.bonus.novelty_model.counts.sum() == len(taken_back)
        return taken_back

    def stored(self):
        return self.buffer.stored_rows.rows[: self.buffer.size()]

    def past(self, rows):
        """Which of them are of an episode that had come along a route that is known still."""
        return self.bonus.routes.include(self.buffer.followed[rows])

    def apart_but_newest(self):
        """A re-clustering that finds the newest trajectory in no mode."""
        successes = self.buffer.trajectories(True)
        newest = max(successes, key=lambda each: each.serial)
        labels = np.array([-1 if each is newest else 0 for each in successes])
        self.buffer.assign_modes(successes, labels, [], np.zeros(0, dtype=int), [0])
        return newest


def test_an_episode_that_came_along_the_route_is_told_from_one_that_did_not():
    line = Line(n_envs=2)
    line.watch({0: 5})
    counted = []
    for step in range(14):  # one goes on past the end, one turns round after two
        along, away = step + 0.5, min(step + 0.5, 3.5 - step)
        now = [step - 0.5, min(step - 0.5, 4.5 - step)]
        counted.append(line.add(now, [along, away], step == 13, success=False)[:, 0].tolist())
    along, away = line.buffer.trajectories(False)
    # In the eighth tenth of the route when it comes to 7.5
    np.testing.assert_array_equal(line.buffer.followed[along.rows], np.where(np.arange(14) >= 7, 5, NO_ROUTE))
    np.testing.assert_array_equal(line.past(along.rows), np.arange(14) >= 7)
    assert (line.buffer.followed[away.rows] == NO_ROUTE).all()
    assert [len(each) for each in counted] == [2] * 7 + [1] * 7 and counted[-1] == [-9.5]
    assert len(line.add([0, 0], [1, 1], False)) == 2  # the next episode starts anew


@pytest.mark.parametrize("running", [False, True])
def test_what_came_along_a_route_before_it_was_known(running):
    """As if it had been known from the first."""
    early, late = Line(n_envs=2), Line(n_envs=2)
    assert len(early.watch({0: 5})) == 0  # the few members pay as yet
    for each in (early, late):
        each.go_on(steps=12 if running else 14)
    noted = late.watch({0: 5})
    rows = early.stored()
    np.testing.assert_array_equal(early.buffer.followed[rows], late.buffer.followed[rows])
    np.testing.assert_array_equal(np.sort(noted), np.sort(rows[late.buffer.followed[rows] == 5]))
    followed = [each.bonus.routes.followed.tolist() for each in (early, late)]
    assert followed == [[5, 5] if running else [NO_ROUTE] * 2] * 2
    assert th.equal(early.bonus.novelty_model.counts, late.bonus.novelty_model.counts)
    assert len(late.watch({0: 5})) == 0  # not twice
    late.watch({})
    late.buffer.followed[noted] = NO_ROUTE  # as of a new route
    assert len(late.watch({0: 8})) == 0 and late.past(noted).all()  # uncounted before: not once more


def test_a_new_route_found_before_the_known_one_was_known_keeps_its_worth():
    line = Line()
    line.go_on(success=True)
    newest = line.apart_but_newest()
    line.watch({0: 5})
    assert (line.buffer.followed[newest.rows] == NO_ROUTE).all()


def test_what_lies_past_the_route_is_worth_nothing_to_explorers_alone():
    line = Line()
    line.watch({0: 5})
    line.go_on()
    rows = line.buffer.trajectories(False)[0].rows
    batch = line.bonus.end_past_routes(line.buffer.sample_modes(4000, 0.9, 3, 1))
    places = [{int(row): i for i, row in enumerate(group)} for group in batch.rows]
    for number, row in enumerate(rows[:13]):  # what is followed within three steps ends there
        expected = 0.0 if number + 2 >= 7 else 0.9**3
        assert batch.discounts[EXPLORATORY_GROUP, places[EXPLORATORY_GROUP][int(row)]] == pytest.approx(expected)
    assert (batch.discounts[1] > 0).sum() > 0.8 * len(batch.rows[1])  # a mode's own steps but the last


def test_a_new_route_that_leads_on_from_a_known_one_keeps_its_worth():
    line = Line()
    line.watch({0: 5})
    line.go_on(success=True)
    newest = max(line.buffer.trajectories(True), key=lambda each: each.serial)
    assert line.past(newest.rows).any()
    assert line.apart_but_newest() is newest
    line.watch({0: 5})
    assert (line.buffer.followed[newest.rows] == NO_ROUTE).all()


def test_known_routes_go_on_where_they_were():
    line = Line()
    line.watch({0: 5})
    line.go_on(steps=7)
    again = Line()
    restore_buffer(again.buffer, buffer_state(line.buffer))
    again.bonus.load_state_dict(line.bonus.state_dict())
    again.bonus.recall_episodes(again.buffer)
    for each in (line, again):
        routes = each.bonus.routes
        assert routes.followed.tolist() == [NO_ROUTE]
        assert len(each.add([6.5], [7.5], False)) == 0 and routes.followed.tolist() == [5]
        each.watch({})
        assert routes.followed.tolist() == [NO_ROUTE] and not each.past(each.stored()).any()
        each.watch({0: 5})
        assert routes.followed.tolist() == [5]
        each.buffer.drop_unfinished_episodes()
        each.bonus.forget_episodes()
        assert routes.followed.tolist() == [NO_ROUTE]


def two_way_line():
    """Modes 5 and 6 go from 0 to 10 and from 0 to -10, in this order."""
    line = Line(n_envs=2)
    for _ in range(4):
        for x in range(10):
            line.add([-x, -x], [-x - 1, -x - 1], x == 9)
    successes = line.buffer.trajectories(True)
    modes = np.array([int(line.buffer.full_path(each)[-1, 0] < 0) for each in successes])
    line.buffer.assign_modes(successes, modes, [], np.zeros(0, dtype=int), [0, None])
    line.watch({0: 5, 1: 6})
    assert line.bonus.routes.numbers() == [5, 6]
    return line


@pytest.mark.parametrize("seed", range(4))
def test_resuming_and_reclustering_follow_the_same_route_where_two_are_completed(seed):
    """One environment comes along the second route of the list, then along the first; the other goes to and fro."""
    line, resumed, rng = two_way_line(), two_way_line(), np.random.default_rng(seed)
    straight = [*-np.arange(0.0, 10.5), *np.arange(-9.0, 10.5)]
    wandering = np.cumsum(rng.normal(size=len(straight), scale=4.0)).clip(-10, 10)
    told = []
    for before, now in zip(np.stack([straight, wandering], 1), np.stack([straight, wandering], 1)[1:], strict=False):
        line.add(before, now, False)
        followed = line.bonus.routes.followed.tolist()
        told.append(followed[0])
        restore_buffer(resumed.buffer, buffer_state(line.buffer))
        resumed.bonus.load_state_dict(line.bonus.state_dict())
        resumed.bonus.recall_episodes(resumed.buffer)
        for each in (resumed, line):
            for _ in range(2):  # as it was resumed, and after a re-clustering
                assert each.bonus.routes.followed.tolist() == followed
                np.testing.assert_array_equal(each.bonus.routes._been, line.bonus.routes._been)
                assert each.bonus.episode_cells.seen == line.bonus.episode_cells.seen
                assert len(each.watch({0: 5, 1: 6})) == 0
    assert told[0] == NO_ROUTE and told[-1] == 6 and set(told) == {NO_ROUTE, 6}


@pytest.mark.parametrize(
    ("part", "wrong"),
    [
        ("paths", np.empty((0, N_PATH_POINTS, 1), np.float32)),
        ("paths", np.full((1, N_PATH_POINTS, 1), np.nan, np.float32)),
        ("radius", np.nan),
        ("radius", -1.0),
        ("number", -1),
        ("number", 2**40),
    ],
)
def test_a_route_that_cannot_be_is_refused_before_anything_is_lost(part, wrong):
    line = Line()
    line.watch({0: 5})
    state = line.bonus.state_dict()
    state["routes"][0][part] = wrong
    with pytest.raises(ValueError, match="a route that cannot be"):
        line.bonus.load_state_dict(state)
    assert line.bonus.routes.numbers() == [5]
    line.add([0], [1], False)


def test_what_is_known_no_more_pays_again():
    line = Line()
    line.watch({0: 5})
    line.go_on()
    rows = line.buffer.trajectories(False)[0].rows
    for forget in (lambda: line.watch({}), line.bonus.forget_routes):
        line.watch({0: 5})
        assert line.past(rows).sum() == 7
        forget()
        assert not line.past(rows).any()


@pytest.mark.parametrize("novelty", ["rnd", "counts"])
def test_when_all_environments_are_past_known_routes(novelty):
    """There is nothing to observe: the mean of nothing is NaN."""
    kwargs = {} if novelty == "rnd" else {"cell_size": 0.5}
    model = planar_model(novelty={"measure": novelty, "kwargs": kwargs}, exploration={"past_modes": False})
    walk(model, "up", 6)
    model.recluster()
    make_able(model, [0])
    model.bonus.routes.followed[:] = model.modes[0].number
    before = {name: value.clone() for name, value in model.bonus.novelty_model.state_dict().items()}
    model._last_obs = model.env.reset()
    model._last_original_obs = model._last_obs
    action = np.zeros((1, *model.action_space.shape), dtype=np.float32)
    model._store_transition(model.replay_buffer, action, model._last_obs, np.zeros(1), np.zeros(1, dtype=bool), [{}])
    for name, value in model.bonus.novelty_model.state_dict().items():
        assert th.equal(value, before[name]), name


def past_known_routes(model, rows):
    return model.bonus.routes.include(model.replay_buffer.followed[rows])


@pytest.mark.parametrize(("past_modes", "able"), [(False, [0]), (False, []), (True, [0])])
def test_explorers_past_an_able_mode_are_paid_nothing(past_modes, able):
    exploration = {"off_modes": False, "past_modes": past_modes}
    model = planar_model(exploration=exploration, novelty={"episodic": False, "normalize": False, "scale": 0.0})
    walk(model, "up", 6)
    model.recluster()
    make_able(model, able)
    line = np.concatenate([np.linspace((0, 0), (0, 6), 7), np.linspace((1, 6), (18, 6), 18)]).astype(np.float32)
    fill(model.replay_buffer, [line], False, bonus=model.bonus)
    past = model.replay_buffer.trajectories(False)[-1].rows[:, None]
    rewards = intrinsic_rewards(model, np.stack([past, past]))
    stops = not past_modes and bool(able)
    assert bool((rewards[EXPLORATORY_GROUP, -12:] == 0).all()) is bool(past_known_routes(model, past).any()) is stops
    ordinary = model.novelty_settings.coef * model.bonus.moments.mean  # which modes are paid less
    assert (rewards[EXPLORATORY_GROUP, :5] > 0).all() and (rewards[1, -12:] + ordinary > 1e-3 * ordinary).all()


@pytest.mark.parametrize("novelty", ["rnd", "counts"])
def test_visits_past_a_route_are_taken_back_when_it_is_known(novelty):
    """Counts become those of a run that had known it from the first; a network keeps what it has learned."""
    kwargs = {} if novelty == "rnd" else {"cell_size": 0.5}
    model = planar_model(novelty={"measure": novelty, "kwargs": kwargs}, exploration={"past_modes": False})
    walk(model, "up", 6)
    model.recluster()
    line = np.concatenate([np.linspace((0, 0), (0, 6), 7), np.linspace((1, 6), (18, 6), 18)]).astype(np.float32)
    fill(model.replay_buffer, [line], False, bonus=model.bonus)
    buffer = model.replay_buffer
    rows = buffer.stored_rows.rows[: buffer.size()]
    positions = buffer.features.of_tensors(buffer.read_observations(rows)[1])
    before = {name: value.clone() for name, value in model.bonus.novelty_model.state_dict().items()}
    make_able(model, [0])
    uncounted = past_known_routes(model, rows)
    assert uncounted.any() and not uncounted.all()
    if novelty == "counts":
        expected = VisitCounts(2, 2, **kwargs)
        expected.observe(positions[~uncounted])
        before = expected.state_dict()
    for name, value in model.bonus.novelty_model.state_dict().items():
        assert th.equal(value, before[name]), name


def test_a_model_that_is_loaded_without_its_buffer_knows_its_routes(tmp_path):
    """And trains on, though nothing is stored by which to tell how far places are apart."""
    env = DummyVecEnv([TwoEnds] * 4)
    model = small_model(env, exploration={"past_modes": False}).learn(240)
    make_able(model, range(len(model.modes)))
    numbers = model.bonus.routes.numbers()
    assert len(numbers) == 2
    model.save(tmp_path / "model")
    loaded = DDiffPG.load(tmp_path / "model", env=env)
    loaded.set_logger(model.logger)
    assert loaded.bonus.routes.numbers() == numbers
    loaded.learn(12, reset_num_timesteps=False)
    loaded.recluster()
    assert set(loaded.bonus.routes.numbers()) == set(numbers)  # modes without trajectories keep theirs
    loaded.learn(100, reset_num_timesteps=False)


@pytest.mark.parametrize("past_modes", [True, False])
def test_the_setting_holds_for_what_is_loaded(tmp_path, past_modes):
    model = planar_model(exploration={"past_modes": False})
    walk(model, "up", 6)
    model.recluster()
    make_able(model, [0])
    assert model.bonus.routes.routes
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = DDiffPG.load(tmp_path / "model", exploration={"past_modes": past_modes})
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.set_logger(model.logger)
    loaded.recluster()
    assert bool(loaded.bonus.routes.routes) is not past_modes


def test_the_papers_settings_pay_past_modes():
    entries = yaml.safe_load(config_file("ddiffpg").read_text())
    assert entries["paper"]["exploration"]["past_modes"] is True


@pytest.fixture
def able():
    """A model whose two modes know their routes, which explorers are not paid beyond."""
    model = small_model(DummyVecEnv([TwoEnds] * 4), exploration={"past_modes": False}).learn(600)
    make_able(model, range(len(model.modes)))
    assert len(model.bonus.routes.numbers()) == 2
    return model


def test_routes_go_with_their_modes_when_parameters_are_replaced(able):
    able.set_parameters(small_model(DummyVecEnv([TwoEnds] * 4)).get_parameters())
    assert len(able.modes) == 0 and able.bonus.routes.numbers() == []


def test_a_file_to_act_says_nothing_of_where_it_has_been(able, tmp_path):
    able.save(tmp_path / "acts", to_train=False)
    loaded = DDiffPG.load(tmp_path / "acts", env=DummyVecEnv([TwoEnds] * 4))
    loaded.set_logger(able.logger)
    assert not loaded.bonus.known_cells.known.any() and not loaded.bonus.known_cells.by_mode
    assert loaded.bonus.routes.numbers() == []
    loaded.recluster()
    assert not loaded.bonus.known_cells.known.any()
