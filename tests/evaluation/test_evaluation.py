"""Counting modes: the numbers against hand and chance, and what is counted when."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from environments import AnySpaces, TwoEnds, small_model
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import TD3
from stable_baselines3.common.vec_env import DummyVecEnv
from test_rollout import Scripted

from sb3_ddiffpg import DDiffPG, EvaluateModesCallback
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.results import CommandResult, ModeEvaluation, RouteResult


def result(mode, n, labels):
    return CommandResult(mode, n, sum(labels.values()), 10.0, 1.0, labels)


def evaluation(labels, n, commanded=(), listed=()):
    names = list(dict.fromkeys([*labels, *(label for each in commanded for label in each.labels)]))
    ways = tuple(RouteResult(name, 1, 1.0, 1.0) for name in names)
    return ModeEvaluation("any", "environment", tuple(listed), 0.0, result(None, n, labels), tuple(commanded), ways)


def test_which_model_is_kept(monkeypatch, tmp_path):
    """What modes achieve counts first, then that there are any; luck without command is last, and ties go to the later one."""
    fails, succeeds = result("a", 20, {}), result("a", 20, {"0": 1})
    found = [
        evaluation({"0": 1}, 40),
        evaluation({}, 40, [fails]),
        evaluation({"0": 9}, 40),
        evaluation({}, 40, [fails]),
        evaluation({}, 40, [succeeds]),
        evaluation({"0": 9}, 40, [fails]),
        evaluation({}, 40, [succeeds]),
    ]
    model, kept, tests = small_model(TwoEnds()), [], iter(found)
    monkeypatch.setattr("sb3_ddiffpg.callbacks.evaluation.evaluate_modes", lambda *args, **kwargs: next(tests))
    callback = EvaluateModesCallback(None, eval_freq=1, best_model_path=tmp_path / "model.zip")
    for number in range(1, 8):
        model.learn(1, callback=callback, reset_num_timesteps=number == 1)
        kept.append(callback.best_step)
    rollout = kept[0]
    assert kept == [number * rollout for number in (1, 2, 2, 4, 5, 5, 7)]
    assert DDiffPG.load(tmp_path / "model.zip").num_timesteps == 7 * rollout


# ---------------------------------------------------------------------- the numbers


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 40), min_size=1, max_size=5), st.integers(0, 40), st.integers(1, 30), st.integers(0, 2**20))
def test_expected_modes_are_the_mean_of_drawing(counts, n_failed, n_draws, seed):
    n = sum(counts) + n_failed
    labels = np.repeat([*range(len(counts)), -1], [*counts, n_failed])
    rng = np.random.default_rng(seed)
    drawn = [set(rng.choice(labels, size=min(n_draws, n), replace=False)) - {-1} for _ in range(2000)]
    sizes = np.array([len(each) for each in drawn])
    expected = evaluation({str(k): count for k, count in enumerate(counts)}, n).expected_modes(n_draws)
    assert expected == pytest.approx(sizes.mean(), abs=5 * sizes.std() / np.sqrt(2000) + 0.005)


def test_expected_modes_by_hand():
    assert evaluation({"a": 100, "b": 100}, 200).expected_modes() == pytest.approx(2.0, abs=1e-5)
    assert evaluation({"a": 1}, 200).expected_modes() == pytest.approx(20 / 200)
    assert evaluation({"a": 7, "b": 1}, 10).expected_modes() == 2.0  # all ten are drawn
    assert evaluation({}, 10).expected_modes() == 0.0


def test_robust_and_effective_modes():
    found = evaluation({"a": 95, "b": 95, "c": 10, "d": 9}, 209, listed=("a", "c", "x", "y"))
    assert found.robust_modes == 2 and found.coverage == 0.25  # 5 % of 209 are 10.45
    assert evaluation({"a": 90, "b": 10}, 200).robust_modes == 2
    assert evaluation({name: 25 for name in "abcd"}, 200).effective_modes == pytest.approx(4.0)
    assert evaluation({"a": 7}, 10).effective_modes == pytest.approx(1.0)
    assert evaluation({"a": 3, "b": 1}, 8).effective_modes == pytest.approx(
        math.exp(0.75 * math.log(4 / 3) + 0.25 * math.log(4))
    )
    nothing = evaluation({}, 10)
    assert (nothing.robust_modes, nothing.effective_modes) == (0, 0.0) and math.isnan(nothing.coverage)


@pytest.mark.parametrize(("successes", "n"), [(0, 20), (20, 20), (13, 20), (95, 100)])
def test_wilson_interval(successes, n):
    z, p = 1.959963985, successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    assert result("m", n, {"a": successes}).success_interval == pytest.approx((centre - half, centre + half), abs=1e-7)


def test_control():
    rows = (result("one", 10, {"b": 9, "a": 1}), result("two", 10, {"a": 6, "b": 2}), result("three", 10, {"b": 10}))
    found = evaluation({}, 10, rows)
    assert found.labels == ["b", "a"]
    np.testing.assert_array_equal(found.confusion, [[9, 1, 0], [2, 6, 2], [10, 0, 0]])
    # "b" can be the own way of one of them only
    assert found.matching == {"two": "a", "three": "b"} and found.control_accuracy == pytest.approx(16 / 30)
    assert found.commandable == ["b"]
    assert math.isnan(evaluation({"a": 3}, 10).control_accuracy) and evaluation({"a": 3}, 10).matching == {}


# ---------------------------------------------------------------------- running them


class Two(Scripted):
    """Has two modes; uncommanded it goes above in three of four episodes."""

    modes = (SimpleNamespace(name="above"), SimpleNamespace(name="below"))

    def predict(self, obs, state=None, mode=None, **kwargs):
        if mode is not None:
            return super().predict(obs, mode=mode)
        upper = super().predict(obs, mode="above")[0]
        upper[::4] = super().predict(obs, mode="below")[0][::4]
        return upper, state


def test_a_maze():
    found = evaluate_modes(Two(), "PointMazeV1-v0", 8, seed=0)
    assert (found.env_id, found.label_source, found.listed) == ("PointMazeV1-v0", "environment", ("0:-", "0:a"))
    assert [(each.mode, each.n_episodes, each.labels) for each in found.commanded] == [
        ("above", 8, {"0:a": 8}),
        ("below", 8, {"0:-": 8}),
    ]
    assert found.uncommanded.n_episodes == 16 and found.uncommanded.labels == {"0:a": 12, "0:-": 4}
    assert found.start_spread == 0.0 and found.control_accuracy == 1.0 and found.coverage == 1.0
    assert [way.label for way in found.routes] == ["0:a", "0:-"] and found.routes[0].n_episodes == 20
    assert all(1.0 <= way.path_ratio < 1.01 and 15 < way.mean_length < 40 for way in found.routes)
    lines = str(found).splitlines()
    assert lines[1].split()[:2] == ["above", "8/8"] and lines[3].startswith("(none)") and "100.0%" in lines[5]
    below = evaluate_modes(Two(), "PointMazeV1-v0", 4, n_uncommanded=4, modes=["below"], seed=0)
    assert [each.mode for each in below.commanded] == ["below"] and below.uncommanded.n_episodes == 4


def test_different_starts_are_told():
    env = make_vec_env("PointMazeV1-v0", 4, seed=0, start_noise=0.4)
    found = evaluate_modes(Two(), env, 4)
    assert 0.2 < found.start_spread < 1.2
    assert f"Episodes start up to {found.start_spread:.3g} apart" in str(found)


def test_other_algorithms_have_one_way_at_most():
    model = TD3("MlpPolicy", make_vec_env("PointMazeV1-v0", 1), buffer_size=10, policy_kwargs={"net_arch": [8]})
    found = evaluate_modes(model, "PointMazeV1-v0", 2, max_episode_steps=30)
    assert found.commanded == () and found.uncommanded.n_episodes == 4 and len(found.routes) <= 1
    assert math.isnan(found.control_accuracy) and "control accuracy -" in str(found)


def test_where_nobody_labels_ways_are_clusters(trained):
    env = DummyVecEnv([TwoEnds] * 4)
    found = evaluate_modes(trained, env, 8, seed=0)
    assert found.label_source == "clustering" and "gives no labels" in str(found)
    assert {label.split()[0] for label in found.labels} <= {"cluster", "other"} and len(found.labels) >= 1
    assert [each.mode for each in found.commanded] == trained.modes.names


def test_successes_that_are_like_too_few_others_are_told():
    rows = (replace(result("one", 10, {"cluster 0": 7}), n_successes=9), result("two", 10, {"cluster 1": 10}))
    found = replace(evaluation({"cluster 0": 5}, 10, rows), label_source="clustering")
    assert "clusters of these very episodes' paths, but for 2 of 24, which are like too few others" in str(found)
    assert "but for" not in str(replace(found, commanded=rows[1:]))
    assert "but for" not in str(replace(found, label_source="environment"))


def test_without_word_of_success_every_episode_counts():
    env = DummyVecEnv([lambda: AnySpaces(spaces.Box(-1.0, 1.0, (2,)))] * 2)
    found = evaluate_modes(small_model(env), env, 3)
    assert found.uncommanded.n_successes == found.uncommanded.n_episodes == 6


def test_json(tmp_path):
    found = evaluate_modes(Two(), "PointMazeV1-v0", 4, seed=0)
    found = replace(found, commanded=(*found.commanded, CommandResult("lost", 4, 0, float("nan"), 0.0, {})))
    found.save(tmp_path / "found.json")
    data = json.loads((tmp_path / "found.json").read_text(), parse_constant=pytest.fail)
    assert data["summary"]["robust_modes"] == 2 and data["commanded"][2]["mean_length"] is None
    again = ModeEvaluation.load(tmp_path / "found.json")
    assert str(again) == str(found) and again.uncommanded == found.uncommanded and again.routes == found.routes
    with pytest.raises(ValueError, match="uncommanded"):
        ModeEvaluation.from_dict({"format": 1})
    (tmp_path / "other.json").write_text('{"format": 0}')
    with pytest.raises(ValueError, match="is no evaluation of modes in format 1"):
        ModeEvaluation.load(tmp_path / "other.json")


def test_seed_reproduces(trained):
    first, second = (evaluate_modes(trained, DummyVecEnv([TwoEnds] * 3), 6, seed=4) for _ in range(2))
    assert first == second


def test_bad_arguments():
    with pytest.raises(ValueError, match=r"modes: 'left' given; the model's modes are \['above', 'below'\]"):
        evaluate_modes(Two(), "PointMazeV1-v0", 4, modes=["left"])
    with pytest.raises(ValueError, match="n_episodes must be an integer of at least 1"):
        evaluate_modes(Two(), make_vec_env("PointMazeV1-v0", 1), 0)
    with pytest.raises(ValueError, match=r"\['maze_map'\] given; accepted beside an env"):
        evaluate_modes(Two(), make_vec_env("PointMazeV1-v0", 1), 1, maze_map="V2")
