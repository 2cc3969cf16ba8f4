"""Files that version 0.1 wrote are loaded, and what is loaded acts and goes on as it did."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.logger import Logger

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.envs import make_vec_env

FOLDER = Path(__file__).parents[1] / "files_of_0_1"
NAMES = ("consistency_ac", "diffusion_ql", "dipo", "rpg", "sac_c51", "td3_c51")
ALGORITHMS = {"ddiffpg": DDiffPG, "ddiffpg_rnd": DDiffPG, **{name: BASELINES[name] for name in NAMES}}
MAZE = ["#######", "#g.r.g#", "#######"]


@pytest.fixture(params=sorted(ALGORITHMS))
def case(request):
    """Name, algorithm, folder, and what the model did."""
    folder = FOLDER / request.param
    return request.param, ALGORITHMS[request.param], folder, np.load(folder / "acts.npz")


def environments():
    return make_vec_env("PointMazeV1-v0", n_envs=8, seed=0, maze_map=MAZE)


def quiet(load, *args, **kwargs):
    """Of a setting that is gone they say so."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = load(*args, **kwargs)
    model.set_logger(Logger(None, []))
    return model


def assert_acts_as_before(model, acts):
    modes = [name for name in acts.files if name not in ("observations", "none")]
    assert [mode.name for mode in getattr(model, "modes", [])] == modes
    for name in ["none", *modes]:
        # One action for each observation, as in 0.1
        command = ({} if name == "none" else {"mode": name}) | ({"n_samples": 1} if hasattr(model, "modes") else {})
        actions = model.predict(acts["observations"], deterministic=True, **command)[0]
        np.testing.assert_allclose(actions, acts[name], atol=1e-5)


def test_zip(case):
    _, algorithm, folder, acts = case
    model = quiet(algorithm.load, folder / "model.zip", env=environments(), device="cpu")
    assert_acts_as_before(model, acts)
    assert model.num_timesteps == 12_000
    assert len(model.visits) > 10  # where it has been
    model.load_replay_buffer(folder / "replay_buffer.pkl")
    assert model.replay_buffer.size() > 1000
    before = model._n_updates
    model.learn(400, reset_num_timesteps=False)
    assert model._n_updates > before


def test_safe_file(case):
    _, algorithm, folder, acts = case
    model = quiet(algorithm.load, folder / "model.safetensors", safe=True, device="cpu")
    assert_acts_as_before(model, acts)


def test_checkpoint(case):
    _, algorithm, folder, acts = case
    model = quiet(algorithm.resume, folder / "checkpoint_000000012000.safetensors", environments(), device="cpu")
    assert_acts_as_before(model, acts)
    assert model.replay_buffer.size() > 1000
    model.learn(12_400)  # what was left of it, and a little more
    assert model.num_timesteps == 12_400 and model.replay_buffer.size() > 1000


def test_settings(case):
    """Flat attributes have become groups, the values the same in all three files."""
    name, algorithm, folder, _ = case
    loaded = [
        quiet(algorithm.load, folder / "model.zip", device="cpu"),
        quiet(algorithm.load, folder / "model.safetensors", safe=True, device="cpu"),
        quiet(algorithm.resume, folder / "checkpoint_000000012000.safetensors", environments(), device="cpu"),
    ]
    expected = {
        "ddiffpg": [("critic", "v_max", 10), ("modes", "trials", 4000), ("target_action", "optimizer", "normalized")],
        "ddiffpg_rnd": [
            ("novelty", "measure", "rnd"),
            ("novelty", "episodic", False),
            ("critic", "twin_target", "elementwise"),
        ],
        "dipo": [("target_action", "learning_rate", 0.2), ("critic", "v_max", 10)],
        "diffusion_ql": [("critic", "v_max", 10)],
        "consistency_ac": [("novelty", "normalize", False)],
        "rpg": [("critic", "n_atoms", 1), ("novelty", "coef", 0.1)],
        "sac_c51": [("critic", "n_atoms", 1), ("novelty", "clip", 5.0), ("critic", "target_policy_noise", 0.0)],
        "td3_c51": [("critic", "target_policy_noise", 0.2), ("critic", "target_noise_clip", 0.5)],
    }[name]
    for model in loaded:
        for group, setting, value in expected:
            assert getattr(getattr(model, f"{group.removesuffix('s')}_settings"), setting) == value
        assert not any(flat in vars(model) for flat in ("v_max", "novelty", "intrinsic_coef", "action_lr", "_modes"))


def test_a_setting_that_is_gone_is_told():
    with pytest.warns(UserWarning, match="switch_modes, which is no argument any more"):
        DDiffPG.load(FOLDER / "ddiffpg" / "model.zip", device="cpu")


def test_old_names_of_modules_say_where_things_are():
    with pytest.warns(FutureWarning, match=r"sb3_ddiffpg.replanning.Replanner is sb3_ddiffpg.evaluation.replanner.Replanner"):
        from sb3_ddiffpg.replanning import Replanner  # noqa: F401
    with pytest.raises(ImportError), pytest.warns(FutureWarning):
        from sb3_ddiffpg.behavior import Behavior, nothing_of_the_kind  # noqa: F401
