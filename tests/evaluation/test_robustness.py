"""Robustness curves, counted by hand."""

import json
import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv
from test_rollout import Scripted
from tiny_envs import TwoEnds

from sb3_ddiffpg.envs import ChangedEnv, make_vec_env
from sb3_ddiffpg.evaluation import RobustnessCurve, robustness_curve
from sb3_ddiffpg.visualization.plots import plot_robustness


class Counting(gym.Env):
    """The mode's number is the action. Mode k succeeds in the first ``first[k]`` of its episodes under this change."""

    listed_modes = ()

    def __init__(self, first):
        self.observation_space, self.action_space = gym.spaces.Box(-1, 1, (1,)), gym.spaces.Box(0, 10, (1,))
        self.first, self.counts = first, [0] * len(first)
        self.closed = False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        mode = int(action[0])
        self.counts[mode] += 1
        success = self.counts[mode] <= self.first[mode]
        return np.zeros(1, dtype=np.float32), float(success), True, False, {"is_success": success}

    def close(self):
        self.closed = True


class Stub:
    """Modes "a" and "b", and a third thing that it does without command."""

    modes = (SimpleNamespace(name="a"), SimpleNamespace(name="b"))

    def predict(self, observation, state=None, mode=None, **kwargs):
        number = {"a": 0, "b": 1, None: 2}[mode]
        return np.full((len(observation), 1), number, dtype=np.float32), state


# Successes of 4 episodes of "a" and of "b", and of 8 without command, by the value of the change
BY_HAND = {0.0: (4, 3, 8), 0.5: (1, 2, 5), 1.0: (0, 3, 2), 2.0: (0, 0, 0)}


def by_hand(values=tuple(BY_HAND), model=None, made=None):
    def make(value):
        env = DummyVecEnv([lambda: Counting(BY_HAND[value])])
        if made is not None:
            made.extend(env.envs)
        return env

    return robustness_curve(Stub() if model is None else model, make, values, n_episodes=4)


def test_by_hand():
    made = []
    curve = by_hand(made=made)
    assert curve.values == (0.0, 0.5, 1.0, 2.0) and curve.modes == ("a", "b")
    assert curve.success == {"a": (1.0, 0.25, 0.0, 0.0), "b": (0.75, 0.5, 0.75, 0.0)}
    assert curve.uncommanded_success == (1.0, 5 / 8, 0.25, 0.0)
    assert curve.best_modes == ("a", "b", "b", "a")
    assert curve.best_success == (1.0, 0.5, 0.75, 0.0)
    assert curve.best_median == (1.0, 0.5, 1.0, 0.0)
    assert len(made) == 4 and all(env.closed and env.counts == [4, 4, 8] for env in made)
    assert str(curve).splitlines()[2].split() == ["0.5", "25.0%", "50.0%", "62.5%", "b"]


@pytest.mark.parametrize("n_successes", range(8))
def test_the_median_is_numpys(n_successes):
    class One(Stub):
        modes = Stub.modes[:1]

    def make(value):
        return DummyVecEnv([lambda: Counting((n_successes, 0, 0))])

    curve = robustness_curve(One(), make, ["x"], n_episodes=7)
    assert curve.best_median == (np.median([1.0] * n_successes + [0.0] * (7 - n_successes)),)


def test_without_modes():
    class Plain:
        def predict(self, observation, state=None, **kwargs):
            return np.full((len(observation), 1), 2, dtype=np.float32), state

    curve = by_hand(model=Plain())
    assert curve.modes == () and curve.success == {} and curve.uncommanded_success == (1.0, 5 / 8, 0.25, 0.0)
    assert curve.best_modes == (None,) * 4 and all(map(math.isnan, (*curve.best_success, *curve.best_median)))
    assert str(curve).splitlines()[1].split() == ["0", "100.0%", "-"]


