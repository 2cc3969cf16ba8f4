"""Other goals for transitions, against brute force; where goals could be others and where not; and what is learned by it."""

import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from environments import small_model
from goal_envs import NEAR, AnyGoal, NoGoals, OneAtATime, wrapped
from planar import belongings, same
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_ddiffpg import DDiffPG, check_env
from sb3_ddiffpg.baselines import TD3C51
from sb3_ddiffpg.buffers.hindsight import Hindsight
from sb3_ddiffpg.envs.vec_env import WorkerVecEnv

GAMMA = 0.9


class NeverTold(gym.Wrapper):
    """As if no goal were ever reached."""

    def step(self, action):
        *step, info = super().step(action)
        return *step, {**info, "is_success": False}


def made(n_envs=2, wrapper=lambda env: env, learning_starts=100, **kwargs):
    env = DummyVecEnv([lambda: wrapper(AnyGoal(**kwargs))] * n_envs)
    env.seed(0)
    settings = {"learning_starts": learning_starts, "modes": {"distance_threshold": None}}
    return small_model(env, "MultiInputPolicy", gamma=GAMMA, **settings)


def with_modes(**kwargs):
    """Goals reached by chance make a mode, which learns from all."""
    model = made(**kwargs).learn(1000)
    assert len(model.modes)
    return model


def distance(a, b):
    return np.linalg.norm(a - b, axis=-1)


def test_who_has_no_modes_relabels_nothing():
    """And is not told of rewards that do not follow from goals."""
    env, settings = DummyVecEnv([lambda: AnyGoal(extra=0.5)]), {"learning_starts": 10_000, "device": "cpu"}
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        model = TD3C51("MultiInputPolicy", env, critic={"v_min": -100.0, "v_max": 100.0}, **settings)
        model.set_logger(Logger(None, []))
        model.learn(100)
    assert model.replay_buffer.hindsight is None and not model.replay_buffer.has_hindsight


def test_no_return_stands_in_for_a_goal_where_other_goals_can_be_learned_from():
    """The best of dense returns are those whose goal was near: no mode is made of them, but one of all."""
    model = made(wrapper=NeverTold, dense=True, learning_starts=10_000).learn(400)
    buffer = model.replay_buffer
    returns = {each.episode_return for each in buffer.finished_trajectories()}
    assert buffer.has_hindsight and buffer.has_success_signal and len(returns) == 20
    assert buffer.trajectories(True) == [] and len(model.modes) == 1


@pytest.mark.parametrize("latches", [False, True])
@pytest.mark.parametrize("dense", [False, True])
def test_against_brute_force(dense, latches):
    """Reward by reward, from the row on to where its goal is reached first, or the window ends."""
    buffer = with_modes(dense=dense, latches=latches).replay_buffer
    assert buffer.hindsight.in_use
    owner = {int(row): (each.rows, place) for each in buffer.training_trajectories() for place, row in enumerate(each.rows)}
    seen = {"own": 0, "other": 0, "ended": 0}
    for n_steps in (1, 3, 5):
        batch = buffer.sample_modes(500, GAMMA, 1, n_steps)
        n = batch.rows.shape[1]
        assert not batch.relabelled[0].any()
        for group in range(1, len(batch.rows)):
            for i, row in enumerate(batch.rows[group]):
                at = group * n + i
                told = batch.observations["desired_goal"][at].numpy()
                np.testing.assert_array_equal(told, batch.next_observations["desired_goal"][at].numpy())
                rows, place = owner[int(row)]
                stored = buffer.observations["desired_goal"][row]
                if not batch.relabelled[group, i]:
                    np.testing.assert_array_equal(told, stored)
                    seen["own"] += 1
                    continue
                seen["other"] += 1
                reached = buffer.next_observations["achieved_goal"][rows]
                assert (distance(reached[place:], told) == 0).any(), "a goal that was not achieved later"
                expected, discount, ended = 0.0, 1.0, False
                for step in range(place, min(place + n_steps, len(rows))):
                    far = distance(reached[step], told)
                    expected += discount * (-far if dense else -float(far > NEAR))
                    discount *= GAMMA
                    last = rows[step]
                    if far == 0 if dense else far <= NEAR:
                        ended = True
                        break
                seen["ended"] += ended
                assert batch.rewards[group, i].item() == pytest.approx(expected, abs=1e-4)
                assert batch.discounts[group, i].item() == pytest.approx(0.0 if ended else discount, rel=1e-5)
                np.testing.assert_array_equal(
                    batch.next_observations["observation"][at].numpy(), buffer.next_observations["observation"][last]
                )
                # What was done is where the ascent begins: what is stored was improved for another goal
                np.testing.assert_array_equal(batch.target_actions[group, i].numpy(), buffer.actions[row])
    assert all(seen.values())
    assert seen["other"] / (seen["own"] + seen["other"]) == pytest.approx(0.8, abs=0.06)


