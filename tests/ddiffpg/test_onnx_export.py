"""A policy without torch: an exported file against ``predict``, through onnxruntime."""

import builtins
import json
import subprocess
import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import TwoEnds, small_model
from gymnasium import spaces
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

import sb3_ddiffpg
from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.ddiffpg import onnx_export
from sb3_ddiffpg.networks.critics import ALL_GROUPS, ModeCritics

onnxruntime = pytest.importorskip("onnxruntime")
EXAMPLE = Path(__file__).parents[2] / "examples" / "control_loop.py"
# The first of five steps of denoising magnifies the noise that is predicted by 103, with float32's rounding of it (2 ** -23)
CLOSE = 1e-5 + 103 * 2**-23


class OddUnits(gym.Env):
    """A point that goes to one of two ends: a dict of numbers far from 0, in float64, and actions in a range of their own."""

    def __init__(self):
        whole = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.observation_space = spaces.Dict(here=whole, turned=spaces.Discrete(3), switches=spaces.MultiBinary(2))
        self.action_space = spaces.Box(np.array([[2.0, -500.0]]), np.array([[4.0, 0.0]]), dtype=np.float64)
        self.mode_features = "here"

    def _observation(self):
        far = 1e4 + 300.0 * np.array([self.x, self.steps / 8])
        return {"here": far, "turned": self.steps % 3, "switches": np.array([self.x > 0, self.x < 0], dtype=np.int8)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = 0.0, 0
        return self._observation(), {}

    def step(self, action):
        self.x += 0.5 * (float(action[0, 0]) - 3.0)
        self.steps += 1
        reached = abs(self.x) >= 1
        return self._observation(), float(reached), reached, self.steps >= 8, {"is_success": reached}


def session(path):
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


def about(path):
    return {key: json.loads(value) for key, value in session(path).get_modelmeta().custom_metadata_map.items()}


def sampled(space, n):
    """By name of the input, and as ``predict`` takes them; always the same."""
    space.seed(0)
    if isinstance(space, spaces.Dict):
        drawn = {key: np.stack([np.asarray(each.sample()) for _ in range(n)]) for key, each in space.spaces.items()}
        return {f"observation.{key}": each for key, each in drawn.items()}, drawn
    drawn = np.stack([space.sample() for _ in range(n)])
    return {"observation": drawn}, drawn


def noise_of(path, n, n_samples):
    """Without chance: no noise for the first action, and what the file says for the others."""
    known = np.array(about(path)["deterministic_noise"], np.float32)
    assert known.shape[0] == 4 and not known[0].any() and known[1:].all()
    return np.tile(known[None, :n_samples], (n, 1, 1, 1))


def assert_equal_actions(found, expected, half, values=None):
    """
    Actions in a range of twice ``half``, of many observations. Where one of several was chosen, by ``values`` of actions, a
    rounding may choose another that is liked as well.
    """
    assert found.shape == expected.shape
    apart = np.abs(found - expected) / half
    assert np.quantile(apart, 0.5 if values else 0.99) < 1e-5
    others = apart.reshape(len(found), -1).max(axis=1) >= CLOSE
    if values:
        of_found, of_expected = values(found)[others], values(expected)[others]
        assert np.abs(of_found - of_expected).max(initial=0.0) < 1e-5 * np.abs(of_expected).max(initial=1.0)
    else:
        assert not others.any()


def values_by(model, observations, mode, actions):
    """What the mode's critics expect of actions, those of the mode that expects most without one."""
    policy = model.policy
    with th.no_grad():
        features = policy.actor.extract_features(policy.obs_to_tensor(observations)[0], policy.critic_features_extractor)
        scaled = th.as_tensor(policy.scale_action(actions).astype(np.float32)).flatten(1)
        values = policy.critics.values_by(ALL_GROUPS, features, scaled).numpy()
    anybody = values[1:].max(axis=0) if len(values) > 1 else values[0]
    return anybody if mode is None else values[mode + 1]


def assert_equal_to_predict(model, path, inputs, observations):
    """For every mode, and for none."""
    run, n = session(path), len(next(iter(inputs.values())))
    half = (model.action_space.high - model.action_space.low) / 2
    for mode in [None, *range(len(model.modes))]:
        for n_samples in (1, 4):
            given = {**inputs, "mode": np.full(n, -1 if mode is None else mode), "noise": noise_of(path, n, n_samples)}
            (found,) = run.run(["action"], given)
            expected, _ = model.predict(observations, deterministic=True, mode=mode, n_samples=n_samples)
            values = partial(values_by, model, observations, mode) if n_samples > 1 else None
            assert_equal_actions(found, expected, half, values)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    model = small_model(DummyVecEnv([TwoEnds] * 4), policy_kwargs={"net_arch": [32, 32]}).learn(600)
    assert len(model.modes) == 2
    model.rename_mode(0, "to the left")
    path = tmp_path_factory.mktemp("onnx") / "model.onnx"
    model.export_onnx(path)
    return model, path


def test_numbers(exported):
    model, path = exported
    assert_equal_to_predict(model, path, *sampled(model.observation_space, 1000))
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_what_is_exported_before_anything_else_is_asked():
    """Nothing that the exporter traces may be kept: with as many modes as no other model of this process has."""
    model = small_model(DummyVecEnv([TwoEnds] * 4), policy_kwargs={"net_arch": [32, 32]})
    model.policy.resize(9)
    graph = onnx_export.PolicyGraph(model.policy, None)
    onnx_export._exported(onnx_export.with_exact_activations(graph), onnx_export._example(graph))
    for critics in (model.policy.critics, ModeCritics(3, 1, [8], n_groups=10)):
        values = critics.values(th.randn(10, 2, 5, critics.n_atoms))
        assert type(values) is th.Tensor and values.isfinite().all()


def test_noise_is_an_input(exported):
    """By denoising with the same noise: [T, N, A] there, [N, 1, T, A] in the file."""
    model, path = exported
    inputs, observations = sampled(model.observation_space, 50)
    noise, modes = np.random.standard_normal((50, 1, 5, 1)).astype(np.float32), np.arange(50) % 3 - 1
    (found,) = session(path).run(["action"], {**inputs, "mode": modes, "noise": noise})
    embeddings = model.policy.group_embeddings(np.where(modes < 0, -1, modes + 1))
    with th.no_grad():
        condition = model.policy.actor.condition(th.as_tensor(observations), embeddings)
        expected = model.policy.actor.diffusion.denoise(condition, noise=th.as_tensor(noise[:, 0]).transpose(0, 1))
    np.testing.assert_allclose(found, expected.numpy(), rtol=0, atol=CLOSE)
    assert len(np.unique(found)) > 30


def test_a_flow_takes_one_draw_for_each_action(tmp_path):
    model, path = small_model(DummyVecEnv([TwoEnds] * 4), n_diffusion_steps=None).learn(600), tmp_path / "model.onnx"
    model.export_onnx(path)
    assert about(path)["n_diffusion_steps"] is None and np.shape(about(path)["deterministic_noise"]) == (4, 1, 1)
    assert_equal_to_predict(model, path, *sampled(model.observation_space, 100))


def test_the_file_says_what_it_is(exported):
    model, path = exported
    said = about(path)
    assert said["sb3_ddiffpg"] == sb3_ddiffpg.__version__ and said["n_diffusion_steps"] == 5
    assert said["observation_space"] == {"shape": [2], "dtype": "float32", "low": -2.0, "high": 2.0}
    assert said["action_space"] == {"shape": [1], "dtype": "float32", "low": -1.0, "high": 1.0}
    first = model.modes[0]
    assert [each["name"] for each in said["modes"]] == model.modes.names and said["modes"][0] == {
        "name": "to the left",
        "success_rate": first.success_rate,
        "mean_return": first.mean_return,
        "mean_length": first.mean_length,
    }


def test_one_mode_alone(exported, tmp_path):
    model, _ = exported
    alone = tmp_path / "left.onnx"
    random = np.random.get_state()[1].copy(), th.random.get_rng_state()
    model.export_onnx(alone, mode="to the left")
    assert (np.random.get_state()[1] == random[0]).all() and th.equal(th.random.get_rng_state(), random[1])
    assert [each.name for each in session(alone).get_inputs()] == ["observation", "noise"]
    inputs, observations = sampled(model.observation_space, 1000)
    for n_samples in (1, 4):
        (found,) = session(alone).run(["action"], {**inputs, "noise": noise_of(alone, 1000, n_samples)})
        expected, _ = model.predict(observations, deterministic=True, mode=0, n_samples=n_samples)
        assert_equal_actions(found, expected, 1.0, partial(values_by, model, observations, 0) if n_samples > 1 else None)
    assert [each["name"] for each in about(alone)["modes"]] == ["to the left"]
    with pytest.raises(ValueError, match="mode='to the right' is unknown"):
        model.export_onnx(tmp_path / "none.onnx", mode="to the right")
    assert not (tmp_path / "none.onnx").exists()


def test_normalised_observations_in_a_dict_and_actions_in_a_range(tmp_path):
    env = VecNormalize(DummyVecEnv([OddUnits] * 4), norm_obs_keys=["here"])
    model = small_model(env, "MultiInputPolicy").learn(2400)
    env.training = False
    model.export_onnx(tmp_path / "model.onnx")
    assert len(model.modes)
    inputs, observations = sampled(env.observation_space, 200)
    observations["here"] = inputs["observation.here"] = 1e4 + 300.0 * np.random.default_rng(0).uniform(-1, 1, (200, 2))
    # As the environment gives them, of which ``predict`` gets what the normaliser makes
    assert_equal_to_predict(model, tmp_path / "model.onnx", inputs, env.normalize_obs(observations))
    said = about(tmp_path / "model.onnx")
    assert said["action_space"] == {"shape": [1, 2], "dtype": "float64", "low": [2.0, -500.0], "high": [4.0, 0.0]}
    assert said["observation_space"]["here"] == {"shape": [2], "dtype": "float64", "low": None, "high": None}
    assert said["observation_space"]["turned"] == {"shape": [], "dtype": "int64"}


def test_images(tmp_path):
    env = FakeImageEnv(screen_height=40, screen_width=36, n_channels=3, discrete=False)
    kwargs = {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 8}}
    model = small_model(env, "CnnPolicy", policy_kwargs=kwargs, buffer_size=400, train_freq=8).learn(80)
    model.export_onnx(tmp_path / "model.onnx")
    inputs, observations = sampled(model.observation_space, 20)
    assert_equal_to_predict(model, tmp_path / "model.onnx", inputs, observations)
    assert about(tmp_path / "model.onnx")["observation_space"]["dtype"] == "uint8"


