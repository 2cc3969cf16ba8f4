"""The baselines: each against something independent, and all as SB3 algorithms."""

import math
import re
from collections import defaultdict
from copy import deepcopy
from functools import partial
from typing import ClassVar
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import AnySpaces, TwoEnds, change_settings, fill, image_dict_space
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ddiffpg import DDiffPG, ModeReplayBuffer
from sb3_ddiffpg.baselines import BASELINES, DIPO, RPG, SACC51, TD3C51, ConsistencyAC, DiffusionQL
from sb3_ddiffpg.baselines.baseline import FifoReplayBuffer
from sb3_ddiffpg.baselines.consistency_ac import SIGMA_MAX, SIGMA_MIN, karras_sigmas
from sb3_ddiffpg.baselines.dipo import TargetActionReplayBuffer
from sb3_ddiffpg.buffers.assigned_buffer import AssignedReplayBuffer
from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.networks.diffusion import variance_preserving_betas

SMALL = {"learning_starts": 40, "buffer_size": 2000, "batch_size": 32, "train_freq": 4, "seed": 0}


def small(algorithm, env=None, policy="MlpPolicy", **changes):
    env = DummyVecEnv([TwoEnds] * 4) if env is None else env
    model = algorithm(policy, env, **{"policy_kwargs": {"net_arch": [16]}, **SMALL, **changes})
    model.set_logger(Logger(None, []))
    return model


@pytest.fixture(params=BASELINES.values(), ids=BASELINES.keys())
def algorithm(request):
    return request.param


# ------------------------------------------------------------------ as SB3 algorithms


def test_saves_loads_and_goes_on(algorithm, tmp_path):
    model = small(algorithm, **({} if algorithm is RPG else {"actor_tau": 0.1}))
    model.learn(200)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    model.policy.save(tmp_path / "policy")
    loaded = algorithm.load(tmp_path / "model", env=DummyVecEnv([TwoEnds] * 4))
    loaded.load_replay_buffer(tmp_path / "buffer")
    obs = np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    policy = type(model.policy).load(tmp_path / "policy")
    np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    for name, before in model.get_parameters().items():
        after = loaded.get_parameters()[name]
        if "optimizer" not in name:
            assert all(th.equal(before[key], after[key]) for key in before), name
    assert loaded.replay_buffer.size() == model.replay_buffer.size()
    loaded.learn(60, reset_num_timesteps=False)
    assert loaded.num_timesteps >= model.num_timesteps + 60 and loaded._n_updates > model._n_updates


def test_saved_without_what_only_training_needs(algorithm, tmp_path):
    """It acts as before, also where it draws, and its target networks begin anew."""
    model = small(algorithm, **({} if algorithm is RPG else {"actor_tau": 0.1}))
    model.learn(200)
    model.save(tmp_path / "model", to_train=False)
    loaded = algorithm.load(tmp_path / "model")
    obs = np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    drawn = []
    for each in (model, loaded):
        th.manual_seed(0)
        drawn.append(each.predict(obs)[0])
    np.testing.assert_array_equal(*drawn)
    for target, online in algorithm.target_networks.items():
        followed = getattr(model.policy, online).state_dict()
        for name, value in getattr(loaded.policy, target).state_dict().items():
            assert th.equal(value, followed[name]), (target, name)


@pytest.mark.parametrize("space", [spaces.Discrete(3), image_dict_space(), spaces.Box(0, 255, (1, 36, 36), dtype=np.uint8)])
def test_observations(algorithm, space):
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy"
    env = DummyVecEnv([lambda: AnySpaces(space)])
    model = small(algorithm, env, policy, learning_starts=10, critic={"v_max": 20.0})
    model.learn(24)
    action, _ = model.predict(env.reset())
    assert model._n_updates > 0 and action.shape == (1, *env.action_space.shape) and env.action_space.contains(action[0])


def test_with_normalised_observations(algorithm):
    env = VecNormalize(DummyVecEnv([TwoEnds] * 4), norm_reward=False)
    model, seen = small(algorithm, env), []
    model.learn(120)
    features = model.actor.extract_features
    model.actor.extract_features = model.policy.extract_features = lambda obs, *rest: (
        seen.append(obs.numpy()) or features(obs, *rest)
    )
    model.train(1, 32)
    stored = env.normalize_obs(model.replay_buffer.observations[: model.replay_buffer.size()])
    known = {tuple(obs) for obs in np.round(stored, 5).tolist()}
    assert model.is_normalized and all(tuple(obs) in known for obs in np.round(seen[-1], 5).tolist())


def test_the_same_seed_is_the_same_run(algorithm):
    models = [small(algorithm, seed=7).learn(120) for _ in range(2)]
    for first, second in zip(*(model.policy.parameters() for model in models), strict=True):
        assert th.equal(first, second)


