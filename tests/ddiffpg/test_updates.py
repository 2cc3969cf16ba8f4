"""One update of the algorithm: who learns from what."""

import warnings
from collections import defaultdict
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from environments import SMALL, TwoEnds, merged, small_model
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import TD3C51
from sb3_ddiffpg.experiments.ablations import ABLATIONS
from sb3_ddiffpg.networks.critics import ModeCritics

# Plain steps: what is not trained stays exactly as it is
PLAIN = {"net_arch": [16], "optimizer_class": th.optim.SGD}


def trained_model(algorithm=DDiffPG, **changes):
    model = algorithm("MlpPolicy", DummyVecEnv([TwoEnds] * 4), **merged(SMALL, {"policy_kwargs": PLAIN}, changes))
    model.set_logger(Logger(None, []))
    model.learn(300)
    assert len(model.modes) == 2
    model.policy.set_training_mode(True)
    return model


def draw(model, batch_size=60, visits_of_modes=False):
    explores, modes = model.exploration_settings, model.mode_settings
    return model.replay_buffer.sample_modes(
        batch_size,
        model.gamma,
        explores.n_steps_beside(model.n_steps),
        modes.n_steps_beside(model.n_steps),
        exploration_gamma=explores.gamma,
        visits_of_modes=visits_of_modes,
    )


def parameters_of(module):
    return [parameter.detach().clone() for parameter in module.parameters()]


def scrambled(batch, group):
    """The same batch with other numbers in one group's rows."""
    n_groups, n = batch.rows.shape
    observations, next_observations = batch.observations.clone(), batch.next_observations.clone()
    rewards, actions, target_actions = batch.rewards.clone(), batch.actions.clone(), batch.target_actions.clone()
    for rows in (observations, next_observations):
        rows.view(n_groups, n, -1)[group] *= -1.0
    rewards[group] += 3.0
    actions[group] *= -0.5
    target_actions[group] *= -0.5
    return batch._replace(
        observations=observations,
        next_observations=next_observations,
        rewards=rewards,
        actions=actions,
        target_actions=target_actions,
    )


def test_targets_follow_slowly():
    model = trained_model(tau=0.1)
    before = parameters_of(model.policy.critics_target)
    model.train(1, 60)
    online, after = parameters_of(model.policy.critics), parameters_of(model.policy.critics_target)
    for old, new, target in zip(before, online, after, strict=True):
        th.testing.assert_close(target, 0.9 * old + 0.1 * new)
        assert not th.equal(old, target)


def test_each_critic_learns_from_its_own_part_of_the_batch():
    model = trained_model()
    batch = draw(model)
    start = deepcopy(model.get_parameters())
    updated = []
    for each in (batch, scrambled(batch, 1)):
        model.set_parameters(start)
        th.manual_seed(0)
        model._update_critics(each, each.rewards, defaultdict(list))
        updated.append(parameters_of(model.critics))
    for name, first, second in zip(start["policy"], *updated, strict=False):
        assert th.equal(first[[0, 2]], second[[0, 2]]), name
        assert not th.equal(first[1], second[1]), name


def test_groups_without_data_train_nothing(tmp_path):
    """As after loading a model without its buffer: the rows that stand in for theirs must not count."""
    trained_model().save(tmp_path / "model")
    model = DDiffPG.load(tmp_path / "model", env=DummyVecEnv([TwoEnds] * 4), recluster_freq=1000)
    model.learn(100)
    batch = draw(model)
    assert batch.active.tolist() == [True, False, False]
    start = deepcopy(model.get_parameters())
    buffer, updated = deepcopy(model.replay_buffer), []
    for each in (batch, scrambled(scrambled(batch, 1), 2)):
        model.set_parameters(start)
        th.manual_seed(0)
        model._update_critics(each, each.rewards, defaultdict(list))
        improved = model._improve_target_actions(each)
        model._update_policy(each, improved)
        updated.append((parameters_of(model.critics), parameters_of(model.actor)))
    (critics, actor), (other_critics, other_actor) = updated
    assert all(th.equal(first, second) for first, second in zip(critics + actor, other_critics + other_actor, strict=True))
    weights = model.critics.weights
    for layer, weight in enumerate(weights):
        assert th.equal(weight[1:], start["policy"][f"critics.weights.{layer}"][1:])
        assert not th.equal(weight[0], start["policy"][f"critics.weights.{layer}"][0])
    np.testing.assert_array_equal(model.replay_buffer.target_actions, buffer.target_actions)
    assert not np.array_equal(model.replay_buffer.exploratory_target_actions, buffer.exploratory_target_actions)


