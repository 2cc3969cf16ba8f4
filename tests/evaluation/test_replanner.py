"""Switching modes when stuck: the rule against a slow one, and in use."""

from types import SimpleNamespace

import numpy as np
import pytest
from environments import TwoEnds, image_dict_space, some_observations
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import TD3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import Mode, ModeTable
from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.replanner import Replanner
from sb3_ddiffpg.modes.mode import Outcome


class Stub:
    """Three modes; an action is the index of the mode that was commanded."""

    observation_space = spaces.Box(-1e5, 1e5, (3,))
    gamma, success_key, resolved_features, is_normalized = 0.9, None, [0, 1], False

    def __init__(self, returns=(0.5, 1.0, 0.8), lengths=(5.0, 5.0, 5.0)):
        modes = [Mode(i, f"mode_{i}", 0, 5, mean_length=length) for i, length in enumerate(lengths)]
        for mode, value in zip(modes, returns, strict=True):
            mode.representative = np.array([[0.0, 0.0], [0.3, 0.4], [0.6, 0.8]])
            mode.outcomes.append(Outcome(True, value, 5))
        self.modes = ModeTable(modes)

    def get_vec_normalize_env(self):
        return None

    def predict(self, obs, state=None, episode_start=None, deterministic=False, mode=None):
        return np.asarray(mode)[:, None].astype(np.float32), None

    def mode_values(self, obs):
        return np.stack([obs[:, 0], -obs[:, 0], np.zeros(len(obs))], axis=1)


def follow(replanner, paths, starts=None):
    """Modes that drive the environments along given positions, [T, N]."""
    state, driven = None, []
    for t, positions in enumerate(paths):
        obs = np.concatenate((positions, np.zeros((len(positions), 1))), axis=1).astype(np.float32)
        start = np.full(len(positions), t == 0) if starts is None else starts[t]
        actions, state = replanner.predict(obs, state, start)
        driven.append(actions[:, 0].astype(int))
    return np.array(driven)


def slow(order, positions, starts, patience, tolerance):
    """One environment, written out."""
    driven, at = [], None
    for position, start in zip(positions, starts, strict=True):
        if at is None or start:
            mode, at, still, failed = order[0], position, 0, []
        elif np.linalg.norm(position - at) > tolerance:
            at, still = position, 0
        else:
            still += 1
        if still >= patience:
            failed.append(mode)
            if set(failed) == set(order):
                failed = []
            others = [each for each in order if each != mode] or order
            mode = next(each for each in others if each not in failed)
            at, still = position, 0
        driven.append(mode)
    return driven


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.lists(st.sampled_from([0.0, 0.0, 0.4, 2.0]), min_size=30, max_size=30), min_size=1, max_size=3),
    st.integers(1, 4),
    st.sampled_from([["mode_2", "mode_0", "mode_1"], ["mode_1", "mode_2"], ["mode_0"]]),
    st.integers(0, 2**16),
)
def test_like_a_slow_one(moves, patience, order, seed):
    rng = np.random.default_rng(seed)
    steps = np.array(moves).T[..., None] * np.array([1.0, 0.0])  # [T, N, 2]
    positions = (steps * rng.choice([-1.0, 1.0], size=steps.shape)).cumsum(axis=0)
    starts = rng.random(positions.shape[:2]) < 0.1
    replanner = Replanner(Stub(), patience=patience, tolerance=0.5, order=order)
    driven = follow(replanner, positions, starts)
    numbers = [int(name[-1]) for name in order]
    for env in range(positions.shape[1]):
        expected = slow(numbers, positions[:, env].astype(np.float32), starts[:, env], patience, 0.5)
        assert driven[:, env].tolist() == expected


def test_begins_with_what_returns_most_and_remembers_what_failed():
    replanner = Replanner(Stub(), patience=2, order="return")
    assert replanner.tolerance == pytest.approx(1.0)  # two steps of the routes
    driven = follow(replanner, np.zeros((14, 1, 2)))[:, 0].tolist()
    assert driven == [1, 1, 2, 2, 0, 0, 1, 1, 2, 2, 0, 0, 1, 1]
    # the same return, sooner
    assert Replanner(Stub((1.0, 1.0, 1.0), (9.0, 7.0, 8.0)), order="return").ranked.tolist() == [1, 2, 0]
    # a mode that was never commanded is taken by its trajectories' return
    model = Stub()
    model.modes[0].outcomes.clear()
    model.modes[0].mean_return = 2.0
    assert Replanner(model, order="return").ranked.tolist() == [0, 1, 2]