def test_bad_arguments_are_named(algorithm):
    for argument, value in (("n_steps", 0), ("gamma", 1.5), ("novelty", "none"), ("critic", {"v_max": -1.0})):
        with pytest.raises(ValueError, match=argument if argument != "critic" else r"critic\..*v_max=-1.0"):
            small(algorithm, **{argument: value})


@pytest.mark.parametrize(
    ("algorithm", "argument", "values"),
    [
        (DIPO, "total_gradient_ratio", (0.0, -1.0, math.nan)),
        (DIPO, "own_policy_batch", ("no", 1)),
        (DIPO, "target_action.optimizer", ("rmsprop",)),
        (DiffusionQL, "actor_tau", (2.0, -1.0, "x")),
        (DiffusionQL, "q_coef", (-1.0, math.inf)),
        (DiffusionQL, "bc_coef", (math.nan, -1.0)),
        (DiffusionQL, "n_candidates", (0, 1.5)),
        (DiffusionQL, "average_freq", (0,)),
        (DiffusionQL, "average_start", (-1, "x")),
        (DiffusionQL, "noise_schedule", ("linear",)),
        (ConsistencyAC, "consistency_coef", (-1.0,)),
        (ConsistencyAC, "n_levels", ((1, 1), (10, 2), 5, (2, 3, 4), (2.0, 3.0))),
        (ConsistencyAC, "n_diffusion_steps", (0,)),
        (TD3C51, "policy_delay", (0, -1, 1.5)),
        (SACC51, "initial_entropy_coef", (-1.0, math.inf)),
        (SACC51, "entropy_learning_rate", (-1.0,)),
        (SACC51, "target_entropy", ("auto", math.nan)),
        (RPG, "gae_lambda", (1.5, -1.0)),
        (RPG, "latent_dim", (0, -1)),
        (RPG, "latent_coef", (-1.0, math.nan)),
        (RPG, "reward_loss_coef", (-1.0,)),
        (RPG, "value_loss_coef", (math.inf,)),
        (RPG, "state_loss_coef", (math.nan,)),
        (RPG, "target_update_interval", (0, 0.5)),
        (RPG, "critic.n_atoms", (51,)),
    ],
)
def test_bad_arguments_of_one_algorithm_are_named(algorithm, argument, values):
    for value in values:
        with pytest.raises(ValueError, match=f"{re.escape(argument)} must .*, got {re.escape(repr(value))}"):
            small(algorithm, **{argument: value})


def test_the_first_trajectory_is_the_first_to_go(algorithm):
    model = small(algorithm, buffer_size=60, learning_starts=10**6)
    model.learn(400)
    buffer = model.replay_buffer
    rows, retired = buffer.stored_rows.rows[: buffer.size()], buffer.groups.retired
    serials = [trajectory.serial for trajectory in retired]
    assert serials == sorted(serials) and serials[-1] - serials[0] == len(serials) - 1
    finished = sum(trajectory.length for trajectory in retired)
    assert finished <= len(rows) <= 60


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        (FifoReplayBuffer, ()),
        (TargetActionReplayBuffer, ("exploratory_target_actions",)),
        (ModeReplayBuffer, ("target_actions", "exploratory_target_actions")),
    ],
)
def test_target_actions_are_stored_for_those_who_improve_them(kind, fields, tmp_path):
    """The others pay nothing for them: the bytes of a row, by hand."""
    buffer = kind(50, spaces.Box(-9.0, 9.0, (3,)), spaces.Box(-1.0, 1.0, (2,)))
    rng = np.random.default_rng(0)
    fill(buffer, [rng.normal(size=(9, 3)).astype(np.float32) for _ in range(4)])
    # Four bytes a number: the observation's 3 and the action's 2, and 2 for each target action; 3 of the next observation
    assert buffer.steps.bytes.shape == (50, 4 * (3 + 2 + 2 * len(fields))) and buffer.nexts.bytes.shape == (50, 4 * 3)
    assert tuple(buffer.steps.fields) == ("observations", "actions", *fields)
    # Reward and next row have four bytes, and one each whether it is done, by a time limit, a first visit, a goal. With modes
    # also the route that it came along, how new that is, whether its visit counts, whether it is off its mode's route or an
    # off-mode success: 2 times 4 bytes and 3, each kept at a multiple of its size
    has_modes = kind is ModeReplayBuffer
    assert buffer.notes.bytes.shape == (50, 28 if has_modes else 12)
    # Where each row stands among all rows, and among its mode's
    assert buffer.storage_bytes == 50 * (4 * (8 + 2 * len(fields)) + (28 + 8 if has_modes else 12 + 4))
    for name in ("target_actions", "exploratory_target_actions"):
        assert hasattr(buffer, name) == (name in fields)
    batch = buffer.sample_modes(8, 0.9, 1, 1)
    assert th.equal(batch.target_actions, batch.actions)
    if fields:
        improved = th.full_like(batch.actions, 0.5)
        buffer.store_target_actions(batch, improved)
        stored = buffer.exploratory_target_actions
        assert (stored[batch.rows] == 0.5).all() and (stored != buffer.actions).any(axis=1).sum() == len(set(batch.rows.flat))
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    again = load_from_pkl(tmp_path / "buffer.pkl")
    assert type(again) is kind and tuple(again.steps.fields) == ("observations", "actions", *fields)
    np.testing.assert_array_equal(again.steps.bytes[: buffer.pos], buffer.steps.bytes[: buffer.pos])


