"""Actions of several steps at once: by hand where they are stored, drawn and followed, and in every place that acts."""

import json

import numpy as np
import onnxruntime
import pytest
import torch as th
from environments import SMALL, TwoEnds, merged, small_model
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.callbacks import RunCheckpointCallback
from sb3_ddiffpg.ddiffpg.action_plans import ActionPlans
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation import BestOf, Replanner, evaluate_modes

K = 3


def chunked(n_steps=600, **changes):
    model = small_model(DummyVecEnv([TwoEnds] * 4), **merged({"policy_kwargs": {"action_chunk": K}}, changes))
    return model.learn(n_steps)


@pytest.fixture(scope="module")
def model():
    found = chunked()
    assert len(found.modes) == 2
    return found


def observations(n=4, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (n, 2)).astype(np.float32)


# ------------------------------------------------------------------ plans


def test_plans_by_hand():
    plans = ActionPlans(2)
    assert plans.over(np.array([0, 1])).tolist() == [0, 1]
    plans.make(np.array([0, 1]), np.array([0, 1]), np.array([[0.1, 0.2], [0.3, 0.4]], np.float32))
    np.testing.assert_allclose(plans.next_actions(), [[0.1], [0.3]])
    plans = ActionPlans(2, plans.state)
    assert not len(plans.over(np.array([0, 1])))
    np.testing.assert_allclose(plans.next_actions(), [[0.2], [0.4]])
    assert ActionPlans(2, plans.state).over(np.array([0, 1])).tolist() == [0, 1]  # all done


def test_a_plan_ends_with_the_episode_and_with_whoever_made_it():
    plans = ActionPlans(3)
    plans.over(np.array([0, 0, 0]))
    plans.make(np.arange(3), np.zeros(3, int), np.zeros((3, 3), np.float32))
    plans.next_actions()
    assert ActionPlans(3, plans.state, [True, False, False]).over(np.array([0, 2, 0])).tolist() == [0, 1]
    before = [each.copy() for each in plans.state]
    ActionPlans(3, plans.state, True).over(np.zeros(3, int))
    for each, part in zip(before, plans.state, strict=True):  # what was given stays as it is
        np.testing.assert_array_equal(each, part)


@pytest.mark.parametrize("state", [(np.zeros(2),), (np.zeros(2), np.zeros((2, 4, 1)), np.zeros(2)), (1, 2, 3)])
def test_a_state_that_is_none_is_refused(model, state):
    with pytest.raises(ValueError, match="state must be what the previous call of predict returned"):
        model.predict(observations(2), (np.zeros(2, int), *state), mode=0)
    with pytest.raises(ValueError, match="state must be what the previous call of predict returned"):
        model.predict(observations(2), state)


# ------------------------------------------------------------------ acting


def test_actions_are_those_that_were_drawn_at_once(model):
    first, later = observations(4, 0), observations(4, 1)
    with th.no_grad():
        groups = model.policy.group_embeddings(np.ones(4, int))
        plan = model.actor(th.as_tensor(first), True, groups).numpy().reshape(4, K)
    state, seen = None, first
    for step in range(K):
        actions, state = model.predict(seen, state, deterministic=True, mode=0, n_samples=1)
        np.testing.assert_allclose(actions[:, 0], plan[:, step], atol=1e-6)
        seen = later
    again, _ = model.predict(later, state, deterministic=True, mode=0, n_samples=1)
    fresh, _ = model.predict(later, deterministic=True, mode=0, n_samples=1)
    np.testing.assert_array_equal(again, fresh)


def test_another_mode_and_another_episode_plan_anew(model):
    seen = observations(4)
    _, state = model.predict(seen, mode=0)
    fresh, _ = model.predict(seen, deterministic=True, mode=1)
    np.testing.assert_array_equal(model.predict(seen, state, deterministic=True, mode=1)[0], fresh)
    fresh, _ = model.predict(seen, deterministic=True, mode=0)
    starts = np.array([True, False, True, False])
    actions, after = model.predict(seen, state, starts, deterministic=True, mode=0)
    np.testing.assert_allclose(actions[starts], fresh[starts], atol=1e-6)
    assert after[-1].tolist() == [1, 2, 1, 2]


def test_one_observation_alone(model):
    seen, state = observations(1)[0], None
    for step in range(1, 5):
        action, state = model.predict(seen, state)
        assert action.shape == (1,) and state[-1].tolist() == [1 + (step - 1) % K]


