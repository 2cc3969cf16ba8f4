"""Files without code: what goes in comes out, and nothing that comes from a stranger is run."""

import json
import os
import pickle
import re
import resource
import subprocess
import sys
import threading
import zipfile

import numpy as np
import pytest
import torch as th
from environments import (
    AnySpaces,
    TwoEnds,
    assert_same_state,
    copied,
    image_dict_space,
    small_model,
    some_observations,
    state_of,
)
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from safetensors.numpy import load_file, save_file
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.callbacks.checkpoint import RunCheckpointCallback
from sb3_ddiffpg.common.schedules import LateLinearSchedule
from sb3_ddiffpg.ddiffpg.policies import DiffusionPolicy
from sb3_ddiffpg.saving.model import build_model, model_tree
from sb3_ddiffpg.serialization.codec import from_plain, to_plain
from sb3_ddiffpg.serialization.safetensors_tree import DamagedError, _digest, convert, read, remove_unfinished, write

PLAIN = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
ARRAYS = hnp.arrays(
    st.sampled_from([np.float32, np.float64, np.int32, np.int64, np.uint8, bool]), hnp.array_shapes(min_dims=0)
)
KEYS = st.text().filter(lambda key: not key.startswith("$"))
TREES = st.recursive(PLAIN | ARRAYS, lambda each: st.lists(each, max_size=4) | st.dictionaries(KEYS, each, max_size=4))


def assert_same_tree(first, second):
    assert type(first) is type(second)
    if isinstance(first, dict):
        assert list(first) == list(second)
        first, second = list(first.values()), list(second.values())
    if isinstance(first, list):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same_tree(one, other)
    elif isinstance(first, np.ndarray):
        assert first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()
    else:
        assert first == second


@given(tree=TREES)
@settings(max_examples=100, deadline=None)
def test_what_goes_in_comes_out(tmp_path_factory, tree):
    path = tmp_path_factory.mktemp("tree") / "file"
    write(path, "thing", tree)
    assert_same_tree(read(path, "thing"), tree)


def test_each_array_has_one_place(tmp_path):
    """Named many times, a small file would hold many; named nowhere, it would hide."""
    for tree in ('[{"$array": "/0"}, {"$array": "/0"}]', '[{"$array": "/1"}]', "[]", '{"0": [{"$array": "/0"}]}'):
        arrays = {"/0": np.zeros(3)}
        metadata = {"format": "sb3_ddiffpg", "version": "1", "kind": "thing", "tree": tree}
        save_file(arrays, tmp_path / "file", {**metadata, "sha256": _digest("thing", tree, arrays)})
        with pytest.raises(ValueError, match="an array of another place|have no place"):
            read(tmp_path / "file", "thing")


def test_too_many_plain_values(tmp_path, monkeypatch):
    write(tmp_path / "file", "thing", list(range(100)))
    monkeypatch.setattr("sb3_ddiffpg.serialization.safetensors_tree._LONGEST", 200)
    with pytest.raises(ValueError, match="390 characters of plain values; accepted are up to 200"):
        read(tmp_path / "file", "thing")
    with pytest.raises(TypeError, match="390 characters"):
        write(tmp_path / "other", "thing", list(range(100)))
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("dtype", ["F8_E4M3", "F8_E5M2", "BF16"])
def test_numbers_that_numpy_does_not_have(tmp_path, dtype):
    size = {"BF16": 2}.get(dtype, 1)
    header = json.dumps(
        {
            "__metadata__": {"format": "sb3_ddiffpg", "version": "1", "kind": "thing", "tree": "[]", "sha256": ""},
            "/0": {"dtype": dtype, "shape": [1], "data_offsets": [0, size]},
        }
    ).encode()
    (tmp_path / "file").write_bytes(len(header).to_bytes(8, "little") + header + bytes(size))
    with pytest.raises(ValueError, match="is damaged"):
        read(tmp_path / "file", "thing")


