"""ModeReplayBuffer and its parts against plain references: lists of dicts, Python sets and loops."""

import io
import pickle
from collections import defaultdict

import numpy as np
import pytest
from environments import AnySpaces, TwoEnds, fill, image_dict_space, small_model
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.state import buffer_state, restore_buffer
from sb3_ddiffpg.buffers.storage import RowSet
from sb3_ddiffpg.buffers.success import SuccessRule
from sb3_ddiffpg.buffers.trajectory import NO_MODE, PAST_GOAL
from sb3_ddiffpg.clustering.distance_cache import DistanceCache
from sb3_ddiffpg.clustering.dtw import dtw_distances
from sb3_ddiffpg.exploration.bonus import ExplorationBonus
from sb3_ddiffpg.exploration.cells import CellGrid
from sb3_ddiffpg.exploration.novelty import VisitCounts
from sb3_ddiffpg.exploration.settings import NoveltySettings

OBSERVATION, ACTION = spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(-1.0, 1.0, (2,))
GAMMA = 0.9


def make_buffer(buffer_size=200, n_envs=1, observation_space=OBSERVATION, **kwargs):
    return ModeReplayBuffer(buffer_size, observation_space, ACTION, device="cpu", n_envs=n_envs, **kwargs)


def cell(position):
    """Of edge 1."""
    return tuple(int(x // 1) for x in position)


class PlainBuffer:
    """What ModeReplayBuffer promises, with lists of dicts and no regard for speed. A step is known by its number."""

    def __init__(self, size, n_envs, max_successes, max_failures, explore_beyond_goals):
        self.explore_beyond_goals = explore_beyond_goals
        self.size, self.limits = size, {True: max_successes, False: max_failures}
        self.running = [[] for _ in range(n_envs)]
        self.episodes = []
        self.n_modes = self.n_finished = self.n_retired = 0

    def steps(self):
        return [step for episode in [e["steps"] for e in self.episodes] + self.running for step in episode]

    def evictable(self):
        """The episodes of which one may go next: the longest retired, else the oldest of any largest group."""
        retired = [episode for episode in self.episodes if episode["retired"] is not None]
        if retired:
            return [min(retired, key=lambda episode: episode["retired"])]
        groups = defaultdict(list)
        for episode in self.episodes:
            groups[PAST_GOAL if episode["past"] else episode["mode"], episode["success"] and not episode["off_mode"]].append(
                episode
            )
        # A mode's only success stays
        groups = [group for key, group in groups.items() if len(group) > 1 or key[0] < 0 or not key[1]]
        largest = max((sum(len(e["steps"]) for e in group) for group in groups), default=0)
        oldest = [min(group, key=lambda e: e["serial"]) for group in groups]
        return [e for e, group in zip(oldest, groups, strict=True) if sum(len(g["steps"]) for g in group) == largest]

    def make_room(self, n, stored):
        """Evict until n steps fit. Of equally large groups any may give way: one choice must give ``stored``."""
        held = self.episodes
        if len(self.steps()) + n <= self.size:
            return {step["number"] for step in self.steps()} <= stored
        for episode in self.evictable():
            self.episodes = [other for other in held if other is not episode]
            if episode["steps"][0]["number"] not in stored and self.make_room(n, stored):
                return True
        self.episodes = held
        return False

    def add(self, env, step, done, success):
        """An episode is what it does up to its first success; the rest is stored by itself."""
        step["before"] = len(self.running[env])
        step["goal"] = success and not any(earlier["goal"] for earlier in self.running[env])
        self.running[env].append(step)
        if done:
            steps, self.running[env] = self.running[env], []
            end = next((i + 1 for i, each in enumerate(steps) if each["goal"]), len(steps))
            for part, past in ((steps[:end], False), (steps[end:], True)):
                if part:
                    episode = {"steps": part, "success": part[-1]["goal"], "serial": self.n_finished, "past": past}
                    episode["return"] = sum(each["reward"] for each in (part if past else steps))
                    self.episodes.append(episode | {"mode": NO_MODE, "trains": False, "off_mode": False, "retired": None})
                    self.n_finished += 1

    def cells_seen(self, env, obs):
        """Of an episode that goes on from an observation: where it began, and what it has reached."""
        before = self.running[env]
        return [cell(before[0]["obs"] if before else obs), *(cell(step["next_obs"]) for step in before)]

    def length_before(self, number):
        """Steps of an episode before one, which may have ended it."""
        return next(step["before"] for step in self.steps() if step["number"] == number)

    def active(self, success):
        """Those in use by a mode or not yet clustered, in order of finishing; off-mode successes count as failures."""
        found = [
            e
            for e in self.episodes
            if (e["success"] and not e["off_mode"]) == success and e["retired"] is None and not e["past"]
        ]
        return sorted(found, key=lambda episode: episode["serial"])

    def assign(self, success_modes, failure_modes, parents):
        retiring = []
        for success, modes in ((True, success_modes), (False, failure_modes)):
            limit, members = self.limits[success], defaultdict(list)
            for episode, mode in zip(self.active(success), modes, strict=True):
                members[mode].append(episode)
            for mode, episodes in members.items():
                direct = self.direct(episodes) if success else episodes
                direct = [] if mode == NO_MODE else direct
                detours = [episode for episode in episodes if episode not in direct]
                for episode in episodes:
                    stays_in_family = episode["mode"] == NO_MODE or (mode != NO_MODE and parents[mode] == episode["mode"])
                    if not stays_in_family:
                        for step in episode["steps"]:
                            step["target"] = step["action"]
                    episode["mode"] = mode
                    episode["trains"] = episode in direct[-limit:]
                retiring += [*direct[:-limit], *detours[:-limit]]
        self.n_modes = len(parents)
        for episode in sorted(retiring, key=lambda episode: episode["serial"]):
            episode.update(mode=NO_MODE, retired=self.n_retired)
            self.n_retired += 1

    def direct(self, episodes):
        """At most half as long again as the shortest, and the five shortest in any case."""
        lengths = sorted(len(episode["steps"]) for episode in episodes)
        limit = max(1.5 * lengths[0], lengths[:5][-1])
        return [episode for episode in episodes if len(episode["steps"]) <= limit]

    def window(self, number, n_steps, for_mode, gamma=GAMMA, lost_value=0.0):
        """
        n-step reward, discount and the last step of the window that begins with a step. For a mode, a step off its route is
        the end, worth what it is worth to be lost, and a goal the end too, at which one stays for ever where the environment
        does not end the episode and pays; for exploration a goal that ends it is none if it shall go on beyond.
        """
        episodes = [e["steps"] for e in self.episodes] + self.running
        steps = next(e for e in episodes if any(step["number"] == number for step in e))
        first = next(i for i, step in enumerate(steps) if step["number"] == number)
        reward, discount, lost = 0.0, 1.0, False
        for last in steps[first : first + n_steps]:
            if for_mode and last["off_route"] and not lost:
                lost, reward = True, reward + discount * lost_value
            terminated, goal = (
                last["done"] and not last["timeout"],
                last["goal"] and all(steps is not each for each in self.running),
            )
            stays = for_mode and goal and not terminated and last["reward"] > 0
            reward += 0.0 if lost else discount * last["reward"] * (sum(gamma**k for k in range(1000)) if stays else 1)
            discount *= gamma
        ended = terminated or goal if for_mode else terminated and not (goal and self.explore_beyond_goals)
        return reward, 0.0 if lost or ended else discount, last


class BufferMachine(RuleBasedStateMachine):
    """Random steps, clusterings, improved target actions and interruptions; both buffers must hold the same after each."""

    @initialize(n_envs=st.integers(1, 3), seed=st.integers(0, 2**16), spare=st.integers(0, 40), beyond=st.booleans())
    def start(self, n_envs, seed, spare, beyond):
        self.rng = np.random.default_rng(seed)
        np.random.seed(seed)
        self.n_envs, self.longest, self.number, self.most_modes = n_envs, 6, 0, 3
        # Room for the episodes in progress, and for the one success of each mode that is never evicted
        size = self.longest * (n_envs + self.most_modes) + spare
        limits = {"max_successes_per_mode": 4, "max_failures_per_mode": 2}
        self.buffer = make_buffer(size, n_envs, **limits, explore_beyond_goals=beyond)
        self.buffer.success_rule.has_goal = True  # before that the best returns stand in
        self.bonus = ExplorationBonus(VisitCounts(2, 2), 2, NoveltySettings(), None, n_envs, CellGrid(2, 1.0))
        self.plain = PlainBuffer(size, n_envs, 4, 2, beyond)

    def stored(self):
        """Number of every stored step -> its row."""
        rows = self.buffer.stored_rows.rows[: self.buffer.size()] if self.number else []
        return {int(self.buffer.observations[row, 0]): int(row) for row in rows}

    @rule(n=st.integers(1, 8))
    def step(self, n):
        for _ in range(n):
            self._step()

    def _step(self):
        numbers = np.arange(self.number, self.number + self.n_envs)
        self.number += self.n_envs
        obs = np.stack([numbers, self.rng.normal(size=self.n_envs)], axis=1).astype(np.float32)
        next_obs = self.rng.normal(size=obs.shape).astype(np.float32)
        actions = self.rng.uniform(-1, 1, (self.n_envs, 2)).astype(np.float32)
        rewards = self.rng.normal(size=self.n_envs).astype(np.float32)
        full_length = np.array([len(episode) == self.longest - 1 for episode in self.plain.running])
        dones = full_length | (self.rng.random(self.n_envs) < 0.3)
        timeouts = dones & (self.rng.random(self.n_envs) < 0.5)
        successes = self.rng.random(self.n_envs) < np.where(dones, 0.6, 0.1)
        infos = [
            {"is_success": bool(success), "TimeLimit.truncated": bool(timeout)}
            for success, timeout in zip(successes, timeouts, strict=True)
        ]
        record = self.buffer.add(obs, next_obs, actions, rewards, dones, infos)
        self.bonus.observe(record, self.buffer)
        assert self.plain.make_room(self.n_envs, self.stored().keys()), "evicted another trajectory than promised"
        for env in range(self.n_envs):
            step = {
                "number": int(numbers[env]),
                "obs": obs[env],
                "next_obs": next_obs[env],
                "action": actions[env],
                "target": actions[env],
                "exploratory": actions[env],
                "reward": float(rewards[env]),
                "done": bool(dones[env]),
                "timeout": bool(timeouts[env]),
                "off_route": False,
                "first": cell(next_obs[env]) not in self.plain.cells_seen(env, obs[env]),
            }
            self.plain.add(env, step, dones[env], bool(successes[env]))
        assert [env for env, _ in record.finished] == np.flatnonzero(dones).tolist()
        outcomes = {e["serial"]: e["success"] for e in self.plain.episodes}
        assert all(t.success == outcomes.get(t.serial, t.success) for _, t in record.finished)
        np.testing.assert_array_equal(record.positions, next_obs)
        starts = [env for env in range(self.n_envs) if self.plain.length_before(numbers[env]) == 0]
        assert record.started.tolist() == starts
        np.testing.assert_array_equal(record.start_positions, obs[starts])

    def _mark_off_mode(self):
        """Some of the new successes did not go where they were told."""
        for trajectory, episode in zip(self.buffer.trajectories(True), self.plain.active(True), strict=True):
            if trajectory.mode == NO_MODE and self.rng.random() < 0.3 and len(self.plain.active(True)) > 3:
                trajectory.off_mode_success = episode["off_mode"] = True
                off_route = self.rng.random(trajectory.length) < 0.3
                self.buffer.off_route[trajectory.rows] = off_route
                for step, off in zip(episode["steps"], off_route, strict=True):
                    step["off_route"] = bool(off)

    @rule()
    def recluster(self):
        successes, failures = self.buffer.trajectories(success=True), self.buffer.trajectories(success=False)
        if self.plain.n_modes:
            self._mark_off_mode()
            failures = sorted([*failures, *(t for t in successes if t.off_mode_success)], key=lambda t: t.serial)
            successes = [t for t in successes if not t.off_mode_success]
        n_modes = min(int(self.rng.integers(1, self.most_modes + 1)), len(successes))
        old = [None, *range(self.plain.n_modes)]
        parents = [old[self.rng.integers(len(old))] for _ in range(n_modes)]
        # Every mode has a success, as every cluster has
        labels = [*range(n_modes), *self.rng.integers(NO_MODE, n_modes, size=len(successes) - n_modes).tolist()]
        labels = self.rng.permutation(np.array(labels, dtype=int))
        failure_labels = self.rng.integers(0, n_modes, size=len(failures)) if n_modes else np.full(len(failures), NO_MODE)
        self.buffer.assign_modes(successes, labels, failures, failure_labels, parents)
        self.plain.assign(labels.tolist(), failure_labels.tolist(), parents)

    @rule(
        batch_size=st.integers(8, 40),
        exploration=st.integers(1, 3),
        mode=st.integers(1, 5),
        exploration_gamma=st.sampled_from([None, 0.5]),
        lost=st.sampled_from([0.0, -7.0]),
    )
    def improve(self, batch_size, exploration, mode, exploration_gamma, lost):
        if not self.number or not self.buffer.size():
            return
        gammas = {"exploration_gamma": exploration_gamma}
        batch = self.buffer.sample_modes(batch_size, GAMMA, exploration, mode, **gammas, lost_value=lost)
        n = batch_size // (self.plain.n_modes + 1)
        assert batch.rows.shape == (self.plain.n_modes + 1, n)
        numbers = batch.observations[:, 0].numpy().astype(int).reshape(batch.rows.shape)
        owner = {s["number"]: e["mode"] for e in self.plain.episodes if e["trains"] for s in e["steps"]}
        by_number = {step["number"]: step for step in self.plain.steps()}
        assert batch.active.tolist() == [True, *(m in owner.values() for m in range(self.plain.n_modes))]
        improved = self.rng.uniform(-1, 1, batch.actions.shape).astype(np.float32)
        next_obs = batch.next_observations.numpy().reshape(*batch.rows.shape, 2)
        for group, column in np.ndindex(batch.rows.shape):
            number, step = numbers[group, column], by_number[numbers[group, column]]
            if group > 0 and batch.active[group]:
                assert owner[number] == group - 1
            gamma = GAMMA if group else exploration_gamma or GAMMA
            reward, discount, last = self.plain.window(number, mode if group else exploration, group > 0, gamma, lost)
            assert batch.rewards[group, column].item() == pytest.approx(reward, rel=1e-4, abs=1e-5)
            assert batch.discounts[group, column].item() == pytest.approx(discount, rel=1e-5)
            np.testing.assert_array_equal(next_obs[group, column], last["next_obs"])
            np.testing.assert_array_equal(batch.actions[group, column], step["action"])
            target = "target" if group else "exploratory"
            np.testing.assert_array_equal(batch.target_actions[group, column], step[target])
        self.buffer.store_target_actions(batch, batch.actions.new_tensor(improved))
        for group, column in np.ndindex(batch.rows.shape):
            if batch.active[group]:
                by_number[numbers[group, column]]["target" if group else "exploratory"] = improved[group, column]

    @rule()
    def expect_modes(self):
        """What a model does that was given other parameters."""
        n_modes = int(self.rng.integers(0, self.most_modes + 1))
        nobody = [[NO_MODE] * len(self.plain.active(success)) for success in (True, False)]
        self.buffer.expect_modes(n_modes)
        self.plain.assign(*nobody, [None] * n_modes)

    @rule()
    def interrupt(self):
        self.buffer.drop_unfinished_episodes()
        self.bonus.forget_episodes()
        self.plain.running = [[] for _ in range(self.n_envs)]

    @rule()
    def save_and_load(self):
        self.buffer = pickle.loads(pickle.dumps(self.buffer))
        self.bonus.recall_episodes(self.buffer)

    @rule()
    def go_on_in_another_process(self):
        restore_buffer(self.buffer, buffer_state(self.buffer))
        self.buffer.success_rule.has_goal = True  # of an empty buffer nothing is restored
        self.bonus.recall_episodes(self.buffer)

    @invariant()
    def same_contents(self):
        stored = self.stored()
        steps = self.plain.steps()
        assert stored.keys() == {step["number"] for step in steps}
        assert self.buffer.size() == len(steps) == len(set(stored.values())) <= self.buffer.buffer_size
        if not steps:
            return
        rows = [stored[step["number"]] for step in steps]
        for name, key in [
            ("observations", "obs"),
            ("next_observations", "next_obs"),
            ("actions", "action"),
            ("target_actions", "target"),
            ("exploratory_target_actions", "exploratory"),
            ("dones", "done"),
            ("timeouts", "timeout"),
            ("off_route", "off_route"),
            ("first_visits", "first"),
        ]:
            np.testing.assert_array_equal(getattr(self.buffer, name)[rows], np.stack([step[key] for step in steps]))
        np.testing.assert_allclose(self.buffer.rewards[rows], [step["reward"] for step in steps])
        self._same_trajectories(stored)
        # Free rows are never drawn
        assert set(self.buffer.sample(50).observations[:, 0].int().tolist()) <= stored.keys()

    def _same_trajectories(self, stored):
        for success in (True, False):
            active = self.plain.active(success)
            trajectories = self.buffer.trajectories(success)
            assert [t.mode for t in trajectories] == [e["mode"] for e in active]
            assert [t.serial for t in trajectories] == [e["serial"] for e in active]
            assert [t.trains for t in trajectories] == [e["trains"] for e in active]
            for trajectory, episode in zip(trajectories, active, strict=True):
                assert trajectory.rows.tolist() == [stored[step["number"]] for step in episode["steps"]]
                assert trajectory.episode_return == pytest.approx(episode["return"], abs=1e-4)
                last = episode["steps"][-1]["next_obs"]
                path = [*(step["obs"] for step in episode["steps"]), last]
                np.testing.assert_array_equal(self.buffer.full_path(trajectory), np.stack(path))


BufferMachine.TestCase.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
TestBufferAgainstListsOfDicts = BufferMachine.TestCase


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.sets(st.integers(0, 299), max_size=150)), max_size=20), st.integers(0, 100))
def test_row_sets_are_sets(changes, seed):
    rng = np.random.default_rng(seed)
    position = np.zeros(300, dtype=np.int32)
    # Two sets that share no row may share the array
    ours, others, expected = RowSet(position), RowSet(position), set()
    for adding, rows in changes:
        chosen = sorted(rows - expected if adding else rows & expected)
        chosen = rng.permutation(np.array(chosen, dtype=np.int32))
        if adding:
            inside = np.isin(chosen, others.rows[: others.size])
            others.remove(chosen[inside])
            ours.add(chosen)
            expected |= set(chosen.tolist())
        else:
            ours.remove(chosen)
            others.add(chosen)
            expected -= set(chosen.tolist())
        assert set(ours.rows[: ours.size].tolist()) == expected and ours.size == len(expected)
        if expected:
            assert set(ours.sample(40).tolist()) <= expected


