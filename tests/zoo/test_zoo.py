"""The RL zoo's commands with DDiffPG: training, resuming, watching, filming, optimising."""

import argparse
import errno
import inspect
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import optuna
import pytest
import yaml
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import VecMonitor
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn, optim

from sb3_ddiffpg import DDiffPG, zoo
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.envs import PointMazeVecEnv
from sb3_ddiffpg.saving.checkpoint import checkpoint_files
from sb3_ddiffpg.utils.arguments import settings_attribute
from sb3_ddiffpg.visualization.runs import read_sketch
from sb3_ddiffpg.zoo import ModeExperimentManager, check_hyperparameters, main, search
from sb3_ddiffpg.zoo.settings import ZOO_KEYS

ENV = "PointMazeV1-v0"
# The goal is next to the start: random actions find it
MAP = ["#####", "#.rg#", "#####"]
ENV_KWARGS = ["--env-kwargs", f"maze_map:{MAP}", "start_noise:0", "max_episode_steps:50"]
ALGOS_OF_OURS = {"ddiffpg": DDiffPG, **BASELINES}
SMALL = {
    "learning_starts": 100,
    "batch_size": 32,
    "buffer_size": 5000,
    "modes.min_size": 2,
    "recluster_freq": 20,
    "policy_kwargs": {"net_arch": [16]},
}


def value_of(model, name):
    """Of an argument, or of a single setting of a group."""
    group, _, setting = name.partition(".")
    return getattr(getattr(model, f"{group.removesuffix('s')}_settings"), setting) if setting else getattr(model, name)


def settings_of(model):
    """All groups."""
    return {kind.group: getattr(model, settings_attribute(kind.group)) for kind in type(model).settings_groups}


