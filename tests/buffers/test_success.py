"""What counts as a success, row by row as environments tell it: when, how, and what follows for modes and evaluation."""

import math
import warnings

import numpy as np
import pytest
import torch as th
from environments import KnownEnds, TwoEnds, change_settings, small_model
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import ModeEvalCallback
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.state import buffer_state, restore_buffer
from sb3_ddiffpg.buffers.success import read_success
from sb3_ddiffpg.buffers.trajectory import NO_MODE, PAST_GOAL
from sb3_ddiffpg.evaluation import evaluate_modes
from sb3_ddiffpg.evaluation.rollout import run_episodes
from sb3_ddiffpg.exploration.bonus import ExplorationBonus
from sb3_ddiffpg.exploration.cells import CellGrid
from sb3_ddiffpg.exploration.known_regions import KnownRoute
from sb3_ddiffpg.exploration.novelty import VisitCounts
from sb3_ddiffpg.exploration.settings import ExplorationSettings, NoveltySettings
from sb3_ddiffpg.zoo.commands import OutcomeVecEnv

GAMMA = 0.9
SPACE = spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(-1.0, 1.0, (1,))


class GoesOn(TwoEnds):
    """
    ``TwoEnds`` that go on at a goal until the time is up. ``tell`` says what info holds, from whether the point is at a goal;
    a point cannot get further than 1.5.
    """

    listed_modes = ("left", "right")

    def __init__(self, tell, limit=12, pay=(1.0, 0.0)):
        super().__init__(limit=limit)
        self.tell, self.pay = tell, pay

    def step(self, action):
        self.x = float(np.clip(self.x + 0.5 * float(action[0]), -1.5, 1.5))
        self.steps += 1
        there = abs(self.x) >= 1
        info = {**self.tell(there), "mode": "left" if self.x < 0 else "right"}
        return self._observation(), self.pay[not there], False, self.steps >= self.limit, info


#: Ways in which environments tell a success
TOLD = {
    "always, bool": lambda there: {"is_success": there},
    "always, numpy": lambda there: {"success": np.bool_(there)},
    "always, float": lambda there: {"is_success": float(there)},
    "always, array of one": lambda there: {"success": np.array([there])},
    "always, tensor": lambda there: {"success": th.tensor(float(there))},
    "always, NaN for no": lambda there: {"is_success": 1.0 if there else math.nan},
    "only where true": lambda there: {"is_success": True} if there else {},
    "None for no": lambda there: {"success": True if there else None},
}


class There:
    """Drives to the right goal by 5 steps of 0.25, and back from there: at the end it is far from any goal."""

    success_key = None

    def predict(self, obs, **kwargs):
        early = obs[:, 1] < 0.45  # of the time
        return np.where(early, 0.5, -1.0)[:, None].astype(np.float32), None


# ---------------------------------------------------------------------- one step


@pytest.mark.parametrize(
    ("value", "meaning"),
    [
        *(
            (value, True)
            for value in (True, np.bool_(True), 1, 1.0, np.float32(1), np.array([True]), np.array(1.0), th.ones(1))
        ),
        *((value, False) for value in (False, np.bool_(False), 0, 0.0, np.array([0]), math.nan, np.float32(np.nan))),
        (None, None),
    ],
    ids=str,
)
def test_one_value(value, meaning):
    assert read_success({"is_success": value}) is meaning is read_success({"success": value})
    assert read_success({"solved": value, "is_success": not meaning}, "solved") is meaning


@pytest.mark.parametrize("value", [0.7, -0.5, "yes", [1, 0], np.ones(2), np.inf, {1}], ids=str)
def test_values_that_are_none(value):
    with pytest.raises(ValueError, match=r"info\['is_success'\]: .* given; accepted is True or False"):
        read_success({"is_success": value})


# ---------------------------------------------------------------------- episodes in training