def test_what_without_modes_is_always_the_same_is_not_stored(algorithm):
    """Learning from it is the same, number for number, as from a buffer that stores all of it."""

    class Stores(small(algorithm).replay_buffer_class):
        constant_notes: ClassVar[dict] = {}
        has_modes = True
        hindsight = None

        def claim(self, env):
            super(AssignedReplayBuffer, self).claim(env)

    frugal, lavish = (small(algorithm, replay_buffer_class=kind, seed=3).learn(120) for kind in (None, Stores))
    assert lavish.replay_buffer.notes.bytes.shape[1] == frugal.replay_buffer.notes.bytes.shape[1] + 16
    for mine, other in zip(frugal.policy.parameters(), lavish.policy.parameters(), strict=True):
        assert th.equal(mine, other)
    for name, value in frugal.replay_buffer.constant_notes.items():
        assert (getattr(lavish.replay_buffer, name)[lavish.replay_buffer.stored_rows.rows[:20]] == value).all()
        with pytest.raises(ValueError, match="read-only"):
            getattr(frugal.replay_buffer, name)[:] = value


def test_which_baseline_stores_target_actions(algorithm):
    kind = TargetActionReplayBuffer if algorithm is DIPO else FifoReplayBuffer
    model = small(algorithm)
    assert type(model.replay_buffer) is kind
    if algorithm is DIPO:
        buffer = model.learn(60).replay_buffer
        assert not np.array_equal(buffer.exploratory_target_actions, buffer.actions)


def test_modes_are_counted_without_commands(algorithm):
    model = small(algorithm)
    model.learn(60)
    found = evaluate_modes(model, DummyVecEnv([TwoEnds] * 2), 2)
    assert found.commanded == () and found.uncommanded.n_episodes == 4


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("model_free", [each for each in BASELINES.values() if each is not RPG])
def test_rewards_are_the_environments_and_what_is_new(model_free, n_steps):
    """Both discounted over the steps of a return."""
    model = small(model_free, n_steps=n_steps, reward_scale=3.0, novelty={"normalize": False}, gamma=0.9)
    model.learn(100)
    seen = {}
    model._update_critics = lambda batch, rewards, metrics: seen.update(batch=batch, rewards=rewards)
    model.train(1, 32)
    batch, buffer, settings = seen["batch"], model.replay_buffer, model.novelty_settings

    def novelty(obs):
        positions = buffer.features.of_tensors(th.from_numpy(obs))
        return model.bonus.novelty_model.novelty(positions, positions).item()

    for k, row in enumerate(batch.rows[0]):
        expected, length = 0.0, 0
        while row >= 0 and length < n_steps:
            now, then = (novelty(obs[row : row + 1]) for obs in (buffer.observations, buffer.next_observations))
            new = settings.coef * max(then - settings.scale * now, 0.0) * buffer.first_visits[row]
            expected += 0.9**length * (3.0 * buffer.rewards[row] + new)
            row, length = buffer.next_row[row], length + 1
        assert seen["rewards"][0, k].item() == pytest.approx(expected, rel=1e-4, abs=1e-6)
        assert batch.visited.present[0, k].tolist() == [step < length for step in range(n_steps)]


# ------------------------------------------------------------------ how actors learn

MODEL_FREE = [each for each in BASELINES.values() if each is not RPG]
CLIMBERS = [DiffusionQL, ConsistencyAC, TD3C51, SACC51]


def drawn_batch(model):
    np.random.seed(0)
    return model.replay_buffer.sample_modes(32, model.gamma, 1, 1)


def twin_values(model, batch, actions):
    """Each critic's, [C, n]."""
    return model.critics.values(model.critics(model.policy.critic_features(batch.observations), actions[None]))[0]


def loss_of(model, batch):
    """What an update hands to the actor's optimiser, by the noise of seed 0."""
    seen = []
    with patch.object(model, "_step_actor", lambda loss: seen.append(loss) or loss.detach()):
        th.manual_seed(0)
        model._update_actor(batch, defaultdict(list))
    return seen[0]


