"""What a folder of recorded trainings is said to come to, against numbers that were put there."""

import itertools
import json
import re
import shutil
import sys
import time

import numpy as np
import pandas as pd
import pytest
import yaml
from matplotlib.figure import Figure
from scipy.stats import trim_mean

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation.results import CommandResult, ModeEvaluation
from sb3_ddiffpg.experiments import __main__ as cli
from sb3_ddiffpg.experiments import card, figures, store, summary
from sb3_ddiffpg.experiments.report import make_report
from sb3_ddiffpg.experiments.wall_clock import Stopwatch

ENV = "PointMazeV1-v0"


def evaluation(n_successes, length=20.0, env_id=ENV):
    length = length if n_successes else float("nan")
    uncommanded = CommandResult(None, 20, n_successes, length, n_successes / 20, {"0:a": n_successes} if n_successes else {})
    return ModeEvaluation(env_id, "environment", ("0:a", "0:-"), 0.0, uncommanded, (), ())


def training(root, variant, seed, n_successes, algo="td3_c51", env=ENV, elsewhere=None, **hyperparams):
    """The record of a training that never was."""
    folder = root / env / variant / f"seed{seed}"
    (folder / "logs").mkdir(parents=True)
    parts = {"collection": 1.0, "critic": 2.0, "policy": 3.0, "target action": 0.5, "other learning": 1.5, "callbacks": 100.0}
    record = {
        "env": env,
        "algo": algo,
        "variant": variant,
        "seed": seed,
        "hyperparams": {"n_timesteps": 100, **hyperparams},
        "command": "none",
        "git_commit": "abc",
        "machine": {"gpu": None, "processor": "slow", "cores": 2, "torch_threads": 1},
        "versions": {"torch": "2"},
        "result": {"complete": True, "steps": 100, "updates": 500, "hours": 0.5 + seed, "cpu_hours": 0.4, "seconds": parts},
    }
    (folder / "config.yml").write_text(yaml.safe_dump(record))
    evaluation(n_successes).save(folder / "evaluation.json")
    if elsewhere is not None:
        evaluation(elsewhere).save(folder / "evaluation_PointMazeRandom-v0.json")
    rows = {"step": [50, 100], "hours": [0.1, 0.2], "success_rate": [0.5, n_successes / 20], "cells": [5, 9]}
    pd.DataFrame({**rows, "expected_modes": [0, 1], "commanded_modes": [0, 0]}).to_csv(folder / "curve.csv", index=False)
    return folder


def test_results_are_found_at_any_depth(tmp_path):
    training(tmp_path / "x" / "y", "a", 0, 5)
    half = training(tmp_path, "a", 1, 5)
    record = yaml.safe_load((half / "config.yml").read_text())
    (half / "config.yml").write_text(yaml.safe_dump({key: value for key, value in record.items() if key != "result"}))
    member = training(tmp_path, "union", 2, 7)
    shutil.copytree(member, member / "member_0")  # below a training lies none that counts
    runs, others = store.read_results(tmp_path)
    assert [run.trial.seed for run in runs] == [2, 0] and others == [half]
    with pytest.raises(ValueError, match="have left their records"):
        store.read_results(tmp_path / "nowhere")


def test_the_table_says_what_the_evaluations_say(tmp_path):
    """Interquartile means by scipy's trimmed mean; of one seed the number itself."""
    successes = [3, 10, 12, 20, 20, 0]
    for seed, n in enumerate(successes):
        training(tmp_path, "td3_c51", seed, n, env="AntMazeV1-v0")
    training(tmp_path, "alone", 0, 4, env="AntMazeV1-v0")
    table = summary.task_table(store.read_results(tmp_path)[0]).set_index("")
    mean, low, high = map(float, re.findall(r"[\d.]+", table.loc["td3_c51", "success"]))
    assert mean == pytest.approx(trim_mean(np.array(successes) / 20, 0.25), abs=0.005)
    assert 0 <= low < mean < high <= 1
    assert table.loc["alone", "success"] == "0.20" and table.loc["alone", "seeds"] == "1"
    # Learning alone: 2 + 3 + 0.5 + 1.5 seconds for 500 updates
    assert table.loc["alone", "learning, s per 1000 updates"] == "14.0"
    # The paper's own beside its algorithm, and not beside what somebody made of it
    assert table.loc["td3_c51", "paper: length"] == "59.2" and table.loc["alone", "paper: length"] == "-"


