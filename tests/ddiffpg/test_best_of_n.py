"""Of some actions that which the critics like best: by going through all of them, one by one."""

import numpy as np
import pytest
import torch as th
from environments import AnySpaces, TwoEnds, small_model
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg.evaluation import BestOf, Replanner, evaluate_modes

N_SAMPLES = 3


def trained_on(n_atoms):
    env = DummyVecEnv([lambda: TwoEnds()] * 4)
    return small_model(env, critic={"n_atoms": n_atoms}).learn(800)


@pytest.fixture(scope="module", params=[51, 1], ids=["distributional", "scalar"])
def model(request):
    found = trained_on(request.param)
    assert len(found.modes) == 2
    return found


def one_by_one(model, observation, group, noise):
    """The best action for one observation: every candidate is judged by every critic that may, without batches."""
    policy = model.policy
    judges = [group] if group >= 0 else range(1, policy.critics.n_groups) if policy.n_modes else [0]
    embedding = policy.mode_embeddings[group] if group >= 0 else th.zeros_like(policy.mode_embeddings[0])
    obs = th.as_tensor(observation)[None]
    best = -np.inf, None
    with th.no_grad():
        for sample in range(N_SAMPLES):
            condition = policy.actor.condition(obs, embedding[None])
            action = policy.actor.diffusion.denoise(condition, noise=noise[:, sample : sample + 1])
            features = policy.extract_features(obs, policy.critic_features_extractor)
            for judge in judges:
                everybody = policy.critics.n_groups
                logits = policy.critics(features.expand(everybody, 1, -1), action.expand(everybody, 1, -1))
                value = policy.critics.values(logits)[judge].min().item()
                if value > best[0]:
                    best = value, action[0].numpy()
    return best


def fixed_noise(model):
    noise = model.policy.fixed_noise(N_SAMPLES)
    assert noise.shape[1] == N_SAMPLES and not noise[:, 0].any() and 0.5 < noise[:, 1:].std() < 1.5
    return noise


def some_observations(n):
    return np.random.default_rng(1).uniform(-1, 1, (n, 2)).astype(np.float32)


def test_against_one_by_one(model):
    observations, modes = some_observations(30), np.arange(30) % 2
    noise = fixed_noise(model)
    for commanded in (modes, None):
        found, _ = model.predict(observations, deterministic=True, mode=commanded, n_samples=N_SAMPLES)
        groups = np.full(30, -1) if commanded is None else commanded + 1
        expected = [one_by_one(model, each, int(group), noise)[1] for each, group in zip(observations, groups, strict=True)]
        np.testing.assert_allclose(found, expected, atol=1e-4)
        # Another than without: the critics have a say
        assert np.abs(found - model.predict(observations, deterministic=True, mode=commanded, n_samples=1)[0]).max() > 1e-3


def test_the_same_call_gives_the_same_action_whatever_is_beside_it(model):
    observations = some_observations(12)
    batch, _ = model.predict(observations, deterministic=True, mode=1, n_samples=4)
    np.random.seed(3), th.manual_seed(3)
    single = [model.predict(each, deterministic=True, mode=1, n_samples=4)[0] for each in observations]
    np.testing.assert_allclose(single, batch, atol=1e-4)
    assert not np.array_equal(model.predict(observations, mode=1, n_samples=4)[0], batch)
    # Four are what is drawn where there is to be no chance, and one otherwise
    np.testing.assert_array_equal(model.predict(observations, deterministic=True, mode=1)[0], batch)
    drawn = []
    for n_samples in (None, 1):
        th.manual_seed(5)
        drawn.append(model.predict(observations, mode=1, n_samples=n_samples)[0])
    np.testing.assert_array_equal(*drawn)
    # One without chance is the actor's, without noise
    plain, _ = model.predict(observations, deterministic=True, mode=1, n_samples=1)
    with th.no_grad():
        embeddings = model.policy.group_embeddings(np.full(len(observations), 2))
        expected = model.policy.actor(th.as_tensor(observations), deterministic=True, embeddings=embeddings)
    np.testing.assert_allclose(plain, expected.numpy(), atol=1e-6)


def test_modes_that_are_drawn_are_kept(model):
    observations = some_observations(20)
    actions, state = model.predict(observations, episode_start=np.ones(20, dtype=bool), deterministic=True, n_samples=3)
    assert set(state[0].tolist()) == {0, 1}
    again, kept = model.predict(observations, state, np.zeros(20, dtype=bool), deterministic=True, n_samples=3)
    np.testing.assert_array_equal(actions, again)
    np.testing.assert_array_equal(kept[0], state[0])
    np.testing.assert_array_equal(model.predict(observations, deterministic=True, mode=state[0], n_samples=3)[0], actions)


def test_before_there_is_a_mode_explorers_judge():
    model = small_model(DummyVecEnv([TwoEnds]), learning_starts=10_000).learn(20)
    assert len(model.modes) == 0
    (observation,) = some_observations(1)
    found, _ = model.predict(observation, deterministic=True, n_samples=N_SAMPLES)
    np.testing.assert_allclose(found, one_by_one(model, observation, -1, fixed_noise(model))[1], atol=1e-4)


def test_observations_in_a_dict():
    space = spaces.Dict(a=spaces.Box(-1, 1, (2,)), b=spaces.Discrete(3))
    model = small_model(AnySpaces(space), "MultiInputPolicy", learning_starts=10).learn(20)
    batch = {"a": np.zeros((4, 2), np.float32), "b": np.arange(4) % 3}
    assert model.predict(batch, n_samples=5)[0].shape == (4, *model.action_space.shape)


@pytest.mark.parametrize("wrong", [0, -1, 1.5, "many"])
def test_numbers_that_are_none(model, wrong):
    with pytest.raises(ValueError, match=f"n_samples: {wrong!r} given; accepted are whole numbers from 1 up"):
        model.predict(some_observations(1), n_samples=wrong)


def test_a_model_that_always_does_so(model, monkeypatch):
    asked = []
    known = type(model.policy).predict

    def noted(self, *args, **kwargs):
        asked.append(kwargs["n_samples"])
        return known(self, *args, **kwargs)

    monkeypatch.setattr(type(model.policy), "predict", noted)
    agent, env = BestOf(model, 4), DummyVecEnv([TwoEnds] * 2)
    assert [each.mode for each in evaluate_modes(agent, env, 4).commanded] == model.modes.names
    observation = some_observations(1)[0]
    np.testing.assert_array_equal(
        agent.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True, n_samples=4)[0]
    )
    evaluate_policy(agent, env, 2, warn=False)
    Replanner(agent).predict(some_observations(2))
    assert set(asked) == {4} and agent.modes.names == model.modes.names
    with pytest.raises(ValueError, match="n_samples: 0 given"):
        BestOf(model, 0)