def test_the_policy_does_not_imitate_off_mode_successes():
    """For the mode only: to the exploratory group all steps are alike."""
    model = trained_model()
    buffer = model.replay_buffer
    buffer.off_mode_success[: buffer.pos : 3] = True
    batch = draw(model)
    off_mode = buffer.off_mode_success[batch.rows]
    assert off_mode.any(axis=1).all()
    off_mode[0] = False
    np.testing.assert_array_equal(batch.imitated.numpy(), ~off_mode)
    start, updated = deepcopy(model.get_parameters()), []
    for changed in (np.zeros_like(off_mode), off_mode, ~off_mode):
        model.set_parameters(start)
        th.manual_seed(0)
        model._update_policy(batch, th.where(th.as_tensor(changed)[..., None], -batch.target_actions, batch.target_actions))
        updated.append(parameters_of(model.actor))
    same = [all(th.equal(a, b) for a, b in zip(updated[0], other, strict=True)) for other in updated[1:]]
    assert same == [True, False]


@pytest.mark.parametrize("probability", [0.0, 0.3, 1.0])
def test_embeddings_are_masked_as_a_whole_and_exploration_never(probability):
    th.manual_seed(0)
    model = trained_model(modes={"mask_prob": probability})
    table = model.policy.mode_embeddings
    for masked in (True, False):
        embeddings = model.policy.row_embeddings(1000, probability if masked else None).view(3, 1000, -1)
        assert (embeddings[0] == table[0]).all()
        for group in (1, 2):
            whole, none = (embeddings[group] == table[group]).all(dim=1), (embeddings[group] == 0).all(dim=1)
            assert (whole | none).all()
            assert none.float().mean().item() == pytest.approx(probability * masked, abs=0.05)


def test_shuffled_embeddings_say_nothing_of_the_mode():
    model = trained_model(ABLATIONS["ddiffpg_shuffled_embeddings"])
    rows = model.policy.row_embeddings(30).view(3, 30, -1)
    table = model.policy.mode_embeddings
    assert (rows[0] == table[0]).all()
    mine = (rows[1:] == table[1:, None]).all(dim=2).float().mean(dim=1)
    assert ((mine > 0.2) & (mine < 0.8)).all()
    each = th.stack([(rows[1:].flatten(0, 1) == embedding).all(dim=1).sum() for embedding in table[1:]])
    assert each.tolist() == [30, 30]


def test_random_clusters_have_the_sizes_of_the_true_ones():
    model = trained_model(ABLATIONS["ddiffpg_random_clusters"])
    distances = np.full((40, 40), 5.0, dtype=np.float32)
    distances[:30, :30] = distances[30:, 30:] = 0.1
    np.fill_diagonal(distances, 0.0)
    labels = model.mode_manager._cluster(distances)
    assert sorted(np.bincount(labels).tolist()) == [10, 30] and len(set(labels[30:])) == 2


@pytest.mark.parametrize("backup_embedding", ["mode", "masked"])
def test_the_backup_follows_the_mode(backup_embedding):
    model = trained_model(modes={"backup_embedding": backup_embedding, "mask_prob": 0.5})
    batch, seen = draw(model), []

    def watch(module, arguments, keywords):
        seen.append((arguments[0].clone(), keywords["embeddings"].clone()))

    hook = model.actor.register_forward_pre_hook(watch, with_kwargs=True)
    model._update_critics(batch, batch.rewards, defaultdict(list))
    hook.remove()
    ((observations, embeddings),) = seen
    assert th.equal(observations, batch.next_observations)
    own = model.policy.mode_embeddings.repeat_interleave(20, dim=0)
    is_own, is_zero = (embeddings == own).all(dim=1), (embeddings == 0).all(dim=1)
    if backup_embedding == "mode":
        assert is_own.all()
    else:
        assert (is_own | is_zero).all() and is_own[:20].all() and 0.2 < is_zero[20:].float().mean() < 0.8


def test_target_policy_smoothing(monkeypatch):
    th.manual_seed(0)
    model = trained_model(critic={"target_policy_noise": 0.8, "target_noise_clip": 0.2})
    batch, noise = draw(model, 3000), []
    monkeypatch.setattr(model.actor, "forward", lambda obs, embeddings: th.zeros(len(obs), 1))

    def bellman_target(features, actions, rewards, discounts):
        noise.append(actions.flatten())
        raise StopIteration

    monkeypatch.setattr(model.policy.critics_target, "bellman_target", bellman_target)
    with pytest.raises(StopIteration):
        model._update_critics(batch, batch.rewards, defaultdict(list))
    assert noise[0].abs().max().item() == pytest.approx(0.2)
    # Of N(0, .8) four fifths lie beyond .2, in equal parts on both sides
    assert (noise[0].abs() > 0.199).float().mean().item() == pytest.approx(0.80, abs=0.03)
    assert noise[0].mean().item() == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("optimizer", ["sgd", "normalized", "adam"])
