"""Which episodes have come along a mode's way, against going through their positions one by one, and what follows from it."""

from collections import defaultdict

import numpy as np
import pytest
import torch as th
import yaml
from environments import fill
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from planar import planar_model, walk
from test_intrinsic import make_able

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.behavior import EXPLORATORY_GROUP
from sb3_ddiffpg.buffer_state import buffer_state, restore_buffer
from sb3_ddiffpg.buffers import ModeReplayBuffer
from sb3_ddiffpg.dtw import N_PATH_POINTS
from sb3_ddiffpg.intrinsic import VisitCounts
from sb3_ddiffpg.known_ways import NO_WAY, KnownWays, Way, come_along
from sb3_ddiffpg.zoo import config_file

LINE, ACTION = spaces.Box(-np.inf, np.inf, (1,)), spaces.Box(-1.0, 1.0, (1,))


def slow_followed_at_each(ways, positions):
    """Number of the way of which an episode came through eight tenths, position by position; the first if several at once."""
    numbers = []
    for n in range(1, len(positions) + 1):
        before = numbers[-1] if numbers else -1
        numbers.append(before if before >= 0 else followed_now(ways, positions[:n]))
    return numbers


def followed_now(ways, positions):
    for way in ways:
        parts = set()
        for position in positions:
            nearest = min(
                (float(np.linalg.norm(point - position)), number) for path in way.paths for number, point in enumerate(path)
            )
            if nearest[0] < way.radius:
                n_parts = min(10, way.paths.shape[1])
                parts.add(nearest[1] * n_parts // way.paths.shape[1])
        if parts and len(parts) / n_parts >= 0.8:
            return way.number
    return -1


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 2), st.sampled_from([2, 7, 20]))
def test_followed_as_told_one_by_one(seed, n_ways, dim, n_points):
    rng = np.random.default_rng(seed)
    n_envs = 3
    ways = [Way(7 + i, rng.normal(size=(2, n_points, dim)).cumsum(axis=1), rng.uniform(0.5, 2.0)) for i in range(n_ways)]
    known = KnownWays(n_envs)
    known.replace(ways)
    been, told = [[] for _ in range(n_envs)], [-1] * n_envs
    for _ in range(25):
        envs = rng.permutation(n_envs)
        way = ways[rng.integers(n_ways)].paths[0]
        positions = way[rng.integers(n_points, size=n_envs)] + rng.normal(scale=0.3, size=(n_envs, dim))
        known.observe(envs, positions)
        for env, position in zip(envs, positions, strict=True):
            been[env].append(position)
            told[env] = told[env] if told[env] >= 0 else followed_now(ways, been[env])
        if rng.random() < 0.1:
            env = int(rng.integers(n_envs))
            known.forget(env)
            been[env], told[env] = [], -1
        np.testing.assert_array_equal(known.followed, told)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3), st.integers(1, 2), st.sampled_from([2, 7, 20]))
def test_a_whole_episode_as_told_one_by_one(seed, n_ways, dim, n_points):
    rng = np.random.default_rng(seed)
    ways = [Way(7 + i, rng.normal(size=(2, n_points, dim)).cumsum(axis=1), rng.uniform(0.5, 2.0)) for i in range(n_ways)]
    positions = rng.normal(size=(12, dim))
    if ways:  # along one of them for some time, or for all of it
        along = np.concatenate([ways[rng.integers(n_ways)].paths[0], ways[0].paths[1]])
        positions = along[np.sort(rng.integers(len(along), size=25))] + rng.normal(scale=0.2, size=(25, dim))
    told = come_along(ways, positions)
    np.testing.assert_array_equal(told, slow_followed_at_each(ways, positions))


def test_a_way_with_zeros_where_denormal_numbers_are_flushed():
    """Training flushes them, see ``set_flush_denormal``: scipy's trees crash the process there."""
    if not th.set_flush_denormal(True):
        pytest.skip("this processor does not flush them")
    try:
        path = np.append(np.zeros(12), np.linspace(0, 40, 88)).reshape(1, -1, 1).astype(np.float32)
        known = KnownWays(1)
        known.replace([Way(0, np.repeat(path, 20, axis=0), 1.0)])
        known.observe(np.zeros(40, dtype=int), np.arange(40.0)[:, None])
        assert known.followed.tolist() == [0]
    finally:
        th.set_flush_denormal(False)