@pytest.mark.parametrize("algorithm", CLIMBERS)
def test_updates_raise_the_value_of_what_the_actor_does(algorithm):
    model = small(algorithm, actor_tau=None)
    model.learn(120)
    if algorithm is SACC51:
        with th.no_grad():
            model.policy.log_entropy_coef.fill_(-20.0)  # entropy is worth next to nothing
    batch = drawn_batch(model)

    def worth():
        th.manual_seed(1)
        return twin_values(model, batch, model.actor(batch.observations)).amin(dim=0).mean().item()

    before = worth()
    for _ in range(60):
        model._update_actor(batch, defaultdict(list))
    assert worth() > before + 1e-3 * abs(before)


@pytest.mark.parametrize("algorithm", [ConsistencyAC, TD3C51, SACC51])
def test_the_smaller_of_both_values_is_climbed(algorithm):
    model = small(algorithm, **({"initial_entropy_coef": 0.3} if algorithm is SACC51 else {}))
    model.learn(40)
    batch = drawn_batch(model)
    entropy_coef = model.entropy_coef if algorithm is SACC51 else 0.0  # of before the update
    found = loss_of(model, batch)
    th.manual_seed(0)
    if algorithm is SACC51:
        actions, log_probabilities = model.actor.sample(batch.observations)
        cost = entropy_coef * log_probabilities
    else:
        actions, cost = model.actor(batch.observations), th.zeros(32)
    first, second = twin_values(model, batch, actions)
    expected = [cost[k].item() - min(first[k].item(), second[k].item()) for k in range(32)]
    assert found.item() == pytest.approx(np.mean(expected), rel=1e-5)


@pytest.mark.parametrize("algorithm", MODEL_FREE)
def test_a_target_actor_follows_and_acts_in_the_target(algorithm):
    """As parameters by hand; without one the actor itself acts there, and the target is its copy when one is asked for."""
    model = small(algorithm, actor_tau=0.25, **({"average_start": 0, "average_freq": 1} if algorithm is DiffusionQL else {}))
    model.learn(60)
    actor, target = model.actor, model.policy.actor_target
    with th.no_grad():
        for parameter in target.parameters():
            parameter += 0.1 * th.randn_like(parameter)
    expected = [0.75 * t + 0.25 * a for t, a in zip(target.parameters(), actor.parameters(), strict=True)]
    model._update_targets()
    for found, by_hand in zip(target.parameters(), expected, strict=True):
        th.testing.assert_close(found, by_hand)
    batch = drawn_batch(model)

    def acts(policy):
        th.manual_seed(0)
        return policy(batch.next_observations)

    for tau, acting in ((0.25, target), (None, actor)):
        model.actor_tau = tau
        th.manual_seed(0)
        assert th.equal(model._next_actions(batch)[0], acts(acting))
    assert not th.equal(acts(target), acts(actor))
    model.train(1, 32)
    assert all(th.equal(t, a) for t, a in zip(target.parameters(), actor.parameters(), strict=True))


# ------------------------------------------------------------------ DIPO


def test_dipo_updates_as_ddiffpg_without_modes_does():
    """The same networks (DDiffPG's embedding of zero added) and batch: the same target actions, losses and steps."""
    settings = {"policy_kwargs": {"net_arch": [16, 16]}, "target_action": {"n_steps": 3, "learning_rate": 0.1}}
    dipo, ours = (
        small(DIPO, learning_starts=10**6, **settings),
        small(DDiffPG, modes={"embedding_dim": 1}, exploration={"v_max": 5.0}, n_diffusion_steps=5, **settings),
    )
    dipo.learn(40)
    state = dipo.policy.state_dict()
    name = "actor.diffusion.denoiser.condition_in.weight"
    state[name] = th.cat((state[name], th.zeros(16, 1)), dim=1)
    state["mode_embeddings"] = th.zeros(1, 1)
    ours.policy.load_state_dict({key: value for key, value in state.items() if not key.startswith("actor_target")})
    np.random.seed(0)
    batch = dipo.replay_buffer.sample_modes(32, dipo.gamma, 1, 1)
    ours.replay_buffer.store_target_actions = dipo.replay_buffer.store_target_actions = lambda *_: None
    rewards = th.rand(1, 32)
    th.manual_seed(1)
    metrics, our_metrics = defaultdict(list), defaultdict(list)
    dipo._update_critics(batch, rewards, metrics)
    dipo._update_actor(batch, metrics)
    th.manual_seed(1)
    ours._update_critics(batch, rewards, our_metrics)
    assert th.equal(metrics["critic_loss"][0], our_metrics["critic_loss"][0])
    improved = ours._improve_target_actions(batch)
    change_settings(ours, modes={"mask_prob": 0.0})
    drawn = th.rand
    th.rand = lambda *shape, **kwargs: th.ones(*shape, **kwargs)  # DDiffPG's mask draws where DIPO has none
    try:
        actor_loss = ours._update_policy(batch, improved)
    finally:
        th.rand = drawn
    th.testing.assert_close(metrics["actor_loss"][0], actor_loss)
    th.testing.assert_close(metrics["target_action_shift"][0], (improved - batch.target_actions).abs().mean())
    for key, value in dipo.policy.critics.state_dict().items():
        th.testing.assert_close(value, ours.policy.critics.state_dict()[key])
    th.testing.assert_close(dipo.actor.diffusion.denoiser.trunk.state_dict(), ours.actor.diffusion.denoiser.trunk.state_dict())