def test_files(tmp_path):
    path = tmp_path / "curve.json"
    curve = by_hand()
    curve.save(path)
    data = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert data["summary"]["best_success"] == [1.0, 0.5, 0.75, 0.0] and data["summary"]["best_modes"] == ["a", "b", "b", "a"]
    again = RobustnessCurve.load(path)
    # Not the curves themselves: the mean length of no success is NaN
    assert again.to_dict() == curve.to_dict() and str(again) == str(curve)
    for name, value in (("format", 0), ("values", [1.0]), ("values", [None] * 4), ("evaluations", [{}] * 4), ("values", 3)):
        path.write_text(json.dumps({**data, name: value}))
        with pytest.raises(ValueError, match="is no robustness curve in format 1"):
            RobustnessCurve.load(path)
    data["evaluations"][1]["commanded"].pop()
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match="of different modes"):
        RobustnessCurve.load(path)


class Two(Scripted):
    """Goes above, or below."""

    modes = (SimpleNamespace(name="above"), SimpleNamespace(name="below"))

    def predict(self, obs, mode=None, **kwargs):
        return super().predict(obs, mode=mode or "above")


def test_a_maze_that_is_walled_and_a_body_that_becomes_weak():
    """The upper way round is walled, of the lower one no passage is narrow. Without a motor along y nobody gets round."""
    rows = ["#####", "#...#", "#g#r#", "#...#", "#...#", "#####"]

    def walled(n_blocked):
        return make_vec_env("PointMazeV1-v0", 2, maze_map=rows, start_noise=0.0, changes={"n_blocked": n_blocked})

    curve = robustness_curve(Two(), walled, [0, 1], n_episodes=4, n_uncommanded=2, seed=0)
    assert curve.success == {"above": (1.0, 0.0), "below": (1.0, 1.0)} and curve.best_modes == ("above", "below")
    assert curve.uncommanded_success == (1.0, 0.0)

    def weak(strength):
        changes = {"motor_strength": {1: strength}}
        return make_vec_env("PointMazeV1-v0", 2, start_noise=0.0, changes=changes)

    curve = robustness_curve(Two(), weak, [1.0, 0.0], n_episodes=2, n_uncommanded=2, seed=0)
    assert curve.success == {"above": (1.0, 0.0), "below": (1.0, 0.0)} and curve.uncommanded_success == (1.0, 0.0)


def test_any_environment_and_its_picture():
    def far(size):
        def change(world, rng):
            world.limit = size

        return DummyVecEnv([lambda: ChangedEnv(TwoEnds(), change)] * 2)

    class Steps(Stub):
        def predict(self, observation, state=None, mode=None, **kwargs):
            return np.full((len(observation), 1), 0.5 if mode == "a" else -1.0, dtype=np.float32), state

    # 1 m in steps of 0.25 m or 0.5 m, from within 0.1 m
    curve = robustness_curve(Steps(), far, [1, 3, 8], n_episodes=4, n_uncommanded=2, seed=0)
    assert curve.success["a"] == (0.0, 0.0, 1.0) and curve.success["b"] == (0.0, 1.0, 1.0)
    axes = plot_robustness(curve, "steps").axes[0]
    assert [line.get_label() for line in axes.lines] == ["a", "b", "no command"]
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [1, 3, 8])
    np.testing.assert_array_equal(axes.lines[1].get_ydata(), [0, 1, 1])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], "values: .* given; accepted is a list"),
        ("ab", "values: 'ab' given; accepted is a list"),
        ([0.5, np.nan], "values: nan given; accepted are finite numbers and words"),
        ([{"gravity": 1}], "values: {'gravity': 1} given; accepted are finite numbers and words"),
        ([0.5, 0.5], r"values: \[0.5, 0.5\] given; accepted are different ones"),
    ],
)
def test_bad_values(values, message):
    with pytest.raises(ValueError, match=message):
        robustness_curve(Stub(), None, values)


def test_bad_environments():
    with pytest.raises(ValueError, match="make_env: 'V1' made of 1; accepted is a function that makes environments"):
        robustness_curve(Stub(), lambda value: "V1", [1])