def hyperparams(**changes):
    return ["--hyperparams", *(f"{key}:{value!r}" for key, value in (SMALL | changes).items())]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A folder in which an agent was trained, with everything the zoo can write on the way."""
    folder = tmp_path_factory.mktemp("zoo")
    command = ["train", "--env", ENV, "-n", "800", "--n-envs", "4", "--seed", "0", "-f", str(folder)]
    command += ["-tb", str(folder / "tb"), "--eval-freq", "400", "--eval-episodes", "2", "--save-freq", "400"]
    main([*command, "--save-replay-buffer", *ENV_KWARGS, *hyperparams()])
    return folder


@pytest.fixture
def run(logs):
    return logs / "ddiffpg" / f"{ENV}_1"


def train(folder, *options, **changes):
    main(["train", "--env", ENV, "-n", "150", "--eval-freq", "-1", "-f", str(folder), *options, *hyperparams(**changes)])


def test_training_leaves_what_the_zoo_looks_for(logs, run):
    expected = {"best_model.zip", "evaluations.npz", "replay_buffer.pkl", f"{ENV}.zip"}
    assert read_sketch(run / "live.json").env == ENV  # for those who watch it
    assert expected | {"rl_model_400_steps.zip", "rl_model_800_steps.zip"} <= {path.name for path in run.iterdir()}
    (events,) = (logs / "tb").rglob("events.out.tfevents*")
    tags = EventAccumulator(str(events)).Reload().Tags()["scalars"]
    assert {"eval/n_modes", "eval/success_rate", "modes/n_modes", "train/target_action_shift", "time/recluster"} <= set(tags)
    # --n-envs joins --hyperparams instead of replacing it
    config = yaml.unsafe_load((run / ENV / "config.yml").read_text())
    assert config["n_envs"] == 4 and config["learning_starts"] == 100
    # successes for `plot_train -y success`
    header, *episodes = (run / "0.monitor.csv").read_text().splitlines()[1:]
    assert header.split(",")[-1] == "is_success" and "True" in "".join(episodes)
    model = DDiffPG.load(run / f"{ENV}.zip")
    assert model.num_timesteps == 800 and model.batch_size == 32 and len(model.modes) >= 1


def test_resume(run, tmp_path):
    before = DDiffPG.load(run / f"{ENV}.zip")
    changes = {"n_envs": 4, "qf_learning_rate": "lin_2e-4", "critic.v_max": 3.0, "exploration": {"n_steps": 2}}
    train(tmp_path, "-i", str(run / f"{ENV}.zip"), "--save-replay-buffer", *ENV_KWARGS, **changes)
    resumed = tmp_path / "ddiffpg" / f"{ENV}_1"
    after = DDiffPG.load(resumed / f"{ENV}.zip")
    after.load_replay_buffer(resumed / "replay_buffer.pkl")
    assert after._n_updates > before._n_updates
    assert set(before.modes.names) & set(after.modes.names)
    assert after.qf_learning_rate(0.5) == pytest.approx(1e-4)
    expected = settings_of(before)
    expected["critic"] = replace(expected["critic"], v_max=3.0)
    expected["exploration"] = replace(expected["exploration"], n_steps=2)
    assert settings_of(after) == expected and expected["exploration"].fraction == 0.7  # of the file
    # the buffer came along, so that every step was one of the policy and was learnt from
    assert after.learning_starts == 0
    assert after.replay_buffer.size() * 4 > 800


def test_a_killed_training_goes_on(tmp_path, monkeypatch):
    """``train --resume`` ends as if nothing had happened, whether the run is named or not."""

    def command(name, *options):
        return [*("train", "--env", ENV, "-n", "800", "--n-envs", "4", "--seed", "1", "-f", str(tmp_path / name)), *options]

    settings = [*ENV_KWARGS, *hyperparams(), "--checkpoint-freq", "200", "--eval-freq", "60", "--eval-episodes", "2"]
    main(command("whole", *settings))
    for options in (["--resume"], ["--resume", str(tmp_path / "killed" / "ddiffpg" / f"{ENV}_1")]):
        learn = DDiffPG.train

        def dies(self, *args, learn=learn, **kwargs):
            learn(self, *args, **kwargs)
            if self.num_timesteps >= 500:
                raise RuntimeError("killed")

        with monkeypatch.context() as patch:
            patch.setattr(DDiffPG, "train", dies)
            with pytest.raises(RuntimeError, match="killed"):
                main(command("killed", *settings))
        main(command("killed", *settings, *options))
        runs = [tmp_path / name / "ddiffpg" / f"{ENV}_1" for name in ("whole", "killed")]
        models = [DDiffPG.load(folder / f"{ENV}.zip") for folder in runs]
        assert models[0].num_timesteps == models[1].num_timesteps == 800
        for mine, other in zip(*(model.policy.parameters() for model in models), strict=True):
            np.testing.assert_array_equal(mine.detach().numpy(), other.detach().numpy())
        evaluations = [np.load(folder / "evaluations.npz")["timesteps"].tolist() for folder in runs]
        assert evaluations[0] == evaluations[1] and len(evaluations[0]) >= 3
        shutil.rmtree(tmp_path / "killed")
    with pytest.raises(SystemExit, match="holds no run of PointMazeV1-v0"):
        main(command("nothing", "--resume"))
    with pytest.raises(SystemExit, match="accepted is the folder of a run"):
        main(command("nothing", "--resume", str(tmp_path)))


@pytest.mark.parametrize("changes", [{}, {"env_wrapper": "gymnasium.wrappers.FlattenObservation"}], ids=["ours", "wrapped"])
def test_a_full_disk_does_not_end_a_training(tmp_path, monkeypatch, changes):
    """The monitor's file, logs, what an evaluation found: the run goes on without, and keeps its checkpoints."""
    full = OSError(errno.ENOSPC, "No space left on device")

    def fails(*args, **kwargs):
        raise full

    for place in (Logger, "dump"), (np, "savez"), (ResultsWriter, "write_row"), (ResultsWriter, "close"):
        monkeypatch.setattr(*place, fails)
    command = ["train", "--env", ENV, "-n", "300", "--n-envs", "4", "-f", str(tmp_path), "--log-interval", "1", *ENV_KWARGS]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        main([*command, *hyperparams(**changes), "--eval-freq", "40", "--checkpoint-freq", "100"])
    run = tmp_path / "ddiffpg" / f"{ENV}_1"
    assert DDiffPG.load(run / f"{ENV}.zip").num_timesteps == 300 and len(list((run / "checkpoints").glob("*_*"))) == 2
    missed = {str(each.message).split(" cannot be written")[0] for each in said if "No space left" in str(each.message)}
    assert missed == {"Logs", "What the evaluation found", "What the monitor notes"}
    full.errno = errno.EACCES
    with pytest.raises(OSError, match="No space left"):  # of another number now
        main([*command, *hyperparams(**changes), "--eval-freq", "-1"])