def test_intervals_cover_as_often_as_they_say():
    """Of 12 seeds' interquartile mean, in 95 of 100 cases; the percentile bootstrap is known to fall short with few."""
    rng = np.random.default_rng(0)
    found = [summary.interquartile_mean(list(rng.uniform(size=12))) for _ in range(150)]
    covered = np.mean([low <= 0.5 <= high for _, low, high in found])
    assert 0.85 <= covered <= 0.99
    assert summary.interquartile_mean([0.3, 0.3, 0.3]) == (0.3, 0.3, 0.3)


def test_over_tasks_only_what_has_all(tmp_path):
    for env, n in ((ENV, 10), ("PointMazeV2-v0", 20)):
        for seed in (0, 1):
            training(tmp_path, "all", seed, n, env=env)
    training(tmp_path, "one", 0, 20)
    found = summary.over_tasks(store.read_results(tmp_path)[0], "success")
    assert list(found) == ["all"] and found["all"] == pytest.approx((0.75, 0.75, 0.75))


def test_curves_pass_through_the_tests(tmp_path):
    training(tmp_path, "a", 0, 20)
    training(tmp_path, "a", 1, 10)
    (training(tmp_path, "without a curve", 0, 20) / "curve.csv").unlink()
    figure = figures.curves(store.read_results(tmp_path)[0], "success_rate")
    (line,) = [line for line in figure.axes[0].lines if len(line.get_xdata())]
    np.testing.assert_allclose(np.interp([0, 25, 50, 100], *line.get_data()), [0, 0.25, 0.5, 0.75], atol=0.01)
    (band,) = figure.axes[0].collections
    assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx(1.0)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a"]


def test_each_of_many_variants_has_a_panel(tmp_path):
    """Thirteen lines in one panel cannot be told apart; the unchanged algorithm comes first."""
    for number in range(13):
        training(tmp_path, f"a{number:02}", 0, number)
    training(tmp_path, "td3_c51", 0, 20)
    figure = figures.curves(store.read_results(tmp_path)[0], "success_rate")
    panels = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title().split()[0] for axes in panels] == ["td3_c51", *(f"a{number:02}" for number in range(13))]
    # Behind it are all means, in front its own
    for axes, n_successes in zip(panels, [20, *range(13)], strict=True):
        *behind, own = axes.lines
        assert len(behind) == 14 and own.get_ydata()[-1] == pytest.approx(n_successes / 20)
        assert sorted(line.get_ydata()[-1] for line in behind) == pytest.approx([n / 20 for n in [*range(13), 20]])


def test_a_report_of_everything(tmp_path):
    for value in (1, 4):
        for seed in (0, 1):
            training(tmp_path, f"steps {value}", seed, 5 * value, elsewhere=3, gradient_steps=value, algo="ddiffpg")
            training(tmp_path, f"steps {value}", seed, 5, env="PointMazeV2-v0", gradient_steps=value, algo="ddiffpg")
    page = make_report(tmp_path, tmp_path / "out", "<a & b>", ablation="gradient_steps")
    names = {
        "ablation",
        "aggregate",
        "cells",
        "commanded_modes",
        "expected_modes",
        "success_rate",
        "success_rate_hours",
        "wall_clock",
    }
    assert {path.stem for path in (tmp_path / "out").glob("*.png")} == names
    html, text = page.read_text(), (tmp_path / "out" / "report.md").read_text()
    assert "<title>&lt;a &amp; b&gt;</title>" in html and html.count("data:image/png;base64,") == len(names)
    assert not re.search(r'(src|href)="(?!data:)', html)
    assert "tested in" in text and "PointMazeRandom-v0" in text and html.count("<table>") == 3
    # A report that is made twice is the same
    before = text
    make_report(tmp_path, tmp_path / "out", "<a & b>", ablation="gradient_steps")
    assert (tmp_path / "out" / "report.md").read_text() == before


