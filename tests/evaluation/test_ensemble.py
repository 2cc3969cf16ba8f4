"""Several models taken as one."""

from types import SimpleNamespace

import numpy as np
import pytest
from environments import TwoEnds
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import RPG
from sb3_ddiffpg.evaluation.ensemble import PolicyEnsemble, evaluate_ensemble


class Walks(SimpleNamespace):
    """A model that always walks one way."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.full((len(observation), 1), self.way, dtype=np.float32), None


def walker(way, steps=100):
    spaces_of = TwoEnds()
    return Walks(
        way=way, num_timesteps=steps, observation_space=spaces_of.observation_space, action_space=spaces_of.action_space
    )


class Labelled(TwoEnds):
    """Says by which end an episode ended."""

    listed_modes = ()  # what it says is a label

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {**info, "mode": "right" if self.x > 0 else "left"}


def test_an_ensemble_has_the_ways_of_its_members():
    models = [walker(1.0), walker(-1.0), walker(0.0)]
    found = evaluate_ensemble(models, DummyVecEnv([Labelled] * 4), 10, seed=0)
    assert [each.labels for each in found.commanded] == [{"right": 10}, {"left": 10}, {}]
    assert set(found.uncommanded.labels) == {"left", "right"}
    assert 0 < found.uncommanded.n_successes < 20  # the one that stands still never succeeds
    assert PolicyEnsemble(models).num_timesteps == 300


def test_a_member_acts_throughout_an_episode():
    ensemble = PolicyEnsemble([walker(1.0), walker(-1.0)])
    obs = np.zeros((50, 2), dtype=np.float32)
    actions, state = ensemble.predict(obs, episode_start=np.ones(50, dtype=bool))
    assert set(actions[:, 0]) == {-1.0, 1.0}
    again, state = ensemble.predict(obs, state, np.zeros(50, dtype=bool))
    np.testing.assert_array_equal(again, actions)
    starts = np.arange(50) < 25
    third, _ = ensemble.predict(obs, state, starts)
    np.testing.assert_array_equal(third[25:], actions[25:])
    assert not np.array_equal(third[:25], actions[:25])


class Wavers(SimpleNamespace):
    """A model that draws what it does in an episode when that begins, and remembers it in its state."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        drawn = np.random.uniform(*self.within, size=(len(observation), 1))
        if state is not None:
            drawn = np.where(np.asarray(episode_start)[:, None], drawn, state[0])
        return drawn.astype(np.float32), (drawn,)


@pytest.mark.parametrize("mode", [None, "model_1"])
def test_members_keep_what_they_drew_for_an_episode(mode):
    ensemble = PolicyEnsemble([Wavers(**vars(walker(0.0)), within=within) for within in ((0.0, 0.5), (0.5, 1.0))])
    obs = np.zeros((40, 2), dtype=np.float32)
    rng = np.random.default_rng(0)
    actions, state = ensemble.predict(obs, episode_start=np.ones(40, dtype=bool), mode=mode)
    for _ in range(20):
        starts = rng.random(40) < 0.2
        following, state = ensemble.predict(obs, state, starts, mode=mode)
        np.testing.assert_array_equal(following == actions, ~starts[:, None])
        actions = following
    assert (actions > 0.5).all() if mode else set(actions[:, 0] > 0.5) == {True, False}


def test_an_ensemble_of_models_with_modes_or_latents_follows_them():
    for algorithm, policy in ((RPG, "MlpPolicy"), (DDiffPG, "DiffusionPolicy")):
        models = [algorithm(policy, DummyVecEnv([TwoEnds]), seed=seed) for seed in range(2)]
        if algorithm is DDiffPG:
            for model in models:
                model.policy.resize(3)
                model.mode_manager.expect_unknown(3, 0, model.replay_buffer, model.scheduler)
        ensemble, obs = PolicyEnsemble(models), np.zeros((30, 2), dtype=np.float32)
        _, (acting, states) = ensemble.predict(obs, episode_start=np.ones(30, dtype=bool))
        _, (later, followed) = ensemble.predict(obs, (acting, states), np.zeros(30, dtype=bool))
        np.testing.assert_array_equal(acting, later)
        for before, after in zip(states, followed, strict=True):
            np.testing.assert_array_equal(before[0], after[0])
            assert len(np.unique(before[0])) > 1


def test_bad_ensembles():
    with pytest.raises(ValueError, match="models: none"):
        PolicyEnsemble([])
    other = walker(1.0)
    other.action_space = spaces.Box(-1.0, 1.0, (2,))
    with pytest.raises(ValueError, match="number 1 has another action_space"):
        PolicyEnsemble([walker(1.0), other])
    with pytest.raises(ValueError, match="model_0"):
        PolicyEnsemble([walker(1.0)]).predict(np.zeros((1, 2)), mode="model_7")
    for lone in (np.zeros(2), {"a": np.zeros(2)}):
        with pytest.raises(ValueError, match="observation: shape"):
            ensemble = PolicyEnsemble([walker(1.0)])
            if isinstance(lone, dict):
                ensemble.models[0].observation_space = spaces.Dict({"a": TwoEnds().observation_space})
            ensemble.predict(lone)