def test_row_set_draws_every_row_equally_often():
    np.random.seed(0)
    row_set = RowSet(np.zeros(100, dtype=np.int32))
    row_set.add(np.arange(40, dtype=np.int32))
    row_set.remove(np.arange(0, 40, 2, dtype=np.int32))
    counts = np.bincount(row_set.sample(20_000), minlength=40)
    assert counts[::2].sum() == 0
    np.testing.assert_allclose(counts[1::2], 1000, atol=5 * np.sqrt(1000))


def test_distances_of_the_cache_are_fresh_ones():
    rng = np.random.default_rng(0)
    paths = [rng.normal(size=(12, 2)).astype(np.float32) for _ in range(20)]
    cache = DistanceCache()
    for kept in ([0, 1, 2], [1, 2, 5, 7], [7], [], [3, 7, 9, 11, 19], [3, 7, 9, 11, 19]):
        distances = cache(np.array(kept, dtype=np.int64), [paths[i] for i in kept])
        np.testing.assert_allclose(distances, dtw_distances([paths[i] for i in kept]) if kept else np.zeros((0, 0)), rtol=1e-6)


def test_distances_as_in_the_paper():
    buffer = make_buffer(500, mode_features=[0, 1], normalize_distances=False, n_path_points=9)
    fill(buffer, [straight(8), straight(8) + np.float32([0, 3])])
    # Nine points, each three metres from its partner
    np.testing.assert_allclose(buffer.success_distances(buffer.trajectories(True))[0, 1], np.sqrt(9 * 3.0**2), rtol=1e-5)


