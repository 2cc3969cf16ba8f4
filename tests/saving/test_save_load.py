"""Saving and loading, as SB3's tests ask of an algorithm; whatever the number of modes."""

import io
import subprocess
import sys
import zipfile
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch as th
from environments import (
    SMALL,
    AnySpaces,
    TwoEnds,
    assert_same_state,
    small_model,
    some_observations,
    state_of,
)
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import ClusteringCallback, DDiffPG, DiffusionPolicy, Mode
from sb3_ddiffpg.exploration.noise import SpreadNormalActionNoise


def test_save_and_load_random_parameters(tmp_path, trained):
    trained.save(tmp_path / "trained")
    model = DDiffPG.load(tmp_path / "trained", env=DummyVecEnv([TwoEnds] * 4))
    original = deepcopy(model.get_parameters())
    # Every persistent entry can take random values, none is derived from others
    randomised = deepcopy(original)
    randomised["policy"] = {name: 0.1 * th.rand_like(value) for name, value in original["policy"].items()}
    model.set_parameters(randomised)
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, randomised["policy"][name]) and not th.allclose(value, original["policy"][name])
    expected, _ = model.predict(some_observations(), deterministic=True)
    state = state_of(model)
    model.save(tmp_path / "model.zip")
    for device in ("cpu", "auto"):
        loaded = DDiffPG.load(str(tmp_path / "model"), env=DummyVecEnv([TwoEnds] * 4), device=device)
        assert_same_state(state_of(loaded), state)
        np.testing.assert_array_equal(loaded.predict(some_observations(), deterministic=True)[0], expected)
        loaded.learn(60)


def test_set_parameters_is_strict(trained, tmp_path):
    trained.save(tmp_path / "model")
    model = DDiffPG.load(tmp_path / "model")
    params = deepcopy(model.get_parameters())
    with pytest.raises(ValueError, match="invalid object name"):
        model.set_parameters(params | {"no_such_object": "no_state_dict"})
    for name in params:
        with pytest.raises(ValueError, match="do not match"):
            model.set_parameters({key: value for key, value in params.items() if key != name})
        model.set_parameters({key: value for key, value in params.items() if key != name}, exact_match=False)
    with pytest.raises(ValueError, match="do not match"):
        model.set_parameters({})
    for name in ("policy", "bonus.novelty_model"):
        missing = {key: value for key, value in params[name].items() if key != next(iter(params[name]))}
        with pytest.raises(RuntimeError, match="Missing key"):
            model.set_parameters(params | {name: missing})
        model.set_parameters(params | {name: missing}, exact_match=False)
    assert_same_state(state_of(model), state_of(trained))


def test_load_in_a_fresh_process_gives_the_same_bits(trained, tmp_path):
    trained.save(tmp_path / "model")
    observations = some_observations()
    np.save(tmp_path / "observations.npy", observations)
    code = """
import sys, numpy as np, torch
from sb3_ddiffpg import DDiffPG
torch.set_num_threads(1)  # as in the tests: the number of threads decides the order of sums
model = DDiffPG.load(sys.argv[1] + "/model")
observations = np.load(sys.argv[1] + "/observations.npy")
for mode in (None, *model.modes.names):
    print(mode, model.predict(observations, deterministic=True, mode=mode)[0].tobytes().hex())
print(model.modes)
"""
    # The custom environment of the tests is not importable there, nor needed
    command = [sys.executable, "-c", code, str(tmp_path)]
    result = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    expected = [
        f"{mode} {trained.predict(observations, deterministic=True, mode=mode)[0].tobytes().hex()}"
        for mode in (None, *trained.modes.names)
    ]
    assert result.stdout.splitlines() == expected + str(trained.modes).splitlines()