def written(path, text, arrays=None, **tensors):
    """A file as a stranger may write it: any text for its plain values, any tensors in the header."""
    digest = _digest("model", text, arrays or {})
    metadata = {"format": "sb3_ddiffpg", "version": "1", "kind": "model", "tree": text, "sha256": digest}
    header = json.dumps({"__metadata__": metadata, **tensors}).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    return path


def test_a_long_key_above_a_long_list_costs_no_more_than_both(tmp_path, monkeypatch):
    """A place was spelt for each entry: hours for a file of a few megabytes."""
    spelt = []
    monkeypatch.setattr("sb3_ddiffpg.serialization.safetensors_tree._name", lambda key: spelt.append(key) or key)
    read(written(tmp_path / "file", json.dumps({"x" * 1000: [0] * 1000})), "model")
    assert len(spelt) <= 1
    with pytest.raises(ValueError, match="model: Object contains unknown field") as raised:
        DDiffPG.load(tmp_path / "file", safe=True)
    assert len(str(raised.value)) < 600


@pytest.mark.parametrize("shape", [[0, 2**62], [0] * 65], ids=["large", "many"])
def test_shapes_that_numpy_does_not_have(tmp_path, shape):
    path = written(tmp_path / "file", "{}", **{"/0": {"dtype": "F32", "shape": shape, "data_offsets": [0, 0]}})
    with pytest.raises(DamagedError, match=re.escape(str(path))):
        read(path, "model")


def test_half_of_a_character(tmp_path):
    path = written(tmp_path / "file", r'{"\ud800": 1}')
    with pytest.raises(ValueError, match="model: .*surrogates not allowed"):
        DDiffPG.load(path, safe=True)


def test_many_write_one_file(tmp_path):
    """Each whole, whoever is the last; as readable as the user wants files; and nothing else is left."""
    path = tmp_path / "file"
    writers = [threading.Thread(target=write, args=(path, "thing", [np.full(1000, i)] * 1)) for i in range(8)]
    for each in writers:
        each.start()
    for each in writers:
        each.join()
    assert len(set(read(path, "thing")[0])) == 1 and list(tmp_path.iterdir()) == [path]
    (tmp_path / "plain").touch()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_killed_writer_leaves_what_can_be_swept_away(tmp_path):
    script = "import os, sys, signal, pathlib, numpy; from sb3_ddiffpg.serialization import safetensors_tree\n"
    script += "safetensors_tree.os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)\n"
    script += "safetensors_tree.write(pathlib.Path(sys.argv[1]), 'thing', [numpy.zeros(1000)])"
    done = subprocess.run([sys.executable, "-c", script, tmp_path / "a_1.x"])
    assert done.returncode == -9 and len(list(tmp_path.rglob("*"))) >= 2
    own = tmp_path / f".a_2.x.{os.getpid()}.abc"
    another = tmp_path / f".a_3.x.{os.getppid()}.abc"
    for place in (own, another):
        place.mkdir()
    remove_unfinished(tmp_path, "a_*.x")
    assert list(tmp_path.rglob("*")) == [another]


def test_only_plain_values_go_in(tmp_path):
    for bad, place in (({"a": [1, {2}]}, "/a/1"), ({"a": {1: 2}}, "/a"), ({"$array": "x"}, ""), ([np.array(["x"])], "/0")):
        with pytest.raises(TypeError, match=f"^{place}: "):
            write(tmp_path / "file", "thing", bad)
    assert not list(tmp_path.iterdir())