def test_cached_distances_follow_the_trajectories():
    buffer = make_buffer(buffer_size=60, mode_features=[0, 1])
    rng = np.random.default_rng(0)
    for _ in range(12):  # six trajectories fit: the oldest are evicted on the way
        fill(buffer, [rng.normal(size=(11, 2)).astype(np.float32).cumsum(axis=0)])
        successes = buffer.trajectories(success=True)
        cached = buffer.success_distances(successes)
        fresh = dtw_distances([buffer.resample(buffer.full_path(trajectory)) for trajectory in successes])
        np.testing.assert_allclose(cached, fresh, rtol=1e-5, atol=1e-6)
    assert [trajectory.serial for trajectory in successes] == [6, 7, 8, 9, 10, 11]


def two_wanderers() -> list[np.ndarray]:
    """Both go straight from 2 to 8 at the end; before that one went up, the other down."""
    return [np.concatenate(([[0, 0], [1, side], [2, side]], straight(8)[2:])).astype(np.float32) for side in (1, -1)]


@pytest.mark.parametrize(("compared_length", "differs"), [(None, True), (8.0, True), (6.0, False), (3.0, False)])
def test_what_was_done_before_the_compared_end_does_not_count(compared_length, differs):
    buffer = make_buffer(500, mode_features=[0, 1], compared_length=compared_length)
    fill(buffer, two_wanderers())
    distance = buffer.success_distances(buffer.trajectories(True))[0, 1]
    assert distance > 0.2 if differs else distance == 0.0