def test_workers_of_the_zoo_survive_an_interrupt(tmp_path):
    """In a terminal it reaches all processes; SB3's own workers would end, and the run with them."""
    command = [sys.executable, "train.py", "--env", ENV, "-n", "1000000", "--n-envs", "3", "--vec-env", "subproc"]
    command += ["-f", str(tmp_path), "--eval-freq", "-1", *hyperparams(learning_starts=10**6)]
    root = Path(__file__).parents[2]
    process = subprocess.Popen(command, cwd=root, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    run = tmp_path / "ddiffpg" / f"{ENV}_1"
    while not list(run.glob("checkpoints/checkpoint_*")):
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.1)
    time.sleep(1)
    os.killpg(process.pid, signal.SIGINT)
    assert b"SIGINT: training ends with a checkpoint after this step" in process.communicate(timeout=60)[0]
    assert process.returncode == 0
    assert checkpoint_files(run / "checkpoints")[0].stem > "checkpoint_000000000000" and (run / f"{ENV}.zip").exists()


@pytest.mark.parametrize("text", ["", "[1, 2]", f"{ENV}: [1]", f"{ENV}:", f"{ENV}: {{5: 3}}", "a: [", "\\x00"], ids=range(7))
def test_files_of_settings_that_hold_none(tmp_path, text):
    (tmp_path / "own.yml").write_text(text)
    with pytest.raises(SystemExit, match=rf"--conf-file: {tmp_path}/own.yml "):
        main(["train", "--env", ENV, "--conf-file", str(tmp_path / "own.yml"), "-f", str(tmp_path)])


def test_settings_that_are_no_python(tmp_path):
    (tmp_path / "own.yml").write_text(f"{ENV}: {{n_timesteps: 100, policy: MlpPolicy, policy_kwargs: 'dict('}}")
    for options in (["--conf-file", str(tmp_path / "own.yml")], ["--hyperparams", "batch_size:3 +"]):
        with pytest.raises(SystemExit, match="in the settings is no expression of Python"):
            main(["train", "--env", ENV, "-f", str(tmp_path), *options])


@pytest.mark.parametrize("given", ["gamma=0.9", "gamma", "gamma:"])
def test_hyperparameters_without_a_value(tmp_path, given):
    with pytest.raises(SystemExit, match=f"--hyperparams: '{given}' given; accepted is name:value"):
        main(["train", "--env", ENV, "-f", str(tmp_path), "--hyperparams", "batch_size:64", given])


def test_resuming_refuses_unknown_keys(run, tmp_path):
    # the zoo would set an attribute that nobody reads
    with pytest.raises(TypeError, match="'recluster_frq' is not a hyperparameter of ddiffpg: did you mean 'recluster_freq'"):
        train(tmp_path, "-i", str(run / f"{ENV}.zip"), recluster_frq=3)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("n_timestep", "did you mean 'n_timesteps'"),
        ("action_learning_rate", "learning_rate"),
        ("seed", "not a hyperparameter"),
        ("zzz", "it takes action_noise, .*, critic, .*, modes, "),
        ("critic.zzz", "critic takes n_critics, n_atoms, "),
        ("critic.natoms", "did you mean 'critic.n_atoms'"),
        ("novelty.cell_size", "novelty takes measure, kwargs, "),
        ("switch_mode", "not a hyperparameter"),
    ],
)
def test_unknown_key_in_a_file(tmp_path, key, message):
    path = tmp_path / "own.yml"
    path.write_text(yaml.dump({"default": {"policy": "DiffusionPolicy", "n_timesteps": 100, key: 1}}))
    with pytest.raises(TypeError, match=message) as caught:
        main(["train", "--env", ENV, "--conf-file", str(path), "-f", str(tmp_path / "logs")])
    assert repr(key) in str(caught.value)
    assert not (tmp_path / "logs").exists()