@given(data=st.data())
@settings(max_examples=100, deadline=None)
def test_one_changed_byte_is_found(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("tree") / "file"
    write(path, "thing", {"numbers": np.arange(5), "word": "abc"})
    raw = bytearray(path.read_bytes())
    place = data.draw(st.integers(0, len(raw) - 1))
    raw[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(raw)
    with pytest.raises(ValueError, match="file"):
        read(path, "thing")


def test_what_it_says_it_is(tmp_path):
    path = tmp_path / "file"
    write(path, "thing", [1])
    with pytest.raises(ValueError, match="holds a 'thing', not a 'model'"):
        read(path, "model")
    save_file({"x": np.zeros(3)}, path)
    with pytest.raises(ValueError, match="no file of sb3_ddiffpg"):
        read(path, "thing")
    save_file({"x": np.zeros(3)}, path, {"format": "sb3_ddiffpg", "version": "7"})
    with pytest.raises(ValueError, match="of version '7'; this sb3_ddiffpg reads version 1"):
        read(path, "thing")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read(tmp_path / "nowhere", "thing")


# ------------------------------------------------------------------ models


def test_exported_models_act_the_same(trained, tmp_path):
    path = tmp_path / "model.safetensors"
    trained.export(path)
    loaded = DDiffPG.load(path, safe=True)
    for mode in (None, *trained.modes.names):
        expected = trained.predict(some_observations(), deterministic=True, mode=mode)[0]
        np.testing.assert_array_equal(loaded.predict(some_observations(), deterministic=True, mode=mode)[0], expected)
    assert str(loaded.modes) == str(trained.modes) and str(loaded.mode_history) == str(trained.mode_history)
    assert [mode.outcomes for mode in loaded.modes] == [mode.outcomes for mode in trained.modes]
    assert loaded.visits._counts == trained.visits._counts if trained.visits else loaded.visits is None
    assert loaded.get_env() is None and loaded.num_timesteps == trained.num_timesteps
    loaded = DDiffPG.load(path, env=DummyVecEnv([TwoEnds] * 2), safe=True, batch_size=16)
    assert loaded.batch_size == 16
    loaded.learn(60)


def test_with_optimizers_training_goes_on_the_same(trained, tmp_path):
    trained.export(tmp_path / "half")
    trained.export(tmp_path / "whole", optimizers=True)
    trained.save(tmp_path / "zip")
    assert_same_state(state_of(DDiffPG.load(tmp_path / "whole", safe=True)), state_of(DDiffPG.load(tmp_path / "zip")))
    assert (tmp_path / "half").stat().st_size < 0.7 * (tmp_path / "whole").stat().st_size


@pytest.mark.parametrize("name", sorted(BASELINES))
def test_baselines(tmp_path, name):
    env = DummyVecEnv([TwoEnds] * 2)
    model = BASELINES[name]("MlpPolicy", env, learning_starts=10, policy_kwargs={"net_arch": [8]}, seed=0)
    model.learn(40)
    model.export(tmp_path / "model", optimizers=True)
    loaded = BASELINES[name].load(tmp_path / "model", safe=True)
    assert_same_state(state_of(loaded), state_of(model))
    with pytest.raises(ValueError, match=f"holds a {type(model).__name__}: load it with that class, not with DDiffPG"):
        DDiffPG.load(tmp_path / "model", safe=True)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (3,), dtype=np.float64),
        spaces.Box(np.array([-np.inf, 0.0]), np.array([1.0, np.inf])),
        spaces.Discrete(5),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(3),
        image_dict_space(),
    ],
    ids=lambda space: type(space).__name__,
)
def test_spaces(space, tmp_path):
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy"
    model = small_model(DummyVecEnv([lambda: AnySpaces(space)]), policy)
    model.export(tmp_path / "model")
    loaded = DDiffPG.load(tmp_path / "model", safe=True)
    assert loaded.observation_space == model.observation_space and loaded.action_space == model.action_space
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        DDiffPG.load(tmp_path / "model", env=DummyVecEnv([lambda: AnySpaces(spaces.Box(-5, 5, (9,)))]), safe=True)


@pytest.mark.parametrize("name", ["ddiffpg", *BASELINES])
def test_parts_of_an_observation_keep_their_order(tmp_path, name):
    """Gymnasium sorts them where they come in a dict; the networks were made for the order that there was."""
    algorithm = DDiffPG if name == "ddiffpg" else BASELINES[name]
    box = spaces.Box(-1.0, 1.0, (2,))
    space = spaces.Dict([("observation", box), ("achieved_goal", box), ("desired_goal", box)])
    env = DummyVecEnv([lambda: AnySpaces(space)] * 2)
    model = algorithm("MultiInputPolicy", env, learning_starts=10, buffer_size=500, policy_kwargs={"net_arch": [8]}, seed=0)
    model.learn(40, callback=RunCheckpointCallback(tmp_path / "run"))
    model.export(tmp_path / "model")
    observations = {key: np.random.default_rng(i).uniform(-1, 1, (3, 2)) for i, key in enumerate(space.spaces)}
    expected = model.predict(observations, deterministic=True)[0]
    for loaded in (
        algorithm.load(tmp_path / "model", safe=True),
        algorithm.load(tmp_path / "model", env=env, safe=True),
        algorithm.resume(tmp_path / "run", env),
    ):
        assert list(loaded.observation_space.spaces) == ["observation", "achieved_goal", "desired_goal"]
        np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], expected)


