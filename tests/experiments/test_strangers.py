"""Tasks of others: the settings of SB3's algorithms, what is left out, and which way a maze was walked."""

from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import rl_zoo3
import yaml
from environments import TwoEnds
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.experiments import __main__ as cli
from sb3_ddiffpg.experiments import figures
from sb3_ddiffpg.experiments.ablations import load_to_act
from sb3_ddiffpg.experiments.files import task_file_name
from sb3_ddiffpg.experiments.suite import read_suite
from sb3_ddiffpg.experiments.trial import hyperparameters

HIDDEN = "sb3_ddiffpg.experiments.strangers:PointMaze_{}_HiddenGoal-v3"


def zoo(algo, entry):
    """As the RL zoo's own file has it."""
    return yaml.safe_load((Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml").read_text())[entry]


@pytest.mark.parametrize("algo", ["td3", "sac"])
def test_settings_of_the_rl_zoo(algo):
    assert hyperparameters(algo, "Pendulum-v1", "rl_zoo3") == zoo(algo, "Pendulum-v1")
    assert hyperparameters(algo, "Hopper-v5", "rl_zoo3") == zoo(algo, "default")
    hopper = hyperparameters(algo, "Hopper-v5", "rl_zoo3", {"gamma": 0.5}, entry="Hopper-v4")
    assert hopper == {**zoo(algo, "Hopper-v4"), "gamma": 0.5}


def test_the_entry_of_another_algorithm():
    """What TD3 does not take is left out; what it alone takes, its noise, is its own."""
    fetch = hyperparameters("td3", "FetchReach-v4", "rl_zoo3", entry="sac:FetchReach-v1")
    expected = zoo("sac", "FetchReach-v1")
    assert expected.pop("ent_coef") == "auto"
    assert fetch == {**zoo("td3", "default"), **expected} and fetch["noise_std"] == 0.1
    wrong = (("td3", "sac:Nothing-v0", "sac.yml"), ("td3", "Nothing-v0", "td3.yml"), ("ddiffpg", None, "no settings"))
    for algo, entry, said in wrong:
        with pytest.raises(ValueError, match=said):
            hyperparameters(algo, "Pendulum-v1", "rl_zoo3", entry=entry)


def test_the_suite_gives_ddiffpg_nothing_but_the_environment():
    suite = read_suite("strangers")
    suite.leave_out()
    trials = [trial for trial in suite.trials().values() if trial.algo == "ddiffpg"]
    assert {"Pendulum-v1", "PointMaze_UMaze-v3", HIDDEN.format("Medium")} <= {trial.env for trial in trials}
    for trial in trials:
        assert trial.hyperparams.keys() - {"env_kwargs"} == {"policy", "n_timesteps", "n_envs"}
        assert trial.hyperparams["n_envs"] == 1 and 1 <= trial.hyperparams["n_timesteps"] <= 200_000
    steps = {(trial.env, trial.hyperparams["n_timesteps"]) for trial in suite.trials().values()}
    assert len(steps) == len(suite.tasks)  # the same for all


def test_what_is_not_installed_is_left_out(tmp_path, capsys):
    path = tmp_path / "a.yml"
    path.write_text(
        """
        description: nothing
        tasks: {no_such_module:Nothing-v0: , Pendulum-v1: }
        variants: {sac: {algo: sac, conf_file: rl_zoo3}}
        seeds: [0]
        needs: {"no_such_module:Nothing-v0": no-such-package==1}
        """
    )
    command = ["run", str(path), "--out", str(tmp_path / "out"), "--list"]
    cli.main(command)
    said = capsys.readouterr().out
    assert "no_such_module:Nothing-v0 is left out; it needs: pip install no-such-package==1\n" in said
    assert said.split()[-1] == "Pendulum-v1/sac/seed0"
    with pytest.raises(SystemExit):
        cli.main([*command, "--tasks", "no_such_module:Nothing-v0"])
    assert "none of those that are asked for can be made" in capsys.readouterr().err
    path.write_text(path.read_text().replace("needs", "also").replace("no-such-package==1", "[]"))
    with pytest.raises(SystemExit):  # nothing is said of what it needs: an error
        cli.main(command)
    assert "no_such_module" in capsys.readouterr().err


@pytest.mark.parametrize("env_id", ["no_such_module:Nothing-v0", "Nothing-v0"])
def test_a_report_needs_no_environment(env_id, tmp_path):
    trial = SimpleNamespace(env=env_id, algo="sac", variant="sac", hyperparams={})
    maps = figures.Maps([SimpleNamespace(trial=trial, folder=tmp_path)])
    assert maps.exploration() is None and maps.values() is None


def test_names_of_files_have_no_module():
    assert task_file_name("shimmy:dm_control/reacher-easy-v0") == "dm_control-reacher-easy-v0"


def test_goals_in_hindsight(tmp_path):
    """SB3 loads such a model with an environment only. The last one is kept, and acts without chance."""
    settings = "{n_timesteps: 100, learning_starts: 60, env_kwargs: {max_episode_steps: 50}, policy: MultiInputPolicy,"
    settings += " policy_kwargs: 'dict(net_arch=[8])', normalize: true, buffer_size: 1000,"
    settings += " replay_buffer_class: HerReplayBuffer, replay_buffer_kwargs: {n_sampled_goal: 2}}"
    tests = "{n_tests: 2, n_test_episodes: 1, n_episodes: 1, deterministic: true, last: true}"
    command = ["trial", "--algo", "sac", "--env", "PointMaze_UMaze-v3", "--conf-file", "constructor"]
    cli.main([*command, "--override", settings, "--tests", tests, "--out", str(tmp_path)])
    found = yaml.safe_load((tmp_path / "config.yml").read_text())["result"]
    assert found["complete"] and found["best_step"] == found["steps"] == 100 and found["updates"] > 0
    kept, last = (load_to_act("sac", tmp_path / name) for name in ("model.zip", "logs/final_model.zip"))
    assert isinstance(kept, SAC) and type(kept.replay_buffer) is DictReplayBuffer
    assert all((a == b).all() for a, b in zip(kept.policy.parameters(), last.policy.parameters(), strict=True))
    assert (tmp_path / "vecnormalize.pkl").is_file()
    assert ModeEvaluation.load(tmp_path / "evaluation.json").success_told


@pytest.mark.parametrize(("success_key", "told"), [("is_success", True), (None, False)])
def test_whether_anybody_says_what_a_success_is(success_key, told, tmp_path):
    class Rightwards:
        def predict(self, obs, **kwargs):
            return np.ones((len(obs), 1)), None

    found = evaluate_modes(Rightwards(), DummyVecEnv([lambda: TwoEnds(success_key)] * 2), 2)
    assert found.success_told is told
    found.save(tmp_path / "a.json")
    assert ModeEvaluation.load(tmp_path / "a.json").success_told is told


START, END = [(1, 2), (2, 2), (3, 2)], [(4, 4), (4, 5), (4, 6), (5, 6), (6, 6), (6, 5)]
ABOVE, BELOW = [(3, 3), (3, 4)], [(4, 2), (4, 1), (5, 1), (6, 1), (6, 2), (6, 3), (5, 3), (5, 4)]


@pytest.mark.parametrize(
    ("maze", "cells", "label"),
    [
        ("UMaze", [(1, 2), (1, 3), (2, 3), (3, 3), (3, 2), (3, 1)], "0:-"),
        ("Medium", [*START, *ABOVE, *END], "0:A"),
        ("Medium", [*START, *BELOW, *END], "0:-"),
    ],
)
def test_routes_get_their_labels(maze, cells, label):
    """A ball that is driven through these cells."""
    env = gym.make(HIDDEN.format(maze))
    base = env.unwrapped
    observation, _ = env.reset(seed=0)
    done, ended, steps = False, [], 0
    for cell in cells:
        goal = base.maze.cell_rowcol_to_xy(np.array(cell))
        while not done and np.linalg.norm(goal - observation[:2]) > 0.3:
            action = np.clip(10 * (goal - observation[:2]) - 2 * observation[2:4], -1, 1)
            observation, reward, terminated, truncated, info = env.step(action.astype(np.float32))
            done, steps = terminated or truncated, steps + 1
            ended.append(info["mode"])
    env.close()
    assert terminated and reward == 1 and info["is_success"]
    assert ended[-1] == label and set(ended[:-1]) == {None} and label in env.get_wrapper_attr("listed_modes")