@pytest.mark.parametrize("tell", TOLD.values(), ids=TOLD.keys())
def test_a_goal_in_mid_episode_is_a_success_that_ends_there(tell):
    """However it is told; against the positions."""
    model = small_model(DummyVecEnv([lambda: GoesOn(tell)] * 4), learning_starts=10_000, recluster_freq=10**6)
    model.learn(4 * 12 * 25)
    buffer = model.replay_buffer
    found = {success: buffer.trajectories(success) for success in (True, False)}
    past = buffer.groups.past_goals()
    assert len(found[True]) >= 10 and len(past) >= 5 and len(found[True]) + len(found[False]) == 100
    for success, trajectories in found.items():
        for each in trajectories:
            path = buffer.full_path(each)[:, 0]
            assert (np.abs(path[:-1]) < 1).all() and (abs(path[-1]) >= 1) == each.success == success
            assert len(path) == each.length + 1
            assert buffer.goals[each.rows].tolist() == [False] * (each.length - 1) + [success]
            assert each.label == ("left" if path[-1] < 0 else "right")
    assert all(not each.success and each.mode == PAST_GOAL and not buffer.goals[each.rows].any() for each in past)
    # Together they are all there is, and windows end at the goal
    rows = np.concatenate([each.rows for each in (*found[True], *found[False], *past)])
    assert len(set(rows.tolist())) == len(rows) == buffer.size() == model.num_timesteps
    assert (buffer.next_row[[each.rows[-1] for each in found[True]]] == -1).all()


def test_what_follows_a_goal_trains_no_mode():
    """But explorers, who share it."""
    model = small_model(DummyVecEnv([lambda: GoesOn(TOLD["always, bool"])] * 4), gamma=GAMMA, learning_starts=100)
    model.learn(1600)
    buffer = model.replay_buffer
    assert len(model.modes) == 2
    past = {row for each in buffer.groups.past_goals() for row in each.rows.tolist()}
    of_modes = {row for row_set in buffer.mode_rows for row in row_set.rows[: row_set.size].tolist()}
    assert past and of_modes and not past & of_modes
    batch = buffer.sample_modes(900, GAMMA, 3, 3, visits_of_modes=True)
    assert past & set(batch.rows[0].tolist()) and not past & set(batch.rows[1:].ravel().tolist())
    # The lengths of modes are those to the goal, of 12 steps that each episode has
    assert all(mode.mean_length < 12 and abs(mode.representative[-1, 0]) >= 1 for mode in model.modes)
    assert all((np.abs(mode.representative[:-1, 0]) < 1).all() for mode in model.modes)


def episode(buffer, positions, infos, rewards, end):
    """One environment walks along positions; ``end`` is "terminated", "truncated" or None."""
    for k, (info, reward) in enumerate(zip(infos, rewards, strict=True)):
        last = k == len(infos) - 1 and end is not None
        info = {**info, "TimeLimit.truncated": last and end == "truncated"}
        obs, after = (np.array([[positions[i], 0.0]], dtype=np.float32) for i in (k, k + 1))
        record = buffer.add(obs, after, np.zeros((1, 1)), np.array([reward]), np.array([last]), [info])
    return record


def make_buffer(size=500, **kwargs):
    return ModeReplayBuffer(size, *SPACE, device="cpu", mode_features=[0], **kwargs)