def test_statistics_that_no_observations_have(tmp_path):
    model = small_model(VecNormalize(DummyVecEnv([TwoEnds] * 2), norm_reward=False)).learn(40)
    env = DummyVecEnv([TwoEnds] * 2)
    for place, value, said in (
        (("statistics", "observations", "", "count"), float("inf"), "numbers that no observations have"),
        (("statistics", "observations", "", "var"), np.full(2, np.inf), "numbers that no observations have"),
        (("statistics", "observations", "", "mean"), np.full(2, 1e308), "numbers that no observations have"),
        (("settings", "gamma"), 5.0, "gamma"),
        (("settings", "epsilon"), float("nan"), "epsilon"),
        (("settings", "norm_obs"), "x", "norm_obs"),
    ):
        tree = copied(model_tree(model))
        _set(tree, ("normalizer", *place), value)
        with pytest.raises(ValueError, match=said):
            build_model(DDiffPG, tree, env)


def test_normalisation_at_the_edges(tmp_path):
    env = VecNormalize(DummyVecEnv([TwoEnds] * 2), gamma=0.0, epsilon=0.0, clip_obs=np.inf)
    small_model(env).learn(40).export(tmp_path / "model")
    loaded = DDiffPG.load(tmp_path / "model", env=DummyVecEnv([TwoEnds] * 2), safe=True).get_vec_normalize_env()
    assert (loaded.gamma, loaded.epsilon, loaded.clip_obs) == (0.0, 0.0, np.inf)


def test_normalised_observations(tmp_path):
    env = VecNormalize(DummyVecEnv([TwoEnds] * 2), norm_reward=False, clip_obs=7.0)
    model = small_model(env)
    model.learn(80)
    model.export(tmp_path / "model")
    loaded = DDiffPG.load(tmp_path / "model", env=DummyVecEnv([TwoEnds] * 2), safe=True)
    normalizer = loaded.get_vec_normalize_env()
    assert normalizer.clip_obs == 7.0 and not normalizer.norm_reward
    for name in ("mean", "var", "count"):
        np.testing.assert_array_equal(getattr(normalizer.obs_rms, name), getattr(env.obs_rms, name))
    with pytest.warns(UserWarning, match="normalised observations: give env="):
        DDiffPG.load(tmp_path / "model", safe=True)


def test_schedules_and_noise(tmp_path):
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    schedules = {"learning_rate": LateLinearSchedule(1e-3), "qf_learning_rate": LinearSchedule(1e-3, 1e-4, 0.5)}
    model = small_model(DummyVecEnv([TwoEnds]), action_noise=noise, **schedules)
    model.export(tmp_path / "model")
    loaded = DDiffPG.load(tmp_path / "model", safe=True)
    for progress in (1.0, 0.4, 0.0):
        assert loaded.lr_schedule(progress) == model.lr_schedule(progress)
        assert loaded._qf_schedule(progress) == model._qf_schedule(progress)
    np.testing.assert_array_equal(loaded.action_noise._sigma, noise._sigma)


def test_code_is_given_again(tmp_path):
    def rate(progress):
        return 1e-3 * progress

    model = small_model(DummyVecEnv([TwoEnds]), learning_rate=rate)
    model.export(tmp_path / "model")
    with pytest.raises(ValueError, match=r"learning_rate is code .*custom_objects={'learning_rate': ...}"):
        DDiffPG.load(tmp_path / "model", safe=True)
    loaded = DDiffPG.load(tmp_path / "model", safe=True, custom_objects={"learning_rate": rate})
    assert loaded.lr_schedule(0.5) == 5e-4