def test_a_goal_that_pays_is_worth_staying():
    """As a goal of the environment's own is: r / (1 - gamma)."""
    model = with_modes()
    buffer = model.replay_buffer
    buffer.hindsight.rewards = lambda achieved, desired: 2.0 * (distance(achieved, desired) <= NEAR).astype(np.float32)
    batch = buffer.sample_modes(300, GAMMA, 1, 1)
    other, ended = batch.relabelled, batch.discounts.numpy() == 0
    assert (other & ended).any()
    np.testing.assert_allclose(batch.rewards.numpy()[other & ended], 2.0 / (1 - GAMMA), rtol=1e-5)
    np.testing.assert_allclose(batch.rewards.numpy()[other & ~ended], 0.0)


def test_target_actions_for_other_goals_are_not_stored():
    buffer = with_modes().replay_buffer
    batch = buffer.sample_modes(200, GAMMA, 1, 1)
    before = buffer.target_actions[batch.rows].copy()
    buffer.store_target_actions(batch, batch.target_actions + 5.0)
    other = batch.relabelled[1:]
    own_rows = set(batch.rows[1:][~other].tolist())
    for row, is_other, old in zip(batch.rows[1:].ravel(), other.ravel(), before[1:].reshape(-1, 2), strict=True):
        if is_other and int(row) not in own_rows:
            np.testing.assert_array_equal(buffer.target_actions[row], old)
        elif not is_other:
            assert (buffer.target_actions[row] > 3).all()


def test_modes_learn_from_all_their_trajectories():
    """Also from those that missed their goal long ago, and after some have left."""
    buffer = with_modes().replay_buffer
    trained = sum(row_set.size for row_set in buffer.mode_rows)
    assert trained == sum(each.length for each in buffer.training_trajectories())
    assert len([each for each in buffer.groups.retired if each.trains])
    while len(buffer.groups.retired) > 3:
        buffer._evict()
    assert buffer.sample_modes(100, GAMMA, 1, 3).relabelled.any()