def own_mode(buffer):
    """All is one mode's."""
    successes, failures = buffer.trajectories(True), buffer.trajectories(False)
    buffer.assign_modes(successes, np.zeros(len(successes)), failures, np.zeros(len(failures)), [None])


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("end", ["terminated", "truncated", "goes on"])
@pytest.mark.parametrize(("on_the_way", "at_the_goal"), [(0.0, 1.0), (-1.0, 0.0), (9.0, 10.0), (-1.0, -1.0)])
def test_what_a_goal_is_worth_to_a_mode(end, on_the_way, at_the_goal, n_steps):
    """
    Returns from each step by hand: of an episode that ends with its goal, as the environment pays it; where it goes on, as to
    one who stays for ever, if that pays.
    """
    buffer = make_buffer()
    told = [{"is_success": k >= 4} for k in range(8 if end == "goes on" else 5)]
    rewards = [at_the_goal if k >= 4 else on_the_way for k in range(len(told))]
    record = episode(buffer, np.arange(9.0), told, rewards, "truncated" if end == "goes on" else end)
    assert [(env, t.length, t.success) for env, t in record.finished] == [(0, 5, True)]
    assert record.finished[0][1].episode_return == sum(rewards)
    own_mode(buffer)
    batch = buffer.sample_modes(400, GAMMA, n_steps, n_steps)
    step = batch.observations[:, 0].numpy().astype(int).reshape(batch.rows.shape)
    assert set(step[1]) == set(range(5)) and set(step[0]) == set(range(len(told)))
    goal = at_the_goal if end == "terminated" or at_the_goal <= 0 else at_the_goal * sum(GAMMA**k for k in range(2000))
    for group, column in np.ndindex(batch.rows.shape):
        first = step[group, column]
        if group:
            paid = [*([on_the_way] * 4), goal][first : first + n_steps]
            goes_on = first + n_steps < 5
        else:
            # A window that reaches the goal is shorter, and goes on with what the critics expect there
            stop = min(first + n_steps, 5 if first < 5 else len(told))
            paid, goes_on = rewards[first:stop], not (end == "terminated" and stop == 5)
        expected = sum(GAMMA**k * reward for k, reward in enumerate(paid))
        assert batch.rewards[group, column].item() == pytest.approx(expected, rel=1e-4, abs=1e-5)
        assert batch.discounts[group, column].item() == pytest.approx(GAMMA ** len(paid) if goes_on else 0.0, rel=1e-5)


def test_explorers_who_are_paid_for_a_goal_end_there_too():
    """Or they would be paid each time that they come back to it."""
    for share, ended in ((0.25, True), (0.0, False)):
        buffer = make_buffer(new_route_share=share, explore_beyond_goals=True)
        episode(buffer, np.arange(9.0), [{"is_success": k == 4} for k in range(8)], np.arange(8.0), "truncated")
        successes = buffer.trajectories(True)
        buffer.assign_modes(successes, np.full(1, NO_MODE), [], np.zeros(0), [])  # of no mode, so all new
        batch = buffer.sample_modes(300, GAMMA, 1, 1)
        step = batch.observations[:, 0].numpy().astype(int)
        at_goal = batch.discounts[0][step == 4].numpy()
        np.testing.assert_allclose(at_goal, 0.0 if ended else GAMMA, rtol=1e-6)
        np.testing.assert_allclose(batch.discounts[0][(step != 4)].numpy(), GAMMA, rtol=1e-6)
        assert (batch.new_routes.numpy() == np.where(step == 4, batch.rewards[0].numpy(), 0)).all()


def test_a_best_episode_that_ran_out_of_time_is_no_goal():
    """Its return goes on, as before: nobody has said that anything was reached."""
    buffer = make_buffer()
    for total in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0):
        episode(buffer, np.arange(4.0), [{}] * 3, [0.0, 0.0, total], "truncated")
    buffer.judge_by_returns()
    own_mode(buffer)
    assert [t.episode_return for t in buffer.trajectories(True)] == [4.0, 5.0]
    batch = buffer.sample_modes(200, GAMMA, 1, 1)
    np.testing.assert_allclose(batch.discounts.numpy(), GAMMA, rtol=1e-6)
    assert set(batch.rewards[1].tolist()) <= {0.0, 1.0, 2.0, 3.0, 4.0, 5.0}


# ---------------------------------------------------------------------- judged again