# ------------------------------------------------------------------ strangers

RAN = []


def evil():
    RAN.append("evil")


class Evil:
    def __reduce__(self):
        return evil, ()


def evil_zip(trained, path):
    """SB3's own format with code in a field of ``data``."""
    trained.save(path)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(parts["data"])
    data["learning_rate"] = {":type:": "Evil", ":serialized:": __import__("base64").b64encode(pickle.dumps(Evil())).decode()}
    parts["data"] = json.dumps(data).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, part in parts.items():
            archive.writestr(name, part)


def test_code_in_a_zip_a_buffer_or_a_normalizer_is_not_run(trained, tmp_path):
    """SB3's three ways in (its issue 2281). That they are ways in is shown as well."""
    evil_zip(trained, tmp_path / "model.zip")
    (tmp_path / "buffer.pkl").write_bytes(pickle.dumps(Evil()))
    (tmp_path / "vecnormalize.pkl").write_bytes(pickle.dumps(Evil()))
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(ValueError, match="damaged, or no file|was written by save, and may hold code"):
            DDiffPG.load(path, safe=True)
        with pytest.raises(ValueError, match="damaged, or no file"):
            DDiffPG.resume(path, DummyVecEnv([TwoEnds] * 4))
    assert not RAN
    with pytest.raises(Exception):  # noqa: B017 - whatever it trips over, it has run by then
        DDiffPG.load(tmp_path / "model.zip")
    assert RAN == ["evil"]
    RAN.clear()


def _set(tree, place, value):
    for key in place[:-1]:
        tree = tree[key]
    if value is None:
        del tree[place[-1]]
    else:
        tree[place[-1]] = value


@pytest.mark.parametrize("name", ["nan", "inf"])
def test_weights_that_are_no_numbers_are_refused(trained, name):
    for part in ("actor.diffusion.denoiser.action_in.weight", "mode_embeddings", "critics.weights.0"):
        tree = read_back(trained)
        tree["parameters"]["policy"][part].flat[0] = float(name)
        with pytest.raises(ValueError, match=f"{part}: there are numbers that are not finite"):
            build_model(DDiffPG, tree)


def test_records_that_no_training_makes_are_refused(trained):
    """What would fail, or do harm, only when training has begun."""
    of_optimizer, of_modes = ("parameters", "actor.optimizer"), ("state", "parts", "modes")
    of_exploration = ("arguments", "exploration", "dict")
    for place, value, said in (
        (("state", "counters", "_steps_before"), 2**70, "_steps_before"),
        (("state", "counters", "num_timesteps"), -1, "num_timesteps"),
        (("state", "counters", "_current_progress_remaining"), float("nan"), "_current_progress_remaining"),
        ((*of_modes, "modes", 0, "number"), 2**63, "modes"),
        ((*of_modes, "modes", 0, "number"), -1, "modes"),
        ((*of_modes, "modes", 0, "born_at"), -1, "modes"),
        ((*of_modes, "modes", 0, "name"), "mode_77", "reserved"),
        ((*of_modes, "modes", 0, "name"), " x", "no name"),
        ((*of_modes, "modes", 0, "representative"), np.full((4, 1), np.nan, dtype=np.float32), "representative"),
        ((*of_modes, "modes", 0, "representative"), np.zeros((4, 3), dtype=np.float32), "representative"),
        ((*of_optimizer, "state", "0", "exp_avg"), np.full((16, 1), np.nan, dtype=np.float32), "exp_avg"),
        ((*of_optimizer, "state", "0", "exp_avg_sq"), np.full((16, 1), -1.0, dtype=np.float32), "exp_avg_sq"),
        ((*of_optimizer, "state", "0", "step"), np.array(-1e9, dtype=np.float32), "step"),
        ((*of_optimizer, "state", "0", "exp_avg"), None, "gathered"),
        ((*of_optimizer, "state", "77"), {}, "none of its"),
        ((*of_optimizer, "groups", 0, "amsgrad"), True, "gathered"),
        ((*of_optimizer, "groups", 0, "differentiable"), True, "optimizer"),
        ((*of_optimizer, "groups", 0, "eps"), float("nan"), "accepted are numbers"),
        ((*of_optimizer, "groups", 0, "eps"), 10**400, "accepted are numbers"),
        ((*of_optimizer, "groups", 0, "weight_decay"), 1e300, "accepted are numbers"),
        ((*of_modes, "next_number"), -1, "modes"),
        ((*of_modes, "next_number"), 1, "not below 1"),
        ((*of_exploration, "share"), {"class": "torch.optim.Adam"}, "exploration.share"),
        ((*of_exploration, "off_modes"), "False", "exploration.off_modes"),
        (("arguments", "exploration_share"), {"class": "torch.optim.Adam"}, "exploration.share"),  # of version 0.1
        ((*of_optimizer, "groups", 0, "weight_decay"), -1.0, "weight_decay"),
        ((*of_optimizer, "groups", 0, "betas"), {"tuple": [1.0, 1.0]}, "beta"),
        ((*of_optimizer, "groups", 0, "betas"), {"tuple": ["x", "y"]}, "optimizer"),
    ):
        tree = copied(model_tree(trained))
        shape = np.shape(tree["parameters"]["actor.optimizer"]["state"]["0"]["exp_avg"])
        if isinstance(value, np.ndarray) and place[-1].startswith("exp"):
            value = np.broadcast_to(value.flat[0], shape).copy()
        _set(tree, place, value)
        with pytest.raises(ValueError, match=said):
            build_model(DDiffPG, tree)


