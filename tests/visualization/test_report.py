"""Pictures and the page: they show what is known, and a browser can open them without network."""

import base64
import io
import json
from html.parser import HTMLParser

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
import torch as th
from environments import TwoEnds, small_model
from PIL import Image
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_ddiffpg import DDiffPG, EvaluateModesCallback, LiveCallback, ModeFigureCallback
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.replanner import Replanner
from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.evaluation.rollout import EpisodeResult
from sb3_ddiffpg.exploration.visit_map import VisitMap
from sb3_ddiffpg.modes.history import ModeEvent, ModeHistory, ModeState
from sb3_ddiffpg.report import main
from sb3_ddiffpg.visualization.figures import CAPTIONS, draw_all
from sb3_ddiffpg.visualization.plots import (
    grid_observations,
    plot_exploration,
    plot_routes,
    plot_success,
    plot_timeline,
    plot_values,
)

# Two goals next to the start: random actions find both
MAP = ["#####", "#grg#", "#####"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A small run on a maze, with everything logged."""
    folder = tmp_path_factory.mktemp("run")
    env = make_vec_env("PointMazeV1-v0", 4, seed=0, maze_map=MAP)
    test_env = make_vec_env("PointMazeV1-v0", 2, seed=1, maze_map=MAP, start_noise=0.0)
    model = small_model(env, modes={"patience": 0, "distance_threshold": 2.0})
    model.set_logger(configure(str(folder / "tb"), ["tensorboard"]))
    evaluation = EvaluateModesCallback(test_env, eval_freq=900, n_episodes=2, path=folder / "log" / "evaluations.jsonl")
    model.learn(2400, callback=[ModeFigureCallback(1200, test_env, n_episodes=1), evaluation])
    assert len(model.modes) >= 2
    model.rename_mode(0, "to the left")
    model.save(folder / "model.zip")
    model.save_replay_buffer(folder / "buffer.pkl")
    return model, evaluation, folder


# ---------------------------------------------------------------------- pictures


def episode(path, success=True):
    path = np.asarray(path, dtype=float)
    return EpisodeResult(success, len(path) - 1, 1.0, None, path)


def test_routes_of_an_arm_are_seen_from_three_sides():
    figure = plot_routes({"a": [episode([[0, 0, 0], [1, 2, 3]])], "b": [episode([[0, 0, 0], [2, 2, 2]], False)]})
    space, above, side = figure.axes
    assert space.name == "3d"
    np.testing.assert_array_equal(above.lines[0].get_xydata(), [[0, 0], [1, 2]])
    np.testing.assert_array_equal(side.lines[0].get_xydata(), [[0, 0], [1, 3]])
    assert [axes.get_ylabel() for axes in figure.axes] == ["mode feature 1", "mode feature 1", "mode feature 2"]
    assert [line.get_linestyle() for line in above.lines if len(line.get_xdata())] == ["-", "--"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b"]
    assert len(plot_routes({"a": []}).axes) == 1


@pytest.mark.parametrize(("width", "aspect"), [(2.0, 1.0), (5e4, "auto")])
def test_axes_of_no_maze_say_which_components_they_are(width, aspect):
    """Nobody has said that these are metres, or both the same: on one scale an angle beside them would be a line."""
    axes = plot_routes({"a": [episode([[0, 0], [width, 1], [width, 2]])]}).axes[0]
    assert axes.get_aspect() == aspect
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("mode feature 0", "mode feature 1")
    visits = VisitMap(1, 0.1)
    visits.observe(np.linspace(0, 2, 50)[:, None])
    axes = plot_exploration(visits).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("mode feature 0", "")


def test_density_is_capped_and_lies_where_the_visits_were():
    visits = VisitMap(2, 1.0)
    visits.observe(np.array([[0.5, 0.5]] * 500 + [[3.5, 1.5]] * 7))
    most = 7 + 0.95 * 493  # 0.95 of the way from the one to the other of two cells
    visits.note(10)
    visits.note(20)
    image = plot_exploration(visits).axes[0].images[0]
    assert image.get_extent() == [0.0, 4.0, 0.0, 2.0]
    np.testing.assert_array_equal(image.get_array().filled(0), [[most, 0, 0, 0], [0, 0, 0, 7]])
    assert plot_exploration(visits).axes[1].lines[0].get_ydata().tolist() == [2, 2]
    assert "no visit" in plot_exploration(None).axes[0].texts[0].get_text()


# What happened to two modes, of which one goes on
SPLIT_AND_MERGED = (
    ModeEvent(10, "born", 0, "mode_0"),
    ModeEvent(20, "split from", 1, "mode_1", "mode_0"),
    ModeEvent(25, "renamed to", 0, "mode_0", "old road"),
    ModeEvent(30, "merged into", 1, "mode_1", "old road"),
)


def test_timeline():
    history = ModeHistory([*SPLIT_AND_MERGED, ModeEvent(40, "frozen", 0, "old road")])
    axes = plot_timeline(history, end=100).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["old road", "mode_1"]
    assert [
        line.get_xdata().tolist() if hasattr(line.get_xdata(), "tolist") else line.get_xdata() for line in axes.lines[:2]
    ] == [
        [10, 100],
        [20, 30],
    ]
    assert "nothing" in plot_timeline(ModeHistory()).axes[0].texts[0].get_text()


def test_success_over_time():
    history = ModeHistory(states=[ModeState(10 * i, number, 5, 0.1 * i + number / 2) for i in range(5) for number in (0, 1)])
    figure = plot_success(history, {1: "mode_1"})
    np.testing.assert_allclose(figure.axes[0].lines[1].get_ydata(), [0.5, 0.6, 0.7, 0.8, 0.9])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["mode_1"]
    assert "no re-clustering" in plot_success(ModeHistory()).axes[0].texts[0].get_text()


def test_places_of_a_maze(run):
    model, _, _ = run
    maze = model.env.get_attr("maze", 0)[0]
    places = grid_observations(model, np.array([0, 0, 7, 8], dtype=np.float32), maze)
    assert len(places) == 3 * 16 and (places[:, 2:] == [7, 8]).all()  # three free cells of 4 m by 4 m
    assert np.abs(places[:, 0]).max() == 5.5 and np.abs(places[:, 1]).max() == 1.5


def test_all_pictures_there_are(run):
    model, _, folder = run
    maze, observation = model.env.get_attr("maze", 0)[0], model.env.reset()[0]
    figures = draw_all(model, maze, observation, {"to the left": [episode([[0, 0], [-4, 0]])]})
    assert list(figures) == list(CAPTIONS)
    for figure in figures.values():
        with io.BytesIO() as file:
            figure.savefig(file, format="png")
            assert np.asarray(Image.open(file).convert("L")).std() > 5
    # with the zip alone
    loaded = DDiffPG.load(folder / "model.zip")
    assert list(draw_all(loaded, maze, observation)) == ["success", "timeline", "values", "exploration"]
    assert set(draw_all(small_model(DummyVecEnv([TwoEnds])))) == {"success", "timeline", "exploration"}
    titles = [axes.get_title() for axes in figures["values"].axes][: len(model.modes)]
    assert titles == model.modes.names


# ---------------------------------------------------------------------- during training


def test_evaluation_during_training(run):
    _, evaluation, folder = run
    steps = [step for step, _ in evaluation.evaluations]
    assert steps[0] >= 900 and 1 <= len(steps) <= 2 and evaluation.evaluations[0][1].uncommanded.n_episodes == 4
    lines = [json.loads(line) for line in (folder / "log" / "evaluations.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == steps and "expected_modes_in_20" in lines[0]["summary"]
    (events,) = (folder / "tb").rglob("events.out.tfevents*")
    log = EventAccumulator(str(events), {"images": 0, "scalars": 0}).Reload()
    assert {f"figures/{name}" for name in CAPTIONS} <= set(log.Tags()["images"])
    assert {"eval_modes/robust_modes", "eval_modes/control_accuracy"} <= set(log.Tags()["scalars"])
    logged = [event.value for event in log.Scalars("eval_modes/expected_modes")]
    np.testing.assert_allclose(logged, [found.expected_modes() for _, found in evaluation.evaluations], rtol=1e-6)
    image = log.Images("figures/routes")[0]
    assert Image.open(io.BytesIO(image.encoded_image_string)).size[0] > 300


@pytest.mark.parametrize("make", [lambda: ModeFigureCallback(0), lambda: EvaluateModesCallback(None, 0)])
def test_bad_frequencies(make):
    with pytest.raises(ValueError, match="_freq must be at least 1, got 0"):
        make()


# ---------------------------------------------------------------------- the page


class Page(HTMLParser):
    """What a reader sees, and what a browser would fetch."""

    def __init__(self, text):
        super().__init__()
        self.text, self.sources, self.open = "", [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.open += [tag] if tag not in ("meta", "img", "br", "link", "input", "path") else []
        self.sources += [value for name, value in attrs if name in ("src", "href")]

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def page(run):
    model, _, folder = run
    path = folder / "page" / "report.html"
    main([str(folder / "model.zip"), "--output", str(path), "--replay-buffer", str(folder / "buffer.pkl"), "--episodes", "4"])
    return model, path


def test_page_holds_everything(page):
    model, path = page
    read = Page(path.read_text())
    assert read.open == [] and all(source.startswith("data:") for source in read.sources)
    data = json.loads(path.read_text().partition('id="data">')[2].partition("</script>")[0])[0]
    assert [mode["name"] for mode in data["modes"]] == model.modes.names
    for mode in data["modes"]:
        assert len(mode["episodes"]) == 4 and len(mode["starts"]["x"]) == 4
        assert len(set(zip(mode["starts"]["x"], mode["starts"]["y"], strict=True))) == 4, "of all starts, not of one"
        assert len(mode["values"]["value"]) == len(model.modes) and len(mode["values"]["step"]) >= 3
        assert mode["episodes"][0]["length"] + 1 >= len(mode["episodes"][0]["path"][0])
    for part in (
        "Routes in PointMazeV1-v0",
        "to the left",
        "95 % interval",
        "renamed to to the left",
        *CAPTIONS.values(),
    ):
        assert part in read.text
    assert "buffer_size" in read.text and "--env PointMazeV1-v0 --env-kwargs" in read.text
    pictures = [base64.b64decode(s.partition(",")[2]) for s in read.sources if s.startswith("data:image/png")]
    assert len(pictures) == len(CAPTIONS) and all(Image.open(io.BytesIO(picture)).size[0] > 300 for picture in pictures)
    found = ModeEvaluation.load(path.with_suffix(".json"))
    assert [each.mode for each in found.commanded] == model.modes.names and found.start_spread == 0.0
    assert str(found) in read.text


def test_a_film_of_each_mode(page):
    model, path = page
    for index, name in enumerate(model.modes.names):
        film = imageio.imread(path.with_name(f"report-{index}-{name.replace(' ', '_')}.mp4"))
        assert film.ndim == 4 and film.shape[3] == 3 and len(film) >= 3 and film[0].std() > 5


def test_a_browser_opens_the_page_without_network(page, browser):
    """Of a real model: all charts are drawn, and the film of the mode that is chosen plays."""
    model, path = page
    browser.open(path.as_uri())
    browser.until("!!document.body.dataset.drawn")
    drawn = browser.run(
        "Object.fromEntries([...document.querySelectorAll('.chart')].map((e) => [e.ariaLabel, e.data.length]))"
    )
    assert all(drawn.values()) and len(drawn) == 4 + 4
    assert "to the left" in browser.run("[...document.querySelectorAll('button.mode')].map((e) => e.textContent).join()")
    for index, name in enumerate(model.modes.names):
        browser.click(f"button[data-mode='{index}']")
        assert browser.run("document.querySelector('.panel h3').textContent") == name
        browser.until("document.querySelector('.panel video').readyState >= 2", 20)
    assert browser.errors == []


def test_without_modes_there_is_a_page_too(tmp_path):
    """Also beside another model, from which it is told by as much of its folder as that takes."""
    model = small_model(make_vec_env("PointMazeV1-v0", 2))
    paths = [tmp_path / name / "model.zip" for name in ("one", "two")]
    for path in paths:
        model.save(path)
    page = tmp_path / "page.html"
    main([str(paths[0]), "--compare", str(paths[1]), "--output", str(page), "--episodes", "2", "--no-videos"])
    text = page.read_text()
    assert (
        text.count("found no mode yet") == 2 and "The modes of one/model.zip" in text and "The modes of two/model.zip" in text
    )
    assert f"--compare {paths[1]}" in text


def test_what_cannot_be_shown(tmp_path):
    small_model(DummyVecEnv([TwoEnds])).save(tmp_path / "model")
    arguments = [str(tmp_path / "model.zip"), "--output", str(tmp_path / "page.html")]
    for extra, message in (
        ([], "env: not given, and the model does not remember"),
        (["--env", "Nowhere-v0"], "env: 'Nowhere-v0' is not registered"),
        (["--replay-buffer", str(tmp_path / "no.pkl")], "no.pkl does not exist"),
        (["--compare", str(tmp_path / "no.zip")], "no.zip does not exist"),
        (["--episodes", "0"], "--episodes: 0 given"),
        (["--output", str(tmp_path)], "accepted is the path of a page"),
        (["--output", str(tmp_path / "page.json")], "accepted is the path of a page"),
        (["--env", "Pendulum-v1"], "env: Pendulum-v1 has observations and actions"),
        (["--env", "PointMazeV1-v0", "--env-kwargs", "no_such=1"], "PointMazeV1-v0 cannot be made with"),
    ):
        with pytest.raises(SystemExit, match=message):
            main([*arguments, *extra])


def test_a_model_of_a_single_environment_of_others(tmp_path):
    """The command makes the environment again that ``gymnasium.make`` made, though nothing of it is ours."""
    small_model(gym.make("MountainCarContinuous-v0", max_episode_steps=30), critic={"v_min": -20.0}).save(
        tmp_path / "model.zip"
    )
    main([str(tmp_path / "model.zip"), "--output", str(tmp_path / "page.html"), "--episodes", "1", "--no-videos"])
    found = ModeEvaluation.load(tmp_path / "page.json")
    assert found.env_id == "MountainCarContinuous-v0" and found.uncommanded.mean_length == 30
    assert "MountainCarContinuous-v0" in (tmp_path / "page.html").read_text()


def test_normalised_observations(tmp_path):
    """The page shows what the model does with the statistics that it was trained with, and none without."""
    env = VecNormalize(make_vec_env("PointMazeV1-v0", 4, seed=0, maze_map=MAP), norm_reward=False)
    model = small_model(env, modes={"patience": 0}).learn(2400)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))
    arguments = [str(tmp_path / "model.zip"), "--output", str(tmp_path / "page.html"), "--episodes", "4", "--no-videos"]
    with pytest.raises(SystemExit, match="--vec-normalize: not given"):
        main(arguments)
    main([*arguments, "--vec-normalize", str(tmp_path / "statistics.pkl")])
    found = ModeEvaluation.load(tmp_path / "page.json")
    test_env = VecNormalize.load(
        str(tmp_path / "statistics.pkl"), make_vec_env("PointMazeV1-v0", 4, maze_map=MAP, start_noise=0.0)
    )
    again = evaluate_modes(DDiffPG.load(tmp_path / "model.zip"), test_env, 4, seed=0)
    assert [each.labels for each in again.commanded] == [each.labels for each in found.commanded]
    before = test_env.obs_rms.mean.copy()
    evaluate_modes(model, test_env, 2)
    np.testing.assert_array_equal(test_env.obs_rms.mean, before)
    # the values that are drawn are those of normalised observations
    places = grid_observations(model, np.zeros(4, dtype=np.float32), model.env.get_attr("maze", 0)[0])
    th.manual_seed(0)
    drawn = plot_values(model, places).axes[0].collections[-1].get_array()
    th.manual_seed(0)
    np.testing.assert_allclose(drawn, model.mode_values(env.normalize_obs(places))[:, 0], rtol=1e-5)
    with pytest.raises(ValueError, match="normalizer: None given"):
        Replanner(DDiffPG.load(tmp_path / "model.zip"))
    assert Replanner(model).normalizer is env


def test_looking_on_changes_nothing(tmp_path):
    """A run that is evaluated, drawn and watched learns what it would have learned."""
    policies = []
    for looks in (False, True):
        test_env = make_vec_env("PointMazeV1-v0", 2, seed=1, maze_map=MAP, start_noise=0.0)
        looking = [
            EvaluateModesCallback(test_env, 200, 1, seed=3),
            ModeFigureCallback(300, test_env, 1),
            LiveCallback(tmp_path, 0),
        ]
        callbacks = looking if looks else None
        model = small_model(make_vec_env("PointMazeV1-v0", 4, seed=0, maze_map=MAP), seed=5).learn(800, callback=callbacks)
        policies.append([parameter.detach().clone() for parameter in model.policy.parameters()])
    assert all(th.equal(first, second) for first, second in zip(*policies, strict=True))


def test_one_dimension_is_drawn_too(trained):
    rows = np.linspace(-1, 1, 5)[:, None].astype(np.float32) * np.ones((1, 2), dtype=np.float32)
    figure = plot_values(trained, rows)
    assert figure.axes[0].collections[-1].get_offsets()[:, 1].tolist() == [0] * 5
    far = VisitMap(2, 1.0)
    far.observe(np.array([[0.0, 0.0], [1e5, 0.0]]))
    assert max(plot_exploration(far).axes[0].images[0].get_array().shape) <= 1001