def test_the_best_are_those_of_now():
    """The best fifth of the returns, by hand: what was among the best when it came may be none, the first is judged too."""
    buffer = make_buffer()
    for total in (9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 0.0):
        episode(buffer, np.arange(4.0), [{}] * 3, [0.0, 0.0, total], "truncated")
    assert [t.episode_return for t in buffer.trajectories(True)] == [5.0, 6.0, 7.0, 8.0]  # when they came
    buffer.judge_by_returns()
    assert [t.episode_return for t in buffer.trajectories(True)] == [9.0, 8.0]
    assert [t.serial for t in buffer.trajectories(False)] == [1, 2, 3, 4, 5, 6, 7, 9]
    # Fewer than a fifth, where all others are alike
    rare = make_buffer()
    for total in (0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0):
        episode(rare, np.arange(4.0), [{}] * 3, [0.0, 0.0, total], "truncated")
    rare.judge_by_returns()
    assert [t.episode_return for t in rare.trajectories(True)] == [0.5, 1.0]
    # Once an environment says what a success is, returns say nothing
    episode(buffer, np.arange(4.0), [{}, {}, {"is_success": True}], [0.0, 0.0, -5.0], "terminated")
    buffer.judge_by_returns()
    assert [t.episode_return for t in buffer.trajectories(True)] == [-5.0]
    # Nor where a key is waited for, or where all are alike, whatever is said
    for other, total, word in (
        (make_buffer(success_key="solved"), 1.0, {}),
        (make_buffer(success_key="solved"), 1.0, {"solved": False}),
        (make_buffer(), 0.0, {}),
        (make_buffer(), 0.0, {"is_success": False}),
    ):
        for k in range(5):
            episode(other, np.arange(4.0), [word] * 3, [0.0, 0.0, k * total], "truncated")
        other.judge_by_returns()
        assert other.trajectories(True) == []


def test_modes_of_a_dense_reward_learn_from_all_their_episodes():
    """From long ones, old ones and retired ones; where successes are told, from the newest direct ones."""
    for told in (False, True):
        buffer = make_buffer(max_successes_per_mode=3, max_failures_per_mode=2)
        for k in range(12):
            said = {"is_success": k % 2 == 0} if told else {}
            episode(buffer, np.linspace(0, 1, 3 + k), [{}] * (1 + k) + [said], [float(k % 2 == 0)] * (2 + k), "truncated")
        buffer.groups.judge_again(lambda trajectory: trajectory.serial % 2 == 0)
        for parents in ([None], [0], [None, 0]):  # a birth; the mode goes on; it is the second one now
            mine = len(parents) - 1
            parts = buffer.trajectories(True), buffer.trajectories(False)
            buffer.assign_modes(parts[0], np.full(len(parts[0]), mine), parts[1], np.full(len(parts[1]), mine), parents)
        rows = buffer.mode_rows[1]
        assert buffer.mode_rows[0].size == 0
        # Told: the 3 newest that are no detours, and 2 failures
        expected = sum(2 + k for k in (6, 8, 10, 9, 11)) if told else buffer.size()
        assert rows.size == expected == sum(t.length for t in _all(buffer) if t.trains)
        # It leaves the mode with the buffer's storage, and comes back from a file
        other = make_buffer(max_successes_per_mode=3, max_failures_per_mode=2)
        other.expect_modes(2)
        restore_buffer(other, buffer_state(buffer))
        np.testing.assert_array_equal(np.sort(other.mode_rows[1].rows[: rows.size]), np.sort(rows.rows[: rows.size]))
        gone = buffer._evict()
        assert rows.size == expected - gone.length * gone.trains
        # With the first word, a mode of what was no success ends
        if not told:
            episode(buffer, np.arange(3.0), [{}, {"success": True}], [0.0] * 2, "terminated")
            parts = buffer.trajectories(True), buffer.trajectories(False)
            buffer.assign_modes(parts[0], np.zeros(1), parts[1], np.full(len(parts[1]), NO_MODE), [None])
            assert buffer.mode_rows[0].size == 2


def _all(buffer):
    return [*(each for group in buffer.groups.members.values() for each in group), *buffer.groups.retired]