class ReadsValues(BaseFeaturesExtractor):
    """Somebody's own, whose constructor looks at values, and which has a mask of infinities."""

    def __init__(self, observation_space, mean=()):
        super().__init__(observation_space, 2)
        assert float(th.from_numpy(observation_space.sample()).abs().sum()) >= 0 and th.ones(2).sum().item() == 2
        self.register_buffer("mask", th.full((2,), -float("inf")))

    def forward(self, observations):
        return observations


def test_networks_of_ones_own_are_made_as_they_are(trained, tmp_path):
    kwargs = {"net_arch": [16], "features_extractor_class": ReadsValues, "features_extractor_kwargs": {"mean": [0.0] * 500}}
    model = small_model(DummyVecEnv([TwoEnds]), policy_kwargs=kwargs)
    model.export(tmp_path / "model")
    loaded = DDiffPG.load(tmp_path / "model", safe=True, custom_objects={"policy_kwargs": kwargs})
    obs = some_observations()
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])


@pytest.mark.parametrize("look", [th.Tensor.item, th.Tensor.numpy])
def test_a_policy_of_ones_own_is_made_as_it_is_once_its_arguments_are_given(tmp_path, look):
    class LooksAtValues(DiffusionPolicy):
        """Somebody's own, for which the size of its networks cannot be told beforehand."""

        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            assert look(next(self.actor.parameters()).detach().sum()) != 0

    custom = {"policy": LooksAtValues, "policy_kwargs": {"net_arch": [16]}}
    model = DDiffPG(LooksAtValues, DummyVecEnv([TwoEnds]), policy_kwargs={"net_arch": [16]})
    model.export(tmp_path / "model")
    with pytest.raises(ValueError, match=r"needs custom_objects={'policy_kwargs': ...} too"):
        DDiffPG.load(tmp_path / "model", safe=True, custom_objects={"policy": LooksAtValues})
    loaded = DDiffPG.load(tmp_path / "model", safe=True, custom_objects=custom)
    assert isinstance(loaded.policy, LooksAtValues)
    obs = some_observations()
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])


def test_a_policy_of_ones_own_does_not_let_a_small_file_ask_for_all_of_the_memory(tmp_path):
    tree = read_back(small_model(DummyVecEnv([TwoEnds]), novelty="rnd"))
    tree["arguments"]["novelty"]["dict"]["kwargs"] = {"dict": {"net_arch": [10**6, 10**6]}}
    with pytest.raises(ValueError, match=r"model.parameters.bonus.novelty_model.*accepted is"):
        build_model(DDiffPG, tree, custom_objects={"policy_kwargs": {"net_arch": [16]}})