def test_optimisation_does_not_swallow_an_unknown_key(tmp_path):
    with pytest.raises(TypeError, match="recluster_frq"):
        train(tmp_path, "-optimize", "--n-trials", "1", recluster_frq=3)


@pytest.mark.parametrize("options", [[], ["--mode", "0"], ["--mode", "0", "--deterministic"]])
def test_enjoy(logs, capsys, monkeypatch, options):
    seen = []
    predict = DDiffPG.predict

    def spy(self, *args, **kwargs):
        seen.append((kwargs.get("mode"), kwargs["deterministic"]))
        return predict(self, *args, **kwargs)

    monkeypatch.setattr(DDiffPG, "predict", spy)
    monkeypatch.setattr(sys, "argv", ["enjoy.py"])
    main(["enjoy", "--env", ENV, "--no-render", "-n", "300", "-f", str(logs), *options])
    assert set(seen) == {(0 if "--mode" in options else None, "--deterministic" in options)}
    # our table against the zoo's own statistics
    printed = capsys.readouterr().out
    rows = re.findall(r"^\S.*?  +(\d+)  +(\d+)$", printed.split("successes\n")[1], re.MULTILINE)
    episodes, successes = (sum(column) for column in zip(*(map(int, row) for row in rows), strict=True))
    assert f"\n{episodes} Episodes" in printed
    assert f"Success rate: {100 * successes / episodes:.2f}%" in printed
    # and nothing of it stays behind
    assert ALGOS["ddiffpg"] is DDiffPG and ExperimentManager.default_vec_env_cls is None and sys.argv == ["enjoy.py"]


def test_enjoy_names_the_known_modes(logs):
    with pytest.raises(ValueError, match="'nowhere' is unknown; the modes are"):
        main(["enjoy", "--env", ENV, "--no-render", "-n", "10", "-f", str(logs), "--mode", "nowhere"])
    assert ALGOS["ddiffpg"] is DDiffPG
    with pytest.raises(SystemExit, match="--mode needs --algo ddiffpg"):
        main(["enjoy", "--algo", "td3", "--env", ENV, "--mode", "0"])


def test_record_video(logs, tmp_path):
    main(["record_video", "--env", ENV, "-n", "10", "-f", str(logs), "-o", str(tmp_path), "--mode", "0"])
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 0


def test_normalised_observations(tmp_path, capsys):
    train(tmp_path, normalize={"norm_obs": True, "norm_reward": False})
    assert (tmp_path / "ddiffpg" / f"{ENV}_1" / ENV / "vecnormalize.pkl").is_file()
    main(["enjoy", "--env", ENV, "--no-render", "-n", "160", "-f", str(tmp_path)])
    assert "Loading running average" in capsys.readouterr().out


@pytest.mark.parametrize("algo", ["ddiffpg", *BASELINES])
def test_optimise(tmp_path, capsys, algo):
    storage = ["--storage", str(tmp_path / "study.log"), "--study-name", "one"]
    options = ["-optimize", "--n-trials", "1", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]
    settings = {
        name: value for name, value in SMALL.items() if algo == "ddiffpg" or name not in ("modes.min_size", "recluster_freq")
    }
    # All but the last few steps are random: the trial's own settings may be slow
    settings |= {"n_envs": 2, "learning_starts": 140}
    options += ["--hyperparams", *(f"{name}:{value!r}" for name, value in settings.items())]
    main(["train", "--algo", algo, "--env", ENV, "-n", "150", "-f", str(tmp_path), "--seed", "3", *storage, *options])
    assert "Best trial:" in capsys.readouterr().out
    assert list(tmp_path.glob(f"{algo}/report_*.csv"))


@pytest.mark.parametrize("algo", ["ddiffpg", *BASELINES])
def test_sampled_hyperparameters_are_accepted(algo):
    zoo.register()
    env = gym.make(ENV)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(5):
        trial = study.ask()
        sampled = search.sample_params(algo, trial, 2, 1, {})
        # --trial-id rebuilds them from what the study has stored
        assert search.convert_params(trial.params) == sampled
        assert trial.user_attrs == {"gamma": sampled["gamma"], "batch_size": sampled["batch_size"]}
        model = ALGOS[algo]("MlpPolicy", env, **sampled)
        assert {name: value_of(model, name) for name in sampled} == sampled