@pytest.mark.parametrize("word", [{}, {"is_success": False}])
def test_what_stood_in_for_successes_is_taken_back(word):
    """With the first goal that is told, in mid-episode; by hand. Until then it may have been said that there is none."""
    buffer = make_buffer(new_route_share=0.25)
    for total in range(10):
        episode(buffer, np.arange(4.0), [word] * 3, [0.0, 0.0, float(total)], "truncated")
    before = buffer.trajectories(True)
    assert [t.episode_return for t in before] == [*range(1, 10)]
    assert buffer.has_success_signal == bool(word) and not buffer.goals_are_told
    successes, failures = before, buffer.trajectories(False)
    buffer.assign_modes(successes, np.array([0] * 4 + [1] * 4 + [NO_MODE]), failures, np.array([1]), [None, None])
    assert len(buffer.new_route_rows)
    sizes = [row_set.size for row_set in buffer.mode_rows]
    episode(buffer, np.arange(9.0), [word, word, {"is_success": True}, word], [0.0] * 4, None)
    assert buffer.goals_are_told and buffer.trajectories(True) == []
    assert [t.serial for t in buffer.trajectories(False)] == list(range(10))
    assert not buffer.goals.any() and not buffer.route_novelty.any() and not len(buffer.new_route_rows)
    assert buffer.unfounded_modes == {0, 1} and [row_set.size for row_set in buffer.mode_rows] == sizes
    # It holds together, and keeps it all through a file
    state, other = buffer_state(buffer), make_buffer(new_route_share=0.25)
    other.expect_modes(2)
    restore_buffer(other, state)
    assert other.unfounded_modes == {0, 1} and [t.serial for t in other.trajectories(False)] == list(range(10))
    for each in (buffer, other):  # and the episode that was running is one with a goal
        episode(each, np.arange(4.0, 9.0), [{}, {}], [0.0, 5.0], "truncated")
        assert [(t.length, t.episode_return) for t in each.trajectories(True)] == [(3, 5.0)]
        assert [t.length for t in each.groups.past_goals()] == [3]


class SaidLate(TwoEnds):
    """An end at the left costs less than to go on; the goal at the right is told where it is reached, and nowhere else."""

    told = True

    def step(self, action):
        observation, reached, terminated, truncated, _ = super().step(action)
        info = {"is_success": True} if self.told and self.x >= 1 else {}
        return observation, reached - 1.0 + (self.x >= 1) * 5.0, terminated, truncated, info


def test_modes_of_what_was_no_success_end_with_the_next_clustering(tmp_path):
    """And what is found then is by the environment's word; a frozen mode is the user's."""
    env = DummyVecEnv([SaidLate] * 4)
    for each in env.envs:
        each.told = False
    # All that is learned before is by returns alone
    model = small_model(env, critic={"v_min": -10.0, "v_max": 5.0}, seed=1).learn(400)
    numbers = [mode.number for mode in model.modes]
    assert numbers and not model.replay_buffer.has_success_signal
    model.freeze_mode(0)
    for each in env.envs:
        each.told = True
    model.learn(400, reset_num_timesteps=False)
    assert model.replay_buffer.has_success_signal and model.replay_buffer.unfounded_modes == set()
    ended = [event.number for event in model.mode_history if event.kind == "retired"]
    assert set(numbers[1:]) <= set(ended) and numbers[0] not in ended
    assert all(model.replay_buffer.full_path(t)[-1, 0] >= 1 for t in model.replay_buffer.trajectories(True))
    model.freeze_mode(0, False)
    # A model that goes on in a new buffer knows that its environment says so
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=env)
    assert loaded.replay_buffer.has_success_signal
    assert not loaded.replay_buffer.success_rule.among_best(1e9)


def test_a_mode_that_is_deleted_takes_its_doubt_with_it():
    buffer = make_buffer()
    for total in range(10):
        episode(buffer, np.arange(4.0), [{}] * 3, [0.0, 0.0, float(total)], "truncated")
    successes = buffer.trajectories(True)
    buffer.assign_modes(successes, np.arange(len(successes)) % 2, [], np.zeros(0), [None, None, None])
    episode(buffer, np.arange(3.0), [{}, {"success": True}], [0.0] * 2, "terminated")
    assert buffer.unfounded_modes == {0, 1}
    failures = buffer.trajectories(False)
    buffer.assign_modes(buffer.trajectories(True), np.full(1, NO_MODE), failures, np.full(len(failures), NO_MODE), [1, 2])
    assert buffer.unfounded_modes == {0}