def test_target_actions_climb_their_own_critic(optimizer):
    ascent = {"optimizer": optimizer, "learning_rate": 0.01, "n_steps": 3}
    model = trained_model(target_action=ascent, critic={"n_atoms": 1})
    for weight in model.critics.weights:
        weight.data.normal_(std=0.5)  # hardly trained critics are flat
    batch = draw(model)

    def values(actions):
        with th.no_grad():
            features = model.policy.critic_features(batch.observations)
            return model.critics.values(model.critics(features, actions))[:, 0]

    improved = model._improve_target_actions(batch)
    gain = (values(improved) - values(batch.target_actions)).mean(dim=1)
    assert (gain > 0).all() and improved.abs().max() <= 1
    rows, buffer = batch.rows, model.replay_buffer
    for group in range(3):
        stored = (buffer.exploratory_target_actions if group == 0 else buffer.target_actions)[rows[group]]
        # A row that was drawn twice has one of its improved actions
        distinct, counts = np.unique(rows[group], return_counts=True)
        drawn_once = np.isin(rows[group], distinct[counts == 1])
        np.testing.assert_array_equal(stored[drawn_once], improved[group].numpy()[drawn_once])


@pytest.mark.parametrize(("n_diffusion_steps", "expected"), [(None, 5), (5, 11)])
def test_a_flow_learns_at_every_second_update(n_diffusion_steps, expected, monkeypatch):
    """However many there are at a time."""
    model = trained_model(n_diffusion_steps=n_diffusion_steps)
    before, calls, original = model._n_updates, [], model._update_policy
    monkeypatch.setattr(model, "_update_policy", lambda *args: calls.append(1) or original(*args))
    model._n_updates = 0
    for n in (1, 3, 1, 1, 5):
        model.train(n, 60)
    assert len(calls) == expected and model._n_updates == 11 and before


def test_a_flow_is_saved_as_one(tmp_path):
    model = trained_model(n_diffusion_steps=None)
    model.save(tmp_path / "model")
    model.export(tmp_path / "model.safetensors")
    seen = np.random.default_rng(0).uniform(-1, 1, (9, 2)).astype(np.float32)
    expected, _ = model.predict(seen, deterministic=True, mode=0)
    for loaded in (DDiffPG.load(tmp_path / "model"), DDiffPG.load(tmp_path / "model.safetensors", safe=True)):
        assert loaded.n_diffusion_steps is None and loaded.actor.diffusion.n_draws == 1
        np.testing.assert_array_equal(loaded.predict(seen, deterministic=True, mode=0)[0], expected)


def test_metrics_of_an_update():
    model = trained_model(novelty="rnd")
    metrics = defaultdict(list)
    model._rewards(draw(model), metrics)
    assert {name: len(values) for name, values in metrics.items()} == {"intrinsic_reward": 1, "novelty_loss": 1}
    before = model._n_updates
    model.train(3, 60)
    assert model._n_updates == before + 3


def test_explorers_may_have_a_horizon_of_their_own():
    fixed = {"v_min": 0.0, "v_max": 5.0}
    model = trained_model(gamma=0.9, exploration={"gamma": 0.5}, novelty={"coef": 2.0, "clip": 10.0}, critic=fixed)
    batch = draw(model, 90, visits_of_modes=True)
    lengths, discounts = batch.visited.present.sum(axis=-1), batch.discounts.numpy()
    for group, gamma in ((0, 0.5), (1, 0.9)):
        goes_on = discounts[group] > 0
        assert goes_on.any()
        np.testing.assert_allclose(discounts[group][goes_on], gamma ** lengths[group][goes_on], rtol=1e-6)
    assert model.policy.critics.upper.tolist() == [2.0 * 10.0 / (1 - 0.5), 5.0]


@pytest.mark.parametrize("n_atoms", [1, 51])
def test_values_that_the_support_cuts_off_are_told(n_atoms):
    """An explorer whose values all lie at the limit does not know where to go; nothing else shows it."""
    env = DummyVecEnv([TwoEnds] * 4)
    settings = {"critic": {"n_atoms": n_atoms}, "novelty": {"coef": 1.0}, "learning_rate": 1e-2}
    model = small_model(env, exploration={"v_max": 0.5}, **settings)
    with pytest.warns(
        UserWarning, match=r"% of the exploratory critics' targets are cut off at exploration.v_max=0.5"
    ) as told:
        model.learn(300)
    assert sum("cut off" in str(each.message) for each in told) == 1  # once
    model = small_model(env, exploration={"v_max": 1000.0}, seed=1, **settings)  # whose first values, by chance, are moderate
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        model.learn(300)
    settings["critic"]["v_max"] = 0.5
    model = TD3C51("MlpPolicy", env, learning_starts=40, batch_size=32, seed=0, **settings)
    with pytest.warns(UserWarning, match="are cut off at critic.v_max=0.5"):
        model.learn(300)


def test_the_share_of_cut_values():
    critics = ModeCritics(3, 2, [8], n_groups=2, n_atoms=1, support=(0.0, 5.0), exploration_support=(0.0, 9.0))
    targets = th.tensor([[[9.0], [8.9], [5.0], [0.0]], [[5.0], [4.9], [5.0], [0.0]]])
    assert critics.share_at_top(targets).tolist() == [0.25, 0.5]
    critics = ModeCritics(3, 2, [8], n_groups=1, n_atoms=3)
    assert critics.share_at_top(th.tensor([[[0.2, 0.2, 0.6], [0.5, 0.5, 0.0]]])).item() == pytest.approx(0.3)