def test_a_report_of_a_suite_leaves_out_what_else_lies_there(tmp_path):
    for variant, env in (("a", ENV), ("b", ENV), ("a", "PointMazeV2-v0")):
        training(tmp_path, variant, 0, 10, env=env)
    text = make_report(tmp_path, tmp_path / "out", "x", suite=({ENV: None}, {"a": None})).with_suffix(".md").read_text()
    assert "| a |" in text and "| b |" not in text and "PointMazeV2" not in text


def test_the_last_model_is_told_beside_the_best(tmp_path):
    for seed, best_step in enumerate((100, 50, 50)):
        folder = training(tmp_path, "a", seed, 20)
        record = yaml.safe_load((folder / "config.yml").read_text())
        record["result"]["best_step"] = best_step
        (folder / "config.yml").write_text(yaml.safe_dump(record))
        if seed == 1:
            evaluation(5).save(folder / "logs" / "evaluation_final.json")
    runs = store.read_results(tmp_path)[0]
    assert [run.last_success for run in runs][:2] == [1.0, 0.25] and np.isnan(runs[2].last_success)
    assert summary.task_table(runs).loc[0, "success, last model"] == "0.62 [0.25, 1.00] (of 2)"


@pytest.mark.parametrize("missing", ["machine", "versions", "git_commit", "hours", "steps"])
def test_a_record_that_lacks_something_is_named(tmp_path, missing):
    folder = training(tmp_path, "a", 0, 20)
    record = yaml.safe_load((folder / "config.yml").read_text())
    (record["result"] if missing in record["result"] else record).pop(missing)
    (folder / "config.yml").write_text(yaml.safe_dump(record))
    with pytest.raises(ValueError, match=f"seed0: its record has no .*{missing}"):
        store.read_results(tmp_path)


@pytest.mark.parametrize(("steps", "said"), [(1600, "1600"), (150_016, "150 k"), (4_000_000, "4,000 k")])
def test_steps_are_told_in_thousands(tmp_path, steps, said):
    folder = training(tmp_path, "a", 0, 20)
    record = yaml.safe_load((folder / "config.yml").read_text())
    record["result"]["steps"] = steps
    (folder / "config.yml").write_text(yaml.safe_dump(record))
    assert summary.task_table(store.read_results(tmp_path)[0]).loc[0, "steps"] == said


def test_few_seeds_have_a_range():
    """A percentile bootstrap of three would hold the truth in 72 of 100 cases, and say 95."""
    assert summary.interquartile_mean([0.2, 0.9, 0.4]) == (pytest.approx(0.5), 0.2, 0.9)
    assert summary.interquartile_mean([0.0, 0.4, 0.6, 1.0]) == (pytest.approx(0.5), 0.0, 1.0)


def test_a_report_of_nothing(tmp_path):
    folder = training(tmp_path, "a", 0, 5)
    (folder / "evaluation.json").unlink()
    with pytest.raises(ValueError, match="none of the 1 trainings"):
        make_report(tmp_path, tmp_path / "out", "x")
    with pytest.raises(SystemExit):
        cli.main(["report", str(tmp_path / "nowhere")])


def test_parts_are_timed_without_those_within_them(monkeypatch):
    clock = iter([0, 1, 3, 10])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    stopwatch = Stopwatch({"critic": 5.0})
    inner = stopwatch.timed("critic", lambda: "found")
    assert stopwatch.timed("policy", lambda: inner())() == "found"
    assert stopwatch.seconds["critic"] == 5.0 + 2 and stopwatch.seconds["policy"] == 10 - 2