def line_buffer(n_envs=1, **kwargs):
    """A buffer with one mode that goes from 0 to 10."""
    buffer = ModeReplayBuffer(500, LINE, ACTION, device="cpu", n_envs=n_envs, visit_cell_size=1.0, **kwargs)
    for _ in range(4):
        for x in range(10):
            add(buffer, [x] * n_envs, [x + 1] * n_envs, x == 9)
    successes = buffer.trajectories(True)
    buffer.assign_modes(successes, np.zeros(len(successes), dtype=int), [], np.zeros(0, dtype=int), [None])
    return buffer


def add(buffer, now, then, done, success=True):
    n = buffer.n_envs
    positions = [np.array(each, dtype=np.float32).reshape(n, 1) for each in (now, then)]
    infos = [{"is_success": done and success}] * n
    buffer.add(*positions, np.zeros((n, 1)), np.zeros(n), np.full(n, done), infos)


def test_an_episode_that_came_along_the_way_is_told_from_one_that_did_not():
    buffer = line_buffer(n_envs=2)
    buffer.watch_ways({0: 5})
    counted = []
    for step in range(14):  # one goes on past the end, one turns round after two
        along, away = step + 0.5, min(step + 0.5, 3.5 - step)
        add(buffer, [step - 0.5, min(step - 0.5, 4.5 - step)], [along, away], step == 13, success=False)
        counted.append(buffer.counted_positions()[:, 0].tolist())
    along, away = buffer.trajectories(False)
    # In the eighth tenth of the way when it comes to 7.5
    np.testing.assert_array_equal(buffer.followed[along.rows], np.where(np.arange(14) >= 7, 5, NO_WAY))
    np.testing.assert_array_equal(buffer.past_known_ways(along.rows), np.arange(14) >= 7)
    assert (buffer.followed[away.rows] == NO_WAY).all()
    assert [len(each) for each in counted] == [2] * 7 + [1] * 7 and counted[-1] == [-9.5]
    add(buffer, [0, 0], [1, 1], False)
    assert len(buffer.counted_positions()) == 2  # the next episode starts anew


def go_on(buffer, success=False, steps=14):
    """Each environment along the mode's way and past its end."""
    for step in range(steps):
        add(buffer, [step - 0.5] * buffer.n_envs, [step + 0.5] * buffer.n_envs, step == 13, success)


@pytest.mark.parametrize("running", [False, True])
def test_what_came_along_a_way_before_it_was_known(running):
    """As if it had been known from the first."""
    early, late = line_buffer(n_envs=2), line_buffer(n_envs=2)
    assert len(early.watch_ways({0: 5})) == 0  # the few members pay as yet
    for each in (early, late):
        go_on(each, steps=12 if running else 14)
    noted = late.watch_ways({0: 5})
    rows = early._all.rows[: early.size()]
    np.testing.assert_array_equal(early.followed[rows], late.followed[rows])
    np.testing.assert_array_equal(np.sort(noted), np.sort(rows[late.followed[rows] == 5]))
    assert early.known_ways.followed.tolist() == late.known_ways.followed.tolist() == ([5, 5] if running else [NO_WAY] * 2)
    assert len(late.watch_ways({0: 5})) == 0  # not twice
    late.watch_ways({})
    late.followed[noted] = NO_WAY  # as of a new way
    assert len(late.watch_ways({0: 8})) == 0 and late.past_known_ways(noted).all()  # uncounted before: not once more


def test_a_new_way_found_before_the_known_one_was_known_keeps_its_worth():
    buffer = line_buffer()
    go_on(buffer, success=True)
    newest = max(buffer.trajectories(True), key=lambda each: each.serial)
    successes = buffer.trajectories(True)
    labels = np.array([-1 if each is newest else 0 for each in successes])
    buffer.assign_modes(successes, labels, [], np.zeros(0, dtype=int), [0])
    buffer.watch_ways({0: 5})
    assert (buffer.followed[newest.rows] == NO_WAY).all()


