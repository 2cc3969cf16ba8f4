"""Rows in the main memory and on an accelerator hold the same; an update on the latter never waits for it."""

import warnings
from collections import defaultdict
from functools import partial

import numpy as np
import pytest
import torch as th
from environments import AnySpaces, TwoEnds, assert_same_state, image_dict_space, small_model, state_of
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_ddiffpg.buffers.storage import DeviceRows, HostRows
from sb3_ddiffpg.utils.divergence import DivergenceWatch

FIELDS = {
    "image": ((1, 3, 3), np.uint8),
    "observation": ((5,), np.float32),
    "flag": ((), bool),
    "number": ((1,), np.int64),
    "reward": ((), np.float32),
}
# What an accelerator does is here done by the processor, through the same code
ON_DEVICE = partial(DeviceRows, device=th.device("cpu"))
ROWS_ON_DEVICE = "sb3_ddiffpg.buffers.row_buffer.make_rows", lambda n_rows, fields, device: ON_DEVICE(n_rows, fields)


@pytest.fixture
def stored_on_device(monkeypatch):
    monkeypatch.setattr(*ROWS_ON_DEVICE)


@pytest.mark.parametrize("make", [HostRows, ON_DEVICE])
@settings(max_examples=25, deadline=None)
@given(writes=st.lists(st.lists(st.integers(0, 19), min_size=1, max_size=6, unique=True), max_size=5), seed=st.integers(0, 99))
def test_holds_what_one_array_for_each_field_would(make, writes, seed):
    rng = np.random.default_rng(seed)
    rows = make(20, FIELDS)
    plain = {name: np.zeros((20, *shape), dtype) for name, (shape, dtype) in FIELDS.items()}
    for places in writes:
        for name, (shape, dtype) in FIELDS.items():
            values = (200 * rng.random((len(places), *shape))).astype(dtype)
            rows.write(name, np.array(places), values)
            plain[name][places] = values
    asked = rng.integers(0, 20, size=30)
    restored = make(20, FIELDS)
    restored.restore(rows.dump(15))
    for name, column in plain.items():
        np.testing.assert_array_equal(rows.tensors(asked)[name].numpy(), column[asked])
        np.testing.assert_array_equal(np.asarray(rows[name]), column)
        np.testing.assert_array_equal(np.asarray(restored[name])[:15], column[:15])
        assert not np.asarray(restored[name])[15:].any()


def trained(env):
    model = small_model(env, seed=3, learning_starts=20, modes={"novelty_coef": 0.2}, novelty="rnd")
    model.learn(200)
    return model


@pytest.mark.parametrize("make_env", [lambda: DummyVecEnv([TwoEnds] * 4), lambda: VecNormalize(DummyVecEnv([TwoEnds] * 4))])
def test_training_is_the_same_wherever_the_rows_are(make_env, monkeypatch):
    on_host = trained(make_env())
    monkeypatch.setattr(*ROWS_ON_DEVICE)
    on_device = trained(make_env())
    assert len(on_host.modes) >= 1 and isinstance(on_device.replay_buffer.steps, DeviceRows)
    assert_same_state(state_of(on_host), state_of(on_device))
    np.testing.assert_array_equal(on_host.replay_buffer.target_actions, on_device.replay_buffer.target_actions.numpy())


@pytest.mark.parametrize("space", [image_dict_space(), spaces.Box(0, 255, (1, 36, 36), dtype=np.uint8), spaces.Discrete(5)])
def test_other_observations_on_a_device(space, stored_on_device, tmp_path):
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy"
    model = small_model(
        DummyVecEnv([lambda: AnySpaces(space)]), policy, learning_starts=10, critic={"v_min": -10.0, "v_max": 10.0}
    )
    model.learn(25)
    model.save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.size() == 28


