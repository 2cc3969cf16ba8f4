"""A recorded run says what it did, and can be done again."""

import csv
import sys

import numpy as np
import pytest
import yaml

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.evaluation import ModeEvaluation
from sb3_ddiffpg.experiments import run as runs

SMALL = "{n_timesteps: 1600, learning_starts: 320, n_envs: 4, policy_kwargs: 'dict(net_arch=[16])'}"


def record(monkeypatch, folder, *arguments):
    monkeypatch.setattr(runs, "N_TESTS", 3)
    monkeypatch.setattr(runs, "N_TEST_EPISODES", 2)
    monkeypatch.setattr(runs, "N_EPISODES", 3)
    monkeypatch.setattr(sys, "argv", ["run", *arguments, "--out", str(folder)])
    runs.main()
    return yaml.safe_load((folder / "config.yml").read_text())


def test_a_run_leaves_its_record_and_can_be_repeated(monkeypatch, tmp_path):
    first = record(monkeypatch, tmp_path / "a", "--env", "PointMazeV1-v0", "--seed", "5", "--override", SMALL)
    assert (first["env"], first["seed"], first["hyperparams"]["n_envs"]) == ("PointMazeV1-v0", 5, 4)
    assert first["result"]["steps"] == 1600 and first["versions"]["torch"] and first["machine"]["cores"] >= 1
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
    with pytest.raises(SystemExit, match="holds another run already"):
        record(monkeypatch, tmp_path / "a", "--env", "PointMazeV1-v0", "--seed", "6", "--override", SMALL)


def test_a_run_that_was_killed_goes_on(monkeypatch, tmp_path):
    """With the same command, to the same end; and a complete one is left alone."""
    command = ("--env", "PointMazeV1-v0", "--override", SMALL)
    whole = record(monkeypatch, tmp_path / "a", *command)
    on_period = runs.CurveCallback._on_period

    def dies(self):
        on_period(self)
        if len(self.rows) == 2:
            raise KeyError("killed")

    monkeypatch.setattr(runs.CurveCallback, "_on_period", dies)
    with pytest.raises(KeyError, match="killed"):
        record(monkeypatch, tmp_path / "b", *command)
    monkeypatch.setattr(runs.CurveCallback, "_on_period", on_period)
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


def test_settings_that_do_not_exist(monkeypatch, tmp_path):
    with pytest.raises(SystemExit, match="PointMazeV9-v0.*PointMazeV1-v0"):
        record(monkeypatch, tmp_path, "--env", "PointMazeV9-v0")
    with pytest.raises(SystemExit, match="--env or --again"):
        record(monkeypatch, tmp_path)
    with pytest.raises(SystemExit, match="folder of a recorded run"):
        record(monkeypatch, tmp_path, "--again", str(tmp_path / "none"))
    with pytest.raises(SystemExit, match="nope.*YAML file"):
        record(monkeypatch, tmp_path, "--algo", "nope", "--env", "PointMazeV1-v0")
    with pytest.raises(SystemExit, match="nope.*ddiffpg"):
        record(monkeypatch, tmp_path, "--algo", "nope", "--conf-file", "ddiffpg", "--env", "PointMazeV1-v0")
    with pytest.raises(SystemExit, match="registered"):
        record(monkeypatch, tmp_path, "--env", "paper")
    for override in ("5", "", "{"):
        with pytest.raises(SystemExit):
            record(monkeypatch, tmp_path, "--env", "PointMazeV1-v0", "--override", override)
    assert not list(tmp_path.iterdir())


def test_the_best_model_comes_with_its_normalisation(monkeypatch, tmp_path):
    settings = SMALL.replace("1600", "1e3").replace("{", "{normalize: {norm_obs: true, norm_reward: false}, ")
    done = record(monkeypatch, tmp_path / "run", "--env", "PointMazeV1-v0", "--override", settings)
    assert done["result"]["complete"] and (tmp_path / "run" / "vecnormalize.pkl").is_file()
