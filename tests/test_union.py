"""Several models taken as one."""

from types import SimpleNamespace

import numpy as np
import pytest
from environments import TwoEnds
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg.union import Union, evaluate_union


class Walks(SimpleNamespace):
    """A model that always walks one way."""

    def predict(self, observation, deterministic=False):
        return np.full((len(observation), 1), self.way, dtype=np.float32), None


def walker(way, steps=100):
    spaces_of = TwoEnds()
    return Walks(
        way=way, num_timesteps=steps, observation_space=spaces_of.observation_space, action_space=spaces_of.action_space
    )


class Labelled(TwoEnds):
    """Says by which end an episode ended."""

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {**info, "mode": "right" if self.x > 0 else "left"}


def test_a_union_has_the_ways_of_its_members():
    models = [walker(1.0), walker(-1.0), walker(0.0)]
    found = evaluate_union(models, DummyVecEnv([Labelled] * 4), 10, seed=0)
    assert [each.labels for each in found.commanded] == [{"right": 10}, {"left": 10}, {}]
    assert set(found.uncommanded.labels) == {"left", "right"}
    assert 0 < found.uncommanded.n_successes < 20  # the one that stands still never succeeds
    assert Union(models).num_timesteps == 300


def test_a_member_acts_throughout_an_episode():
    union = Union([walker(1.0), walker(-1.0)])
    obs = np.zeros((50, 2), dtype=np.float32)
    actions, state = union.predict(obs, episode_start=np.ones(50, dtype=bool))
    assert set(actions[:, 0]) == {-1.0, 1.0}
    again, state = union.predict(obs, state, np.zeros(50, dtype=bool))
    np.testing.assert_array_equal(again, actions)
    starts = np.arange(50) < 25
    third, _ = union.predict(obs, state, starts)
    np.testing.assert_array_equal(third[25:], actions[25:])
    assert not np.array_equal(third[:25], actions[:25])


def test_bad_unions():
    with pytest.raises(ValueError, match="models: none"):
        Union([])
    other = walker(1.0)
    other.action_space = spaces.Box(-1.0, 1.0, (2,))
    with pytest.raises(ValueError, match="number 1 has another action_space"):
        Union([walker(1.0), other])
    with pytest.raises(ValueError, match="model_0"):
        Union([walker(1.0)]).predict(np.zeros((1, 2)), mode="model_7")
