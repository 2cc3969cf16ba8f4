"""A package of somebody else through all commands: its id with the module, its arguments, and the wrapper of the YAML file."""

import json
import sys
from importlib import import_module
from pathlib import Path

import gymnasium as gym
import pytest
import yaml
from environments import SMALL, small_model
from stable_baselines3.common.env_util import make_vec_env as make_sb3_vec_env

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg import report as report_command
from sb3_ddiffpg.envs.description import RememberedEnv, describe_env
from sb3_ddiffpg.evaluation import Replanner, evaluate_modes
from sb3_ddiffpg.experiments import __main__ as experiments
from sb3_ddiffpg.experiments.trial import hyperparameters
from sb3_ddiffpg.saving.checkpoint import checkpoint_files
from sb3_ddiffpg.zoo import main

PLACE = str(Path(__file__).parents[1] / "third_party")
ID, WITH_MODULE = "TinyEnds-v0", "tiny_tasks:TinyEnds-v0"
SCALED = {"tiny_tasks.wrappers.Scaled": {"factor": 10.0}}
PACKAGES = ["--gym-packages", "tiny_tasks", "tiny_tasks.wrappers"]
either_way = pytest.mark.parametrize(
    "named", [["--env", WITH_MODULE], ["--env", ID, "--gym-packages", "tiny_tasks"]], ids=["id", "packages"]
)


def forget():
    """As in a process that has never heard of it."""
    gym.registry.pop(ID, None)
    for name in [name for name in sys.modules if name.split(".")[0] == "tiny_tasks"]:
        del sys.modules[name]