@pytest.mark.parametrize("kwargs", [{"fixed": True}, {"extra": -0.1}], ids=["one goal", "other rewards"])
def test_where_goals_cannot_be_others(kwargs):
    """One goal for all episodes has several ways, which other goals would blur; and rewards must follow from the goals."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = made(**kwargs).learn(600)
    buffer = model.replay_buffer
    assert buffer.hindsight is not None and not buffer.hindsight.in_use and not buffer.learns_from_all
    assert buffer.sample_modes(100, GAMMA, 1, 1).relabelled is None
    told = [str(each.message) for each in caught if "compute_reward" in str(each.message)]
    assert len(told) == ("extra" in kwargs)


@pytest.mark.parametrize("wrapper", [NoGoals, OneAtATime])
def test_environments_without_goals_that_could_be_others(wrapper):
    env = DummyVecEnv([lambda: wrapper(AnyGoal())])
    assert Hindsight.of(env) is None
    assert Hindsight.of(DummyVecEnv([AnyGoal])) is not None


def test_a_run_goes_on_as_if_it_had_not_stopped(tmp_path):
    """What is known of the trajectories is made anew from them."""
    model = with_modes()
    buffer = model.replay_buffer
    state = buffer.state_dict()
    other = type(buffer)(
        buffer.buffer_size, buffer.observation_space, buffer.action_space, "cpu", 2, mode_features="achieved_goal"
    )
    other.expect_modes(len(buffer.mode_rows))
    other.load_state_dict(state)
    other.claim(model.env)
    batches = []
    for each in (buffer, other):
        np.random.seed(0)
        batches.append(each.sample_modes(200, GAMMA, 1, 3))
    np.testing.assert_array_equal(batches[0].relabelled, batches[1].relabelled)
    np.testing.assert_array_equal(batches[0].rewards.numpy(), batches[1].rewards.numpy())
    np.testing.assert_array_equal(batches[0].observations["desired_goal"], batches[1].observations["desired_goal"])


class FarGoal(AnyGoal):
    """Out of reach."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.goal = self.goal + 50.0
        return self._observation(), {}


def test_a_mode_begins_before_any_success():
    """All have reached some goal; what succeeds later is of the same mode, and of one route or not learned with the rest."""
    env = DummyVecEnv([FarGoal] * 2)
    env.seed(0)
    model = small_model(env, "MultiInputPolicy", learning_starts=100, modes={"distance_threshold": None}).learn(600)
    (mode,) = model.modes
    buffer = model.replay_buffer
    assert mode.n_trajectories == 0 and not buffer.trajectories(success=True)
    finished = [*buffer.trajectories(success=False), *buffer.groups.retired]
    assert len(finished) > 25 and sum(each.trains for each in finished) >= len(finished) - 4
    assert model.replay_buffer.sample_modes(64, GAMMA, 1, 1).relabelled[1].any()
    critics = belongings(model)[mode.name]
    # Now it is within reach of some; no re-clustering but this one
    latest = {each.serial for each in buffer.trajectories(success=False)[-3:]}
    buffer.success_rule.has_goal = True
    buffer.groups.judge_again(lambda trajectory: trajectory.serial in latest)
    model.recluster()
    assert [(each.number, each.n_trajectories) for each in model.modes] == [(mode.number, 3)]
    assert same(critics, belongings(model)[mode.name])


@pytest.mark.parametrize("kind", [WorkerVecEnv, partial(SubprocVecEnv, start_method="fork")], ids=["workers", "processes"])
def test_worker_processes(kind):
    """They answer; one that died of the question says why."""
    for wrapper, expected in ((lambda env: env, True), (NoGoals, False)):
        env = kind([partial(wrapped, wrapper)] * 2)
        assert (Hindsight.of(env) is not None) == expected
        env.close()
    with pytest.raises(ValueError, match="compute_reward of the environment must take arrays of goals"):
        Hindsight.of(kind([partial(wrapped, OneAtATime)] * 2))


@pytest.mark.parametrize("fixed", [False, True])
def test_a_check_says_so(fixed):
    assert ("as if the goal had been where it went" not in str(check_env(AnyGoal(fixed), steps=200))) == fixed


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_any_goal_is_reached(seed):
    """At the settings of the package. Without other goals: see the changelog."""
    env = DummyVecEnv([lambda: gym.wrappers.TimeLimit(AnyGoal(limit=1000), 30)] * 4)
    env.seed(seed)
    model = DDiffPG("MultiInputPolicy", env, seed=seed, device="cpu")
    model.set_logger(Logger(None, []))
    model.learn(12_000)
    tested = DummyVecEnv([lambda: gym.wrappers.TimeLimit(AnyGoal(latches=True, limit=1000), 30)])
    tested.seed(1000)
    _, lengths = evaluate_policy(model, tested, 50, return_episode_rewards=True)
    assert np.mean(np.array(lengths) < 30) >= 0.9