def test_another_compared_length_makes_known_distances_anew():
    fresh, loaded = (make_buffer(500, mode_features=[0, 1], compared_length=length) for length in (3.0, None))
    for buffer in (fresh, loaded):
        fill(buffer, two_wanderers())
    assert fresh.success_distances(fresh.trajectories(True))[0, 1] == 0
    before = loaded.success_distances(loaded.trajectories(True))
    loaded.adopt_settings(fresh)
    after = loaded.success_distances(loaded.trajectories(True))
    assert before[0, 1] > 0 and after[0, 1] == 0
    for changed in ({"compared_length": None}, {"loop_share": 0.5}, {"normalize_distances": False}):
        settings = {"compared_length": 3.0, "mode_features": [0, 1]} | changed
        restored, new = make_buffer(500, **settings), make_buffer(500, **settings)
        restore_buffer(restored, buffer_state(loaded))
        fill(new, two_wanderers())
        expected = new.success_distances(new.trajectories(True))
        np.testing.assert_array_equal(restored.success_distances(restored.trajectories(True)), expected)


def test_a_buffer_with_other_rows_is_refused():
    buffer = make_buffer(20)
    fill(buffer, [np.zeros((5, 2), dtype=np.float32)])
    state = buffer.__getstate__()
    layouts = state["state"]["layouts"]
    for other in ([], layouts[:2], [layouts[0], layouts[1], layouts[0]], layouts[::-1]):  # of before, and in another order
        with pytest.raises(ValueError, match="its rows hold"):
            make_buffer(20).__setstate__({**state, "state": {**state["state"], "layouts": other}})


