"""Settings that are known to work: what ``from_preset`` makes is what the zoo makes of the same YAML file."""

import argparse

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import pytest
import torch as th
import yaml
from environments import TwoEnds
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG, zoo
from sb3_ddiffpg.baselines import BASELINES, DIPO, TD3C51
from sb3_ddiffpg.common.presets import PRESETS, config_file, preset
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.modes.settings import ModeSettings
from sb3_ddiffpg.networks.settings import CriticSettings
from sb3_ddiffpg.utils.arguments import constructor_arguments, groups_of, settings_attribute
from sb3_ddiffpg.zoo import ModeExperimentManager
from sb3_ddiffpg.zoo.settings import ZOO_KEYS

gym.register_envs(gymnasium_robotics)

ENTRIES = {file: yaml.safe_load(config_file(file).read_text()) for file in ("ddiffpg", "ddiffpg-cpu")}
ALL = [(file, entry) for file, entries in ENTRIES.items() for entry in entries]
# What the zoo's command line says, and what is of the environment
NOT_OF_THE_FILE = {"env", "policy", "device", "verbose", "seed", "tensorboard_log", "_init_setup_model"}
PROGRESS = (1.0, 0.8, 0.3, 0.15, 0.0)


def needs(env_id):
    if env_id.startswith("Franka"):
        pytest.importorskip("pybullet")


def as_the_zoo_makes_it(folder, algo, env_id, file):
    """A model, of one environment."""
    zoo.register()
    manager = ModeExperimentManager(
        argparse.Namespace(),
        algo,
        env_id,
        str(folder),
        config=str(config_file(file)),
        hyperparams={"n_envs": 1},
        device="cpu",
        verbose=0,
    )
    return manager.setup_experiment()[0]


def values_of(rate):
    """Of a learning rate over a training."""
    return [rate(left) if callable(rate) else rate for left in PROGRESS]


def assert_same_model(first, second):
    """All arguments and settings, and networks and buffer of the same make."""
    for name in sorted(constructor_arguments(type(first)) - NOT_OF_THE_FILE - set(groups_of(type(first)))):
        attribute = "_stats_window_size" if name == "stats_window_size" else name
        ours, theirs = getattr(first, attribute), getattr(second, attribute)
        if name == "action_noise":
            assert type(ours) is type(theirs)
        elif name.endswith("learning_rate"):  # of a number the zoo makes a constant schedule
            assert values_of(ours) == values_of(theirs), name
        else:
            assert ours == theirs, name
    for group in groups_of(type(first)):
        attribute = settings_attribute(group)
        assert getattr(first, attribute) == getattr(second, attribute), group
    shapes = [{name: value.shape for name, value in each.policy.state_dict().items()} for each in (first, second)]
    assert shapes[0] == shapes[1] and type(first.policy) is type(second.policy)
    assert type(first.actor.optimizer) is type(second.actor.optimizer)
    assert str(first.policy) == str(second.policy)  # with activations
    th.testing.assert_close(first.policy.critics.upper, second.policy.critics.upper)
    for name in ("buffer_size", "n_path_points", "normalize_distances", "compared_length", "min_direct", "loop_share"):
        assert getattr(first.replay_buffer, name) == getattr(second.replay_buffer, name), name


# ---------------------------------------------------------------------- the same as the zoo


def test_the_ant_on_two_cores(tmp_path):
    """Against the zoo, and against the numbers of the file that were read by hand."""
    expected = as_the_zoo_makes_it(tmp_path, "ddiffpg", "AntMazeV1-v0", "ddiffpg-cpu")
    model = DDiffPG.from_preset("ant-cpu", expected.get_env())
    assert_same_model(model, expected)
    assert (model.batch_size, model.gradient_steps, model.reward_scale) == (512, 4, 10)
    assert model.critic_settings == CriticSettings(n_atoms=1, v_max=10)
    assert model.mode_settings == ModeSettings(max_successes=60, max_failures=60, min_size=3, trials=4000)
    assert [model.lr_schedule(left) for left in PROGRESS] == pytest.approx([1e-3, 1e-3, 1e-3, 5e-4, 0.0])
    assert model.policy_kwargs["net_arch"] == [256, 256] and model.replay_buffer.min_direct == 40
    assert model.exploration_settings.past_modes is False