@pytest.fixture(autouse=True)
def on_path(monkeypatch):
    forget()
    monkeypatch.syspath_prepend(PLACE)
    yield
    forget()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Trained by the command line: the settings, and the folder of the run."""
    folder = tmp_path_factory.mktemp("run")
    settings = {name: value for name, value in SMALL.items() if name != "seed"}
    settings["policy_kwargs"] = "dict(net_arch=[16])"
    entry = {"policy": "DiffusionPolicy", "n_timesteps": 400, "n_envs": 2, **settings}
    entry |= {"env_wrapper": SCALED, "env_kwargs": {"limit": 6}}
    (folder / "settings.yml").write_text(yaml.safe_dump({ID: entry}))
    sys.path.insert(0, PLACE)
    try:
        main(["train", *train_arguments(folder, WITH_MODULE), "--checkpoint-freq", "200"])
    finally:
        sys.path.remove(PLACE)
    return folder, folder / "logs" / "ddiffpg" / f"{ID}_1"


def train_arguments(folder, env_id):
    settings = ["--conf-file", str(folder / "settings.yml"), "--eval-freq", "-1", "--seed", "0"]
    return ["--env", env_id, *settings, "-f", str(folder / "logs"), "--device", "cpu"]


def trained(run):
    return DDiffPG.load(run[1] / f"{ID}.zip", device="cpu")


def test_what_it_was_trained_in_is_in_the_file(run):
    remembered = RememberedEnv.of(trained(run).env_spec)
    assert (remembered.id, remembered.kwargs, remembered.entry_point) == (ID, {"limit": 6}, "tiny_tasks.task:TinyEnds")
    (wrapper,) = remembered.wrappers
    assert (wrapper.entry_point, wrapper.kwargs) == ("tiny_tasks.wrappers:Scaled", {"factor": 10.0})


@pytest.mark.parametrize(
    "named", [["--env", WITH_MODULE], ["--env", ID, "--gym-packages", "tiny_tasks"]], ids=["id", "packages"]
)
def test_a_run_goes_on(run, named, tmp_path, capsys):
    folder, log = run
    main(["train", *train_arguments(folder, ID)[2:], *named, "--resume", str(log), "-n", "500", "--checkpoint-freq", "0"])
    assert "Going on at step 400 of" in capsys.readouterr().out
    assert len(checkpoint_files(log / "checkpoints")) >= 1


@pytest.mark.parametrize(
    "named", [["--env", WITH_MODULE], ["--env", ID, "--gym-packages", "tiny_tasks"]], ids=["id", "packages"]
)
def test_one_watches_it(run, named, capsys):
    folder = run[0]
    main(["enjoy", *named, "-f", str(folder / "logs"), "-n", "20", "--no-render", "--exp-id", "1", "--device", "cpu"])
    assert "Success rate" in capsys.readouterr().out


@pytest.mark.parametrize(
    "extra", [PACKAGES, ["--env", WITH_MODULE, "--env-kwargs", "limit=6", *PACKAGES]], ids=["left out", "given"]
)
def test_its_page(run, extra, tmp_path):
    model = [str(run[1] / f"{ID}.zip"), "--output", str(tmp_path / "page.html"), "--episodes", "2", "--no-videos"]
    report_command.main([*model, *extra, *PACKAGES])
    page = (tmp_path / "page.html").read_text()
    assert "--gym-packages tiny_tasks tiny_tasks.wrappers" in page and "limit=6" in page
    assert json.loads((tmp_path / "page.json").read_text())["env_id"] == ID


def test_a_page_that_cannot_be_leaves_nothing(run, tmp_path):
    """And says what to import."""
    with pytest.raises(SystemExit, match=r"a file imports nothing: .* --gym-packages tiny_tasks tiny_tasks\.wrappers"):
        report_command.main([str(run[1] / f"{ID}.zip"), "--output", str(tmp_path / "new" / "page.html")])
    assert list(tmp_path.iterdir()) == []
    assert not any(name.startswith("tiny_tasks") for name in sys.modules)


def test_an_old_page_stays_when_a_new_one_cannot_be(run, tmp_path):
    page = tmp_path / "page.html"
    page.write_text("old")
    with pytest.raises(SystemExit, match="--gym-packages: 'no_such' cannot be imported"):
        report_command.main([str(run[1] / f"{ID}.zip"), "--output", str(page), "--gym-packages", "no_such"])
    assert page.read_text() == "old" and list(tmp_path.iterdir()) == [page]


@pytest.mark.parametrize(
    "named", [["--env", WITH_MODULE], ["--env", ID, "--gym-packages", "tiny_tasks"]], ids=["id", "packages"]
)
def test_a_trial_of_it(run, named, tmp_path):
    tests = ["--tests", "{n_tests: 1, n_test_episodes: 2, n_episodes: 2}", "--seed", "0", "--out", str(tmp_path / "out")]
    experiments.main(
        ["trial", *named, "--conf-file", str(run[0] / "settings.yml"), "--override", "{n_timesteps: 100}", *tests]
    )
    record = yaml.safe_load((tmp_path / "out" / "config.yml").read_text())
    assert record["env"] == WITH_MODULE and record["result"]["complete"]
    assert json.loads((tmp_path / "out" / "evaluation.json").read_text())["env_id"] == ID
    assert RememberedEnv.of(DDiffPG.load(tmp_path / "out" / "model.zip").env_spec).wrappers[0].kwargs == {"factor": 10.0}
    forget()
    experiments.main(["report", str(tmp_path / "out")])
    assert ID in (tmp_path / "out" / "report" / "report.md").read_text()


def test_a_trial_without_an_entry_takes_the_default():
    assert hyperparameters("ddiffpg", WITH_MODULE, None) == {"policy": "DiffusionPolicy", "n_timesteps": 3e5, "n_envs": 8}


@pytest.mark.parametrize("env", [None, WITH_MODULE])
def test_it_is_evaluated_where_it_was_trained(run, env):
    model = trained(run)
    import_module("tiny_tasks.wrappers")
    agents = [model, *([Replanner(model)] if len(model.modes) else [])]
    assert len(agents) == 2
    for agent in agents:
        found = evaluate_modes(agent, env, n_episodes=2, seed=0)
        assert found.env_id == ID
        positions = [x for runs in found.episodes.values() for episode in runs for x in episode.path[:, 0]]
        assert max(map(abs, positions)) > 5  # in the units of the wrapper: 1 is 10 there


def test_a_file_imports_nothing(run, tmp_path):
    trained(run).export(tmp_path / "model.safetensors")
    forget()
    model = DDiffPG.load(tmp_path / "model.safetensors", safe=True, device="cpu")
    with pytest.raises(ValueError, match=r"a file imports nothing: .* --gym-packages tiny_tasks tiny_tasks\.wrappers"):
        evaluate_modes(model)
    assert not any(name.startswith("tiny_tasks") for name in sys.modules)
    with pytest.raises(ValueError, match=r"--gym-packages tiny_tasks\.wrappers"):
        evaluate_modes(model, WITH_MODULE)
    assert "tiny_tasks.wrappers" not in sys.modules


@pytest.mark.parametrize(
    ("entry_point", "message"),
    [
        ("subprocess:Popen", "has no such wrapper"),
        ("gymnasium.wrappers:no_such", "has no such wrapper"),
        ("antigravity:fly", "--gym-packages antigravity"),
    ],
)
def test_a_file_calls_nothing_but_wrappers(entry_point, message):
    wrapper = {"name": "x", "entry_point": entry_point, "kwargs": {"args": "true"}}
    spec = json.loads(gym.spec("PointMazeV1-v0").to_json()) | {"additional_wrappers": [wrapper]}
    model = type("Model", (), {"env_spec": json.dumps(spec)})()
    with pytest.raises(ValueError, match=message):
        evaluate_modes(model)
    assert "antigravity" not in sys.modules


def test_nothing_is_filmed_where_a_file_says():
    wrapper = {"name": "x", "entry_point": "gymnasium.wrappers:RecordVideo", "kwargs": {"video_folder": "/nowhere"}}
    spec = json.loads(gym.spec("PointMazeV1-v0").to_json()) | {"additional_wrappers": [wrapper]}
    assert RememberedEnv.of(json.dumps(spec)).wrapper() is None


def test_wrappers_given_in_python():
    """One that takes nothing else is remembered, one whose arguments nobody knows is named."""
    wrappers = import_module("tiny_tasks.wrappers")
    model = small_model(make_sb3_vec_env(ID, 1, wrapper_class=wrappers.Halved))
    assert evaluate_modes(model, n_episodes=1).env_id == ID
    model = small_model(make_sb3_vec_env(ID, 1, wrapper_class=wrappers.Scaled, wrapper_kwargs={"factor": 2.0}))
    with pytest.raises(ValueError, match="with which arguments the wrapper tiny_tasks.wrappers:Scaled was made"):
        evaluate_modes(model, n_episodes=1)


def test_wrappers_within_a_registered_task_are_not_put_on_twice():
    wrappers, task = import_module("tiny_tasks.wrappers"), import_module("tiny_tasks.task")
    gym.register("TinyWrapped-v0", entry_point=lambda **kwargs: wrappers.Scaled(task.TinyEnds(**kwargs), 3.0))
    try:
        env = make_sb3_vec_env("TinyWrapped-v0", 1, wrapper_class=wrappers.Halved)
        model = small_model(env)
        assert [each["kwargs"] for each in json.loads(describe_env(env))["additional_wrappers"]] == [None, {}]
        found = evaluate_modes(model, n_episodes=1)
        starts = [episode.path[0, 0] for runs in found.episodes.values() for episode in runs]
        assert found.env_id == "TinyWrapped-v0" and max(map(abs, starts)) < 0.1 * 3 * 0.5
    finally:
        gym.registry.pop("TinyWrapped-v0")


class Painted(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """It says of what it was made, which JSON cannot hold."""

    def __init__(self, env, brush):
        gym.utils.RecordConstructorArgs.__init__(self, brush=brush)
        gym.Wrapper.__init__(self, env)


def test_arguments_that_json_cannot_hold():
    import_module("tiny_tasks")
    env = make_sb3_vec_env(ID, 1, wrapper_class=Painted, wrapper_kwargs={"brush": object()})
    (wrapper,) = RememberedEnv.of(small_model(env).env_spec).wrappers
    assert (wrapper.name, wrapper.kwargs) == ("Painted", None)
    assert describe_env(make_sb3_vec_env(ID, 1, env_kwargs={"limit": {8}})) is None


def test_an_entry_point_that_is_a_class():
    task = import_module("tiny_tasks.task")
    gym.register("TinyClass-v0", entry_point=task.TinyEnds)
    try:
        model = small_model(make_sb3_vec_env("TinyClass-v0", 1))
        assert RememberedEnv.of(model.env_spec).entry_point == "tiny_tasks.task:TinyEnds"
        assert evaluate_modes(model, n_episodes=1).env_id == "TinyClass-v0"
    finally:
        gym.registry.pop("TinyClass-v0")