def test_a_key_that_is_given_is_waited_for():
    env = DummyVecEnv([lambda: GoesOn(lambda there: {"solved": True} if there else {})] * 4)
    model = small_model(env, success_key="solved", learning_starts=10_000)
    with warnings.catch_warnings():  # about the first episodes, perhaps
        warnings.simplefilter("ignore")
        model.learn(4 * 12 * 10)
    assert model.replay_buffer.has_success_signal and model.replay_buffer.trajectories(True)
    never = small_model(DummyVecEnv([lambda: TwoEnds(None)] * 2), success_key="solved", learning_starts=10_000)
    with pytest.warns(
        UserWarning, match=r"'solved' is not in an .* last info; its keys: .* as failures until one has it"
    ) as said:
        never.learn(400)
    assert len(said) == 1
    assert never.replay_buffer.trajectories(True) == []


# ---------------------------------------------------------------------- episodes in tests


@pytest.mark.parametrize("tell", TOLD.values(), ids=TOLD.keys())
def test_tests_go_by_the_same_rule(tell):
    """Through the same kinds of telling; the goal is reached and left again."""
    env = DummyVecEnv([lambda: GoesOn(tell)] * 2)
    for found in run_episodes(There(), env, 4):
        assert found.success is True and found.length < 8 and found.label == "right"
        assert len(found.path) == found.length + 1 and found.path[-1, 0] >= 1 and (found.path[:-1, 0] < 1).all()
        assert 1 <= found.episode_return < 8  # at the goal and after it

    class Nowhere(There):
        def predict(self, obs, **kwargs):
            return np.zeros((len(obs), 1), dtype=np.float32), None

    failed = run_episodes(Nowhere(), env, 2)
    assert [each.success for each in failed] == [None if "rue" in name_of(tell) or "None" in name_of(tell) else False] * 2
    assert [each.length for each in failed] == [12, 12]


def name_of(tell):
    return next(name for name, each in TOLD.items() if each is tell)


@pytest.mark.parametrize("known", [True, False])
def test_silence_is_failure_where_success_is_told(known):
    """By an episode of the same evaluation, whatever was commanded, or by the training."""
    env = DummyVecEnv([lambda: GoesOn(TOLD["only where true"])] * 2)

    class Commanded:
        modes = ()
        success_key = None

        def __init__(self):
            self.calls = 0

        def predict(self, obs, **kwargs):
            self.calls += 1
            goes = (np.arange(len(obs)) == 0) & (not known)  # the first environment's succeed
            return np.where(goes, 0.5, 0.0)[:, None].astype(np.float32), None

    model = Commanded()
    if known:
        model.replay_buffer = make_buffer()
        model.replay_buffer.success_rule.has_signal = True
    result = evaluate_modes(model, env, 2, n_uncommanded=4).uncommanded
    assert (result.n_successes, result.n_episodes) == ((0, 4) if known else (2, 4))


class Last(Logger):
    """What was logged last under each name."""

    def __init__(self):
        super().__init__(None, [])
        self.last = {}

    def record(self, key, value, exclude=None):
        self.last[key] = value


@pytest.mark.parametrize("name", ["always, bool", "only where true", "always, array of one"])
def test_callbacks_go_by_the_same_rule(name):
    model = small_model(DummyVecEnv([TwoEnds] * 2), learning_starts=10_000)
    model.set_logger(Last())
    model.predict = There().predict
    callback = ModeEvalCallback(
        DummyVecEnv([lambda: GoesOn(TOLD[name])] * 2), eval_freq=10, n_eval_episodes=4, verbose=0, warn=False
    )
    model.learn(40, callback=callback)
    assert model.logger.last["eval/success_rate"] == 1.0 and model.logger.last["eval/n_modes"] == 1


def test_sb3_own_rate_is_as_ever():
    """``rollout/success_rate`` is SB3's: ``info["is_success"]`` of the last step."""
    model = small_model(DummyVecEnv([TwoEnds] * 4), learning_starts=10_000, recluster_freq=10**6).learn(800)
    ends = [each for success in (True, False) for each in model.replay_buffer.trajectories(success)]
    ends = [each.success for each in sorted(ends, key=lambda each: each.serial)][-100:]
    assert list(model.ep_success_buffer) == ends and 0.1 < np.mean(ends) < 0.9