@pytest.mark.parametrize(
    ("file", "entry"), [(file, entry) for file, entry in ALL if entry not in ("paper", "default")], ids=lambda each: each
)
def test_every_entry_is_what_the_zoo_makes_of_it(tmp_path, file, entry):
    needs(entry)
    expected = as_the_zoo_makes_it(tmp_path, "ddiffpg", entry, file)
    model = DDiffPG.from_preset(f"{file}:{entry}", expected.get_env())
    assert_same_model(model, expected)
    expected.get_env().close()


@pytest.mark.parametrize("algo", BASELINES)
def test_baselines_have_their_files_too(tmp_path, algo):
    expected = as_the_zoo_makes_it(tmp_path, algo, "PointMazeV2-v0", algo)
    model = BASELINES[algo].from_preset(f"{algo}:PointMazeV2-v0", expected.get_env())
    assert type(model) is BASELINES[algo]
    assert_same_model(model, expected)
    assert model.critic_settings.v_max == 15
    paper = BASELINES[algo].from_preset(f"{algo}:paper", DummyVecEnv([TwoEnds]))
    assert paper.novelty_settings.measure == "rnd"


# ---------------------------------------------------------------------- each makes a model


@pytest.mark.parametrize("name", PRESETS)
def test_every_name_makes_a_model(name):
    file, entry = PRESETS[name]
    env_id = entry if entry in gym.registry else "PointMazeV1-v0"
    needs(env_id)
    env = make_vec_env(env_id, 1, seed=0)
    model = DDiffPG.from_preset(name, env)
    assert_same_model(model, DDiffPG.from_preset(f"{file}:{entry}", env))
    action, _ = model.predict(env.reset())
    assert np.isfinite(action).all() and len(action) == 1
    env.close()


@pytest.mark.parametrize(("file", "entry"), ALL, ids=lambda each: each)
def test_every_entry_makes_a_model(file, entry):
    """All that it says is there, nothing else is changed; and it learns."""
    env = DummyVecEnv([TwoEnds] * 2)
    small = {"learning_starts": 0, "buffer_size": 2000, "batch_size": 22, "gradient_steps": 1, "train_freq": 2}
    model = DDiffPG.from_preset(f"{file}:{entry}", env, **small)
    said = {key: value for key, value in ENTRIES[file][entry].items() if key not in ZOO_KEYS}
    for group, kind in groups_of(DDiffPG).items():
        assert getattr(model, settings_attribute(group)) == kind(**said.pop(group, {})), group
    for key in ("learning_rate", "qf_learning_rate", "policy_kwargs", "policy", *small):
        said.pop(key, None)
    assert {key: getattr(model, key) for key in said} == said
    model.learn(4)
    assert model._n_updates == 1


def test_names_are_those_of_entries():
    assert {"paper", "ant-cpu"} <= set(PRESETS)
    for file, entry in PRESETS.values():
        assert entry in ENTRIES[file]


# ---------------------------------------------------------------------- changes


def test_changes_of_one_setting_keep_the_others():
    """However the change is said."""
    env = DummyVecEnv([TwoEnds])
    usual = DDiffPG.from_preset("ant-cpu", env)
    for changes in (
        {"critic": {"v_max": 3}},
        {"critic.v_max": 3},
        {"v_max": 3},  # as in version 0.1
    ):
        model = DDiffPG.from_preset("ant-cpu", env, **changes)
        assert model.critic_settings == CriticSettings(n_atoms=1, v_max=3)
        for group in ("modes", "novelty", "exploration", "target_action"):
            attribute = settings_attribute(group)
            assert getattr(model, attribute) == getattr(usual, attribute)
        assert (model.gamma, model.batch_size, model.reward_scale) == (usual.gamma, usual.batch_size, usual.reward_scale)
    model = DDiffPG.from_preset("ant-cpu", env, novelty="rnd", gamma=0.5, modes={"trials": 7, "linkage": "complete"})
    assert (model.novelty_settings.measure, model.novelty_settings.coef, model.gamma) == ("rnd", 0.1, 0.5)
    expected = ModeSettings(max_successes=60, max_failures=60, min_size=3, trials=7, linkage="complete")
    assert model.mode_settings == expected and model.critic_settings == usual.critic_settings
    # Others are replaced
    model = DDiffPG.from_preset("ant-cpu", env, policy_kwargs={"net_arch": [8]}, learning_rate=1e-4, policy="MlpPolicy")
    assert model.policy_kwargs == {"net_arch": [8]} and model.learning_rate == 1e-4
    # No preset is another one now
    assert DDiffPG.from_preset("ant-cpu", env).critic_settings == usual.critic_settings