def test_dipo_limits_the_whole_batchs_gradient():
    model = small(DIPO, total_gradient_ratio=1e-3, target_action={"optimizer": "sgd", "learning_rate": 1.0})
    model.learn(60)
    batch = model.replay_buffer.sample_modes(32, model.gamma, 1, 1)
    stored = {}
    model.replay_buffer.store_target_actions = lambda _, improved: stored.update(improved=improved)
    model._update_actor(batch, defaultdict(list))
    moved = (stored["improved"] - batch.target_actions).norm()
    assert 0 < moved <= 1.01e-3


@pytest.mark.parametrize("own", [False, True])
def test_dipos_policy_may_learn_from_a_batch_of_its_own(own):
    model = small(DIPO, own_policy_batch=own)
    model.learn(60)
    batch, stored = drawn_batch(model), []
    model.replay_buffer.store_target_actions = lambda used, _: stored.append(used)
    model._update_actor(batch, defaultdict(list))
    assert (stored[0] is batch) != own and stored[0].rows.shape == batch.rows.shape


# ------------------------------------------------------------------ Diffusion-QL


def test_variance_preserving_schedule():
    """The numbers that Diffusion-QL's code has for five steps."""
    np.testing.assert_allclose(variance_preserving_betas(5), [0.196, 0.459, 0.636, 0.755, 0.835], atol=5e-4)


def test_the_critics_gradient_reaches_the_actor_through_all_steps(monkeypatch):
    """The loss of an update against finite differences of Q(s, a), with a through the whole chain; the noise is held fixed."""
    model = small(DiffusionQL, policy_kwargs={"net_arch": [8]}, n_diffusion_steps=4, q_coef=2.0)
    model.learn(60)
    model.policy.double()
    batch = drawn_batch(model)
    batch = batch._replace(observations=batch.observations.double())
    monkeypatch.setattr(np.random, "permutation", lambda _: np.array([1, 0]))
    monkeypatch.setattr(th, "randn", partial(th.randn, dtype=th.float64))
    # Seen as they are; SB3 would make 32 bits of them
    monkeypatch.setattr(model.actor, "features", lambda obs: obs)
    monkeypatch.setattr(model.policy, "critic_features", lambda obs: obs[None])

    def values():
        th.manual_seed(0)
        return twin_values(model, batch, model.actor.diffusion.denoise(model.actor.condition(batch.observations)))

    scale = values()[0].abs().mean().item()
    model.actor.zero_grad()
    loss_of(model, batch).backward()
    for name, parameter in model.actor.diffusion.named_parameters():
        place = tuple(np.random.default_rng(0).integers(size) for size in parameter.shape)
        ends = []
        for change in (1e-6, -1e-6):
            with th.no_grad():
                parameter[place] += change
                ends.append(-2.0 * values()[1].mean().item() / (scale + 1e-6))
                parameter[place] -= change
        assert parameter.grad[place].item() == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-3, abs=1e-7), name


@pytest.mark.parametrize("coin", [(0, 1), (1, 0)])
def test_diffusion_qls_loss(monkeypatch, coin):
    model = small(DiffusionQL, q_coef=2.0, bc_coef=0.7)
    model.learn(60)
    batch = drawn_batch(model)
    monkeypatch.setattr(np.random, "permutation", lambda _: np.array(coin))
    found = loss_of(model, batch)
    th.manual_seed(0)
    condition = model.actor.condition(batch.observations)
    values = twin_values(model, batch, model.actor.diffusion.denoise(condition))
    denoising = model.actor.diffusion.loss(batch.actions[0], condition)
    expected = -2.0 * values[coin[0]].mean() / values[coin[1]].abs().mean() + 0.7 * denoising
    assert found.item() == pytest.approx(expected.item(), rel=1e-4)


def test_diffusion_qls_target_actor_waits_and_then_follows_now_and_then():
    model = small(DiffusionQL, actor_tau=0.25, average_start=2, average_freq=3)
    actor, target = (next(iter(part.parameters())) for part in (model.actor, model.policy.actor_target))
    for update in range(1, 8):
        with th.no_grad():
            actor += 1.0
        before = target.clone()
        model._update_targets()
        share = 1.0 if update <= 2 else 0.25 if update in (3, 6) else 0.0
        th.testing.assert_close(target, before + share * (actor - before))


