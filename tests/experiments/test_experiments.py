"""A recorded run says what it did, and can be done again."""

import csv
import re
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
import yaml
from environments import TwoEnds
from filelock import FileLock
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.callbacks.evaluation import EvaluateModesCallback
from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.experiments import __main__ as cli
from sb3_ddiffpg.experiments import machine, training  # noqa: F401 - imported here, or what a test replaces in it would stay
from sb3_ddiffpg.experiments.ablations import ABLATIONS
from sb3_ddiffpg.experiments.curve import Clock, CurveCallback

SMALL = "{n_timesteps: 800, learning_starts: 320, n_envs: 4, policy_kwargs: 'dict(net_arch=[16])'}"


TESTS = "{n_tests: 3, n_test_episodes: 2, n_episodes: 3}"


def record(monkeypatch, folder, *arguments):
    if "--again" not in arguments:
        arguments = (*arguments, "--tests", TESTS)
    arguments = ["trial", *arguments, "--out", str(folder)]
    monkeypatch.setattr(sys, "argv", ["experiments", *arguments])
    cli.main(arguments)
    return yaml.safe_load((folder / "config.yml").read_text())


def test_a_run_leaves_its_record_and_can_be_repeated(monkeypatch, tmp_path, capsys):
    first = record(monkeypatch, tmp_path / "a", "--env", "PointMazeV1-v0", "--seed", "5", "--override", SMALL)
    assert (first["env"], first["seed"], first["hyperparams"]["n_envs"]) == ("PointMazeV1-v0", 5, 4)
    assert first["result"]["steps"] == 800 and first["versions"]["torch"] and first["machine"]["cores"] >= 1
    with (tmp_path / "a" / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == sorted(int(row["step"]) for row in rows) and len(rows) == 3
    assert {"0:-", "0:a", "hours", "commanded_modes"} <= set(rows[0])
    assert first["result"]["best_step"] in [int(row["step"]) for row in rows]
    evaluation = ModeEvaluation.load(tmp_path / "a" / "evaluation.json")
    assert evaluation.start_spread == 0.0 and evaluation.uncommanded.n_episodes == 6
    second = record(monkeypatch, tmp_path / "b", "--again", str(tmp_path / "a"))
    assert second["hyperparams"] == first["hyperparams"]
    models = [DDiffPG.load(tmp_path / name / "model.zip") for name in "ab"]
    for mine, other in zip(*(model.policy.parameters() for model in models), strict=True):
        np.testing.assert_array_equal(mine.detach().numpy(), other.detach().numpy())
    with pytest.raises(SystemExit):
        record(monkeypatch, tmp_path / "a", "--env", "PointMazeV1-v0", "--seed", "6", "--override", SMALL)
    assert "holds another training" in capsys.readouterr().err


@pytest.mark.parametrize("final", [0.5, 1.5])
def test_the_last_model_is_kept_where_it_does_better(monkeypatch, tmp_path, final):
    """In tests the first model does best; with more episodes the last one has ``final``, the first 1."""
    tests, validation = iter([3.0, 2.0, 1.0]), iter([final, 1.0])
    monkeypatch.setattr("sb3_ddiffpg.callbacks.evaluation.score", lambda found: (next(tests), 0, 0.0))
    monkeypatch.setattr("sb3_ddiffpg.experiments.training.score", lambda found: (next(validation), 0, 0.0))
    found = record(monkeypatch, tmp_path, "--env", "PointMazeV1-v0", "--override", SMALL)
    with (tmp_path / "curve.csv").open() as file:
        steps = [int(row["step"]) for row in csv.DictReader(file)]
    assert found["result"]["best_step"] == steps[-1 if final > 1 else 0]
    kept, last = (DDiffPG.load(tmp_path / name) for name in ("model.zip", "logs/final_model.zip"))
    pairs = zip(kept.actor.parameters(), last.actor.parameters(), strict=True)
    assert all(th.equal(*pair) for pair in pairs) is (final > 1)
    assert next(tests, None) is next(validation, None) is None


def test_a_simulators_processes_count_as_the_runs():
    """While they run, and after they have ended."""
    burn = "import time\nwhile time.process_time() < 0.5: pass\nprint(time.process_time(), flush=True)\ninput()"
    clock = Clock(cpu_hours=1.0)
    with subprocess.Popen([sys.executable, "-c", burn], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as worker:
        used = float(worker.stdout.readline())
        assert used - 0.05 <= 3600 * (clock.cpu_hours - 1) <= used + 0.4
        worker.communicate("\n")
    assert used - 0.05 <= 3600 * (clock.cpu_hours - 1) <= used + 0.4


def test_a_run_that_was_killed_goes_on(monkeypatch, tmp_path):
    """With the same command, to the same end; and a complete one is left alone."""
    command = ("--env", "PointMazeV1-v0", "--override", SMALL)
    whole = record(monkeypatch, tmp_path / "a", *command)
    on_period = CurveCallback._on_period

    def dies(self):
        on_period(self)
        if len(self.rows) == 2:
            raise KeyError("killed")

    monkeypatch.setattr(CurveCallback, "_on_period", dies)
    with pytest.raises(KeyError, match="killed"):
        record(monkeypatch, tmp_path / "b", *command)
    monkeypatch.setattr(CurveCallback, "_on_period", on_period)
    assert "result" not in yaml.safe_load((tmp_path / "b" / "config.yml").read_text())
    resumed = record(monkeypatch, tmp_path / "b", *command)
    assert resumed["result"]["steps"] == whole["result"]["steps"] and resumed["result"]["complete"]
    curves = []
    for name in "ab":
        with (tmp_path / name / "curve.csv").open() as file:
            curves.append([{k: v for k, v in row.items() if "hours" not in k} for row in csv.DictReader(file)])
        curves.append((tmp_path / name / "logs" / "evaluations.jsonl").read_text())
    assert curves[:2] == curves[2:]
    models = [DDiffPG.load(tmp_path / name / "logs" / "final_model.zip") for name in "ab"]
    for mine, other in zip(*(model.policy.parameters() for model in models), strict=True):
        np.testing.assert_array_equal(mine.detach().numpy(), other.detach().numpy())
    before = (tmp_path / "b" / "model.zip").stat().st_mtime_ns
    record(monkeypatch, tmp_path / "b", *command)
    assert (tmp_path / "b" / "model.zip").stat().st_mtime_ns == before
    assert sorted(path.name for path in (tmp_path / "b" / "logs").glob("*.monitor.csv")) == ["0.monitor.csv", "1.monitor.csv"]


def test_a_way_that_is_not_listed_has_a_column_from_the_test_on_that_takes_it(monkeypatch, tmp_path):
    def tested(step, **labels):
        return step, SimpleNamespace(
            label_source="environment",
            listed=("a",),
            success_told=True,
            commanded=(),
            uncommanded=SimpleNamespace(n_episodes=4, labels=labels, success_rate=1.0, mean_return=1.0),
            commanded_modes=1.0,
            robust_modes=1,
            expected_modes=lambda: 1.0,
        )

    tests = iter([tested(1, a=4), tested(2, a=1, b=2), tested(3, a=4)])
    monkeypatch.setattr(EvaluateModesCallback, "_on_period", lambda self: self.evaluations.append(next(tests)))
    (tmp_path / "logs").mkdir()
    curve = CurveCallback(tmp_path, eval_env=DummyVecEnv([TwoEnds]), eval_freq=1)
    curve.model = SimpleNamespace(_n_updates=0, modes=[])
    for _ in range(3):
        curve._on_period()
        curve.reached.update("ab")
    with (tmp_path / "curve.csv").open() as file:
        rows = [[row[name] for name in ("step", "a", "reached a", "b", "reached b")] for row in csv.DictReader(file)]
    assert rows == [["1", "1.0", "0", "", ""], ["2", "0.25", "1", "0.5", "1"], ["3", "1.0", "2", "0.0", "2"]]


def test_settings_that_do_not_exist(monkeypatch, tmp_path, capsys):
    point = ("--env", "PointMazeV1-v0")
    for arguments, said in (
        (("--env", "PointMazeV9-v0"), "PointMazeV9-v0.*PointMazeV1-v0"),
        ((), "--env or --again"),
        (("--again", str(tmp_path / "none")), "folder of a recorded training"),
        (("--algo", "nope", *point), "nope.*ddiffpg"),
        ((*point, "--conf-file", "nope"), "nope.*YAML file"),
        (("--env", "paper"), "registered"),
        ((*point, "--override", "5"), "accepted are settings"),
        ((*point, "--override", ""), "accepted are settings"),
        ((*point, "--override", "{"), "no YAML"),
        ((*point, "--override", "{lerning_rate: 1}"), "did you mean 'learning_rate'"),
        ((*point, "--override", "{n_timesteps: 0}"), "n_timesteps: 0 given"),
        ((*point, "--override", "{n_timesteps: .nan}"), "n_timesteps: nan given"),
        ((*point, "--settings", "{policy: MlpPolicy}"), "n_timesteps: None given"),
        ((*point, "--settings", "{gamma: 1}", "--override", "{gamma: 1}"), "one or the other"),
        ((*point, "--members", "0"), "members: 0 given"),
        (("--again", str(tmp_path), "--seed", "5"), "--again: given beside seed"),
        ((*point, "--override", "{n_envs: 0}"), "n_envs: 0 given"),
        ((*point, "--override", "{n_timesteps: true}"), "n_timesteps: True given"),
        ((*point, "--override", "{gamma: 7}"), r"settings of .*: gamma must lie in \[0, 1\], got 7"),
        ((*point, "--override", "{modes: {linkage: null}}"), "modes.linkage must be one of"),
        ((*point, "--override", "{modes.trials: 0}"), "modes.trials must be an integer of at least 1, got 0"),
        ((*point, "--override", "{modes: {trails: 3}}"), r"modes\['trails'\] is no setting: did you mean 'trials'"),
        ((*point, "--override", "{modes: 3}"), "modes must be ModeSettings or a dict"),
        ((*point, "--override", "{env_kwargs: {maze: V9}}"), "PointMazeV1-v0 cannot be made with env_kwargs maze: V9"),
        ((*point, "--override", "{gamma: 0.5, gamma: 0.9}"), "'gamma' stands twice"),
    ):
        with pytest.raises(SystemExit) as ended:
            record(monkeypatch, tmp_path / "run", *arguments)
        assert ended.value.code == 2
        assert re.search(said, capsys.readouterr().err, re.DOTALL), said
    for tests in ("{n_episodes: 0}", "{episodes: 1}", "{also: [Nowhere-v0]}", "{also: [AntMazeV1-v0]}"):
        with pytest.raises(SystemExit):
            cli.main(["trial", *point, "--tests", tests, "--out", str(tmp_path / "run")])
    assert not list(tmp_path.iterdir())


def test_the_best_model_comes_with_its_normalisation(monkeypatch, tmp_path):
    settings = SMALL.replace("800", "6e2").replace("{", "{normalize: {norm_obs: true, norm_reward: false}, ")
    done = record(monkeypatch, tmp_path / "run", "--env", "PointMazeV1-v0", "--override", settings)
    assert done["result"]["complete"] and (tmp_path / "run" / "vecnormalize.pkl").is_file()


def test_an_ensemble_shares_the_steps(monkeypatch, tmp_path):
    """Three trainings of a third each, evaluated as one model with a mode for each; it goes on where it was killed."""
    settings = SMALL.replace("800", "1200").replace("n_envs: 4", "n_envs: 4, n_steps: 1")
    command = ("--algo", "td3_c51", "--env", "PointMazeV1-v0", "--seed", "2", "--members", "3", "--override", settings)
    done = record(monkeypatch, tmp_path, *command)
    members = [yaml.safe_load((tmp_path / f"member_{k}" / "config.yml").read_text()) for k in range(3)]
    assert [member["seed"] for member in members] == [6, 7, 8]
    assert done["result"]["steps"] == sum(member["result"]["steps"] for member in members) == 1200
    for part, seconds in done["result"]["seconds"].items():
        assert seconds == pytest.approx(sum(member["result"]["seconds"][part] for member in members)), part
    found = ModeEvaluation.load(tmp_path / "evaluation.json")
    assert [each.mode for each in found.commanded] == ["model_0", "model_1", "model_2"]
    before = (tmp_path / "member_0" / "model.zip").stat().st_mtime_ns
    (tmp_path / "config.yml").write_text(yaml.safe_dump({k: v for k, v in done.items() if k != "result"}))
    assert record(monkeypatch, tmp_path, *command)["result"] == done["result"]
    assert (tmp_path / "member_0" / "model.zip").stat().st_mtime_ns == before


@pytest.mark.parametrize("algo", ABLATIONS)
def test_an_ablation_is_trained_with_the_settings_of_ddiffpg(monkeypatch, tmp_path, algo):
    """And its part is useless while it trains, not when it is loaded to act."""
    done = record(monkeypatch, tmp_path / "a", "--env", "PointMazeV1-v0", "--algo", algo, "--override", SMALL)
    assert done["algo"] == algo and done["result"]["complete"]
    assert done["hyperparams"]["exploration"] == {"fraction": 0.7, "n_steps": 3}
    model = ABLATIONS[algo].load(tmp_path / "a" / "model.zip")
    plain = DDiffPG.load(tmp_path / "a" / "model.zip")
    assert model._n_updates > 0 and model.modes.names == plain.modes.names
    observations = np.zeros((3, *model.observation_space.shape), dtype=np.float32)
    np.testing.assert_array_equal(*(each.predict(observations, deterministic=True)[0] for each in (model, plain)))


def test_what_was_trained_is_tested_elsewhere_too(monkeypatch, tmp_path):
    tests = "{n_tests: 1, n_test_episodes: 2, n_episodes: 3, also: [PointMazeRandom-v0]}"
    cli.main(["trial", "--env", "PointMazeV3-v0", "--override", SMALL, "--tests", tests, "--out", str(tmp_path)])
    found = ModeEvaluation.load(tmp_path / "evaluation_PointMazeRandom-v0.json")
    assert found.env_id == "PointMazeRandom-v0" and found.uncommanded.n_episodes == 3 and not found.commanded


def test_a_trial_ends_with_the_process_that_started_it(tmp_path):
    """Its standard input closes: it writes a checkpoint and ends."""
    command = [sys.executable, "-m", "sb3_ddiffpg.experiments", "trial", "--env", "PointMazeV1-v0", "--attached"]
    command += ["--override", SMALL.replace("800", "1e8"), "--tests", TESTS, "--out", str(tmp_path)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (tmp_path / "logs" / "progress.json").exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    process.stdin.close()
    assert process.wait(60) == 1
    assert "the same command goes on" in process.stderr.read()
    assert list((tmp_path / "logs" / "checkpoints").glob("*.safetensors"))


def test_settings_are_looked_at_again_under_the_lock(monkeypatch, tmp_path, capsys):
    """Two processes want one folder: the one that waited must not take the other's training for its own."""

    class LateLock(FileLock):
        def __enter__(self):
            record = {"algo": "ddiffpg", "env": "PointMazeV1-v0", "seed": 0, "hyperparams": {}, "result": {"complete": True}}
            (tmp_path / "config.yml").write_text(yaml.safe_dump(record))
            return super().__enter__()

    monkeypatch.setattr("sb3_ddiffpg.experiments.training.FileLock", LateLock)
    with pytest.raises(SystemExit) as ended:
        record(monkeypatch, tmp_path, "--env", "PointMazeV1-v0", "--seed", "1", "--override", SMALL)
    assert ended.value.code == 2 and "holds another training" in capsys.readouterr().err
    assert not (tmp_path / "model.zip").exists()


def test_what_goes_on_says_with_what_it_was_begun(monkeypatch, tmp_path):
    """A training that another commit goes on with is of both."""
    arguments = ("--env", "PointMazeV1-v0", "--algo", "td3_c51", "--override", SMALL)
    monkeypatch.setattr("sb3_ddiffpg.experiments.record.git_commit", lambda: "first")
    whole = record(monkeypatch, tmp_path, *arguments)
    assert "resumed" not in whole
    begun = {**{name: value for name, value in whole.items() if name != "result"}, "started": "long ago"}
    (tmp_path / "config.yml").write_text(yaml.safe_dump(begun))
    monkeypatch.setattr("sb3_ddiffpg.experiments.record.git_commit", lambda: "second")
    done = record(monkeypatch, tmp_path, *arguments)
    assert (done["started"], done["git_commit"]) == ("long ago", "first") and done["result"]["complete"]
    (resumed,) = done["resumed"]
    assert resumed["git_commit"] == "second" and resumed["started"] > "2020" and "versions" not in resumed


def test_the_commit_is_of_this_packages_checkout(monkeypatch, tmp_path):
    """Not of one into which it was installed, and which ignores it."""
    assert re.fullmatch(r"[0-9a-f]{7,}(-dirty)?", machine.git_commit())
    subprocess.run(["git", "init", "-q", tmp_path], check=True)
    commit = ["git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "--allow-empty", "-m", "a"]
    subprocess.run(commit, check=True)
    installed = tmp_path / "venv" / "machine.py"
    installed.parent.mkdir()
    installed.touch()
    monkeypatch.setattr(machine, "__file__", str(installed))
    assert machine.git_commit() is None