def test_a_mode_is_kept_through_an_episode(model):
    _, state = model.predict(observations(30), episode_start=np.ones(30, bool))
    held = state[0].copy()
    assert set(held) == {0, 1}
    _, state = model.predict(observations(30), state, np.zeros(30, bool))
    np.testing.assert_array_equal(state[0], held)


def test_everything_that_acts_takes_it(model):
    env = DummyVecEnv([TwoEnds] * 2)
    assert evaluate_policy(model, env, n_eval_episodes=4)[0] >= 0
    assert evaluate_policy(Replanner(model, tolerance=0.1), env, n_eval_episodes=4)[0] >= 0
    assert evaluate_policy(BestOf(model, 3), env, n_eval_episodes=4)[0] >= 0
    assert evaluate_modes(model, TwoEnds(), n_episodes=5).uncommanded.n_episodes == 10
    assert model.mode_values(observations(5)).shape == (5, 2)


def test_a_replanner_follows_plans(model):
    replanner, seen = Replanner(model, tolerance=0.01, patience=50), observations(3)
    _, state = replanner.predict(seen, deterministic=True)
    for done in (2, 3, 1):
        _, state = replanner.predict(seen, state, deterministic=True)
        assert state[-1].tolist() == [done] * 3


# ------------------------------------------------------------------ learning


def draw(model, batch_size=60):
    return model.replay_buffer.sample_modes(batch_size, 0.9, 1, 1)


def test_a_batch_by_hand(model):
    batch, buffer = draw(model), model.replay_buffer
    assert batch.actions.shape == (3, 20, K) and batch.chunks.shape == (3, 20, K)
    cut = 0
    for group, column in np.ndindex(3, 20):
        row, rows = batch.rows[group, column], []
        while row >= 0 and len(rows) < K:
            rows.append(row)
            row = buffer.next_row[row]
        n = len(rows)
        cut += n < K
        assert batch.chunks[group, column].tolist() == rows + [-1] * (K - n)
        assert batch.executed[group, column].tolist() == [1.0] * n + [0.0] * (K - n)
        np.testing.assert_array_equal(batch.actions[group, column, :n], buffer.actions[rows, 0])
        targets = buffer.exploratory_target_actions if group == 0 else buffer.target_actions
        np.testing.assert_array_equal(batch.target_actions[group, column, :n], targets[rows, 0])
        # What was not done is by chance, and the same in both
        np.testing.assert_array_equal(batch.target_actions[group, column, n:], batch.actions[group, column, n:])
        reached = batch.next_observations.view(3, 20, 2)[group, column]
        np.testing.assert_array_equal(reached, buffer.next_observations[rows[-1]])
        expected = (0.9 ** np.arange(n) * buffer.rewards[rows]).sum()
        if group and not buffer.off_route[rows].any():  # what lies beyond a mode's route is worth nothing to it
            assert batch.rewards[group, column].item() == pytest.approx(expected, abs=1e-6)
            ends = buffer.dones[rows[-1]] and not buffer.timeouts[rows[-1]]
            assert batch.discounts[group, column].item() == pytest.approx(0.0 if ends else 0.9**n, abs=1e-6)
    assert cut


def test_improved_actions_return_to_their_steps():
    model = chunked()
    batch, buffer = draw(model), model.replay_buffer
    improved = th.rand_like(batch.target_actions)
    before = buffer.target_actions.copy(), buffer.exploratory_target_actions.copy()
    buffer.store_target_actions(batch, improved)
    explorers, modes = buffer.exploratory_target_actions, buffer.target_actions
    for stored, old, groups in ((explorers, before[1], [0]), (modes, before[0], [1, 2])):
        rows, values = batch.chunks[groups], improved.numpy()[groups]
        written = np.unique(rows[rows >= 0])
        untouched = np.setdiff1d(np.arange(len(stored)), written)
        np.testing.assert_array_equal(stored[untouched], old[untouched])
        for row in written:
            assert stored[row, 0] in values[rows == row]


def test_what_was_not_done_is_not_imitated(model, monkeypatch):
    batch = draw(model)._replace(imitated=th.ones(3, 20, dtype=th.bool))
    target = batch.target_actions
    other = th.where(batch.executed > 0, target, -target)
    assert not th.equal(other, target)

    def loss(actions):
        th.manual_seed(0)
        return model._policy_gradients(batch, actions)[0]

    # The network sees all of a chunk between action and noise, but what is asked of it is the part that was done
    seen = []

    def says_nothing(actions, condition_part, _):
        seen.append(actions)
        return 0.0 * (actions + condition_part[:, :1])

    monkeypatch.setattr(model.actor.diffusion.denoiser, "forward", says_nothing)
    assert loss(target) == loss(other) and not th.equal(*seen)