@pytest.mark.parametrize("algo", ["ddiffpg", "dipo"])
def test_sampled_settings_reach_the_models_of_the_trials(tmp_path, monkeypatch, algo):
    """Beside what the file says of the same groups."""
    made, setup = [], ALGOS_OF_OURS[algo]._setup_model
    monkeypatch.setattr(ALGOS_OF_OURS[algo], "_setup_model", lambda self: made.append(self) or setup(self))
    (tmp_path / "own.yml").write_text(
        yaml.dump(
            {
                ENV: {
                    **{"policy": "MlpPolicy", "n_timesteps": 40, "n_envs": 2, "learning_starts": 10**6},
                    **{"critic": {"v_max": 7.0}, "novelty": {"clip": 3.0, "coef": 9.0}, "target_action": {"optimizer": "sgd"}},
                    "policy_kwargs": {"net_arch": [16]},
                }
            }
        )
    )
    options = ["-optimize", "--n-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]
    options += ["--storage", str(tmp_path / "study.log"), "--study-name", "one", "--conf-file", str(tmp_path / "own.yml")]
    main(["train", "--algo", algo, "--env", ENV, "-f", str(tmp_path), "--seed", "3", *options, *ENV_KWARGS])
    study = optuna.load_study(study_name="one", storage=JournalStorage(JournalFileBackend(str(tmp_path / "study.log"))))
    assert len(made) == len(study.trials) == 2
    for model, trial in zip(made, study.trials, strict=True):
        sampled = search.convert_params(trial.params)
        assert "novelty.coef" in sampled and {name: value_of(model, name) for name in sampled} == sampled
        assert (model.critic_settings.v_max, model.novelty_settings.clip) == (7.0, 3.0)
        assert model.target_action_settings.optimizer == "sgd"


@pytest.mark.parametrize("algo", BASELINES)
def test_baselines_in_the_zoo(tmp_path, algo, capsys, monkeypatch):
    settings = {"learning_starts": 40, "batch_size": 16, "buffer_size": 2000, "n_envs": 4, "policy_kwargs": {"net_arch": [16]}}
    options = ["--algo", algo, "--env", ENV, "-f", str(tmp_path)]
    hyper = ["--hyperparams", *(f"{key}:{value!r}" for key, value in settings.items())]
    main(["train", *options, "-n", "200", "--eval-freq", "100", "--eval-episodes", "2", *hyper])
    config = yaml.unsafe_load((tmp_path / algo / f"{ENV}_1" / ENV / "config.yml").read_text())
    assert (config["n_steps"], config["reward_scale"]) == (3, 5)
    drawn, predict = set(), ALGOS[algo].predict

    def spy(self, *args, **kwargs):
        drawn.add(not kwargs["deterministic"])
        return predict(self, *args, **kwargs)

    monkeypatch.setattr(ALGOS[algo], "predict", spy)
    main(["enjoy", *options, "--no-render", "-n", "160"])
    assert "observed mode" in capsys.readouterr().out and drawn == {True}


def test_tracking_needs_nothing_of_ours(tmp_path, monkeypatch):
    calls = {}
    config = SimpleNamespace(setdefaults=lambda values: calls.update(config=values))
    recorder = SimpleNamespace(init=lambda **options: calls.update(options) or SimpleNamespace(config=config))
    monkeypatch.setitem(sys.modules, "wandb", recorder)
    monkeypatch.chdir(tmp_path)
    train(tmp_path, "--track")
    assert calls["sync_tensorboard"] and calls["config"]["saved_hyperparams"]["batch_size"] == 32
    assert list((tmp_path / "runs").rglob("events.out.tfevents*"))


@pytest.mark.parametrize(("algo", "deterministic"), [("ddiffpg", False), ("td3", True)])
def test_manager(tmp_path, algo, deterministic):
    zoo.register()
    manager = ModeExperimentManager(argparse.Namespace(), algo, ENV, str(tmp_path), env_kwargs={"maze_map": MAP}, seed=5)
    assert manager.deterministic_eval is deterministic
    env = manager.create_envs(3, eval_env=True)
    assert isinstance(env, VecMonitor) and isinstance(env.venv, PointMazeVecEnv) and env.num_envs == 3
    env.close()
    # a wrapper around each environment cannot go around all of them
    manager.env_wrapper = gym.wrappers.ClipAction
    env = manager.create_envs(3, eval_env=True)
    assert env.env_is_wrapped(gym.wrappers.ClipAction) == [True] * 3
    env.close()


def test_other_algorithms_keep_their_configuration(tmp_path):
    main(["train", "--algo", "td3", "--env", ENV, "-n", "120", "--eval-freq", "-1", "-f", str(tmp_path)])
    config = yaml.unsafe_load((tmp_path / "td3" / f"{ENV}_1" / ENV / "config.yml").read_text())
    assert config["policy"] == "MlpPolicy"


def test_learning_rates_as_text():
    parse = ModeExperimentManager._preprocess_schedules
    assert parse({"qf_learning_rate": "lin_3e-4"})["qf_learning_rate"](0.5) == pytest.approx(1.5e-4)
    assert parse({"qf_learning_rate": "3e-4"})["qf_learning_rate"] == pytest.approx(3e-4)
    assert parse({"qf_learning_rate": 3e-4, "learning_rate": "lin_1e-3"})["learning_rate"](0.5) == pytest.approx(5e-4)
    late = parse({"learning_rate": "late_1e-3"})["learning_rate"]
    assert [late(remaining) for remaining in (1.0, 0.3, 0.15, 0.0)] == pytest.approx([1e-3, 1e-3, 5e-4, 0.0])
    for key, value in (("qf_learning_rate", "fast"), ("learning_rate", "cos_1e-3"), ("learning_rate", "lin_fast")):
        with pytest.raises(TypeError, match=f"{key} must be a number, 'lin_<number>' or 'late_<number>', got '{value}'"):
            parse({key: value})


FILES = [("ddiffpg", "ddiffpg"), ("ddiffpg-cpu", "ddiffpg"), *((algo, algo) for algo in BASELINES)]


@pytest.mark.parametrize(("name", "algo"), [*FILES, *(("baselines-cpu", algo) for algo in BASELINES)])
def test_our_configuration(name, algo):
    zoo.register()
    entries = yaml.safe_load(zoo.config_file(name).read_text())
    gym.register_envs(gymnasium_robotics)
    for env_id, entry in entries.items():
        check_hyperparameters(algo, list(entry))
        assert {"policy", "n_timesteps"} <= set(entry), env_id
        assert env_id in ("paper", "default") or env_id in gym.registry
    ours = {env_id for env_id in gym.registry if str(gym.spec(env_id).entry_point).startswith("sb3_ddiffpg.")}
    assert len(ours) == 14
    assert {env_id for env_id in ours if not name.endswith("-cpu") or not env_id.startswith("Point")} <= set(entries)
    assert zoo.config_file("td3") is None


# What the algorithms have for reasons of their own: names and networks of policies, and room for values of one sum of rewards
OWN_SETTINGS = {
    *("policy", "policy_kwargs", "critic.v_max", "n_steps", "n_diffusion_steps", "replay_buffer_kwargs", "novelty.kwargs")
}
OTHER_SETTINGS = {
    # not in a file for all
    "dipo": {"target_action.optimizer", "target_action.learning_rate", "target_action.n_steps"},
    "rpg": {"critic.n_atoms"},
    "sac_c51": {"critic.target_policy_noise"},
}


def defaults_of(algorithm):
    """Of all arguments by name, those of groups one by one."""
    groups = {kind.group: kind for kind in algorithm.settings_groups}
    found = {
        name: parameter.default
        for each in reversed(algorithm.__mro__)
        if "__init__" in vars(each)
        for name, parameter in inspect.signature(each.__init__).parameters.items()
        if name not in groups
    }
    return found | {f"{group}.{name}": value for group, kind in groups.items() for name, value in kind().to_dict().items()}


def flattened(entry, algorithm):
    """Its settings, those of groups one by one."""
    groups = {kind.group for kind in algorithm.settings_groups}
    found = {key: value for key, value in entry.items() if key not in groups}
    return found | {f"{group}.{name}": value for group in groups & entry.keys() for name, value in entry[group].items()}


@pytest.mark.parametrize(
    ("ours", "theirs", "algo"),
    [
        *(("ddiffpg", algo, algo) for algo in BASELINES if algo != "rpg"),
        *(("ddiffpg-cpu", "baselines-cpu", algo) for algo in BASELINES),
    ],
)
def test_baselines_are_trained_as_ddiffpg_is(ours, theirs, algo):
    """Wherever both have a setting it is the same, also where one of them leaves it to its default."""
    zoo.register()
    files = [yaml.safe_load(zoo.config_file(name).read_text()) for name in (ours, theirs)]
    algorithms = DDiffPG, ALGOS[algo]
    defaults = [defaults_of(algorithm) for algorithm in algorithms]
    own = OWN_SETTINGS | OTHER_SETTINGS.get(algo, set())
    unlike = {"learning_rate", "qf_learning_rate"} if algo in ("diffusion_ql", "consistency_ac") else set()  # or none learns
    compared = set()
    for env_id in files[0].keys() & files[1].keys() - {"default"}:
        entries = [flattened(file[env_id], algorithm) for file, algorithm in zip(files, algorithms, strict=True)]
        for key in (entries[0].keys() | entries[1].keys()) - own - (unlike if env_id.startswith("Point") else set()):
            if all(key in known or key in ZOO_KEYS for known in defaults):
                first, second = (entry.get(key, known.get(key)) for entry, known in zip(entries, defaults, strict=True))
                assert first == second, (env_id, key)
                compared.add(key)
    assert compared >= {"gamma", "n_envs", "novelty.coef", "reward_scale"}


def test_a_configuration_of_ours_by_name(tmp_path):
    options = ["--env", "AntMazeV1-v0", "-f", str(tmp_path), "-n", "8", *hyperparams(n_envs=4)]
    main(["train", "--conf-file", "ddiffpg-cpu", *options])
    config = yaml.unsafe_load((tmp_path / "ddiffpg" / "AntMazeV1-v0_1" / "AntMazeV1-v0" / "config.yml").read_text())
    assert config["env_kwargs"] == {"integrator": "euler", "ends_on_fall": True} and config["n_envs"] == 4
    for name in ("no.yml", "ddiffpg-gpu"):
        with pytest.raises(SystemExit, match=rf"--conf-file: '{name}' given; accepted are .*'ddiffpg', 'ddiffpg-cpu', "):
            main(["train", "--env", ENV, "--conf-file", name, "-f", str(tmp_path)])
    with pytest.raises(ValueError, match="Hyperparameters not found for ddiffpg-PointMazeV1-v0"):
        main(["train", "--env", ENV, "--conf-file", "ddiffpg-cpu", "-f", str(tmp_path)])


def test_papers_numbers():
    entry = yaml.safe_load(zoo.config_file("ddiffpg").read_text())["paper"]
    # Li et al. 2024, table of hyperparameters
    table = {"n_envs": 256, "qf_learning_rate": 5e-4, "learning_rate": 3e-4, "target_action.learning_rate": 3e-2}
    table |= {"critic.v_min": 0, "critic.v_max": 5, "critic.n_atoms": 51}
    table |= {"tau": 5e-2, "batch_size": 4096, "gradient_steps": 8, "gamma": 0.99, "max_grad_norm": 1.0}
    table |= {"buffer_size": 10**6, "recluster_freq": 100, "modes.embedding_dim": 5, "n_diffusion_steps": 5}
    assert {key: flattened(entry, DDiffPG)[key] for key in table} == table
    # the zoo evaluates this text where `nn` and `th` are imported
    kwargs = eval(entry["policy_kwargs"], {"nn": nn, "th": SimpleNamespace(optim=optim)})
    arguments = {key: entry[key] for key in entry if key in inspect.signature(DDiffPG.__init__).parameters}
    model = DDiffPG(**(arguments | {"policy_kwargs": kwargs, "env": gym.make(ENV)}))
    widths = [layer.out_features for layer in model.actor.modules() if isinstance(layer, nn.Linear)]
    assert {1024, 512, 256} <= set(widths)


def test_the_command_line_changes_single_settings(tmp_path):
    """The others of the group stay what the file says, which is not what the constructor does."""
    command = ["train", "--env", ENV, "-n", "8", "--eval-freq", "-1", "-f", str(tmp_path)]
    small = ["n_envs:4", "policy_kwargs:dict(net_arch=[16])"]
    main([*command, "--hyperparams", *small])
    main([*command, "--hyperparams", *small, "critic.v_max:3", "novelty:{'coef': 0.2}", "exploration.n_steps:2"])
    first, second = (DDiffPG.load(tmp_path / "ddiffpg" / f"{ENV}_{run}" / f"{ENV}.zip") for run in (1, 2))
    expected = settings_of(first)
    assert (expected["exploration"].fraction, expected["exploration"].n_steps) == (0.7, 3)  # of the file
    expected["critic"] = replace(expected["critic"], v_max=3)
    expected["novelty"] = replace(expected["novelty"], coef=0.2)
    expected["exploration"] = replace(expected["exploration"], n_steps=2)
    assert settings_of(second) == expected
    assert (first.reward_scale, first.gamma) == (second.reward_scale, second.gamma) == (5, 0.97)


@pytest.mark.filterwarnings("ignore:Arguments of version 0.1:FutureWarning")
def test_a_file_may_say_settings_in_any_way(tmp_path):
    """As groups, one by one, or as in version 0.1, of which it is warned."""
    common = {"policy": "MlpPolicy", "n_timesteps": 8, "policy_kwargs": {"net_arch": [16]}}
    entries = {
        "groups": {
            "critic": {"v_max": 3.0, "n_atoms": 11},
            "modes": {"trials": 7},
            "novelty": {"measure": "rnd", "coef": 0.2},
        },
        "single": {"critic.v_max": 3.0, "critic.n_atoms": 11, "modes.trials": 7, "novelty": "rnd", "novelty.coef": 0.2},
        "of_0_1": {"v_max": 3.0, "n_atoms": 11, "mode_trials": 7, "novelty": "rnd", "intrinsic_coef": 0.2},
        "mixed": {
            "critic": {"v_max": 3.0},
            "n_atoms": 11,
            "mode_trials": 7,
            "novelty": {"measure": "rnd"},
            "novelty.coef": 0.2,
        },
    }
    found = []
    for name, entry in entries.items():
        (tmp_path / f"{name}.yml").write_text(yaml.dump({ENV: {**common, **entry}}))
        command = ["train", "--env", ENV, "--conf-file", str(tmp_path / f"{name}.yml"), "-f", str(tmp_path / name)]
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            main([*command, "--eval-freq", "-1"])
        old = [str(each.message) for each in said if each.category is FutureWarning and "version 0.1" in str(each.message)]
        assert len(old) == (name in ("of_0_1", "mixed")), old
        found.append(settings_of(DDiffPG.load(tmp_path / name / "ddiffpg" / f"{ENV}_1" / f"{ENV}.zip")))
    for each in found[1:]:
        assert each == found[0]
    assert (found[0]["critic"].v_max, found[0]["modes"].trials, found[0]["novelty"].coef) == (3.0, 7, 0.2)
    # What is gone is told where it meant something
    for gone, message in (({"switch_modes": 0.5}, "no episode that follows a mode"), ({"control": "x"}, "ablations")):
        (tmp_path / "gone.yml").write_text(yaml.dump({ENV: {**common, **gone}}))
        with pytest.raises(TypeError, match=f"is no argument any more: .*{message}"):
            main(["train", "--env", ENV, "--conf-file", str(tmp_path / "gone.yml"), "-f", str(tmp_path / "gone")])


def test_scripts(tmp_path, monkeypatch, capsys):
    root = Path(__file__).parents[2]
    for script in ("train", "enjoy", "record_video"):
        monkeypatch.setattr(sys, "argv", [f"{script}.py", "--help"])
        with pytest.raises(SystemExit) as stopped:
            runpy.run_path(str(root / f"{script}.py"), run_name="__main__")
        assert stopped.value.code == 0
        # the zoo's help, in which our algorithm is a choice
        assert "ddiffpg" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["fly"])
    assert "fly" in capsys.readouterr().err