def test_what_lies_past_the_way_is_worth_nothing_to_explorers_alone():
    buffer = line_buffer()
    buffer.watch_ways({0: 5})
    go_on(buffer)
    rows = buffer.trajectories(False)[0].rows
    batch = buffer.sample_modes(4000, 0.9, 3, 1)
    places = [{int(row): i for i, row in enumerate(group)} for group in batch.rows]
    for number, row in enumerate(rows[:13]):  # what is followed within three steps ends there
        expected = 0.0 if number + 2 >= 7 else 0.9**3
        assert batch.discounts[EXPLORATORY_GROUP, places[EXPLORATORY_GROUP][int(row)]] == pytest.approx(expected)
    assert (batch.discounts[1] > 0).sum() > 0.8 * len(batch.rows[1])  # a mode's own steps but the last


def test_a_new_way_that_leads_on_from_a_known_one_keeps_its_worth():
    buffer = line_buffer()
    buffer.watch_ways({0: 5})
    go_on(buffer, success=True)
    newest = max(buffer.trajectories(True), key=lambda each: each.serial)
    assert buffer.past_known_ways(newest.rows).any()
    successes = buffer.trajectories(True)
    labels = np.array([-1 if each is newest else 0 for each in successes])
    buffer.assign_modes(successes, labels, [], np.zeros(0, dtype=int), [0])
    assert (buffer.followed[newest.rows] == NO_WAY).all()


def test_known_ways_go_on_where_they_were():
    buffer = line_buffer()
    buffer.watch_ways({0: 5})
    go_on(buffer, steps=7)
    again = ModeReplayBuffer(500, LINE, ACTION, device="cpu", visit_cell_size=1.0)
    again.mode_rows = list(buffer.mode_rows)
    restore_buffer(again, buffer_state(buffer))
    for each in (buffer, again):
        assert each.known_ways.followed.tolist() == [NO_WAY]
        add(each, [6.5], [7.5], False)
        assert each.known_ways.followed.tolist() == [5] and len(each.counted_positions()) == 0
        each.watch_ways({})
        assert each.known_ways.followed.tolist() == [NO_WAY] and not each.past_known_ways(each._all.rows[: each.size()]).any()
        each.watch_ways({0: 5})
        assert each.known_ways.followed.tolist() == [5]
        each.drop_unfinished_episodes()
        assert each.known_ways.followed.tolist() == [NO_WAY]


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
def test_a_way_that_cannot_be_is_refused_before_anything_is_lost(part, wrong):
    buffer = line_buffer()
    buffer.watch_ways({0: 5})
    state = buffer_state(buffer)
    state["known_ways"][0][part] = wrong
    size = buffer.size()
    with pytest.raises(ValueError, match="a known way that cannot be"):
        restore_buffer(buffer, state)
    assert buffer.size() == size and buffer.known_ways.numbers() == [5]
    add(buffer, [0], [1], False)


def test_what_is_known_no_more_pays_again():
    buffer = line_buffer()
    buffer.watch_ways({0: 5})
    go_on(buffer)
    rows = buffer.trajectories(False)[0].rows
    for forget in (lambda: buffer.watch_ways({}), lambda: buffer.follow_modes([-1], []), lambda: buffer.expect_modes(1)):
        buffer.watch_ways({0: 5})
        assert buffer.past_known_ways(rows).sum() == 7
        forget()
        assert not buffer.past_known_ways(rows).any()
        buffer.assign_modes(buffer.trajectories(True), np.zeros(4, dtype=int), [], np.zeros(0, dtype=int), [None])