@pytest.mark.parametrize(("ours", "theirs"), [(onnx_export._SiLU(), nn.SiLU()), (onnx_export._Mish(), nn.Mish())])
def test_activations_that_onnxruntime_computes_exactly(ours, theirs):
    values = th.cat((th.linspace(-200, 200, 4001), th.linspace(-3, 3, 4001)))
    th.testing.assert_close(ours(values), theirs(values), rtol=1e-6, atol=1e-7)


def test_a_file_that_would_act_otherwise_is_not_written(exported, tmp_path, monkeypatch):
    model, _ = exported
    path = tmp_path / "model.onnx"
    path.write_bytes(b"before")
    monkeypatch.setattr(onnx_export, "_EXACT", {nn.SiLU: nn.ReLU})
    with pytest.raises(RuntimeError, match=r"differ from torch's by up to .*: nothing is written"):
        model.export_onnx(path)
    assert path.read_bytes() == b"before" and [each.name for each in tmp_path.iterdir()] == ["model.onnx"]


def test_without_the_extra(exported, tmp_path, monkeypatch):
    known = builtins.__import__

    def missing(name, *args, **kwargs):
        if name == "onnxscript":
            raise ImportError("No module named 'onnxscript'")
        return known(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ImportError, match=r"pip install 'sb3_ddiffpg\[onnx\]'"):
        exported[0].export_onnx(tmp_path / "model.onnx")