def test_candidates_are_drawn_by_value(monkeypatch):
    model = small(DiffusionQL, n_candidates=3)
    candidates = th.tensor([[-0.5], [0.0], [0.5]])
    values = th.tensor([0.0, math.log(2.0), math.log(5.0)])  # odds 1 : 2 : 5
    monkeypatch.setattr(model.actor, "forward", lambda obs: candidates.repeat(len(obs) // 3, 1))
    critics = model.policy.critics_target
    monkeypatch.setattr(critics, "values", lambda _: values.repeat(4000)[None, None].expand(1, 2, -1))
    actions = model.predict(np.zeros((4000, 2), dtype=np.float32))[0][:, 0]
    shares = [np.isclose(actions, value).mean() for value in (-0.5, 0.0, 0.5)]
    np.testing.assert_allclose(shares, [1 / 8, 2 / 8, 5 / 8], atol=0.03)


# ------------------------------------------------------------------ Consistency-AC


def test_an_action_of_the_smallest_noise_level_stays_as_it_is():
    actor = small(ConsistencyAC).actor
    actions = th.randn(7, 1)
    part = actor.network.condition_in(th.randn(7, 2))
    th.testing.assert_close(actor.consistency(actions, part, th.full((7,), SIGMA_MIN)), actions)
    # and of the largest, nearly nothing of it is left
    assert (actor.consistency(SIGMA_MAX * actions, part, th.full((7,), SIGMA_MAX)) - actions).abs().min() > 1e-4


@pytest.mark.parametrize("n_steps", [1, 2, 5])
def test_sampling_begins_at_the_largest_noise_level(n_steps):
    model = small(ConsistencyAC, n_diffusion_steps=n_steps)
    actor, obs = model.actor, th.rand(500, 2)
    np.testing.assert_allclose(actor.sigmas, [SIGMA_MAX - k * (SIGMA_MAX - 2) / max(n_steps - 1, 1) for k in range(n_steps)])
    if n_steps == 1:
        th.manual_seed(0)
        actions = actor(obs)
        th.manual_seed(0)
        part = actor.network.condition_in(actor.features(obs))
        expected = actor.consistency(SIGMA_MAX * th.randn(500, 1), part, th.full((500,), SIGMA_MAX))
        th.testing.assert_close(actions, expected.clamp(-1, 1))


def test_without_a_target_actor_the_actor_is_its_own_aim():
    model = small(ConsistencyAC, consistency_coef=1.0, actor_tau=None)
    model.learn(40)
    with th.no_grad():
        for parameter in model.policy.actor_target.parameters():
            parameter.fill_(th.nan)
    assert model._consistency_loss(drawn_batch(model)).isfinite()


def test_noise_levels_as_in_karras():
    """Equation 5 of Karras et al. (2022), by hand."""
    sigmas = karras_sigmas(th.arange(18), 18)
    expected = [(0.002 ** (1 / 7) + i / 17 * (80 ** (1 / 7) - 0.002 ** (1 / 7))) ** 7 for i in range(18)]
    np.testing.assert_allclose(sigmas, expected, rtol=1e-4)


def test_the_consistency_loss_makes_the_actor_a_model_of_the_buffer():
    model = small(ConsistencyAC, consistency_coef=1.0, actor_tau=0.05, n_levels=(4, 12), policy_kwargs={"net_arch": [64]})
    model.learn(60)
    batch = model.replay_buffer.sample_modes(32, model.gamma, 1, 1)
    batch = batch._replace(actions=th.full_like(batch.actions, 0.4))
    for _ in range(400):
        model._step_actor(model._consistency_loss(batch))
        model._average_actor(0.05)
    assert (model.actor(batch.observations) - 0.4).abs().mean() < 0.15


# ------------------------------------------------------------------ TD3 and SAC


def in_sb3s(critics, networks):
    """Parameters of SB3's networks, one a twin, and ours that are the same."""
    for layer, (weight, bias) in enumerate(zip(critics.weights, critics.biases, strict=True)):
        for twin, network in enumerate(networks):
            yield network[2 * layer].weight, weight[0, twin].T
            yield network[2 * layer].bias, bias[0, twin, 0]


def test_td3_updates_as_sb3s_does():
    """Scalar critics, the same networks and batch: the same losses."""
    arch = {"net_arch": [16], "activation_fn": th.nn.ReLU}
    kwargs = {**arch, "critic_activation_fn": th.nn.ReLU}
    ours = small(TD3C51, critic={"n_atoms": 1, "v_min": -10.0, "v_max": 10.0}, policy_kwargs=kwargs)
    theirs = TD3("MlpPolicy", DummyVecEnv([TwoEnds] * 4), policy_kwargs=arch, target_policy_noise=0.0)
    with th.no_grad():
        for parameter, value in in_sb3s(ours.critics, [theirs.critic.qf0, theirs.critic.qf1]):
            parameter.copy_(value)
        theirs.actor.mu.load_state_dict(ours.actor.mu.state_dict())
    obs = th.rand(9, 2) * 4 - 2
    scaled = ours.actor.features(obs)
    actions = theirs.actor.mu(scaled)
    th.testing.assert_close(ours.actor(obs), actions)
    q_values = th.stack([q(th.cat((scaled, actions), dim=1)) for q in (theirs.critic.qf0, theirs.critic.qf1)])[..., 0]
    features = ours.policy.critic_features(obs)
    th.testing.assert_close(ours.critics.values(ours.critics(features, actions[None]))[0], q_values)
    target = 0.3 + 0.9 * q_values.min(dim=0).values
    found = ours.critics.bellman_target(features, actions[None], th.full((1, 9), 0.3), th.full((1, 9), 0.9))
    th.testing.assert_close(found[0, :, 0], target)
    expected = sum(th.nn.functional.mse_loss(q, target) for q in q_values)
    th.testing.assert_close(ours.critics.loss(features, actions[None], found)[0], expected)


def test_td3_is_sb3s_update_by_update():
    """Where they coincide: one scalar critic, no noise in the target, no bonus. The same networks after seven updates."""
    arch = {"net_arch": [16], "activation_fn": th.nn.ReLU, "optimizer_class": th.optim.Adam, "n_critics": 1}
    own_arch = {
        "net_arch": [16],
        "activation_fn": th.nn.ReLU,
        "critic_activation_fn": th.nn.ReLU,
        "optimizer_class": th.optim.Adam,
    }
    settings = {"policy_delay": 2, "tau": 0.2, "learning_rate": 0.01}
    ours = small(
        TD3C51,
        **settings,
        critic={"n_atoms": 1, "v_min": -50.0, "v_max": 50.0, "n_critics": 1, "target_policy_noise": 0.0},
        actor_tau=0.2,
        novelty={"coef": 0.0},
        reward_scale=1.0,
        max_grad_norm=1e6,
        policy_kwargs=own_arch,
    )
    ours.learn(40)
    theirs = TD3("MlpPolicy", DummyVecEnv([TwoEnds] * 4), policy_kwargs=arch, target_policy_noise=0.0, **settings)
    theirs.set_logger(Logger(None, []))

    with th.no_grad():
        for critics, q in ((ours.critics, theirs.critic.qf0), (ours.policy.critics_target, theirs.critic_target.qf0)):
            for parameter, value in in_sb3s(critics, [q]):
                parameter.copy_(value)
    theirs.actor.load_state_dict(ours.actor.state_dict(), strict=False)
    theirs.actor_target.load_state_dict(ours.policy.actor_target.state_dict(), strict=False)
    for optimizer in (ours.actor.optimizer, ours.critics.optimizer):  # which have gone a few steps
        optimizer.state.clear()
    ours._n_critic_updates = 0

    batches = [ours.replay_buffer.sample_modes(32, ours.gamma, 1, 1) for _ in range(7)]
    given = iter(
        ReplayBufferSamples(
            ours.actor.features(batch.observations),
            batch.actions[0],
            ours.actor.features(batch.next_observations),
            th.zeros(32, 1),
            batch.rewards[0, :, None],
            batch.discounts[0, :, None],
        )
        for batch in batches
    )
    with patch.object(ours.replay_buffer, "sample_modes", side_effect=batches):
        ours.train(7, 32)
    with patch.object(theirs.replay_buffer, "sample", side_effect=lambda *_, **__: next(given)):
        theirs.train(7, 32)
    for critics, q in ((ours.critics, theirs.critic.qf0), (ours.policy.critics_target, theirs.critic_target.qf0)):
        for parameter, value in in_sb3s(critics, [q]):
            th.testing.assert_close(parameter, value, rtol=1e-4, atol=1e-5)
    for actor, other in ((ours.actor, theirs.actor), (ours.policy.actor_target, theirs.actor_target)):
        for (name, value), (_, expected) in zip(actor.mu.state_dict().items(), other.mu.state_dict().items(), strict=True):
            th.testing.assert_close(value, expected, rtol=1e-4, atol=1e-5, msg=name)


def test_td3_waits_with_its_policy():
    model = small(TD3C51, policy_delay=3)
    model.learn(40)
    metrics = defaultdict(list)
    batch = model.replay_buffer.sample_modes(32, model.gamma, 1, 1)
    model._n_critic_updates = 0
    for _ in range(7):
        model._update_actor(batch, metrics)
    assert len(metrics["actor_loss"]) == 2


def test_td3s_targets_wait_with_its_policy():
    """As in the paper's algorithm, and SB3's."""
    model = small(TD3C51, policy_delay=3, actor_tau=0.1, gradient_steps=1)
    model.learn(40)
    networks = {"actor": model.policy.actor_target, "critics": model.policy.critics_target}
    moved = {name: [] for name in networks}
    for _ in range(6):
        before = {name: deepcopy(network.state_dict()) for name, network in networks.items()}
        model.train(1, 32)
        for name, network in networks.items():
            moved[name].append(any(not th.equal(value, before[name][key]) for key, value in network.state_dict().items()))
    assert moved["actor"] == moved["critics"] and sum(moved["actor"]) == 2
    first = moved["actor"].index(True)
    assert moved["actor"][first + 3]


def test_sacs_entropy_is_part_of_the_target():
    model = small(SACC51, critic={"n_atoms": 1, "v_min": -100.0, "v_max": 100.0}, initial_entropy_coef=0.7)
    model.learn(40)
    batch = model.replay_buffer.sample_modes(32, model.gamma, 1, 1)
    th.manual_seed(0)
    actions, bonus = model._next_actions(batch)
    th.manual_seed(0)
    features = model.actor.features(batch.next_observations)
    mean, log_std = model.actor.latent(features).chunk(2, 1)
    normal = th.distributions.Normal(mean, log_std.clamp(-5, 5).exp())
    before = th.atanh(actions.clamp(-1 + 1e-6, 1 - 1e-6))
    by_hand = (normal.log_prob(before) - th.log(1 - actions**2 + 1e-6)).sum(dim=1)
    th.testing.assert_close(bonus[0], -model.entropy_coef * by_hand, rtol=1e-2, atol=1e-2)


def test_sacs_entropy_coefficient_follows_its_target():
    lower = small(SACC51, target_entropy=-50.0)
    higher = small(SACC51, target_entropy=50.0)
    for model in (lower, higher):
        model.learn(120)
    assert lower.entropy_coef < 1.0 < higher.entropy_coef
    assert lower.action_noise is None


@pytest.mark.slow
@pytest.mark.parametrize(("ours", "theirs"), [(TD3C51, TD3), (SACC51, SAC)])
def test_pendulum_is_learnt_as_by_sb3(tmp_path, ours, theirs):
    """
    Scalar critics, no bonus, SB3's own settings: the same curves within the noise of three seeds, and each seed learns. Its
    last model need not have: SB3's TD3 forgets in between.
    """
    settings = {"learning_starts": 500, "batch_size": 256, "tau": 0.005, "gamma": 0.98, "learning_rate": 1e-3}
    settings["action_noise"] = NormalActionNoise(np.zeros(1), np.full(1, 0.1)) if ours is TD3C51 else None
    arch = {"net_arch": [64, 64]}
    own_arch = {"activation_fn": th.nn.ReLU, "critic_activation_fn": th.nn.ReLU, "optimizer_class": th.optim.Adam}
    own = {
        "policy_kwargs": {**arch, **own_arch},
        "critic": {"n_atoms": 1, "v_min": -2000.0, "v_max": 0.0},
        "novelty": {"coef": 0.0},
        "max_grad_norm": 1e6,
    }
    if ours is SACC51:  # entropy makes values positive; SB3 tunes its coefficient at the learning rate
        own |= {"critic.v_max": 2000.0, "entropy_learning_rate": 1e-3}
    if ours is TD3C51:
        own |= {"policy_delay": 2, "actor_tau": 0.005}
        own |= {"critic.target_policy_noise": 0.2, "critic.target_noise_clip": 0.5}
    curves = {}
    for name, algorithm, extra in (("ours", ours, own), ("sb3", theirs, {"policy_kwargs": arch})):
        found = []
        for seed in range(3):
            test = EvalCallback(
                Monitor(gym.make("Pendulum-v1")), n_eval_episodes=10, eval_freq=1500, log_path=str(tmp_path), verbose=0
            )
            algorithm("MlpPolicy", "Pendulum-v1", seed=seed, **settings, **extra).learn(9000, test)
            found.append(np.mean(test.evaluations_results, axis=1))
        curves[name] = np.array(found)  # [seed, test]
    print(curves)
    means, deviations = ({name: f(curve, axis=0) for name, curve in curves.items()} for f in (np.mean, np.std))
    noise = 2 * np.hypot(deviations["ours"], deviations["sb3"]) + 60
    assert (np.abs(means["ours"] - means["sb3"]) < noise).all()
    assert all((curve[:, 0] < -400).all() and (curve.max(axis=1) > -400).all() for curve in curves.values())