def test_order_by_value():
    replanner = Replanner(Stub(), patience=2)
    positions = np.array([[3.0, 0.0], [-3.0, 0.0]])
    driven = follow(replanner, np.tile(positions, (5, 1, 1)))
    assert driven.T.tolist() == [[0, 0, 2, 2, 1], [1, 1, 2, 2, 0]]


def test_one_observation_and_none_of_the_state():
    replanner = Replanner(Stub(), patience=1, order="return")
    action, state = replanner.predict(np.zeros(3, dtype=np.float32))
    assert action.shape == (1,) and action[0] == 1
    action, state = replanner.predict(np.zeros(3, dtype=np.float32), state)
    assert action[0] == 2
    with pytest.raises(ValueError, match=r"state: of 1 environment\(s\) given for 2"):
        replanner.predict(np.zeros((2, 3), dtype=np.float32), state)


def test_dict_observations_and_normalised_ones(trained):
    model = Stub()
    model.observation_space = spaces.Dict({"camera": image_dict_space()["img"], "at": spaces.Box(-1.0, 1.0, (2,))})
    model.resolved_features = "at"
    replanner = Replanner(model, patience=1, order="return")
    one = {key: space.sample() for key, space in model.observation_space.items()}
    action, state = replanner.predict(one)
    assert action[0] == 1 and replanner.predict({key: value[None] for key, value in one.items()}, state)[0].tolist() == [[2]]
    # Positions are told apart in their own unit: what was scaled down has moved all the same
    scaled = Stub()
    scaled.get_vec_normalize_env = lambda: SimpleNamespace(unnormalize_obs=lambda obs: obs * 100)
    path = np.linspace(0, 0.1, 10)[:, None, None] * np.ones((1, 1, 2))
    assert set(follow(Replanner(scaled, patience=2, order="return"), path).ravel()) == {1}


def test_in_use(trained):
    env = DummyVecEnv([TwoEnds] * 3)
    replanner = Replanner(trained, tolerance=0.05, order="return")
    mean, _ = evaluate_policy(replanner, env, n_eval_episodes=6)
    assert np.isfinite(mean)
    found = evaluate_modes(replanner, env, 3)
    assert found.commanded == () and found.uncommanded.n_episodes == 6
    # as long as it moves, it is the model
    actions, _ = replanner.predict(some_observations(4), deterministic=True)
    expected, _ = trained.predict(some_observations(4), mode=int(replanner.ranked[0]), deterministic=True)
    np.testing.assert_array_equal(actions, expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"patience": 0}, "patience: 0 given"),
        ({"tolerance": 0.0}, "tolerance: 0.0 given"),
        ({"order": "best"}, "order: 'best' given; accepted are 'return', 'value' and a list"),
        ({"order": ["mode_0", "mode_0"]}, "none of them twice"),
        ({"order": []}, "it must name modes"),
        ({"order": ["mode_9"]}, "'mode_9' is unknown"),
        ({"features": [7]}, r"mode_features=\[7\] exceeds"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        Replanner(Stub(), **arguments)


def test_models_without_modes():
    with pytest.raises(ValueError, match="model: a TD3 without modes given"):
        Replanner(TD3("MlpPolicy", "Pendulum-v1", buffer_size=10))


def test_modes_without_a_route_yet():
    """As of goals in hindsight: what counts as movement follows from the steps that are seen, in whatever unit."""
    model = Stub()
    for mode in model.modes:
        mode.representative = np.zeros((0, 0))
    for unit in (1.0, 1e-3, 1e3):
        replanner = Replanner(model, patience=4, order="return")
        there = unit * np.minimum(0.5 * np.arange(40), 10.0)  # it walks for 20 steps, and stands
        trembles = 0.1 * unit * np.random.default_rng(0).uniform(-1, 1, 40)
        path = np.stack((there, trembles), axis=1)[:, None]
        driven = follow(replanner, path)[:, 0].tolist()
        assert driven[:21] == [1] * 21 and driven[21:28].count(2) >= 2 and set(driven[28:]) == {0, 1, 2}