@pytest.mark.parametrize("name", ["ddiffpg", *BASELINES])
def test_all_of_a_training_is_timed(name, monkeypatch):
    """
    The parts add up to what it took, but for what is between them; and afterwards nothing is changed. The clock counts
    function calls, so that it does not matter who else is busy.
    """
    cls = DDiffPG if name == "ddiffpg" else BASELINES[name]
    policy = "DiffusionPolicy" if name == "ddiffpg" else "MlpPolicy"
    env = make_vec_env(ENV, 4, seed=0)
    model = cls(policy, env, learning_starts=40, batch_size=16, policy_kwargs={"net_arch": [16]}, seed=0)
    before = {attribute: getattr(cls, attribute) for attribute in dir(cls)}
    stopwatch, calls = Stopwatch(), itertools.count()
    monkeypatch.setattr(time, "perf_counter", lambda: next(calls))
    sys.setprofile(lambda *_: next(calls))
    try:
        began = next(calls)
        with stopwatch.timing(model):
            model.learn(400)
        took = next(calls) - began
    finally:
        sys.setprofile(None)
    assert {attribute: getattr(cls, attribute) for attribute in dir(cls)} == before
    assert 0.98 * took < sum(stopwatch.seconds.values()) <= took
    updates = {"target action"} if name in ("ddiffpg", "dipo") else set()
    assert {part for part, seconds in stopwatch.seconds.items() if seconds > 0} == {
        "collection",
        "critic",
        "policy",
        "other learning",
        "callbacks",
    } | updates


@pytest.mark.parametrize("name", ["ddiffpg", *BASELINES])
def test_values_of_states(name):
    """What the critics say of actions of the policy: between the smallest and the largest of many."""
    cls = DDiffPG if name == "ddiffpg" else BASELINES[name]
    policy = "DiffusionPolicy" if name == "ddiffpg" else "MlpPolicy"
    env = make_vec_env(ENV, 2, seed=0)
    model = cls(policy, env, policy_kwargs={"net_arch": [16]}, seed=0)
    observations = np.random.default_rng(0).normal(size=(7, 4)).astype(np.float32)
    one = model.state_values(observations, n_actions=1)
    assert one.shape == (7,) and np.isfinite(one).all()
    many = np.array([model.state_values(observations, n_actions=1) for _ in range(60)])
    mean = model.state_values(observations, n_actions=400)
    np.testing.assert_allclose(many.mean(axis=0), mean, atol=4 * many.std() / np.sqrt(60) + 0.02)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A recorded training with a model."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    settings = "{n_timesteps: 800, learning_starts: 320, n_envs: 4, policy_kwargs: 'dict(net_arch=[16])'}"
    arguments = ["trial", "--env", ENV, "--override", settings, "--tests", "{n_tests: 1, n_test_episodes: 2, n_episodes: 3}"]
    cli.main([*arguments, "--out", str(folder)])
    return folder


def test_a_card_and_its_upload(trained, capsys):
    """Offline up to the upload itself; what it says of loading the model is so."""
    cli.main(["card", str(trained), "--repo-id", "me/it"])
    text = (trained / "README.md").read_text()
    head = yaml.safe_load(text.split("---")[1])
    metrics = {each["type"]: each["value"] for each in head["model-index"][0]["results"][0]["metrics"]}
    found = ModeEvaluation.load(trained / "evaluation.json")
    assert metrics["success_rate"] == pytest.approx(found.uncommanded.success_rate, abs=1e-4)
    assert head["library_name"] == "stable-baselines3" and str(found) in text
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]
    code = code.replace(
        "from huggingface_hub import hf_hub_download", f"hf_hub_download = lambda _, name: {str(trained)!r} + '/' + name"
    )
    scope = {"observation": np.zeros(4, dtype=np.float32)}
    exec(code, scope)
    assert scope["action"].shape == (2,)

    calls = []

    class Api:
        def create_repo(self, repo_id, exist_ok):
            calls.append((repo_id, exist_ok))

        def upload_folder(self, **kwargs):
            calls.append(kwargs)
            return "https://there"

    class Offline(Api):
        def create_repo(self, repo_id, exist_ok):
            raise RuntimeError("no network")

    with pytest.raises(OSError, match=r"README.md is written, but not uploaded to me/it: RuntimeError\('no network'\)"):
        card.upload(trained, "me/it", api=Offline())

    assert card.upload(trained, "me/it", Api()) == "https://there"
    assert calls[0] == ("me/it", True) and calls[1]["folder_path"] == trained and "logs" not in str(calls[1]["allow_patterns"])
    for arguments in ([str(trained), "--repo-id", "it"], [str(trained / "logs"), "--repo-id", "me/it"]):
        with pytest.raises(SystemExit) as ended:
            cli.main(["upload", *arguments])
        assert ended.value.code == 2