def test_a_schedule_of_ones_own_does_not_let_a_small_file_ask_for_all_of_the_memory(trained):
    tree = read_back(trained)
    tree["arguments"]["policy_kwargs"] = {"dict": {"net_arch": [10**6, 10**6]}}
    with pytest.raises(ValueError, match="accepted is"):
        build_model(DDiffPG, tree, custom_objects={"learning_rate": lambda _: 1e-3})


def test_what_older_files_do_not_have_begins_anew(trained):
    tree = copied(model_tree(trained))
    del tree["state"]["counters"]["n_rollouts"]
    for group in tree["parameters"]["actor.optimizer"]["groups"]:
        group["fused"] = None  # of another machine
    model = build_model(DDiffPG, tree)
    assert model.n_rollouts == 0 and model.actor.optimizer.param_groups[0]["fused"] is True


def test_names_of_other_classes_are_refused(trained, tmp_path):
    for value in (
        {"class": "os.system"},
        {"class": "torch.load"},
        {"class": "torch.nn.Module"},
        {"class": "sb3_ddiffpg.noise.np"},
        {"object": "subprocess.Popen", "state": {"args": "ls"}},
        {"object": "torch.nn.ReLU", "state": {}},
        {"object": "sb3_ddiffpg.common.schedules.LateLinearSchedule", "state": {"__class__": 1}},
        {"object": "sb3_ddiffpg.common.schedules.LateLinearSchedule", "state": {"__call__": 1}},
        {"other": 1},
        {"tuple": [1], "class": "torch.nn.ReLU"},
    ):
        with pytest.raises(ValueError, match="no value that is saved here|may name|no attribute"):
            from_plain(value)
        tree = model_tree(trained)
        tree["arguments"]["policy_kwargs"] = {"dict": {"activation_fn": value}}
        with pytest.raises(ValueError, match="policy_kwargs"):
            build_model(DDiffPG, tree)


@given(value=st.recursive(PLAIN, lambda each: st.lists(each) | st.tuples(each, each) | st.dictionaries(KEYS, each)))
@settings(max_examples=100, deadline=None)
def test_plain_arguments(value):
    assert from_plain(to_plain(value)) == value


def test_an_array_where_a_mapping_belongs():
    with pytest.raises(ValueError, match="it: Expected `object`"):
        convert(np.zeros(3), dict[str, int], "it")


def read_back(model):
    return copied(model_tree(model))


def test_names_with_slashes_are_not_mixed_up(tmp_path):
    tree = {"a/b": np.zeros(2), "a": {"b": np.ones(3), "~1": np.ones(1)}, "a~1b": np.ones(4), "a~": {"1b": np.ones(5)}}
    write(tmp_path / "file", "model", tree)
    found = read(tmp_path / "file", "model")
    assert [len(each) for each in (found["a/b"], found["a"]["b"], found["a"]["~1"], found["a~1b"], found["a~"]["1b"])] == [
        *(2, 3, 1, 4, 5)
    ]


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="No such file or directory"):
        write(tmp_path / "nowhere" / "file", "model", {"a": np.zeros(2)})


def test_normalisation_below_another_wrapper_is_found(tmp_path):
    """A second one around it would normalise twice."""
    env = VecNormalize(DummyVecEnv([TwoEnds] * 2), norm_reward=False)
    model = small_model(env)
    model.learn(60)
    model.export(tmp_path / "model")
    below = VecNormalize(DummyVecEnv([TwoEnds] * 2), norm_reward=False)
    loaded = DDiffPG.load(tmp_path / "model", env=VecMonitor(below), safe=True)
    assert loaded.get_vec_normalize_env() is below
    np.testing.assert_array_equal(below.obs_rms.mean, env.obs_rms.mean)