def test_presets_are_no_place_for_leftovers():
    """What one caller does with it is not in the next one's."""
    first = preset("paper")
    first["critic"]["v_max"] = 77
    first["policy_kwargs"]["net_arch"]["pi"].append(5)
    second = preset("paper")
    assert second["critic"]["v_max"] == 5 and second["policy_kwargs"]["net_arch"]["pi"] == [1024, 512, 256]
    assert not set(second) & ZOO_KEYS


def test_wrong_changes_are_told():
    env = DummyVecEnv([TwoEnds])
    for changes, kind, said in (
        ({"critic": {"v_maks": 3}}, ValueError, r"critic\['v_maks'\] is no setting: did you mean 'v_max'"),
        ({"critic": {"v_max": -3}}, ValueError, "critic.v_min must be less than v_max"),
        ({"gama": 0.5}, TypeError, "DDiffPG has no argument 'gama'; did you mean 'gamma'"),
        ({"n_envs": 4}, TypeError, "DDiffPG has no argument 'n_envs'"),
    ):
        with pytest.raises(kind, match=said):
            DDiffPG.from_preset("ant-cpu", env, **changes)


def test_other_algorithms_refuse_what_they_have_not():
    """A preset of DDiffPG speaks of modes."""
    with pytest.raises(TypeError, match="TD3C51 has no argument"):
        TD3C51.from_preset("ant-cpu", DummyVecEnv([TwoEnds]))
    assert DIPO.from_preset("dipo:paper", DummyVecEnv([TwoEnds])).target_action_settings.n_steps == 20


# ---------------------------------------------------------------------- names


@pytest.mark.parametrize(
    "name", ["ant", "ddiffpg:AntMazeV1-v0", "ddiffpg-cpu:AntMazeV2-v0", "ddiffpg:default", "rpg:AntMazeV1-v0"]
)
def test_a_file_and_an_entry(name):
    file, entry = PRESETS.get(name, name.split(":"))
    own = yaml.safe_load(config_file(file).read_text())[entry]
    found = preset(name)
    assert set(found) == set(own) - ZOO_KEYS
    assert all(found[key] == own[key] for key in found if key not in ("learning_rate", "qf_learning_rate", "policy_kwargs"))


@pytest.mark.parametrize("name", ["ants", "", "Paper", "ddiffpg-gpu:AntMazeV1-v0", "td3:AntMazeV1-v0", ":paper", "paper:"])
def test_an_unknown_name_is_told_with_the_accepted_ones(name):
    for give in (lambda: preset(name), lambda: DDiffPG.from_preset(name, DummyVecEnv([TwoEnds]))):
        with pytest.raises(ValueError, match="is no preset: accepted are ") as refused:
            give()
        assert f"name={name!r}" in str(refused.value) and "'file:environment'" in str(refused.value)
        assert all(each in str(refused.value) for each in PRESETS)


def test_an_unknown_entry_of_a_file_is_told_with_its_own():
    with pytest.raises(ValueError, match=r"name='ddiffpg-cpu:AntMazeV9-v0' is no preset: .*ddiffpg-cpu.yml has ") as refused:
        preset("ddiffpg-cpu:AntMazeV9-v0")
    assert all(entry in str(refused.value) for entry in ENTRIES["ddiffpg-cpu"])


@pytest.mark.parametrize("name", ["../zoo_hyperparams/ddiffpg:paper", "/etc/passwd:x", "./ddiffpg:paper", "..:paper"])
def test_a_name_is_no_path(name):
    with pytest.raises(ValueError, match="is no preset: accepted are "):
        preset(name)
