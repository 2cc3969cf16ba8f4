"""A function of the user's changes any environment."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from environments import KnownEnds, TwoEnds
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg.envs import ChangedEnv, make_vec_env
from sb3_ddiffpg.envs.description import RememberedEnv, describe_env
from sb3_ddiffpg.envs.snapshots import restore_vec_env, vec_env_snapshot
from sb3_ddiffpg.envs.vec_env import WorkerVecEnv


class Windy(KnownEnds):
    """Wind carries the point, by so much at each step."""

    wind = 0.0

    def step(self, action):
        self.x += self.wind
        return super().step(action)


def blow(world, rng):
    world.wind = rng.uniform(-0.05, 0.05)


def lighten(world, rng):
    world.model.opt.gravity[2] = -5.0


def no_change(world, rng):
    rng.uniform(size=10)


def windy():
    return ChangedEnv(Windy(), blow)


def test_the_change_is_there_from_the_first_observation_on():
    """It is made before the reset, once, on the innermost environment."""
    seen = []

    class Shows(TwoEnds):
        size = 1.0

        def reset(self, **kwargs):
            seen.append(self.size)
            return super().reset(**kwargs)

    def change(world, rng):
        assert type(world) is Shows
        world.size *= 2

    env = ChangedEnv(gym.wrappers.TimeLimit(Shows(), 5), change)
    env.reset(seed=0)
    env.reset()
    assert seen == [2.0, 4.0]


def test_what_the_environment_draws_is_unchanged():
    plain, changed = TwoEnds(), ChangedEnv(TwoEnds(), no_change)
    for seed in (3, None, None):
        np.testing.assert_array_equal(plain.reset(seed=seed)[0], changed.reset(seed=seed)[0])


def test_seeds_reproduce_and_its_draws_are_not_the_environments():
    winds = []
    for _ in range(2):
        env = windy()
        winds.append([env.reset(seed=seed) and env.unwrapped.wind for seed in (7, None, None)])
    assert winds[0] == winds[1] and len(set(winds[0])) == 3
    assert winds[0][0] != 0.05 * (2 * np.random.default_rng(7).random() - 1)


def test_mujoco_of_gymnasium():
    """The change outlasts the reset of the data."""
    env = ChangedEnv(gym.make("InvertedPendulum-v5"), lighten)
    env.reset(seed=0)
    assert env.unwrapped.model.opt.gravity[2] == -5.0
    check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("vec_env", [DummyVecEnv, lambda makers: WorkerVecEnv(makers, 1)])
def test_a_run_goes_on_under_the_same_change(vec_env):
    env, twin = (vec_env([windy] * 2) for _ in range(2))
    env.seed(0)
    env.reset()
    twin.seed(5)
    twin.reset()
    rng = np.random.default_rng(0)
    for _ in range(11):
        env.step(rng.uniform(-0.2, 0.2, (2, 1)))
    restore_vec_env(twin, vec_env_snapshot(env))
    assert twin.get_attr("wind") == env.get_attr("wind")
    for _ in range(30):  # over several resets
        actions = rng.uniform(-0.2, 0.2, (2, 1))
        for ours, theirs in zip(env.step(actions)[:3], twin.step(actions)[:3], strict=True):
            np.testing.assert_array_equal(ours, theirs)
    env.close(), twin.close()


def test_it_is_pickled():
    env = windy()
    env.reset(seed=0)
    twin = pickle.loads(pickle.dumps(env))
    assert twin.unwrapped.wind == env.unwrapped.wind != 0
    for each in (env, twin):
        each.reset()
    assert twin.unwrapped.wind == env.unwrapped.wind


def test_a_model_remembers_that_there_was_one_and_asks_for_it():
    env = make_vec_env("PointMazeV1-v0", 1, wrapper_class=ChangedEnv, wrapper_kwargs={"change": no_change})
    remembered = RememberedEnv.of(describe_env(env))
    with pytest.raises(ValueError, match="with which arguments the wrapper .*ChangedEnv was made, the model does not know"):
        remembered.wrapper()(gym.make("PointMazeV1-v0"))


def test_bad_input():
    with pytest.raises(ValueError, match="change: 0.5 given; accepted is a function"):
        ChangedEnv(TwoEnds(), 0.5)
