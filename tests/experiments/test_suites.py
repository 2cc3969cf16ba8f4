"""Many trials by one command: what is declared, what is missing, what dies and goes on, on this machine and on Ray."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml
from filelock import FileLock

from sb3_ddiffpg.experiments import __main__ as cli
from sb3_ddiffpg.experiments import execution
from sb3_ddiffpg.experiments.execution import LocalExecutor, TrialFailed
from sb3_ddiffpg.experiments.progress import Progress, read_progress, write_progress
from sb3_ddiffpg.experiments.record import is_complete, new_record, recorded_trial
from sb3_ddiffpg.experiments.run import missing_trials, run_suite
from sb3_ddiffpg.experiments.suite import Resources, read_suite, suite_names
from sb3_ddiffpg.experiments.trial import setting_of

TINY = """
description: Two algorithms, hardly trained
tasks: {PointMazeV1-v0: {learning_starts: 320}}
variants:
  ddiffpg: {settings: {policy_kwargs: "dict(net_arch=[16])"}}
  "td3_c51, wide": {algo: td3_c51}
seeds: [0]
settings: {n_timesteps: 800, n_envs: 4}
tests: {n_tests: 2, n_test_episodes: 2, n_episodes: 3}
"""
# Under which nothing else is refused
ALSO = "\nalso: {PointMazeV1-v0: [PointMazeV2-v0]}"


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.yml"
    path.write_text(TINY)
    return path


@pytest.fixture
def start():
    """Starts processes that do not outlive the test."""
    started = []

    def begin(command):
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT))
        return started[-1]

    yield begin
    for process in started:
        process.kill()
        process.communicate()


def test_settings_go_from_the_general_to_the_particular(tmp_path):
    path = tmp_path / "a.yml"
    path.write_text(
        """
        description: nothing
        tasks: {PointMazeV1-v0: {gamma: 0.5, tau: 0.2}, PointMazeV2-v0: }
        variants: {a: {settings: {tau: 0.3}}, b: {algo: td3_c51}}
        settings: {gamma: 0.4, batch_size: 64}
        seeds: [3, 1]
        also: {PointMazeV2-v0: [PointMazeRandom-v0]}
        """
    )
    trials = read_suite(str(path)).trials()
    found = {place: [trial.hyperparams[name] for name in ("batch_size", "gamma")] for place, trial in trials.items()}
    both = [
        Path(task, variant, f"seed{seed}")
        for seed in (3, 1)
        for task in ("PointMazeV1-v0", "PointMazeV2-v0")
        for variant in "ab"
    ]
    assert list(found) == both  # all of the first seed first
    assert found[both[0]] == [64, 0.5] and found[both[2]] == [64, 0.4]
    assert trials[both[0]].hyperparams["tau"] == 0.3 and trials[both[1]].hyperparams["tau"] == 0.2
    assert trials[both[0]].tests.also == [] and trials[both[2]].tests.also == ["PointMazeRandom-v0"]
    # What the file does not say is of the algorithm's own entry
    own = yaml.safe_load((Path(__file__).parents[2] / "zoo_hyperparams" / "td3_c51.yml").read_text())["PointMazeV2-v0"]
    assert trials[both[3]].hyperparams == {**own, "gamma": 0.4, "batch_size": 64}


def test_groups_of_settings_change_setting_by_setting(tmp_path):
    """From the file's entry over the suite's and the task's settings to the variant's, in whatever form each says it."""
    path = tmp_path / "a.yml"
    path.write_text(
        """
        description: nothing
        tasks: {PointMazeV1-v0: {critic: {v_max: 8}}}
        variants:
          a: {settings: {critic: {v_min: -1}, mode_trials: 9}}
          b: {algo: td3_c51}
          c: {algo: ddiffpg_random_clusters}
        settings: {critic: {v_max: 7, n_atoms: 11}, novelty: {coef: 0.2}}
        seeds: [0]
        """
    )
    found = {place.parts[1]: trial.hyperparams for place, trial in read_suite(str(path)).trials().items()}
    assert found["a"]["critic"] == {"v_max": 8, "n_atoms": 11, "v_min": -1} and found["a"]["modes"] == {"trials": 9}
    assert found["b"]["critic"] == {"v_max": 8, "n_atoms": 11}
    # PointMazeV1's own, of which nothing was said; an ablation's are DDiffPG's
    assert found["a"]["exploration"] == found["c"]["exploration"] == {"fraction": 0.7, "n_steps": 3}
    assert all(each["novelty"] == {"coef": 0.2} for each in found.values())


def test_a_report_over_the_values_of_a_setting_of_a_group(tmp_path):
    path = tmp_path / "a.yml"
    path.write_text(
        """
        description: two learning rates
        tasks: {PointMazeV1-v0: }
        variants:
          low: {settings: {target_action: {learning_rate: 0.1}}}
          high: {settings: {target_action.learning_rate: 0.4}}
        seeds: [0]
        settings: {n_timesteps: 400, n_envs: 4, learning_starts: 320, policy_kwargs: "dict(net_arch=[16])"}
        tests: {n_tests: 1, n_test_episodes: 2, n_episodes: 2}
        ablation: target_action.learning_rate
        """
    )
    cli.main(["run", str(path), "--out", str(tmp_path / "out"), "--workers", "2"])
    assert (tmp_path / "out" / "report" / "ablation.png").is_file()
    page = (tmp_path / "out" / "report" / "report.html").read_text()
    assert "The models of the tables over target_action.learning_rate" in page


@pytest.mark.parametrize("name", suite_names())
def test_every_suite_of_the_package_can_be_run(name):
    suite = read_suite(name)
    if any("Franka" in task for task in suite.tasks):
        pytest.importorskip("pybullet")
    suite.leave_out()  # of the one for tasks of others
    assert len(suite.trials()) == len(suite.tasks) * len(suite.variants) * len(suite.seeds)
    if suite.ablation is not None:
        values = [setting_of(trial, suite.ablation) for trial in suite.trials().values()]
        assert len(set(values)) == len(suite.variants)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("description:", "dscription:"), "dscription"),
        (("seeds: [0]", "seeds: [0, 0]"), "seeds"),
        (("seeds: [0]", "seeds: [one]"), "seeds"),
        (("{algo: td3_c51}", "{algo: td4}"), "td4"),
        (("{learning_starts: 320}", "{learning_strts: 320}"), "learning_starts"),
        (("PointMazeV1-v0", "PointMazeV9-v0"), "PointMazeV9-v0"),
        (("n_tests: 2", "n_tests: 0"), "n_tests"),
        (("seeds: [0]", "also: {AntMazeV1-v0: []}\nseeds: [0]"), "AntMazeV1-v0"),
        (("variants:", "variants: ["), "is no YAML"),
        (("seeds: [0]", "seeds: [0]\nseeds: [1]"), "'seeds' stands twice"),
        (("td3_c51, wide", "ddiffpg"), "'ddiffpg' stands twice"),
        (("seeds: [0]", "seeds: [0]\n? [1, 2]\n: 3"), "is no YAML"),
        (("td3_c51, wide", "wide "), "variant"),
        (("{algo: td3_c51", "{algorithm: td3_c51"), "accepted are algo, conf_file, settings, members"),
        (("seeds: [0]", "resources: {gpus: .nan}\nseeds: [0]"), "gpus"),
        (("seeds: [0]", "also: {PointMazeV1-v0: [AntMazeV1-v0]}\nseeds: [0]"), "observations or actions are not those of"),
        (("td3_c51, wide", "../wide"), "variant"),
        (("td3_c51, wide", "a/b"), "variant"),
        (("td3_c51, wide", "a|b"), "variant"),
        (("td3_c51, wide", "-x"), "variant"),
        (("td3_c51, wide", ""), "variant"),
        (("seeds: [0]", "seeds: [-1]"), "seed"),
        (("seeds: [0]", "seeds: [4294967296]"), "seed"),
        (("seeds: [0]", "seeds: [0]\nresources: {cpus: 0}"), "resources"),
        (("seeds: [0]", "seeds: [0]\nablation: nonsense"), "ablation"),
        (("seeds: [0]", "seeds: [0]\nconf_file: tiny.yml"), "conf-file"),
        (("{algo: td3_c51}", "{algo: td3_c51, members: 2000}"), "members"),
        (("{n_timesteps: 800", "{normalize: true, n_timesteps: 800"), "normalize"),
    ],
)
def test_a_suite_that_cannot_be_is_refused_before_anything_runs(tiny, tmp_path, capsys, change, said):
    tiny.write_text(TINY.replace(*change) + (ALSO if said == "normalize" else ""))
    with pytest.raises(SystemExit) as ended:
        cli.main(["run", str(tiny), "--out", str(tmp_path / "out")])
    assert ended.value.code == 2 and said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_parts_of_a_suite(tiny, tmp_path, capsys):
    cli.main(["run", str(tiny), "--out", str(tmp_path / "out"), "--variants", "ddiffpg", "--seeds", "4", "5", "--list"])
    assert capsys.readouterr().out.split()[-2:] == ["PointMazeV1-v0/ddiffpg/seed4", "PointMazeV1-v0/ddiffpg/seed5"]
    for arguments in (["nope"], [str(tiny), "--variants", "nope"], [str(tiny), "--tasks", "x"], [str(tiny), "--workers", "0"]):
        with pytest.raises(SystemExit):
            cli.main(["run", *arguments, "--out", str(tmp_path / "out")])


def test_a_suite_runs_once(tiny, tmp_path, capsys):
    """The second time there is nothing to do; a folder of other trainings is left alone."""
    command = ["run", str(tiny), "--out", str(tmp_path / "out"), "--workers", "2"]
    cli.main(command)
    folders = [tmp_path / "out" / place for place in read_suite(str(tiny)).trials()]
    assert all(is_complete(folder) for folder in folders)
    assert [recorded_trial(folder).variant for folder in folders] == ["ddiffpg", "td3_c51, wide"]
    assert not list((tmp_path / "out").rglob("checkpoint_*"))
    page = (tmp_path / "out" / "report" / "report.html").read_text()
    assert "td3_c51, wide" in page and page.count("data:image/png") >= 6 and 'src="success' not in page
    before = {folder: (folder / "model.zip").stat().st_mtime_ns for folder in folders}
    capsys.readouterr()
    cli.main([*command, "--no-report"])
    assert "0 of 2 trials" in capsys.readouterr().out
    assert {folder: (folder / "model.zip").stat().st_mtime_ns for folder in folders} == before
    tiny.write_text(TINY.replace("n_envs: 4", "n_envs: 8"))
    with pytest.raises(SystemExit):
        cli.main(command)
    assert "holds another training" in capsys.readouterr().err


def test_a_run_that_ended_holds_its_folder_no_longer(tiny, tmp_path, monkeypatch):
    """Whoever keeps its error keeps all that it had in hand."""
    command = ["run", str(tiny), "--out", str(tmp_path / "out"), "--no-report"]

    def fail(*_):
        raise RuntimeError("no more")

    monkeypatch.setattr("sb3_ddiffpg.experiments.run.run_suite", fail)
    kept = []
    for _ in range(2):
        with pytest.raises(RuntimeError, match="no more") as failed:
            cli.main(command)
        kept.append(failed.value)


def _wait_for(condition, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _checkpoints(folder):
    """Those after the first step."""
    return [path for path in folder.rglob("checkpoint_*.safetensors") if int(path.stem.split("_")[1])]


def _processes():
    """Number, parent's number and command line of each."""
    return subprocess.run(["ps", "-wweo", "pid,ppid,args"], capture_output=True, text=True).stdout.split("\n")