def test_the_zoo_counts_by_the_same_rule():
    outcomes = {label: [0, 0] for label in ("left", "right", "(no goal)")}
    env = OutcomeVecEnv([lambda: GoesOn(TOLD["only where true"])] * 2, outcomes)
    obs = env.reset()
    for _ in range(24):
        obs = env.step(There().predict(obs)[0])[0]
    assert outcomes["right"] == [4, 4]


# ---------------------------------------------------------------------- without a time limit


def test_an_endless_episode_is_stored_in_parts():
    """By hand: 10 of 40 rows for each of two environments, which share half of them."""
    buffer = make_buffer(40, n_envs=2)
    env = DummyVecEnv([lambda: TwoEnds(limit=10**9)] * 2)
    buffer.claim(env)
    assert buffer.part_length == 10
    parts, started = [], []
    with pytest.warns(UserWarning, match="stored in parts, of at most 10 steps with this buffer_size=40") as said:
        for k in range(95):
            obs = np.array([[k, 0], [k + 1000, 0]], dtype=np.float32)
            infos = [{"is_success": k == 33}, {"is_success": False}]
            record = buffer.add(obs, obs + 1, np.zeros((2, 1)), np.zeros(2), np.zeros(2, dtype=bool), infos)
            assert record.finished == []
            parts += [(k, env, t.length, t.success, t.mode) for env, t in record.parts]
            started += record.started.tolist()
    assert len(said) == 1 and started == [0, 1] and 30 <= buffer.size() <= 40
    # The goal at the 34th step ends a part's path; what the episode does from then on is past it
    expected = [(9 + 10 * i, env, 10, False, NO_MODE) for i in range(9) for env in range(2)]
    expected[6] = (39, 0, 4, True, NO_MODE)
    expected = [(*each[:4], PAST_GOAL) if each[1] == 0 and each[0] > 39 else each for each in expected]
    assert parts == expected
    assert buffer.success_rule.goal_steps.tolist() == [34, 0] and buffer.success_rule.steps.tolist() == [95, 95]
    batch = buffer.sample(200)
    assert not batch.dones.any()
    # The next step is never that of another part, or of another episode
    rows = buffer.stored_rows.rows[: buffer.size()]
    after = buffer.next_row[rows]
    np.testing.assert_array_equal(buffer.observations[after[after >= 0]], buffer.next_observations[rows[after >= 0]] * [1, 0])
    # The end of the episode is that of its last part
    record = buffer.add(obs + 1, obs + 2, np.zeros((2, 1)), np.zeros(2), np.ones(2, dtype=bool), [{}, {}])
    assert [(env, t.length, t.mode) for env, t in record.finished] == [(0, 6, PAST_GOAL), (1, 6, NO_MODE)]
    assert not buffer.success_rule.steps.any() and not buffer.success_rule.goal_steps.any()


def test_a_declared_time_limit_that_is_not_kept():
    """Parts are made only when there is nothing else to evict, and then as if none had been declared."""
    buffer = make_buffer(40)
    with pytest.warns(UserWarning, match="An episode goes on after 40 steps"):
        for k in range(200):
            obs = np.array([[k, 0]], dtype=np.float32)
            record = buffer.add(obs, obs + 1, np.zeros((1, 1)), np.zeros(1), np.zeros(1, dtype=bool), [{}])
            assert not [t for _, t in record.parts if not np.isin(t.rows, buffer.stored_rows.rows[: buffer.size()]).all()]
    assert buffer.part_length == 20 and buffer.size() <= 40 and buffer.running.lengths.max() <= 20
    values = sorted(buffer.observations[buffer.stored_rows.rows[: buffer.size()], 0].tolist())
    assert values == list(range(200 - len(values), 200))  # the newest


