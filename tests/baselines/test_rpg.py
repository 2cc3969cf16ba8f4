"""RPG: its parts against formulas."""

from collections import defaultdict
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import TwoEnds
from scipy.stats import norm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg.baselines import RPG
from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.experiments import __main__ as cli


def small(env=None, **changes):
    settings = {"learning_starts": 40, "buffer_size": 2000, "batch_size": 32, "seed": 0, "latent_dim": 3}
    env = DummyVecEnv([TwoEnds] * 4) if env is None else env
    model = RPG("MlpPolicy", env, **{"policy_kwargs": {"net_arch": [16], "state_dim": 8}, **settings, **changes})
    model.set_logger(Logger(None, []))
    return model


def imagined(model, states, latents):
    th.manual_seed(3)
    return model._imagine(model.policy.model, states, latents)


def test_returns_are_the_mean_of_all_lengths():
    """(1 - lambda) * sum of lambda^(n-1) G_n, the last with all the weight that is left (Sutton and Barto, chapter 12)."""
    model = small(n_steps=4, gae_lambda=0.7, gamma=0.9, latent_coef=0.3, initial_entropy_coef=0.2)
    states, latents = th.rand(5, 8) - 0.5, th.randn(5, 3)
    returns, log_probabilities, _ = imagined(model, states, latents)
    th.manual_seed(3)
    world, rewards, discounts, values = model.policy.model, [], [], []
    for step in range(4):
        actions, log_probability = model.actor.sample_from(th.cat((states, latents), dim=1))
        assert th.allclose(log_probability, log_probabilities[5 * step : 5 * step + 5])
        told = model.policy.inference.log_ratio(states, actions, latents)
        states, reward, end = world.step(states, actions)
        rewards.append(reward - 0.2 * log_probability + 0.3 * told)
        discounts.append(0.9 / (1 + end.exp()))
        values.append(world.values(states, latents).amin(dim=0))
    expected = th.zeros(5)
    for n in range(1, 5):
        partial, factor = th.zeros(5), th.ones(5)
        for k in range(n):
            partial, factor = partial + factor * rewards[k], factor * discounts[k]
        expected += (0.3 * 0.7 ** (n - 1) if n < 4 else 0.7**3) * (partial + factor * values[n - 1])
    th.testing.assert_close(returns, expected)


def test_what_is_told_about_the_latent_variable():
    model = small()
    states, actions, latents = th.rand(6, 8), th.rand(6, 1), th.randn(6, 3)
    output = model.policy.inference.net(th.cat((states, actions), dim=1)).detach().numpy()
    posterior = norm(output[:, :3], np.exp(output[:, 3:]))
    expected = (posterior.logpdf(latents.numpy()) - norm.logpdf(latents.numpy())).sum(axis=1)
    found = model.policy.inference.log_ratio(states, actions, latents)
    np.testing.assert_allclose(found.detach().numpy(), expected, rtol=1e-4, atol=1e-5)


def test_what_it_is_worth_follows_a_schedule():
    states, latents = th.rand(4, 8) - 0.5, th.randn(4, 3)
    model = small(latent_coef=LinearSchedule(0.8, 0.0, 1.0))
    for remaining in (1.0, 0.25):
        model._current_progress_remaining = remaining
        scheduled = imagined(model, states, latents)[0]
        constant = small(latent_coef=0.8 * remaining)
        assert th.equal(scheduled, imagined(constant, states, latents)[0])
    for wrong in (-0.1, float("nan"), "0.1"):
        with pytest.raises(ValueError, match="latent_coef must be at least 0"):
            small(latent_coef=wrong)


def test_the_policys_gradient_goes_through_the_model():
    """Against finite differences, with the noise held fixed."""
    model = small(n_steps=3, latent_coef=0.1)
    model.policy.double()
    states, latents = th.rand(4, 8, dtype=th.float64) - 0.5, th.randn(4, 3, dtype=th.float64)
    weight = model.actor.latent[0].weight
    imagined(model, states, latents)[0].sum().backward()
    for index in ((0, 0), (5, 9), (15, 10)):
        ends = []
        for change in (1e-6, -1e-6):
            with th.no_grad():
                weight[index] += change
                ends.append(imagined(model, states, latents)[0].sum().item())
                weight[index] -= change
        assert weight.grad[index].item() == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-4, abs=1e-8)