@pytest.mark.parametrize("novelty", ["rnd", "counts"])
def test_zip_holds_everything_that_was_learned(novelty, tmp_path):
    model = small_model(DummyVecEnv([TwoEnds] * 4), novelty=novelty).learn(320)
    model.save(tmp_path / "model")
    loaded = DDiffPG.load(tmp_path / "model", env=DummyVecEnv([TwoEnds] * 4))
    state = state_of(model)
    assert_same_state(state, state_of(loaded))
    # 3 groups of critics, their targets and Adam moments, the embeddings
    assert state["/policy/critics.weights.0"].shape[0] == 3 == len(state["/policy/mode_embeddings"])
    assert state["/policy/critics_target.weights.0"].shape[0] == 3
    moments = [name for name in state if name.startswith("/policy.critics.optimizer") and name.endswith("exp_avg")]
    assert moments and all(state[name].abs().sum() > 0 for name in moments)
    assert any(name.startswith("/actor.optimizer") and name.endswith("exp_avg_sq") for name in state)
    assert state["/bonus.moments/count"] > 0
    if novelty == "rnd":
        assert "/bonus.novelty_model/predictor.0.weight" in state and "/bonus.novelty_model/target.0.weight" in state
        assert any(name.startswith("/bonus.novelty_model.optimizer") for name in state)
        assert state["/bonus.novelty_model/position_scale.var"].item() > 0
    else:
        assert state["/bonus.novelty_model/counts"].sum() == 320
    for ours, theirs in zip(model.modes, loaded.modes, strict=True):
        assert (ours.name, ours.born_at, ours.n_trajectories) == (theirs.name, theirs.born_at, theirs.n_trajectories)
        assert (ours.mean_length, ours.mean_return, list(ours.outcomes)) == (
            theirs.mean_length,
            theirs.mean_return,
            list(theirs.outcomes),
        )
        np.testing.assert_array_equal(ours.representative, theirs.representative)
        np.testing.assert_array_equal(ours.embedding, theirs.embedding)
    attributes = ("num_timesteps", "n_rollouts", "_n_updates", "_episode_num")
    assert [getattr(loaded, name) for name in attributes] == [getattr(model, name) for name in attributes]
    assert loaded.mode_manager.next_number == model.mode_manager.next_number
    assert loaded.scheduler.n_turns == model.scheduler.n_turns > 0
    np.testing.assert_array_equal(loaded.scheduler.groups, model.scheduler.groups)


def test_a_file_of_the_other_kind(trained, tmp_path):
    """It is said which it is; a file of another algorithm, what loads it."""
    trained.save(tmp_path / "model.zip")
    trained.export(tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"path: .*model\.safetensors was written by export: load it with safe=True"):
        DDiffPG.load(tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"path: .*model\.zip was written by save, .* load it without safe=True"):
        DDiffPG.load(tmp_path / "model.zip", safe=True)
    SAC("MlpPolicy", TwoEnds(), buffer_size=10).save(tmp_path / "sac.zip")
    with pytest.raises(ValueError) as raised:
        DDiffPG.load(tmp_path / "sac.zip")
    assert "sac.zip was loaded as a DDiffPG: what another algorithm saved, its class loads" in raised.value.__notes__[0]


def test_zip_is_small(trained, tmp_path):
    class Heavy(BaseCallback):
        """Cannot be pickled, and would be large."""

        def __init__(self):
            super().__init__()
            self.ballast = (np.random.bytes(10_000_000), lambda: self.model)

        def _on_step(self):
            return True

        def __getstate__(self):
            raise AssertionError("callbacks do not belong into the zip")

    class HeavyEnv(TwoEnds):
        def __getstate__(self):
            raise AssertionError("environments do not belong into the zip")

    trained.save(tmp_path / "light.zip")
    model = small_model(DummyVecEnv([HeavyEnv] * 4), novelty="rnd", buffer_size=100_000)
    model.learn(400, callback=[Heavy(), ClusteringCallback(5)])
    model.save(tmp_path / "heavy.zip")
    light, heavy = ((tmp_path / name).stat().st_size for name in ("light.zip", "heavy.zip"))
    assert heavy < 1.2 * light < 1_500_000
    with zipfile.ZipFile(tmp_path / "heavy.zip") as archive:
        assert archive.getinfo("data").file_size < 100_000