class Endless(KnownEnds):
    """Never ends: from a goal the point is put back to the middle."""

    def __init__(self):
        super().__init__(limit=10**9)

    def step(self, action):
        observation, reward, *_ = super().step(action)
        if abs(self.x) > 1.5:
            self.x = 0.0
        return observation / np.array([1.0, max(1.0, self.steps)], dtype=np.float32), reward, False, False, {}


@pytest.mark.parametrize("algorithm", ["ddiffpg", "sac_c51", "rpg"])
def test_endless_episodes_train(algorithm, tmp_path):
    """All of them, for longer than the buffer is; the best parts stand in for successes, and each part has its driver."""
    env = DummyVecEnv([Endless] * 2)
    if algorithm == "ddiffpg":
        model = small_model(env, buffer_size=120, critic={"v_max": 30.0})
        driven = []
        begin = model.scheduler.begin
        model.scheduler.begin = lambda env, share: (driven.append(env), begin(env, share))
    else:
        model = BASELINES[algorithm](
            "MlpPolicy", env, buffer_size=120, learning_starts=500, train_freq=50, batch_size=32, device="cpu"
        )
        driven = None
    with pytest.warns(UserWarning, match="stored in parts, of at most 30 steps"):
        model.learn(600)
    assert model.replay_buffer.size() <= 120
    assert model.bonus._in_parts == {0, 1} and model.replay_buffer.success_rule.steps.tolist() == [300, 300]
    if driven is not None:
        assert driven == [0, 1] * 11  # at the beginning and after 10 parts of either
        assert not any(mode.outcomes for mode in model.modes)  # none has driven an episode from its beginning
        change_settings(model, exploration={"fraction": 1.0})


@pytest.mark.parametrize("cut", [True, False])
def test_what_the_bonus_knows_of_an_episode_in_parts_goes_on(cut):
    """Places and a route from before the parts that the buffer still has: through a re-clustering, and a file."""

    def make_bonus():
        return ExplorationBonus(VisitCounts(1, 1), 1, NoveltySettings(), ExplorationSettings(), 1, CellGrid(1, 1.0))

    def walk(start, stop):
        for k in range(start, stop):
            obs, after = (np.array([[position, 0]], dtype=np.float32) for position in (k, k + 1))
            record = buffer.add(obs, after, np.zeros((1, 1)), np.zeros(1), np.zeros(1, dtype=bool), [{}])
            bonus.observe(record, buffer)

    bonus, buffer = make_bonus(), make_buffer(24 if cut else 500)
    buffer.part_length = 12 if cut else None
    path = np.linspace(0, 30, 48, dtype=np.float32)[None, :, None]
    bonus.routes.replace([KnownRoute(5, path, 1.0)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        walk(0, 29)
    assert bonus.routes.followed.tolist() == [5] and (buffer.observations[buffer.stored_rows.rows[:20], 0] > 4).all() == cut
    seen = {*bonus.episode_cells.seen[0]}
    assert len(seen) == 30
    been = bonus.routes._been.copy()
    # The same route is found again, and another one: what was gone of the old one is known
    bonus.routes.replace([KnownRoute(7, path + 1000, 1.0), KnownRoute(5, path + 0.1, 1.0)], sorted(bonus._in_parts))
    bonus._recall_routes(buffer)
    assert bonus.routes.followed.tolist() == [5] and bonus.routes._been[:, 0].tolist() == [0, been[0, 0]]
    loaded, copy = make_bonus(), make_buffer(24 if cut else 500)
    restore_buffer(copy, buffer_state(buffer))
    loaded.load_state_dict(bonus.state_dict())
    loaded.recall_episodes(copy)
    assert loaded.episode_cells.seen[0] == seen and loaded.routes.followed.tolist() == [5]
    np.testing.assert_array_equal(loaded.routes._been, bonus.routes._been)
    assert loaded._in_parts == bonus._in_parts == ({0} if cut else set())
    # With another buffer, whose episodes are others, nothing of it
    loaded.load_state_dict(bonus.state_dict())
    loaded.recall_episodes(make_buffer())
    assert loaded.episode_cells.seen == [set()] and not loaded.routes._been.any() and not loaded._in_parts