def test_updates_move_their_own_parts():
    """The model's step leaves the policy alone, the policy's step the model."""
    model = small()
    model.learn(48)
    policy = model.policy
    parts = {"model": policy.model, "target": policy.model_target, "actor": policy.actor.latent, "told": policy.inference}

    def changed(update):
        before = {name: [p.clone() for p in part.parameters()] for name, part in parts.items()}
        update()
        return {
            name
            for name, part in parts.items()
            if any(not th.equal(old, new) for old, new in zip(before[name], part.parameters(), strict=True))
        }

    metrics = defaultdict(list)
    segments = model._sample_segments(16, metrics)
    assert changed(lambda: model._update_model(segments, metrics)) == {"model"}
    assert changed(lambda: model._update_policy(segments, metrics)) == {"actor", "told"}
    model._n_model_updates = 0
    assert changed(model._update_targets) == set()
    assert changed(model._update_targets) == {"target"}
    assert all(p.requires_grad for p in policy.model.parameters())


def losses_of(model, update):
    """What an update hands to an optimiser, which takes no step."""
    seen = []
    model.divergence_watch.step = lambda _, optimizer, loss, *rest, **options: seen.append(loss.item())
    th.manual_seed(0)
    update()
    th.manual_seed(0)
    return seen[0]


def test_the_models_loss_by_hand():
    """Segment by segment and step by step; the target model is not the model."""
    model = small(n_steps=3, reward_loss_coef=2.0, value_loss_coef=3.0, state_loss_coef=5.0, critic={"v_min": -1.0})
    model.learn(200)
    policy, metrics = model.policy, defaultdict(list)
    with th.no_grad():
        for parameter in policy.model_target.parameters():
            parameter += 0.1 * th.randn_like(parameter)
    segments = model._sample_segments(32, metrics)
    assert segments.ended.any() and not segments.present.all()
    found = losses_of(model, lambda: model._update_model(segments, metrics))
    latents = policy.draw_latents(32)
    aims = policy.encode(segments.next_observations, target=True)
    returns = model._imagine(policy.model_target, aims, latents.repeat_interleave(3, 0))[0].clamp(-1.0, 5.0)
    total = []
    for k in range(32):
        state = policy.encode(segments.observations[k : k + 1])
        for t in range(3):
            state, reward, end = policy.model.step(state, segments.actions[k : k + 1, t])
            if not segments.present[k, t]:
                continue
            ended, likely = bool(segments.ended[k, t]), th.sigmoid(end).item()
            values = policy.model.values(state, latents[k : k + 1])[:, 0]
            total.append(
                2.0 * (reward.item() - segments.rewards[k, t].item()) ** 2
                - np.log(likely if ended else 1 - likely)
                + 5.0 * np.mean((state - aims[3 * k + t]).detach().numpy() ** 2)
                + (not ended) * 3.0 * ((values - returns[3 * k + t]) ** 2).sum().item()
            )
    assert found == pytest.approx(np.mean(total), rel=1e-4)


def test_the_policy_climbs_its_return_and_what_is_told_becomes_likelier():
    model = small(n_steps=3, latent_coef=0.0, initial_entropy_coef=1e-9)
    model.learn(200)
    policy, metrics = model.policy, defaultdict(list)
    segments = model._sample_segments(64, metrics)

    def worth():
        th.manual_seed(1)
        with th.no_grad():
            states = policy.encode(segments.observations)
            returns, _, ratios = model._imagine(policy.model, states, policy.draw_latents(64))
        return returns.mean().item(), ratios.mean().item()

    before = worth()
    for _ in range(60):
        model._update_policy(segments, metrics)
    after = worth()
    assert after[0] > before[0] and after[1] > before[1], (before, after)