def test_without_what_only_training_needs(trained, tmp_path):
    """To act, and to go on with fresh ones; the model that was saved goes on with its own."""
    moments = [state["exp_avg"].clone() for state in trained.actor.optimizer.state.values()]
    targets = {name: value.clone() for name, value in trained.policy.critics_target.state_dict().items()}
    trained.save(tmp_path / "whole")
    trained.save(tmp_path / "acts", to_train=False)
    after = [state["exp_avg"] for state in trained.actor.optimizer.state.values()]
    assert moments and all(th.equal(old, new) for old, new in zip(moments, after, strict=True))
    assert (tmp_path / "acts.zip").stat().st_size < 0.55 * (tmp_path / "whole.zip").stat().st_size
    loaded = DDiffPG.load(tmp_path / "acts", env=DummyVecEnv([TwoEnds] * 4))
    obs = np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    for mode in range(len(trained.modes)):
        actions = (model.predict(obs, deterministic=True, mode=mode)[0] for model in (trained, loaded))
        np.testing.assert_array_equal(*actions)
    for name, value in loaded.policy.critics_target.state_dict().items():
        assert th.equal(value, trained.policy.critics.state_dict()[name])
    for name, value in trained.policy.critics_target.state_dict().items():  # it trains on with its own
        assert th.equal(value, targets[name])
    assert not loaded.actor.optimizer.state and loaded.policy.critics.optimizer.param_groups[0]["lr"] > 0
    assert not loaded.bonus.known_cells.known.any() and not loaded.bonus.moments.count.any()
    loaded.learn(200, reset_num_timesteps=False)
    assert loaded.actor.optimizer.state
    with pytest.raises(ValueError, match="known_cells"):  # not all of it, as if by mistake
        loaded.set_parameters({name: each for name, each in loaded.get_parameters().items() if name != "bonus.known_cells"})


def test_targets_are_filled_in_only_from_all_of_what_they_follow():
    model = small_model(TwoEnds())
    before = {name: value.clone() for name, value in model.policy.critics_target.state_dict().items()}
    name = next(iter(before))
    model.set_parameters({"policy": {f"critics.{name}": before[name] + 1.0}}, exact_match=False)
    assert th.equal(model.policy.critics.state_dict()[name], before[name] + 1.0)
    for name, value in model.policy.critics_target.state_dict().items():
        assert th.equal(value, before[name])


def test_zip_size_follows_the_number_of_modes(tmp_path):
    sizes = []
    for n_modes in (0, 8):
        model = small_model(TwoEnds())
        model.mode_manager.modes = [Mode(i, f"mode_{i}", born_at=i) for i in range(n_modes)]
        model.mode_manager.next_number = n_modes
        model.policy.resize(n_modes)
        model.save(tmp_path / "model")
        loaded = DDiffPG.load(tmp_path / "model")
        assert len(loaded.modes) == n_modes and loaded.critics.n_groups == n_modes + 1
        assert_same_state(state_of(model), state_of(loaded))
        sizes.append((tmp_path / "model.zip").stat().st_size)
    assert sizes[0] < sizes[1]


def test_policy_and_actor_save_and_load_alone(trained, tmp_path):
    observations = some_observations()
    trained.policy.save(tmp_path / "policy.pkl")
    trained.policy.actor.save(tmp_path / "actor.pkl")
    policy = DiffusionPolicy.load(tmp_path / "policy.pkl")
    actor = type(trained.policy.actor).load(tmp_path / "actor.pkl")
    assert policy.n_modes == 2
    expected, _ = trained.policy.predict(observations, deterministic=True)
    np.testing.assert_array_equal(policy.predict(observations, deterministic=True)[0], expected)
    alone, _ = trained.policy.predict(observations, deterministic=True, n_samples=1)
    np.testing.assert_array_equal(actor.predict(observations, deterministic=True)[0], alone)
    for mode in range(2):
        commanded, _ = trained.predict(observations, deterministic=True, mode=mode)
        np.testing.assert_array_equal(policy.predict(observations, deterministic=True, mode=mode)[0], commanded)
        assert not np.array_equal(commanded, expected)
    for name, value in trained.policy.state_dict().items():
        assert th.equal(value, policy.state_dict()[name])