def test_a_process_that_dies_is_started_again(tiny, tmp_path):
    """And goes on from its checkpoint: the file that the dead one left says so."""
    tiny.write_text(TINY.replace("n_timesteps: 800", "n_timesteps: 2400"))
    suite = read_suite(str(tiny), variants=["ddiffpg"])
    place = next(iter(suite.trials()))
    executor = LocalExecutor(workers=1, retries=1)

    def kill():
        _wait_for(lambda: _checkpoints(tmp_path / place))
        os.kill(next(iter(executor._running)).pid, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    failed = run_suite("tiny", suite, tmp_path, executor)
    killer.join()
    assert not failed and is_complete(tmp_path / place)
    assert (tmp_path / place / "logs" / "output.log").read_text().count("Using cpu device") >= 2


def test_what_cannot_be_is_tried_once(tiny, tmp_path, monkeypatch, capsys):
    command = [sys.executable, "-c", "print('gamma must be'); raise SystemExit(2)"]
    monkeypatch.setattr(execution, "command_of", lambda *_: command)
    with pytest.raises(SystemExit, match="trials failed"):
        cli.main(["run", str(tiny), "--out", str(tmp_path), "--workers", "1", "--retries", "2", "--no-report"])
    for path in tmp_path.glob("*/*/*/logs/output.log"):
        assert path.read_text().count("gamma must be") == 1
    assert "ended with code 2: gamma must be" in capsys.readouterr().out.replace("\n", " ")


def test_two_runs_do_not_share_a_folder(tiny, tmp_path, capsys):
    with FileLock(tmp_path / ".lock"), pytest.raises(SystemExit) as ended:
        cli.main(["run", str(tiny), "--out", str(tmp_path), "--no-report"])
    assert ended.value.code == 2 and "another run is at work" in capsys.readouterr().err
    assert not list(tmp_path.glob("*/*"))


@pytest.mark.parametrize("command", ["run", "trial", "report"])
def test_a_file_is_no_folder(tiny, tmp_path, capsys, command):
    (tmp_path / "file").touch()
    rest = {"run": [str(tiny), "--list"], "trial": ["--env", "PointMazeV1-v0"], "report": [str(tmp_path)]}[command]
    for place in ("file", "file/below"):
        with pytest.raises(SystemExit) as ended:
            cli.main([command, *rest, "--out", str(tmp_path / place)])
        assert ended.value.code == 2 and "is no folder; accepted is a folder" in capsys.readouterr().err


def test_what_lost_its_evaluation_is_not_complete(tmp_path):
    record = {"algo": "ddiffpg", "env": "PointMazeV1-v0", "seed": 0, "hyperparams": {}, "result": {"complete": True}}
    (tmp_path / "config.yml").write_text(yaml.safe_dump(record))
    assert not is_complete(tmp_path)
    (tmp_path / "evaluation.json").touch()
    assert is_complete(tmp_path)


def test_what_fails_is_named_and_the_others_go_on(tiny, tmp_path, monkeypatch, capsys):
    """After all attempts."""
    # What a training leaves, without its training
    finished = (
        "import os, sys; os.chdir(sys.argv[1]); "
        "open('config.yml', 'w').write(sys.argv[2]); open('evaluation.json', 'w').close()"
    )

    def broken(trial, folder):
        if trial.algo != "ddiffpg":
            return [sys.executable, "-c", "print('once'); raise SystemExit(3)"]
        record = yaml.safe_dump({**new_record(trial, folder), "result": {"complete": True}})
        return [sys.executable, "-c", finished, str(folder), record]

    monkeypatch.setattr(execution, "command_of", broken)
    with pytest.raises(SystemExit, match="1 trials failed: PointMazeV1-v0/td3_c51, wide/seed0"):
        cli.main(["run", str(tiny), "--out", str(tmp_path), "--workers", "1", "--retries", "2", "--no-report"])
    assert "ended with code 3" in capsys.readouterr().out.replace("\n", " ")
    log = tmp_path / "PointMazeV1-v0" / "td3_c51, wide" / "seed0" / "logs" / "output.log"
    assert log.read_text() == "once\n" * 3
    assert [place.parts[1] for place in missing_trials(read_suite(str(tiny)), tmp_path)] == ["td3_c51, wide"]


def test_ctrl_c_ends_all_with_a_checkpoint(tiny, tmp_path, start):
    """And the same command goes on."""
    tiny.write_text(TINY.replace("n_timesteps: 800", "n_timesteps: 100000000"))
    command = [sys.executable, "-m", "sb3_ddiffpg.experiments", "run", str(tiny), "--out", str(tmp_path / "out")]
    # In the background a shell may have told processes to ignore it
    script = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    script += "from sb3_ddiffpg.experiments.__main__ import main; main(sys.argv[1:])"
    process = start([sys.executable, "-c", script, *command[3:]])
    _wait_for(lambda: len(list((tmp_path / "out").rglob("progress.json"))) == 2)
    process.send_signal(signal.SIGINT)
    assert process.wait(90) != 0
    assert {path.parents[2].name for path in _checkpoints(tmp_path / "out")} == {"seed0"}
    assert len(_checkpoints(tmp_path / "out")) == 2


def test_a_runner_that_is_killed_leaves_no_process(tiny, tmp_path, start):
    tiny.write_text(TINY.replace("n_timesteps: 800", "n_timesteps: 100000000"))
    command = [sys.executable, "-m", "sb3_ddiffpg.experiments", "run", str(tiny), "--out", str(tmp_path / "out")]
    process = start(command)
    _wait_for(lambda: len(list((tmp_path / "out").rglob("progress.json"))) == 2)
    process.kill()
    process.wait()
    # Each writes a checkpoint when the other end of its standard input closes
    _wait_for(lambda: len(_checkpoints(tmp_path / "out")) >= 2, 90)
    _wait_for(lambda: not [line for line in _processes() if str(tmp_path) in line], 60)


def test_a_suite_that_is_killed_goes_on_and_repeats_nothing(tiny, tmp_path, start, capsys):
    """The runner and what it runs, all by SIGKILL, when one of two trials is complete."""
    text = TINY.replace("n_timesteps: 800", "n_timesteps: 2400")
    tiny.write_text(text.replace("settings: {policy_kwargs", "settings: {n_timesteps: 800, policy_kwargs"))
    out = tmp_path / "out"
    arguments = ["run", str(tiny), "--out", str(out), "--workers", "1", "--no-report"]
    process = start([sys.executable, "-m", "sb3_ddiffpg.experiments", *arguments])
    first, second = (out / place for place in read_suite(str(tiny)).trials())
    _wait_for(lambda: is_complete(first) and _checkpoints(second), 240)
    trials = [int(line.split()[0]) for line in _processes() if " trial " in line and str(out) in line]
    for number in (process.pid, *trials):
        os.kill(number, signal.SIGKILL)
    process.wait()
    assert trials and not is_complete(second)
    before = {path: path.stat().st_mtime_ns for path in first.rglob("*") if path.is_file()}
    cli.main(arguments)
    assert "1 of 2 trials to run" in capsys.readouterr().out and is_complete(second)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    steps = (second / "logs" / "output.log").read_text().split("Going on at step ")[1].split()[0]
    assert int(steps) > 0 and not list(second.rglob("checkpoint_*"))


def test_progress_that_cannot_be_written_or_read(tmp_path):
    assert read_progress(tmp_path) is None
    write_progress(tmp_path, Progress(5, 10))
    assert read_progress(tmp_path) == Progress(5, 10, "training")
    (tmp_path / "progress.json").write_text("{half")
    assert read_progress(tmp_path) is None
    write_progress(tmp_path / "nowhere", Progress(5, 10))


def test_a_local_executor_that_is_stopped_runs_nothing_more(tiny, tmp_path):
    executor = LocalExecutor(workers=1, retries=3)
    trial = next(iter(read_suite(str(tiny)).trials().values()))
    executor.stop()
    with pytest.raises(RuntimeError):
        executor.submit(trial, tmp_path, Resources())
    with pytest.raises(TrialFailed, match="stopped"):
        executor._attempt(["false"], tmp_path, 1)


@pytest.mark.slow
def test_a_ray_worker_that_is_killed_is_replaced(tmp_path, start):
    """On a local Ray with two workers, one of them killed in the middle, with what it runs."""
    path = tmp_path / "tiny.yml"
    path.write_text(TINY.replace("n_timesteps: 800", "n_timesteps: 12000"))
    command = [sys.executable, "-m", "sb3_ddiffpg.experiments", "run", str(path), "--out", str(tmp_path / "out")]
    process = start([*command, "--ray", "--workers", "2", "--no-report"])
    place = tmp_path / "out" / "PointMazeV1-v0" / "ddiffpg" / "seed0"
    _wait_for(lambda: _checkpoints(place), 240)
    worker = next(int(line.split()[1]) for line in _processes() if "trial" in line and str(place) in line)
    os.kill(worker, signal.SIGKILL)
    said = process.communicate(timeout=400)[0].decode()
    assert process.returncode == 0, said
    assert is_complete(place) and said.count("complete") == 2
    assert (place / "logs" / "output.log").read_text().count("Using cpu device") >= 2