@pytest.mark.parametrize("novelty", ["rnd", "counts"])
def test_when_all_environments_are_past_known_ways(novelty):
    """There is nothing to observe: the mean of nothing is NaN."""
    kwargs = {"novelty_kwargs": {} if novelty == "rnd" else None, "explore_past_modes": False}
    model = planar_model(novelty=novelty, **kwargs)
    walk(model, "up", 6)
    model.recluster()
    make_able(model, [0])
    model.replay_buffer.known_ways.followed[:] = model.modes[0].number
    before = {name: value.clone() for name, value in model.novelty_model.state_dict().items()}
    model._last_obs = model.env.reset()
    model._last_original_obs = model._last_obs
    action = np.zeros((1, *model.action_space.shape), dtype=np.float32)
    model._store_transition(model.replay_buffer, action, model._last_obs, np.zeros(1), np.zeros(1, dtype=bool), [{}])
    for name, value in model.novelty_model.state_dict().items():
        assert th.equal(value, before[name]), name


@pytest.mark.parametrize(("explore_past_modes", "able"), [(False, [0]), (False, []), (True, [0])])
def test_explorers_past_an_able_mode_are_paid_nothing(explore_past_modes, able):
    settings = {"explore_off_modes": False, "episodic_novelty": False, "normalize_intrinsic": False}
    model = planar_model(explore_past_modes=explore_past_modes, **settings)
    walk(model, "up", 6)
    model.recluster()
    make_able(model, able)
    line = np.concatenate([np.linspace((0, 0), (0, 6), 7), np.linspace((1, 6), (18, 6), 18)]).astype(np.float32)
    fill(model.replay_buffer, [line], False)
    buffer = model.replay_buffer
    past = buffer.trajectories(False)[-1].rows[:, None]
    rewards = model._intrinsic_rewards(np.stack([past, past]), defaultdict(list))
    stops = not explore_past_modes and bool(able)
    assert bool((rewards[EXPLORATORY_GROUP, -12:] == 0).all()) is bool(buffer.past_known_ways(past).any()) is stops
    assert (rewards[EXPLORATORY_GROUP, :5] > 0).all() and (rewards[1, -12:] > 0).all()


@pytest.mark.parametrize("novelty", ["rnd", "counts"])
def test_visits_past_a_way_are_taken_back_when_it_is_known(novelty):
    """Counts become those of a run that had known it from the first; a network keeps what it has learned."""
    kwargs = {"novelty_kwargs": {} if novelty == "rnd" else {"cell_size": 0.5}, "explore_past_modes": False}
    model = planar_model(novelty=novelty, **kwargs)
    walk(model, "up", 6)
    model.recluster()
    line = np.concatenate([np.linspace((0, 0), (0, 6), 7), np.linspace((1, 6), (18, 6), 18)]).astype(np.float32)
    fill(model.replay_buffer, [line], False)
    buffer = model.replay_buffer
    rows = buffer._all.rows[: buffer.size()]
    positions = buffer.features.of_tensors(buffer.read_observations(rows)[1])
    model.novelty_model.observe(positions)
    before = {name: value.clone() for name, value in model.novelty_model.state_dict().items()}
    make_able(model, [0])
    uncounted = buffer.past_known_ways(rows)
    assert uncounted.any() and not uncounted.all()
    if novelty == "counts":
        expected = VisitCounts(2, 2, **kwargs["novelty_kwargs"])
        expected.observe(positions[~uncounted])
        before = expected.state_dict()
    for name, value in model.novelty_model.state_dict().items():
        assert th.equal(value, before[name]), name


@pytest.mark.parametrize("explore_past_modes", [True, False])
def test_the_setting_holds_for_what_is_loaded(tmp_path, explore_past_modes):
    model = planar_model(explore_past_modes=False)
    walk(model, "up", 6)
    model.recluster()
    make_able(model, [0])
    assert model.replay_buffer.known_ways.ways
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = DDiffPG.load(tmp_path / "model", explore_past_modes=explore_past_modes)
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.set_logger(model.logger)
    loaded.recluster()
    assert bool(loaded.replay_buffer.known_ways.ways) is not explore_past_modes


def test_the_papers_settings_pay_past_modes():
    entries = yaml.safe_load(config_file("ddiffpg").read_text())
    assert entries["paper"]["explore_past_modes"] is True
