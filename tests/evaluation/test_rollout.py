"""Complete episodes, and their picture."""

import numpy as np
import pytest
from environments import WIDE, AnySpaces, TwoEnds, small_model
from gymnasium import spaces
from maze_routes import ROUTES
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ddiffpg import ModeEvalCallback
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation.rollout import run_episodes
from sb3_ddiffpg.visualization.plots import plot_routes


class Scripted:
    """Goes to the goal of V1 round the block, above or below as it is told, or runs into the wall for ever."""

    def __init__(self) -> None:
        self.commands: list = []

    def predict(self, obs, state=None, episode_start=None, deterministic=False, mode=None):
        self.commands.append(mode)
        side = {"above": 1.0, "below": -1.0, "nowhere": 0.0}[mode]
        x, y = obs[:, 0], obs[:, 1]
        leave = (x > -2.0) & (np.abs(y) < 3.5)
        back = x < -6.5
        action = np.stack([np.where(leave & (side != 0), 0.0, -1.0), np.where(leave, side, 0.0)], axis=1)
        action[back] = np.clip(np.stack([-8.0 - x[back], -y[back]], axis=1), -1, 1)
        return action.astype(np.float32), state


@pytest.mark.parametrize(("mode", "label"), [("above", "0:a"), ("below", "0:-")])
def test_episodes_are_complete_and_carry_their_route(mode, label):
    model = Scripted()
    env = make_vec_env("PointMazeV1-v0", 3, seed=0, start_noise=0.0)
    episodes = run_episodes(model, env, 7, mode=mode)
    assert len(episodes) == 7 and set(model.commands) == {mode}
    for episode in episodes:
        assert episode.success and episode.label == label and episode.episode_return == 1.0
        assert episode.path.shape == (episode.length + 1, 2)
        np.testing.assert_allclose(episode.path[0], [0, 0])
        assert np.linalg.norm(episode.path[-1] - [-8, 0]) <= 1.0  # the terminal position, not the next start
        assert np.abs(np.diff(episode.path, axis=0)).max() <= 0.8 + 1e-6
    assert ("V1", label) in ROUTES


def test_failures_last_until_the_time_limit():
    env = make_vec_env("PointMazeV1-v0", 2, seed=0, start_noise=0.0)
    episodes = run_episodes(Scripted(), env, 2, mode="nowhere")
    assert [(e.success, e.label, e.length, e.episode_return) for e in episodes] == [(False, None, 150, 0.0)] * 2


def test_short_episodes_are_not_favoured():
    """Every environment contributes the same number, however long its episodes are."""

    class Mixed(Scripted):
        def predict(self, obs, **kwargs):
            fast = super().predict(obs, mode="above")[0]
            fast[1] = [1.0, 0.0]  # environment 1 never arrives
            return fast, None

    env = make_vec_env("PointMazeV1-v0", 2, seed=0, start_noise=0.0)
    assert [episode.success for episode in run_episodes(Mixed(), env, 6)] == [True] * 3 + [False] * 3


def test_paths_are_in_metres_behind_a_normalising_wrapper():
    """The terminal observation too, which VecNormalize hides in ``info``."""
    plain = make_vec_env("PointMazeV1-v0", 2, seed=0, start_noise=0.0)
    normalised = VecNormalize(make_vec_env("PointMazeV1-v0", 2, seed=0, start_noise=0.0))

    class Unnormalising(Scripted):
        def predict(self, obs, **kwargs):
            return super().predict(normalised.get_original_obs(), **kwargs)

    expected = run_episodes(Scripted(), plain, 4, mode="above")
    for episode, same in zip(run_episodes(Unnormalising(), normalised, 4, mode="above"), expected, strict=True):
        np.testing.assert_allclose(episode.path, same.path, atol=1e-4)
        assert episode.episode_return == same.episode_return == 1.0


class Labelled(TwoEnds):
    """Says at an episode's end which end it was; the left one only counts as one mode more if it is reached."""

    listed_modes = ()  # what it says is a label

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated, {**info, "mode": "left" if self.x < 0 else "right"}