def test_a_rare_mode_is_never_crowded_out():
    buffer = make_buffer(buffer_size=100, mode_features=[0, 1])
    line = np.stack([np.arange(11), np.zeros(11)], axis=1).astype(np.float32)
    fill(buffer, [-line, line, line])
    successes = buffer.trajectories(success=True)
    buffer.assign_modes(successes, np.array([1, 0, 0]), [], np.zeros(0), [None, None])
    for repeats in range(1, 30):
        fill(buffer, [line, line])
        found = buffer.trajectories(success=True)
        labels = np.array([int(trajectory.rows[0] == successes[0].rows[0]) for trajectory in found])
        assert labels.tolist() == [1] + [0] * (len(found) - 1), f"lost after {2 * repeats} more of the other mode"
        buffer.assign_modes(found, labels, [], np.zeros(0), [0, 1])
        assert buffer.size() <= 100
    np.testing.assert_array_equal(buffer.full_path(found[0]), -line)


def test_modes_keep_their_newest_and_what_they_let_go_is_evicted_first():
    buffer = make_buffer(buffer_size=60, mode_features=[0, 1], max_successes_per_mode=2)
    paths = [np.full((11, 2), k, dtype=np.float32) for k in range(8)]
    fill(buffer, paths[:5])
    buffer.assign_modes(buffer.trajectories(True), np.zeros(5), [], np.zeros(0), [None])
    assert [trajectory.serial for trajectory in buffer.trajectories(True)] == [3, 4]
    assert buffer.size() == 50 and buffer.mode_rows[0].size == 20
    fill(buffer, paths[5:8])
    # 60 fit: of the retired 0, 1, 2 the two oldest made room, although the group of new ones is larger than the mode
    assert [trajectory.serial for trajectory in buffer.trajectories(True)] == [3, 4, 5, 6, 7]
    assert set(buffer.observations[buffer.stored_rows.rows[: buffer.size()], 0]) == {2, 3, 4, 5, 6, 7}


def straight(length):
    return np.stack([np.linspace(0, 8, length + 1), np.zeros(length + 1)], axis=1).astype(np.float32)


@pytest.mark.parametrize(
    ("lengths", "detours"),
    [
        ([10, 16, 12, 30, 10, 15, 11, 10], [16, 30]),  # more than half as long again as the shortest
        ([10, 16, 12, 30, 10], []),  # the five shortest in any case
        ([10, 16, 12, 30, 10, 40], [40]),
    ],
)
def test_a_mode_remembers_its_detours_but_does_not_learn_from_them(lengths, detours):
    buffer = make_buffer(500, mode_features=[0, 1])
    fill(buffer, [straight(length) for length in lengths])
    fill(buffer, [straight(100)], success=False)
    successes, failures = buffer.trajectories(True), buffer.trajectories(False)
    buffer.assign_modes(successes, np.zeros(len(lengths)), failures, np.zeros(1), [None])
    assert [t.length for t in successes if not t.trains] == detours
    assert failures[0].trains and all(t.mode == 0 for t in successes)
    assert buffer.trajectories(True) == successes  # they take part in the next clustering
    assert buffer.mode_rows[0].size == sum(lengths) - sum(detours) + 100
    assert set(buffer.sample_modes(400, GAMMA, 1, 1).rows[1]) <= set(
        np.concatenate([t.rows for t in successes + failures if t.trains])
    )


def test_goals_by_new_routes_are_worth_something_to_exploration():
    """As much as their mode is short of trajectories; where no mode is, everything; what has retired or strayed, nothing."""
    buffer = make_buffer(500, mode_features=[0, 1], max_successes_per_mode=4)
    fill(buffer, [np.full((3, 2), k, dtype=np.float32) for k in range(9)], reward=2.0)
    fill(buffer, [np.full((3, 2), 9, dtype=np.float32)], success=False, reward=2.0)
    successes, failures = buffer.trajectories(True), buffer.trajectories(False)
    strayed = successes.pop(0)
    buffer.mark_off_route(strayed, successes[1:2])
    labels = np.array([0, 0, 0, 0, 0, 1, 1, NO_MODE])  # of 4: more than full, half full, and one that is in no mode
    buffer.assign_modes(successes, labels, [strayed, *failures], np.zeros(2), [None, None])
    worth = dict(enumerate([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.5, 1.0, 0.0]))
    batch = buffer.sample_modes(900, GAMMA, 2, 1)
    obs = buffer.observations[batch.rows[0], 0]
    ends = buffer.dones[batch.rows[0]]
    follows = buffer.next_row[batch.rows[0]]
    for k, value in enumerate(batch.new_routes.numpy()):
        # Two steps of return: an episode's last reward counts from itself and from the step before
        ahead = not ends[k] and buffer.dones[follows[k]]
        expected = 2.0 * worth[int(obs[k])] * (1.0 if ends[k] else GAMMA if ahead else 0.0)
        assert value == pytest.approx(expected), (obs[k], ends[k])
    assert (batch.new_routes > 0).any()
    buffer.new_route_share = 0.5
    # What is paid for at a goal ends the return, or it would be paid again at the next step
    buffer.explore_beyond_goals = True
    batch = buffer.sample_modes(400, GAMMA, 1, 1)
    goes_on = (batch.discounts[0] > 0).numpy()
    rows = batch.rows[0]
    paid = buffer.route_novelty[rows] > 0
    assert paid.any() and (buffer.goals[rows] & ~paid).any()
    np.testing.assert_array_equal(goes_on, ~buffer.dones[rows] | (buffer.goals[rows] & ~paid))
    drawn = buffer.observations[buffer.sample_modes(900, GAMMA, 1, 1).rows[0], 0]
    assert {6, 7, 8} == set(drawn[:150]) and set(drawn[150:]) == set(range(10))
    buffer._evict()  # the first to go is a retired one, which none of them is
    assert len(buffer.new_route_rows) == 6
    buffer.add(*[np.full((1, 2), 7, np.float32)] * 2, np.zeros((1, 2)), np.zeros(1), np.zeros(1, bool), [{}])
    assert buffer.route_novelty[buffer.running.rows[0, 0]] == 0.0