def test_a_buffer_of_a_machine_with_an_accelerator_loads_without(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(*ROWS_ON_DEVICE)
        model = small_model(DummyVecEnv([TwoEnds] * 4), learning_starts=20, device="cpu")
        model.learn(100)
        stored = model.replay_buffer.actions.numpy().copy()
        model.replay_buffer.storage_device = th.device("cuda")
        model.save_replay_buffer(tmp_path / "buffer")
    model.replay_buffer.storage_device = th.device("cpu")
    model.load_replay_buffer(tmp_path / "buffer")
    assert isinstance(model.replay_buffer.steps, HostRows) and model.replay_buffer.size() >= 100
    np.testing.assert_array_equal(model.replay_buffer.actions, stored)
    model.learn(20, reset_num_timesteps=False)


def test_rows_move_to_where_the_model_wants_them(monkeypatch):
    model = small_model(DummyVecEnv([TwoEnds] * 4), learning_starts=20, device="cpu")
    model.learn(100)
    before = model.replay_buffer.actions.copy()
    monkeypatch.setattr(*ROWS_ON_DEVICE)
    model.replay_buffer.move_storage(th.device("meta"))
    assert isinstance(model.replay_buffer.steps, DeviceRows)
    np.testing.assert_array_equal(model.replay_buffer.actions.numpy(), before)
    model.replay_buffer.reset()
    assert not hasattr(model.replay_buffer, "steps")  # the memory is free


@pytest.mark.parametrize("device", ["auto", "cpu", "cuda"])
def test_rows_are_only_where_the_samples_go(device):
    env = DummyVecEnv([TwoEnds] * 4)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = small_model(env, device="cpu", replay_buffer_kwargs={"storage_device": device})
    assert model.replay_buffer.storage_device == th.device("cpu")
    assert any("main memory" in str(each.message) for each in caught) == (device == "cuda")
    with pytest.raises(ValueError, match="storage_device"):
        small_model(env, replay_buffer_kwargs={"storage_device": None})


class NoWaiting(TorchDispatchMode):
    """Refuses what makes the main processor wait for an accelerator's result."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.name()
        if name in ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::unique"):
            raise AssertionError(f"{name} waits for the device")
        if name in ("aten::index.Tensor", "aten::index_put_", "aten::index_put"):
            assert not any(each is not None and each.dtype == th.bool for each in args[1]), f"{name} by a mask waits"
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    "settings", [{"novelty": "rnd"}, {"novelty": "counts"}, {"critic": {"n_atoms": 1}, "modes": {"novelty_coef": 0.3}}]
)
def test_an_update_never_waits_for_the_device(settings, stored_on_device, monkeypatch):
    model = small_model(DummyVecEnv([TwoEnds] * 4), learning_starts=20, **settings)
    model.learn(200)
    model.train(1, 48)  # what is made once, is made now
    assert len(model.modes) >= 1

    def refuse(*_, **__):
        raise AssertionError("this waits for the device")

    model.divergence_watch = DivergenceWatch(th.device("cuda"))  # looks later
    model.replay_buffer.storage_device = th.device("cuda")  # only asked whether target actions must come back
    metrics = defaultdict(list)
    if "modes" in settings:
        model.replay_buffer.expect_modes(len(model.modes))  # modes without transitions
    for method in ("cpu", "numpy", "item", "tolist", "__bool__", "__float__", "__int__"):
        monkeypatch.setattr(th.Tensor, method, refuse)
    for function in ("tensor", "as_tensor"):  # they copy from memory that a device cannot read by itself
        monkeypatch.setattr(th, function, refuse)
    with NoWaiting():
        batch = model.replay_buffer.sample_modes(48, model.gamma, 3, 5, visits_of_modes="modes" in settings)
        rewards = model._rewards(batch, metrics)
        model._update_critics(batch, rewards, metrics, ["critics"] * model.critics.n_groups)
        improved = model._improve_target_actions(batch)
        model._update_policy(batch, improved)
        model._update_targets()
