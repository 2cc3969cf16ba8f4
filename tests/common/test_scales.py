"""What follows where a run has been: the same run in any unit, and however many calls of ``learn`` it takes."""

import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import AnySpaces, TwoEnds, assert_same_state, small_model, state_of
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.common.scales import may_choose, use_features
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation import evaluate_modes


class Room(gym.Env):
    """
    Ten by ten, with a wall in the middle, and a goal on its other side that two ways lead to. It declares nothing but which
    labels there are.

    :param unit: Of lengths
    :param worth: What the goal pays
    :param cost: What each step costs
    """

    listed_modes = ("left", "right")

    def __init__(self, unit=1.0, worth=1.0, cost=0.0):
        self.unit, self.worth, self.cost = unit, worth, cost
        self.observation_space = spaces.Box(-10 * unit, 10 * unit, (4,))
        self.action_space = spaces.Box(-1.0, 1.0, (2,))

    def _observation(self):
        return (np.concatenate((self.position, self.velocity)) * self.unit).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = np.array([0.0, -4.0]) + self.np_random.uniform(-0.2, 0.2, 2)
        self.velocity, self.side = np.zeros(2), None
        return self._observation(), {}

    def step(self, action):
        self.velocity = 0.6 * self.velocity + 0.32 * np.clip(action, -1, 1)
        for axis in range(2):
            moved = self.position.copy()
            moved[axis] += self.velocity[axis]
            if np.abs(moved).max() > 5 or (abs(moved[1]) < 0.5 and abs(moved[0]) < 3):
                self.velocity[axis] = 0
            else:
                self.position = moved
        if abs(self.position[1]) < 0.6:
            self.side = "left" if self.position[0] < 0 else "right"
        done = bool(np.hypot(self.position[0], self.position[1] - 4) < 0.7)
        info = {"is_success": done, "mode": self.side if done else None}
        return self._observation(), self.worth * done - self.cost, done, False, info


def rooms(n_envs=4, unit=1.0, worth=1.0, limit=100):
    env = DummyVecEnv([lambda: gym.wrappers.TimeLimit(Room(unit, worth), limit)] * n_envs)
    env.seed(0)
    return env


def settled(env, **changes):
    """A small model at the settings of the package, silent."""
    settings = {"learning_starts": 400, "batch_size": 32, "seed": 0, "device": "cpu", "policy_kwargs": {"net_arch": [16]}}
    model = DDiffPG("MlpPolicy", env, **{**settings, **changes})
    model.set_logger(Logger(None, []))
    return model


def in_own_units(model):
    """All that was learned, but for what is measured in the unit of the observations."""
    measured = re.compile(r"features_extractor(_target)?\.(offset|scale)$")
    return {name: each for name, each in state_of(model).items() if not measured.search(name)}


@pytest.fixture(scope="module")
def in_metres():
    return settled(rooms()).learn(2000)


@pytest.mark.parametrize(("unit", "worth"), [(2.0**-10, 1.0), (2.0**10, 2.0**-10), (1.0, 2.0**10)])
def test_a_run_in_another_unit_is_the_same_bit_for_bit(in_metres, unit, worth):
    """Powers of two are exact, so nothing may differ: what was learned, where it has been, what is new."""
    model = settled(rooms(unit=unit, worth=worth)).learn(2000)
    assert model.resolved_features.tolist() == in_metres.resolved_features.tolist() == [0, 1]
    np.testing.assert_array_equal(model.bonus.grid.edges, unit * in_metres.bonus.grid.edges)
    assert model.visits._counts == in_metres.visits._counts
    for low_or_high in ("low", "high"):
        assert getattr(model.value_range, low_or_high) == worth * getattr(in_metres.value_range, low_or_high)
    assert model.value_range.novelty_unit == in_metres.value_range.novelty_unit
    first, second = in_own_units(model), in_own_units(in_metres)
    assert first.keys() == second.keys()
    for name, each in first.items():
        assert th.equal(each, second[name]), name


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_a_run_in_millimetres_or_kilometres_finds_as_many_places(in_metres, unit):
    model = settled(rooms(unit=unit)).learn(2000)
    assert model.resolved_features.tolist() == in_metres.resolved_features.tolist()
    assert model.bonus.n_cells == pytest.approx(in_metres.bonus.n_cells, rel=0.1) and model.bonus.n_cells > 50
    np.testing.assert_allclose(model.bonus.grid.edges, unit * in_metres.bonus.grid.edges, rtol=0.1)