def test_off_route_is_what_leaves_the_compared_ends():
    """What members did before is no route, or the loitering of one would make every place a part of it."""
    buffer = make_buffer(500, mode_features=[0, 1], compared_length=6.5)
    loitering = np.array([[0, 0], [4, 5], [6, 4], [5, 3], [3, 2], [0, 1], [1, 0], *straight(8)[2:]], dtype=np.float32)
    leaves = np.array([[0, 9], [1, 0], [2, 0], [3, 2], [4, 4], [5, 4], [8, 0]], dtype=np.float32)
    fill(buffer, [straight(8), straight(8), loitering])
    fill(buffer, [leaves], reward=5.0)
    *members, strayed = buffer.trajectories(True)
    buffer.mark_off_route(strayed, members)
    # 6 m before its end it is far from the last 6.5 m of the others; what it did before nobody can tell
    assert buffer.off_route[strayed.rows].tolist() == [False, False, False, True, True, False]


def test_a_mode_is_shown_an_off_mode_success_as_a_way_off_its_route():
    """Up to where it leaves the route it is as any other; from there on it is worth nothing, and the end."""
    buffer = make_buffer(500, mode_features=[0, 1])
    leaves = np.array([[0, 0], [1, 0], [2, 0], [3, 2], [4, 4], [5, 4], [8, 0]], dtype=np.float32)
    fill(buffer, [straight(8)] * 3)
    fill(buffer, [leaves], reward=5.0)
    *members, strayed = buffer.trajectories(True)
    buffer.mark_off_route(strayed, members)
    # The route is 8 m long: a tenth of that is still on it
    assert buffer.off_route[strayed.rows].tolist() == [False, False, True, True, True, False]
    buffer.assign_modes(members, np.zeros(3), [strayed], np.zeros(1), [None])
    assert strayed in buffer.trajectories(False) and strayed not in buffer.trajectories(True) and strayed.trains
    batch = buffer.sample_modes(600, GAMMA, 3, 3)
    expected = {  # reward and discount of three steps from each, for the mode and for exploration
        0: ((0.0, 0.0), (0.0, GAMMA**3)),
        1: ((0.0, 0.0), (0.0, GAMMA**3)),
        2: ((0.0, 0.0), (0.0, GAMMA**3)),
        3: ((0.0, 0.0), (GAMMA**2 * 5, 0.0)),
        4: ((0.0, 0.0), (GAMMA * 5, 0.0)),
        5: ((5.0, 0.0), (5.0, 0.0)),
    }
    order = {row: k for k, row in enumerate(strayed.rows.tolist())}
    seen = set()
    for group, column in np.argwhere(np.isin(batch.rows, strayed.rows)):
        k = order[batch.rows[group, column]]
        reward, discount = expected[k][0 if group else 1]
        assert batch.rewards[group, column].item() == pytest.approx(reward)
        assert batch.discounts[group, column].item() == pytest.approx(discount)
        seen.add((group > 0, k))
    assert len(seen) == 12


def test_another_goal_beside_the_route_is_off_it():
    """Near the route all the way, but not at its end: paid in full, it would draw the mode to the wrong goal."""
    buffer = make_buffer(500, mode_features=[0, 1])
    fill(buffer, [straight(8)] * 3)
    fill(buffer, [np.array([[0, 0], [1, 0], [2, 0], [3, 0.6]], dtype=np.float32)])
    fill(buffer, [straight(8) + np.float32([0, 0.3])])
    *members, elsewhere, there = buffer.trajectories(True)
    for trajectory, off_route in ((elsewhere, [False, False, True]), (there, [False] * 8)):
        buffer.mark_off_route(trajectory, members)
        assert trajectory.off_mode_success and buffer.off_route[trajectory.rows].tolist() == off_route
    buffer.assign_modes(members, np.zeros(3), [elsewhere, there], np.zeros(2), [None])
    assert buffer.trajectories(True) == members
    buffer.readmit(elsewhere)
    assert not elsewhere.off_mode_success and not (buffer.off_route | buffer.off_mode_success)[elsewhere.rows].any()
    assert buffer.trajectories(True) == [*members, elsewhere] and buffer.trajectories(False) == [there]


def test_intrinsic_rewards_end_where_the_route_does():
    buffer = make_buffer(500, mode_features=[0, 1])
    fill(buffer, [straight(8)] * 2)
    for trajectory in buffer.trajectories(True):
        buffer.off_route[trajectory.rows[4:6]] = True
    buffer.assign_modes(buffer.trajectories(True), np.zeros(2), [], np.zeros(0), [None])
    batch = buffer.sample_modes(400, GAMMA, 3, 3, visits_of_modes=True)
    step = batch.rows % 8
    lengths = batch.visited.present.sum(axis=-1)
    np.testing.assert_array_equal(lengths[0], np.minimum(3, 8 - step[0]))
    np.testing.assert_array_equal(lengths[1], np.array([3, 3, 2, 1, 0, 0, 2, 1])[step[1]])


def test_full_of_the_modes_last_successes_is_a_clear_error_that_loses_nothing():
    buffer = make_buffer(buffer_size=30, mode_features=[0, 1])
    fill(buffer, [np.zeros((16, 2), dtype=np.float32)] * 2)
    buffer.assign_modes(buffer.trajectories(True), np.arange(2), [], np.zeros(0), [None] * 2)
    obs = np.ones((1, 2), dtype=np.float32)
    with pytest.raises(ValueError, match="buffer_size=30 transitions is too small.*1 environment"):
        buffer.add(obs, obs, obs, np.zeros(1), np.array([False]), [{}])
    # The modes' only successes are still there
    assert len(buffer.trajectories(True)) == 2 and buffer.size() == 30


def test_storage_is_allocated_when_needed_and_released():
    buffer = make_buffer(buffer_size=10_000_000, observation_space=spaces.Box(-1, 1, (1000,)))
    assert not hasattr(buffer, "observations") and buffer.size() == 0
    assert len(pickle.dumps(buffer)) < 20_000
    buffer = make_buffer()
    fill(buffer, [np.zeros((4, 2), dtype=np.float32)])
    buffer.reset()
    assert buffer.size() == 0 and not buffer.trajectories(True)
    fill(buffer, [np.zeros((6, 2), dtype=np.float32)])
    assert buffer.size() == 5