def test_maps_of_a_trained_model(trained):
    maps = figures.Maps(store.read_results(trained)[0])
    assert isinstance(maps.exploration(), Figure) and isinstance(maps.values(), Figure)


def test_the_papers_numbers_are_whole():
    """Eight tasks and the random one; the numbers of four cells, read in the paper."""
    paper = summary.paper_results()
    assert len(paper) == 9 and all(len(cells) == 3 for row in paper.values() for cells in row.values())
    assert {len(row) for name, row in paper.items() if "Ant" in name} == {7} and json.dumps(paper)
    assert paper["AntMazeV3-v0"]["ddiffpg"] == [4.3, 0.98, 142.5] and paper["FrankaCabinetOpen-v0"]["sac_c51"] == [
        1,
        1.0,
        24.3,
    ]
    assert paper["AntMazeRandom-v0"]["td3_c51"] == [None, 0.5, 310.2] and paper["AntMazeV2-v0"]["rpg"] == [1.5, 0.5, 259.4]


def test_only_seeds_of_the_same_are_averaged(tmp_path):
    """Not a training with other settings, and not one seed twice."""
    training(tmp_path, "a", 0, 5)
    other = training(tmp_path, "a", 1, 5, gamma=0.5)
    with pytest.raises(ValueError, match="differ in their settings"):
        make_report(tmp_path, tmp_path / "out", "x")
    shutil.rmtree(other)
    shutil.copytree(tmp_path / ENV / "a" / "seed0", tmp_path / "copy")
    with pytest.raises(ValueError, match="have the same seed"):
        make_report(tmp_path, tmp_path / "out", "x")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[1]",
        "\0\xff",
        "algo: ddiffpg",
        "result: null",
        "{algo: ddiffpg, env: x, seed: 0, hyperparams: {}, result: 5}",
    ],
)
def test_a_damaged_record_is_no_training_and_hides_none(tmp_path, text):
    """What lies below it is not taken for others."""
    training(tmp_path, "a", 0, 5)
    damaged = training(tmp_path, "union", 0, 5)
    shutil.copytree(damaged, damaged / "member_0")
    (damaged / "config.yml").write_bytes(text.encode("latin-1"))
    runs, others = store.read_results(tmp_path)
    assert [run.trial.variant for run in runs] == ["a"] and others == [damaged]
    for command in (
        ["report", str(damaged)],
        ["card", str(damaged), "--repo-id", "a/b"],
        ["trial", "--again", str(damaged), "--out", "x"],
    ):
        with pytest.raises(SystemExit) as ended:
            cli.main(command)
        assert ended.value.code == 2


@pytest.mark.parametrize("name", ["curve.csv", "evaluation.json"])
def test_a_damaged_file_is_named(tmp_path, name, capsys):
    (training(tmp_path, "a", 0, 5) / name).write_text("")
    with pytest.raises(SystemExit):
        cli.main(["report", str(tmp_path)])
    assert "seed0" in capsys.readouterr().err


def test_what_is_not_known_is_not_counted(tmp_path):
    """No success has no length; records of before say nothing of what learning does beside its parts."""
    for seed, n in enumerate((0, 0, 20)):
        training(tmp_path, "td3", seed, n, algo="td3")
    runs = store.read_results(tmp_path)[0]
    table = summary.task_table(runs)
    assert table.loc[0, "length"] == "20.0 (of 1)" and table.loc[0, "seeds"] == "3"
    for run in runs:
        del run.record["result"]["seconds"]["other learning"]
    assert summary.seconds_per_update(runs[0]) is None and not figures.wall_clock(runs).axes[0].patches