def test_critics_judge_chunks(model):
    batch = draw(model)
    assert model.critics.action_dim == K and model.policy.critics_target.action_dim == K
    features = model.policy.critic_features(batch.observations)
    values = model.critics.values(model.critics(features, batch.actions))
    later = batch.actions.clone()
    later[..., 1:] = -later[..., 1:]
    assert not th.equal(values, model.critics.values(model.critics(features, later)))


def test_explorers_hand_over_in_the_middle_of_a_plan():
    """Whoever drives the episode from then on makes a plan of its own."""
    model = chunked()
    scheduler = model.scheduler
    scheduler.groups[:], scheduler.plans = 0, None
    scheduler.may_hand_over[:] = False
    model._last_obs = observations(4)
    model._training_actions()
    assert scheduler.plans[0].tolist() == [0] * 4 and scheduler.plans[2].tolist() == [1] * 4
    scheduler.groups[1] = 2
    model._training_actions()
    assert scheduler.plans[0].tolist() == [0, 2, 0, 0] and scheduler.plans[2].tolist() == [2, 1, 2, 2]
    scheduler.follow([1, 0])  # the modes change places
    assert scheduler.groups.tolist() == scheduler.plans[0].tolist() == [0, 1, 0, 0]
    scheduler.begin(3, 1.0)
    scheduler.may_hand_over[:] = False
    model._training_actions()
    assert scheduler.plans[2].tolist() == [3, 2, 3, 1]


# ------------------------------------------------------------------ files


def test_files(model, tmp_path):
    model.save(tmp_path / "model")
    model.export(tmp_path / "model.safetensors")
    for loaded in (DDiffPG.load(tmp_path / "model"), DDiffPG.load(tmp_path / "model.safetensors", safe=True)):
        assert loaded.policy.action_chunk == loaded.replay_buffer.action_chunk == K
        state = own = None
        for _ in range(K + 1):
            expected, own = model.predict(observations(), own, deterministic=True, mode=1)
            found, state = loaded.predict(observations(), state, deterministic=True, mode=1)
            np.testing.assert_array_equal(found, expected)


def test_a_resumed_run_is_the_same_bit_for_bit(tmp_path):
    """Killed in the middle of plans: these go on."""

    def make(**more):
        env = make_vec_env("PointMazeV1-v0", n_envs=4, seed=0)
        settings = merged(SMALL, {"policy_kwargs": {"action_chunk": K}, "seed": 0})
        return DDiffPG("MlpPolicy", env, **{**settings, **more})

    whole = make().learn(400)
    checkpoint = RunCheckpointCallback(tmp_path, 220)
    make().learn(400, callback=checkpoint)
    file = min(tmp_path.glob("checkpoint_*"))
    resumed = DDiffPG.resume(file, make_vec_env("PointMazeV1-v0", n_envs=4, seed=0))
    plans = resumed.scheduler.plans
    assert plans is not None and (plans[2] < K).any()
    resumed.learn(400)
    for name, value in whole.policy.state_dict().items():
        assert th.equal(value, resumed.policy.state_dict()[name]), name


def test_a_file_for_robots(model, tmp_path):
    path = tmp_path / "model.onnx"
    model.export_onnx(path)
    session = onnxruntime.InferenceSession(path.read_bytes())
    about = session.get_modelmeta().custom_metadata_map
    assert json.loads(about["action_chunk"]) == K
    noise = np.array(json.loads(about["deterministic_noise"]), np.float32)[None, :1].repeat(4, axis=0)
    (found,) = session.run(["action"], {"observation": observations(), "mode": np.zeros(4, int), "noise": noise})
    assert found.shape == (4, K, 1)
    state = None
    for step in range(K):
        expected, state = model.predict(observations(), state, deterministic=True, mode=0, n_samples=1)
        np.testing.assert_allclose(found[:, step], expected, atol=1e-5)


@pytest.mark.parametrize("value", [0, -1, 1.5, None, "many"])
def test_bad_chunks(value):
    with pytest.raises(ValueError, match="action_chunk must be an integer of at least 1"):
        small_model(DummyVecEnv([TwoEnds]), policy_kwargs={"action_chunk": value})


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_both_routes_are_learned_in_chunks(seed):
    env = make_vec_env("PointMazeV1-v0", n_envs=32, seed=seed)
    model = DDiffPG.from_preset("point", env, seed=seed, policy_kwargs={"action_chunk": 2}).learn(150_000)
    assert len(evaluate_modes(model, "PointMazeV1-v0").commandable) == 2