@pytest.mark.parametrize(
    "place, value, message",
    [
        (("n_envs",), 10**9, "model.n_envs: 1000000000 given; accepted is 1 to 65536"),
        (("n_envs",), 0, "model.n_envs: 0 given"),
        (("arguments", "n_diffusion_steps"), 10**7, "n_diffusion_steps"),
        (("arguments", "policy_kwargs"), {"dict": {"net_arch": [0]}}, "of at least one unit each"),
        (("observation_space",), {"kind": "Discrete", "n": [10**9, 0]}, "accepted is .*1000000005"),
        (("observation_space",), {"kind": "MultiDiscrete", "n": [10**8, 10**8]}, "accepted is .*200000005"),
        (("observation_space",), {"kind": "MultiBinary", "shape": [2**24]}, "accepted is .*16777221"),
        (("observation_space", "dtype"), "f4,(1 1)f4", "space: bounds of shapes .*f4"),
        (("policy",), "LstmPolicy", "'LstmPolicy' given; accepted are"),
        (("arguments", "replay_buffer_kwargs"), {"dict": {"n_path_points": 10**9}}, "n_path_points: 1000000000 given"),
        (("arguments", "train_freq"), {"tuple": [0, "step"]}, "train_freq must be"),
        (("arguments", "train_freq"), {"tuple": [10**12, "step"]}, "train_freq: 1000000000000 given"),
        (("arguments", "train_freq"), 10**12, "train_freq: 1000000000000 given"),
        (("arguments", "gamma"), 2**70, "gamma must lie"),
        (("arguments", "target_action", "dict", "n_steps"), 10**9, "target_action.n_steps: 1000000000 given"),
        (("arguments", "n_action_gradient_steps"), 10**9, "target_action.n_steps: 1000000000 given"),  # of version 0.1
        (("arguments", "batch_size"), 10**12, "batch_size: 1000000000000 given"),
        (("arguments", "policy_kwargs"), {"dict": {"net_arch": [1] * 30_000}}, "30000 layers for a file of"),
    ],
)
def test_a_file_cannot_ask_for_sizes_that_make_no_model(trained, place, value, message):
    tree = read_back(trained)
    node = tree
    for key in place[:-1]:
        node = node[key]
    node[place[-1]] = value
    with pytest.raises(ValueError, match=message):
        build_model(DDiffPG, tree)


def test_a_small_file_cannot_ask_for_all_of_the_memory(trained):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for place, value in (
        (("policy_kwargs",), {"dict": {"net_arch": [10**6, 10**6]}}),
        (("policy_kwargs",), {"dict": {"net_arch": [10**12]}}),
        (("policy_kwargs",), {"dict": {"net_arch": [30_000] * 40}}),
        (("critic", "dict", "n_atoms"), 10**12),
        (("critic", "dict", "n_atoms"), 10**7),
        (("critic", "dict", "n_critics"), 10**12),
        (("modes", "dict", "embedding_dim"), 10**12),
        (("novelty", "dict", "kwargs"), {"dict": {"net_arch": {"tuple": [10**6, 10**6]}}}),
        (("n_atoms",), 10**12),  # of version 0.1
        (("mode_embedding_dim",), 10**12),
        (("novelty_kwargs",), {"dict": {"net_arch": {"tuple": [10**6, 10**6]}}}),
    ):
        tree = read_back(trained)
        _set(tree, ("arguments", *place), value)
        with pytest.raises(ValueError, match="accepted is|make no DDiffPG"):
            build_model(DDiffPG, tree)
    tree = read_back(trained)
    part = tree["state"]["parts"]["modes"]
    part["modes"] = [{**copied(part["modes"][0]), "number": i, "name": f"m{i}"} for i in range(3000)]
    part["next_number"] = 3000
    with pytest.raises(ValueError, match="accepted is"):
        build_model(DDiffPG, tree)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 500_000  # kB


def test_the_file_is_readable_by_others(trained, tmp_path):
    """Weights and settings are where safetensors and JSON put them."""
    trained.export(tmp_path / "model.safetensors")
    arrays = load_file(tmp_path / "model.safetensors")
    embeddings = arrays["/parameters/policy/mode_embeddings"]
    np.testing.assert_array_equal(embeddings[1:], [mode.embedding for mode in trained.modes])