def test_exclude_and_include(tmp_path):
    model = small_model(TwoEnds(), verbose=2)
    model.save(tmp_path / "model", exclude=["verbose"])
    assert DDiffPG.load(tmp_path / "model").verbose != 2
    model.save(tmp_path / "model", exclude=["verbose"], include=["verbose"])
    assert DDiffPG.load(tmp_path / "model").verbose == 2


def test_save_to_a_stream(trained):
    stream = io.BytesIO()
    trained.save(stream)
    stream.seek(0)
    assert_same_state(state_of(DDiffPG.load(stream)), state_of(trained))


def test_loaded_arguments_can_be_changed(trained, tmp_path):
    trained.save(tmp_path / "model")
    model = DDiffPG.load(tmp_path / "model", learning_rate=5e-4, recluster_freq=7, batch_size=64)
    assert (model.learning_rate, model.recluster_freq, model.batch_size) == (5e-4, 7, 64)
    assert model.lr_schedule(1.0) == 5e-4
    with pytest.raises(ValueError, match="policy kwargs"):
        DDiffPG.load(tmp_path / "model", policy_kwargs={"net_arch": [32]})
    DDiffPG.load(tmp_path / "model", policy_kwargs=SMALL["policy_kwargs"])
    # What the zoo's enjoy does
    custom = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}
    assert DDiffPG.load(tmp_path / "model", custom_objects=custom).learning_rate == 0.0


@pytest.mark.parametrize("n_envs", [1, 3])
def test_load_with_another_number_of_environments(n_envs, tmp_path):
    noise = SpreadNormalActionNoise(2, 1, low=0.1, high=0.2)
    small_model(DummyVecEnv([TwoEnds] * 2), action_noise=noise).learn(160).save(tmp_path / "model")
    model = DDiffPG.load(tmp_path / "model", env=DummyVecEnv([TwoEnds] * n_envs))
    assert model.n_envs == n_envs == model.replay_buffer.n_envs
    model.learn(60, reset_num_timesteps=False)
    assert model.num_timesteps >= 220
    assert (model.action_noise.low, model.action_noise.high, len(model.action_noise.sigma)) == (0.1, 0.2, n_envs)


def test_set_env():
    model = small_model(DummyVecEnv([TwoEnds]), learning_starts=20).learn(50)
    other = DummyVecEnv([TwoEnds])
    model.set_env(other)
    assert model.get_env() is other
    model.learn(30, reset_num_timesteps=False)
    model.set_env(TwoEnds())
    model.learn(30)
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(DummyVecEnv([TwoEnds] * 2))
    with pytest.raises(ValueError, match="spaces"):
        model.set_env(AnySpaces(spaces.Box(-1, 1, (7,))))


def test_save_and_load_replay_buffer(tmp_path):
    model = small_model(DummyVecEnv([TwoEnds] * 2)).learn(120)
    old = deepcopy(model.replay_buffer)
    model.save_replay_buffer(tmp_path / "sub" / "buffer.pkl")
    model.replay_buffer = None
    model.load_replay_buffer(tmp_path / "sub" / "buffer")
    new = model.replay_buffer
    assert new.size() == old.size() == 120
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "target_actions"):
        np.testing.assert_array_equal(getattr(new, name), getattr(old, name))
    with open(tmp_path / "stream.pkl", "wb") as stream:
        model.save_replay_buffer(stream)
    with open(tmp_path / "stream.pkl", "rb") as stream:
        model.load_replay_buffer(stream, truncate_last_traj=False)
    assert model.replay_buffer.device == model.device
    model.learn(20, reset_num_timesteps=False)