@pytest.mark.parametrize("fraction", [None, 0.7])
def test_ten_calls_of_learn_are_one(fraction):
    """What explores, and for how long, does not hang on the calls: with ``fraction`` where they know the whole run's steps."""
    horizon = {} if fraction is None else {"horizon": 1600}

    def made():
        noise = NormalActionNoise(np.zeros(1), np.full(1, 0.1))  # the package's own draws anew when ``learn`` begins
        return small_model(DummyVecEnv([TwoEnds] * 4), exploration={"fraction": fraction}, action_noise=noise)

    whole, pieces = made().learn(1600, **horizon), made()
    for call in range(10):
        pieces.learn(160, reset_num_timesteps=call == 0, **(horizon if call == 0 else {}))
    assert whole.modes.names and str(pieces.scheduler.state_dict()) == str(whole.scheduler.state_dict())
    assert (
        pieces._current_progress_remaining == pytest.approx(0.0) and whole._exploration_share() == pieces._exploration_share()
    )
    first, second = state_of(pieces), state_of(whole)
    for name, each in first.items():
        assert th.equal(each, second[name]), name


def test_schedules_follow_the_horizon(tmp_path):
    asked = []

    def rate(progress):
        asked.append(progress)
        return 3e-4

    model = small_model(DummyVecEnv([TwoEnds] * 4), learning_rate=rate)
    asked.clear()
    model.learn(400, horizon=1600)
    assert model._current_progress_remaining == pytest.approx(0.75, abs=0.01) and min(asked) >= 0.75
    model.learn(400, reset_num_timesteps=False)
    assert model._current_progress_remaining == pytest.approx(0.5, abs=0.01)
    model.learn(400)  # counted anew: the run goes on
    assert model._current_progress_remaining == pytest.approx(0.25, abs=0.01)
    for wrong in (0, -5, 1.5, "many"):
        with pytest.raises(ValueError, match="horizon must be"):
            model.learn(10, horizon=wrong)
    model = small_model(DummyVecEnv([TwoEnds] * 4)).learn(400, horizon=1600)
    model.export(tmp_path / "model")
    assert DDiffPG.load(tmp_path / "model", safe=True).horizon == 1600


def test_the_values_that_a_model_says_are_returns():
    """Whatever the goal pays: of a mode at its goal about that."""
    for worth in (1e-3, 1e3):
        env = DummyVecEnv(
            [lambda worth=worth: gym.wrappers.TransformReward(TwoEnds(), lambda reward: worth * float(reward))] * 4
        )
        model = small_model(env, qf_learning_rate=1e-2).learn(2500)
        assert model.value_range.unit == pytest.approx(worth, rel=1e-6) and model.modes
        near = np.array([[0.9, 0.4], [-0.9, 0.4]], dtype=np.float32)
        said = model.mode_values(near).max(axis=1)
        assert (said > 0.3 * worth).all() and (said < 1.3 * worth).all()
        np.testing.assert_allclose(model.state_values(near), said, rtol=0.5)


# ---------------------------------------------------------------------- who chooses