def test_only_used_rows_are_pickled():
    sizes = {}
    for capacity in (1_000, 1_000_000):
        buffer = make_buffer(capacity, mode_features=[0, 1])
        fill(buffer, [np.random.rand(51, 2).astype(np.float32) for _ in range(10)])
        buffer.assign_modes(buffer.trajectories(True), np.arange(10) % 2, [], np.zeros(0), [None, None])
        sizes[capacity] = len(pickle.dumps(buffer))
    bytes_per_row = 4 * (2 + 2 + 3 * 2 + 1) + 2 + 3 * 4  # observations, actions, reward; two flags; three indices
    assert sizes[1_000_000] == pytest.approx(sizes[1_000], rel=0.01)
    assert sizes[1_000_000] < 2 * 500 * bytes_per_row


@pytest.mark.parametrize("channel_last", [False, True])
def test_dict_observations(channel_last):
    space = image_dict_space(channel_last)
    space.seed(0)
    buffer = make_buffer(100, n_envs=2, observation_space=space, mode_features="vec")
    steps = []
    for k in range(30):
        obs, next_obs = ([space.sample() for _ in range(2)] for _ in range(2))
        stacked = [{key: np.stack([o[key] for o in both]) for key in space.spaces} for both in (obs, next_obs)]
        done = np.array([k % 5 == 4, k % 7 == 6])
        record = buffer.add(*stacked, np.zeros((2, 2)), np.full(2, k), done, [{"is_success": True}] * 2)
        steps.append((obs, next_obs))
        np.testing.assert_array_equal(record.positions, stacked[1]["vec"])
    buffer = pickle.loads(pickle.dumps(buffer))
    batch = buffer.sample_modes(64, GAMMA, 1, 1)
    for i, (row, reward) in enumerate(zip(batch.rows[0], batch.rewards[0], strict=True)):
        obs, next_obs = (both[row % 2] for both in steps[int(reward)])
        for key in space.spaces:
            np.testing.assert_array_equal(batch.observations[key][i].squeeze(), np.squeeze(obs[key]))
            np.testing.assert_array_equal(batch.next_observations[key][i].squeeze(), np.squeeze(next_obs[key]))
    samples = buffer.sample(8)
    assert samples.observations["img"].shape == (8, *space["img"].shape) and samples.dones.shape == (8, 1)
    for trajectory in buffer.trajectories(True):
        assert buffer.full_path(trajectory).shape == (trajectory.length + 1, 2)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("part", ["observation", "next observation", "action", "reward"])
def test_values_that_are_not_finite_are_refused_before_anything_is_stored(part, value):
    buffer = make_buffer(n_envs=3)
    add = {
        "observation": np.zeros((3, 2), dtype=np.float32),
        "next observation": np.zeros((3, 2), dtype=np.float32),
        "action": np.zeros((3, 2), dtype=np.float32),
        "reward": np.zeros(3, dtype=np.float32),
    }
    buffer.add(*add.values(), np.zeros(3, dtype=bool), [{}] * 3)
    before = pickle.dumps(buffer)
    add[part][1] = value
    with pytest.raises(ValueError, match=f"The {part} of environment 1 is not finite"):
        buffer.add(*add.values(), np.ones(3, dtype=bool), [{}] * 3)
    assert pickle.dumps(buffer) == before


def test_values_that_are_not_finite_in_one_key_of_a_dict():
    buffer = make_buffer(n_envs=2, observation_space=spaces.Dict({"a": spaces.Box(-1, 1, (1,)), "b": spaces.Discrete(3)}))
    obs = {"a": np.zeros((2, 1), dtype=np.float32), "b": np.zeros(2, dtype=int)}
    with pytest.raises(ValueError, match="next observation of environment 0"):
        bad = obs | {"a": np.array([[np.nan], [0.0]], dtype=np.float32)}
        buffer.add(obs, bad, np.zeros((2, 2)), np.zeros(2), np.zeros(2, dtype=bool), [{}] * 2)
    assert buffer.size() == 0


def test_success_is_what_the_environment_says():
    rule = SuccessRule()

    def success(*infos):
        for info in infos:
            rule.observe([info])
        said = rule.so_far(0, infos[-1]).success
        rule.end(0)
        return said

    assert success({"is_success": True, "success": False}) is True
    assert success({"success": np.bool_(True)}) is True
    assert success({"is_success": 0.0}) is False
    # Once an environment gives the flag, an episode without it has failed, whatever its return
    assert success({}) is False and not any(rule.among_best(episode_return) for episode_return in range(100))
    with pytest.warns(UserWarning, match="success_key='solved' is not in an episode's last info; its keys: .*'is_success'"):
        SuccessRule("solved").check_key({"is_success": True})
    with pytest.raises(ValueError, match="did you mean 'is_success'"):
        SuccessRule("issuccess").check_key({"is_success": True})