def test_segments_are_consecutive_steps_of_one_episode():
    model = small(n_steps=3, reward_scale=2.0, novelty={"coef": 0.0})
    model.learn(200)
    buffer, metrics = model.replay_buffer, defaultdict(list)
    segments = model._sample_segments(64, metrics)
    starts = {tuple(obs): row for row, obs in enumerate(buffer.observations[: buffer.size()].round(6).tolist())}
    ends_seen = 0
    for k in range(64):
        row = starts[tuple(segments.observations[k].numpy().round(6).tolist())]
        for t in range(3):
            assert bool(segments.present[k, t]) == (row >= 0)
            if row < 0:
                break
            np.testing.assert_array_equal(segments.actions[k, t], buffer.actions[row])
            np.testing.assert_array_equal(segments.next_observations[3 * k + t], buffer.next_observations[row])
            assert segments.rewards[k, t].item() == pytest.approx(2.0 * buffer.rewards[row])
            assert bool(segments.ended[k, t]) == bool(buffer.dones[row] and not buffer.timeouts[row])
            ends_seen += int(segments.ended[k, t])
            row = buffer.next_row[row]
    assert ends_seen


def test_an_episode_keeps_its_latent_variable():
    model = small(learning_starts=0, batch_size=8)
    seen = []

    class Notes(DummyVecEnv):
        def step_wait(self):
            result = super().step_wait()
            seen.append((model.episode_latents.values.copy(), self.buf_dones.copy()))
            return result

    model.set_env(Notes([TwoEnds] * 4))
    model.learn(400)
    for (before, dones), (after, _) in pairwise(seen):
        np.testing.assert_array_equal((before == after).all(axis=1), ~dones.astype(bool))
    obs = np.zeros((4, 2), dtype=np.float32)
    _, state = model.predict(obs, episode_start=np.ones(4, dtype=bool))
    _, later = model.predict(obs, state, np.array([False, True, False, False]))
    np.testing.assert_array_equal((state[0] == later[0]).all(axis=1), [True, False, True, True])
    given = model.policy.predict(obs, latents=np.ones(3), deterministic=True)[0]
    np.testing.assert_allclose(given, given[:1].repeat(4, axis=0), rtol=1e-5)
    with pytest.raises(ValueError, match=r"latents must be of shape \[4, 3\], got \[2, 3\]"):
        model.policy.predict(obs, latents=np.ones((2, 3)))


def test_values_are_scalar():
    with pytest.raises(ValueError, match="critic.n_atoms must be 1"):
        small(critic={"n_atoms": 51})


class TwoArms(gym.Env):
    """A bandit whose reward has two equal peaks, at actions of -0.6 and 0.6."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        reward = float(np.exp(-0.5 * ((abs(action[0]) - 0.6) / 0.2) ** 2))
        return np.zeros(1, np.float32), reward, True, False, {}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_it_keeps_both_arms_of_a_bandit(seed):
    """
    What actions tell about z spreads them over all that there is; with less and less of it they gather at the arms, at both. A
    policy without it ends at one arm. An even spread would have 0.15 of its actions at each.
    """
    model = RPG(
        "MlpPolicy",
        make_vec_env(TwoArms, 8, seed=seed),
        n_steps=1,
        gamma=0.0,
        critic={"v_min": -10.0, "v_max": 10.0},
        novelty={"coef": 0.0},
        target_entropy=-2.0,
        learning_starts=200,
        train_freq=1,
        gradient_steps=8,
        batch_size=256,
        learning_rate=3e-3,
        latent_dim=3,
        policy_kwargs={"net_arch": [64, 64], "state_dim": 16},
        buffer_size=20_000,
        seed=seed,
        latent_coef=LinearSchedule(0.8, 0.125, 1.0),
    )
    model.learn(12_000)
    actions = model.policy.predict(np.zeros((400, 1), np.float32), episode_start=np.ones(400, dtype=bool))[0][:, 0]
    left, right = (np.mean(np.abs(actions - arm) < 0.15) for arm in (-0.6, 0.6))
    print(f"seed {seed}: {left:.2f} and {right:.2f} of the actions at the arms")
    assert min(left, right) > 0.3 and left + right > 0.75, (left, right)


@pytest.mark.slow
def test_a_sparse_point_maze(tmp_path):
    """Half of the zoo's steps; the best model of fifteen tests, in fresh episodes. Untrained, one in twenty succeeds."""
    command = ["trial", "--algo", "rpg", "--env", "PointMazeV1-v0", "--override", "{n_timesteps: 75000}"]
    cli.main([*command, "--tests", "{n_tests: 15, n_episodes: 50}", "--out", str(tmp_path)])
    found = ModeEvaluation.load(tmp_path / "evaluation.json")
    print(found)
    assert found.uncommanded.success_rate > 0.9