@pytest.mark.parametrize("success_key", ["is_success", "success"])
def test_evaluation_during_training_counts_modes(success_key):
    """Against SB3's own counts, and the labels as they go by."""
    logged, ended = [], []

    class Watched(Labelled):
        def step(self, action):
            *rest, terminated, truncated, info = super().step(action)
            if terminated or truncated:
                ended.append(info["mode"] if terminated else None)
            return *rest, terminated, truncated, info

    class Recorder(KVWriter):
        def write(self, key_values, key_excluded, step=0):
            if "eval/n_modes" in key_values:
                logged.append((key_values["eval/n_modes"], key_values.get("eval/success_rate"), list(ended)))
                ended.clear()

        def close(self):
            pass

    model = small_model(DummyVecEnv([TwoEnds] * 4))
    model.set_logger(Logger(None, [Recorder()]))
    callback = ModeEvalCallback(
        DummyVecEnv([lambda: Watched(success_key)]), eval_freq=10, n_eval_episodes=3, verbose=0, warn=False
    )
    assert not callback.deterministic
    model.learn(400, callback=callback)
    assert len(logged) == 10 and len({n_modes for n_modes, _, _ in logged}) > 1
    for n_modes, success_rate, labels in logged:
        assert len(labels) == 3 and n_modes == len(set(labels) - {None})
        if success_key == "is_success":  # SB3 knows no other
            assert success_rate == pytest.approx(np.mean([label is not None for label in labels]))
    # Where nobody says, nothing is counted
    silent = ModeEvalCallback(DummyVecEnv([TwoEnds]), eval_freq=20, n_eval_episodes=2, verbose=0, warn=False)
    model.learn(100, callback=silent)
    assert len(logged) == 10


@pytest.mark.parametrize(("success_key", "said"), [("solved", True), (None, None)])
def test_success_is_what_the_model_was_told_to_look_for(success_key, said):
    env = DummyVecEnv([lambda: TwoEnds(success_key)] * 3)

    class Rightwards:
        def predict(self, obs, **kwargs):
            return np.ones((len(obs), 1)), None

    model = Rightwards()
    model.success_key = success_key
    assert [episode.success for episode in run_episodes(model, env, 6)] == [said] * 6


def test_numbers_as_observations():
    class Number(AnySpaces):
        def reset(self, **kwargs):
            return int(super().reset(**kwargs)[0]), {}

        def step(self, action):
            observation, *rest = super().step(action)
            return (int(observation), *rest)

    env = DummyVecEnv([lambda: Number(spaces.Discrete(5))] * 2)
    model = small_model(env, **WIDE)
    assert [len(episode.path) == episode.length + 1 for episode in run_episodes(model, env, 4)] == [True] * 4


@pytest.mark.parametrize(
    ("arguments", "name"), [((TwoEnds, 2), "env"), ((None, 0), "n_episodes"), ((None, 7.0), "n_episodes")]
)
def test_bad_arguments(arguments, name):
    env = arguments[0] or DummyVecEnv([TwoEnds])
    with pytest.raises(ValueError, match=f"{name} must be"):
        run_episodes(Scripted(), env, arguments[1])


def test_routes_are_drawn_over_the_maze():
    env = make_vec_env("PointMazeV1-v0", 2, seed=0, start_noise=0.0)
    model = Scripted()
    episodes = {mode: run_episodes(model, env, 2, mode=mode) for mode in ("above", "nowhere")}
    figure = plot_routes(episodes, maze=env.get_attr("maze", indices=0)[0])
    lines = [line for line in figure.axes[0].lines if len(line.get_xdata()) > 1]
    assert [line.get_linestyle() for line in lines] == ["-", "-", "--", "--"]
    assert lines[0].get_color() == lines[1].get_color() != lines[2].get_color()
    np.testing.assert_allclose(lines[0].get_xydata(), episodes["above"][0].path)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["above", "nowhere"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["start", "goal"]