def test_who_says_where_modes_differ():
    """The user, else the environment, else what was seen; an observation of few numbers is taken whole."""
    model = settled(rooms(), learning_starts=100).learn(200)
    assert model.features_found and model.resolved_features.tolist() == [0, 1] and model.replay_buffer.standardize
    told = settled(rooms(), mode_features=[2], learning_starts=100).learn(200)
    assert told.resolved_features == [2] and not told.features_found and told.replay_buffer.standardize
    declared = settled(make_vec_env("PointMazeV1-v0", 2), learning_starts=100).learn(200)
    assert declared.resolved_features.tolist() == [0, 1] and not declared.features_found
    assert not declared.replay_buffer.standardize  # metres are metres
    few = settled(
        DummyVecEnv([lambda: AnySpaces(spaces.Box(-1, 1, (3,)))]), learning_starts=100, critic={"v_min": -9.0, "v_max": 9.0}
    )
    few.learn(200)
    assert few.resolved_features is None and few.replay_buffer.features.dim == 3 and not may_choose(few)


@pytest.mark.parametrize("novelty", ["counts", "rnd"])
def test_features_that_were_found_are_kept_in_files(tmp_path, novelty):
    model = settled(rooms(), learning_starts=100, novelty=novelty).learn(400)
    model.save(tmp_path / "model")
    model.export(tmp_path / "safe", optimizers=True)
    loaded = [
        DDiffPG.load(tmp_path / "model"),
        DDiffPG.load(tmp_path / "model", env=rooms()),
        DDiffPG.load(tmp_path / "safe", safe=True),
    ]
    for each in loaded:
        assert each.features_found and each.resolved_features.tolist() == [0, 1] and each.replay_buffer.features.dim == 2
        np.testing.assert_array_equal(each.bonus.grid.edges, model.bonus.grid.edges)
        assert each.replay_buffer.standardize
        assert_same_state(state_of(each), state_of(model))


def test_other_features_keep_modes_and_count_anew():
    model = small_model(DummyVecEnv([TwoEnds] * 4)).learn(600)
    names, before = model.modes.names, model.replay_buffer.size()
    assert names
    use_features(model, [0, 1])
    assert model.modes.names == names and model.replay_buffer.features.dim == 2 and model.bonus.dim == 2
    assert model.visits.cells()[1].sum() == before
    model.recluster()
    assert set(names) & set(model.modes.names)
    model.learn(200, reset_num_timesteps=False)
    assert all(mode.representative.shape[1] == 2 for mode in model.modes)


@pytest.mark.parametrize("algorithm", ["td3_c51", "rpg"])
def test_baselines_follow_too(algorithm):
    model = BASELINES[algorithm](
        "MlpPolicy", rooms(), learning_starts=200, batch_size=32, seed=0, policy_kwargs={"net_arch": [16]}
    )
    model.set_logger(Logger(None, []))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.learn(400)
    assert model.features_found and model.resolved_features.tolist() == [0, 1] and model.bonus.n_cells > 20


# ---------------------------------------------------------------------- learning


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unit", "worth", "cost"),
    [(1e-3, 1.0, 0.0), (1.0, 1.0, 0.0), (1e3, 1.0, 0.0), (1.0, 1e-3, 0.0), (1.0, 1e3, 0.0), (1.0, 1.0, 1.0)],
)
@pytest.mark.parametrize("seed", range(3))
def test_both_ways_are_found_in_any_unit_and_for_any_reward(unit, worth, cost, seed):
    """At the settings of the package, whoever measures how and pays what."""
    name = "AnyRoom-v0"
    gym.register(name, lambda **_: Room(unit, worth, cost), max_episode_steps=100)
    try:
        env = DummyVecEnv([lambda: gym.make(name)] * 8)
        env.seed(seed)
        model = DDiffPG("MlpPolicy", env, seed=seed, device="cpu")
        model.set_logger(Logger(None, []))
        model.learn(30_000)
        found = evaluate_modes(model, name, n_episodes=20, seed=1000)
        taken = {label for each in found.commanded for label, times in each.labels.items() if times >= 10}
        assert taken == {"left", "right"}, str(found)
    finally:
        gym.registry.pop(name)