def test_success_without_a_flag_is_a_return_in_the_top_fifth_of_the_latest():
    rng = np.random.default_rng(0)
    rule, returns = SuccessRule(), []
    for _ in range(700):
        returns.append(float(rng.normal()))
        latest = np.sort(returns[-500:])[::-1]
        expected = len(returns) >= 2 and returns[-1] >= latest[(len(latest) - 1) // 5]
        assert rule.among_best(returns[-1]) == expected
    # Where all returns are alike, none is a success
    constant = SuccessRule()
    assert not any(constant.among_best(1.0) for _ in range(20))


def test_terminal_observation_is_stored_not_the_one_after_the_reset():
    model = small_model(DummyVecEnv([TwoEnds] * 3), learning_starts=1000)
    model.learn(300)
    ends = []
    for success in (True, False):
        for trajectory in model.replay_buffer.trajectories(success):
            path = model.replay_buffer.full_path(trajectory)[:, 0]
            assert abs(path[0]) <= 0.1
            assert (np.abs(path[:-1]) < 1).all() and (abs(path[-1]) >= 1) == trajectory.success == success
            # A step is at most half a metre: a reset would be a leap
            assert (np.abs(np.diff(path)) <= 0.5 + 1e-6).all()
            last = trajectory.rows[-1]
            assert model.replay_buffer.timeouts[last] == (not success)
            ends.append(np.sign(path[-1]) * success)
    assert {-1.0, 0.0, 1.0} == set(ends)


def test_normalised_observations_and_rewards_are_normalised_when_sampled():
    env = VecNormalize(DummyVecEnv([TwoEnds] * 2), gamma=GAMMA)
    model = small_model(env, learning_starts=1000)
    model.learn(200)
    buffer = model.replay_buffer
    batch, samples = buffer.sample_modes(60, GAMMA, 2, 1, env=env), buffer.sample(60, env=env)
    np.testing.assert_allclose(batch.observations, env.normalize_obs(buffer.observations[batch.rows.ravel()]), rtol=1e-6)
    for row, reward in zip(batch.rows[0], batch.rewards[0], strict=True):
        window = [row, *([buffer.next_row[row]] if buffer.next_row[row] >= 0 else [])]
        expected = sum(GAMMA**k * env.normalize_reward(buffer.rewards[row]) for k, row in enumerate(window))
        assert reward.item() == pytest.approx(expected, abs=1e-6)
    raw = env.unnormalize_obs(samples.observations.numpy())
    nearest = np.abs(raw[:, None] - buffer.observations[None, : buffer.pos]).sum(axis=2).min(axis=1)
    assert nearest.max() < 1e-5
    # Clustering sees metres
    for trajectory in buffer.trajectories(True):
        assert abs(buffer.full_path(trajectory)[-1, 0]) >= 1


def test_whole_observations_are_standardised_once():
    buffer = make_buffer()
    rng = np.random.default_rng(0)
    scale = np.array([1.0, 1000.0], dtype=np.float32)
    fill(buffer, [rng.normal(size=(11, 2)).astype(np.float32) * scale for _ in range(5)])
    stored = np.concatenate([buffer.full_path(t)[:-1] for t in buffer.trajectories(True)])
    path = buffer.path(buffer.trajectories(True)[0])
    expected = buffer.full_path(buffer.trajectories(True)[0]) / stored.std(axis=0)
    np.testing.assert_allclose(path[[0, -1]], expected[[0, -1]], rtol=1e-4)
    fill(buffer, [1000 * rng.normal(size=(11, 2)).astype(np.float32)])
    np.testing.assert_allclose(buffer.resample(buffer.full_path(buffer.trajectories(True)[0])), path, rtol=1e-6)
    # A component that never changes is left alone
    constant = make_buffer()
    fill(constant, [np.array([[0.0, 5.0], [1.0, 5.0], [2.0, 5.0]], dtype=np.float32)])
    assert np.isfinite(constant.path(constant.trajectories(True)[0])).all()


def test_a_limit_without_handling_of_timeouts_is_terminal():
    buffer = make_buffer(handle_timeout_termination=False)
    obs = np.zeros((1, 2), dtype=np.float32)
    buffer.add(obs, obs, obs, np.zeros(1), np.array([True]), [{"TimeLimit.truncated": True}])
    assert buffer.sample_modes(1, GAMMA, 1, 1).discounts.item() == 0 and buffer.sample(1).dones.item() == 1


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        *(("handle_timeout_termination", value) for value in ("False", 1, None)),
        ("buffer_size", 0),
        ("max_successes_per_mode", 0),
        ("max_failures_per_mode", -1),
        *(("n_path_points", value) for value in (1, 48.5, True, "48", None)),
        *(("new_route_share", value) for value in (2.0, -0.1, float("nan"), "half", True)),
        *(("min_direct", value) for value in (0, 2.5, float("inf"), "5")),
        *(("loop_share", value) for value in (float("nan"), -0.1, float("inf"), "0.1", None)),
        *(("max_length_ratio", value) for value in (float("nan"), 0.5, "1.5")),
        *((flag, value) for flag in ("normalize_distances", "explore_beyond_goals") for value in ("False", 1, None, 0.0)),
        ("compared_length", 0.0),
        *(("compared_length", value) for value in (float("nan"), float("inf"), "0.3", [0.3], True)),
        ("optimize_memory_usage", True),
    ],
)
def test_bad_arguments(argument, value):
    with pytest.raises(ValueError, match=argument):
        make_buffer(**{argument: value})
    if argument not in ("buffer_size", "optimize_memory_usage"):  # which are the model's own
        # Where the model is made, not hours later where they are used
        with pytest.raises(ValueError, match=argument):
            small_model(TwoEnds(), replay_buffer_kwargs={argument: value})


def test_extend_is_add_row_by_row():
    old, new = make_buffer(), make_buffer()
    fill(old, [np.random.rand(9, 2).astype(np.float32) for _ in range(3)], success=False)
    n = old.size()
    infos = [[{"TimeLimit.truncated": bool(timeout), "is_success": True}] for timeout in old.timeouts[:n]]
    columns = [old.observations, old.next_observations, old.actions, old.rewards, old.dones]
    new.extend(*(column[:n, None] for column in columns), infos)
    assert new.size() == n and len(new.trajectories(True)) == 3
    np.testing.assert_array_equal(new.observations[:n], old.observations[:n])


def test_pickles_to_any_file_like_object():
    buffer = make_buffer()
    fill(buffer, [np.random.rand(9, 2).astype(np.float32)])
    stream = io.BytesIO()
    pickle.dump(buffer, stream)
    stream.seek(0)
    loaded = pickle.load(stream)
    # It goes on where it was: the storage has its full size again
    fill(loaded, [np.random.rand(9, 2).astype(np.float32) for _ in range(40)])
    assert loaded.size() == 200 and len(loaded.observations) == 200


def test_images_keep_their_type():
    space = spaces.Box(0, 255, (1, 36, 36), dtype=np.uint8)
    model = small_model(DummyVecEnv([lambda: AnySpaces(space)]), learning_starts=1000, critic={"v_min": -10.0, "v_max": 10.0})
    model.learn(25)
    assert model.replay_buffer.observations.dtype == np.uint8