def test_the_control_loop_needs_numpy_and_onnxruntime_alone(exported):
    """Run with nothing else: it changes modes, and says how well it kept its rate."""
    script = (
        "import runpy, sys\n"
        "sys.argv[0] = sys.argv.pop(1)\n"
        "runpy.run_path(sys.argv[0], run_name='__main__')\n"
        "print(sorted({'torch', 'gymnasium', 'stable_baselines3', 'sb3_ddiffpg'} & set(sys.modules)))\n"
    )
    command = [sys.executable, "-c", script, str(EXAMPLE), str(exported[1]), *("--seconds", "0.3", "--switch-every", "0.1")]
    said = subprocess.run(command, capture_output=True, text=True, check=True, cwd="/").stdout
    assert (
        said.startswith(f"modes: {', '.join(exported[0].modes.names)}\n")
        and "60 steps at 200 Hz" in said
        and said.endswith("[]\n")
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", sorted(Path(__file__).parents[2].glob("results/*/seed0/model.zip")), ids=lambda p: p.parts[-3]
)
def test_recorded_models(path, tmp_path):
    """Where they are used: at observations of the size that they have seen."""
    model = DDiffPG.load(path)
    model.export_onnx(tmp_path / "model.onnx")
    inputs, observations = sampled(spaces.Box(-1.0, 1.0, model.observation_space.shape), 1000)
    assert_equal_to_predict(model, tmp_path / "model.onnx", inputs, observations)
