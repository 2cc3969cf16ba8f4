"""Declared mode features behind every observation wrapper of Gymnasium: followed exactly, or refused."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from environments import TwoEnds, small_model
from gymnasium import spaces, wrappers
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecExtractDictObs, VecFrameStack

from sb3_ddiffpg.buffers.features import ModeFeatures, declared_mode_features
from sb3_ddiffpg.evaluation.rollout import run_episodes


class Numbered(gym.Env):
    """Component k of an observation is 100 * k + the number of steps, by which it is found again; modes differ in 1 and 3."""

    mode_features = np.array([1, 3])

    def __init__(self, shape=(4,)):
        self.observation_space = spaces.Box(-1e4, 1e4, shape, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,))

    def _observation(self):
        shape = self.observation_space.shape
        return (100 * np.arange(np.prod(shape)) + self.steps).reshape(shape).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._observation(), {}

    def step(self, action):
        self.steps += 1
        return self._observation(), 0.0, False, False, {}


class NumberedDict(Numbered):
    """The same in two entries, of which "place" is where modes differ; not in the order of the alphabet."""

    mode_features = "place"

    def __init__(self):
        super().__init__()
        parts = {"zero": spaces.Discrete(3), "place": spaces.Box(-1e4, 1e4, (2,)), "first": spaces.Box(-1.0, 1.0, (3,))}
        self.observation_space = spaces.Dict(parts)

    def _observation(self):
        place = np.array([100.0, 300.0], dtype=np.float32) + self.steps
        return {"zero": 1, "place": place, "first": np.zeros(3, dtype=np.float32)}


def selected(env):
    """What a batch of the observations of the third step holds where the features are said to be."""
    env = DummyVecEnv([lambda: env])
    features = ModeFeatures(env.observation_space, declared_mode_features(env))
    env.reset()
    for _ in range(3):
        observation = env.step(np.zeros((1, 1)))[0]
    return features(observation)[0]


FOLLOWED = {
    "nothing": lambda env: env,
    "plain wrappers": lambda env: Monitor(wrappers.TimeLimit(wrappers.OrderEnforcing(wrappers.ClipAction(env)), 50)),
    "reward": lambda env: wrappers.NormalizeReward(wrappers.TransformReward(env, lambda reward: 2 * reward)),
    "dtype": lambda env: wrappers.DtypeObservation(env, np.float64),
    "reshape": lambda env: wrappers.ReshapeObservation(env, (2, 2)),
    "flatten": lambda env: wrappers.FlattenObservation(wrappers.ReshapeObservation(env, (2, 2))),
    "stack": lambda env: wrappers.FrameStackObservation(env, 3),
    "stacked twice": lambda env: wrappers.FrameStackObservation(wrappers.FrameStackObservation(env, 3), 2),
    "flattened stack": lambda env: wrappers.FlattenObservation(wrappers.FrameStackObservation(env, 3)),
    "time": lambda env: wrappers.TimeAwareObservation(wrappers.TimeLimit(env, 50)),
    "stack of time": lambda env: wrappers.FrameStackObservation(wrappers.TimeAwareObservation(wrappers.TimeLimit(env, 50)), 2),
}


@pytest.mark.parametrize("wrap", FOLLOWED.values(), ids=FOLLOWED.keys())
def test_the_components_are_found_again(wrap):
    np.testing.assert_array_equal(selected(wrap(Numbered())), [103.0, 303.0])


def test_an_image_that_is_flattened_keeps_the_order():
    env = wrappers.FlattenObservation(Numbered((2, 2)))
    np.testing.assert_array_equal(selected(env), [103.0, 303.0])


def test_components_that_are_scaled_or_late_keep_their_places():
    """Their unit is the wrapper's."""
    space = spaces.Box(-1.0, 1.0, (4,), dtype=np.float32)
    env = wrappers.RescaleObservation(Numbered(), space.low, space.high)
    np.testing.assert_allclose(selected(env), [0.0103, 0.0303], rtol=1e-5)
    np.testing.assert_array_equal(selected(wrappers.DelayObservation(Numbered(), 2)), [101.0, 301.0])
    env = DummyVecEnv([lambda: wrappers.NormalizeObservation(Numbered())])
    assert declared_mode_features(env).tolist() == [1, 3]


OF_DICTS = {
    "nothing": lambda env: env,
    "flatten": wrappers.FlattenObservation,
    "filter": lambda env: wrappers.FilterObservation(env, ["place"]),
    "time": lambda env: wrappers.TimeAwareObservation(wrappers.TimeLimit(env, 50), flatten=False),
    "flattened time": lambda env: wrappers.FlattenObservation(
        wrappers.TimeAwareObservation(wrappers.TimeLimit(env, 50), flatten=False)
    ),
    "late": lambda env: wrappers.FlattenObservation(wrappers.FilterObservation(env, ["place", "first"])),
}


@pytest.mark.parametrize("wrap", OF_DICTS.values(), ids=OF_DICTS.keys())
def test_an_entry_of_a_dict_is_found_again(wrap):
    np.testing.assert_array_equal(selected(wrap(NumberedDict())), [103.0, 303.0])


class Reversed(gym.ObservationWrapper):
    def observation(self, observation):
        return observation[::-1]


class Halved(gym.Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Box(-1e4, 1e4, (2,), dtype=np.float32)


class Pictured(Numbered):
    """That can be drawn."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    render_mode = "rgb_array"

    def render(self):
        return np.zeros((8, 8, 3), dtype=np.uint8)

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(0, 255, (8, 8, 3), dtype=np.uint8)


REFUSED = {
    "TransformObservation": (Numbered, lambda env: wrappers.TransformObservation(env, np.flip, env.observation_space)),
    "Reversed": (Numbered, Reversed),
    "Halved": (Numbered, Halved),
    "MaxAndSkipObservation": (Numbered, wrappers.MaxAndSkipObservation),
    "TimeAwareObservation": (
        NumberedDict,
        lambda env: wrappers.TimeAwareObservation(wrappers.TimeLimit(env, 50)),
    ),
    "FilterObservation": (NumberedDict, lambda env: wrappers.FilterObservation(env, ["first"])),
    "FrameStackObservation": (NumberedDict, lambda env: wrappers.FrameStackObservation(env, 2)),
    "GrayscaleObservation": (Pictured, wrappers.GrayscaleObservation),
    "AddRenderObservation": (Pictured, lambda env: wrappers.AddRenderObservation(env, render_only=True)),
    "DiscretizeObservation": (Numbered, lambda env: wrappers.DiscretizeObservation(env, 5)),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_known_is_refused(name):
    make, wrap = REFUSED[name]
    with pytest.raises(
        ValueError, match=rf"declares mode_features=.*changed by {name}: say with mode_features= where they are"
    ):
        declared_mode_features(DummyVecEnv([lambda: wrap(make())]))


def test_all_observation_wrappers_of_gymnasium_are_in_these_tests():
    """A new one is refused until somebody has thought about it."""
    names = [name for name in wrappers.__all__ if "Observation" in name]
    text = Path(__file__).read_text()
    # ResizeObservation needs OpenCV; it is refused as GrayscaleObservation is, by its base class
    assert len(names) >= 15 and [name for name in names if name not in text] == []


def test_whoever_declares_them_outside_means_his_own():
    class Declares(Reversed):
        mode_features = (0, 2)

    np.testing.assert_array_equal(selected(Declares(Numbered())), [303.0, 103.0])


def test_a_callable_means_what_the_environment_itself_gives():
    env = Numbered()
    env.mode_features = lambda observations: observations[:, :1]
    assert declared_mode_features(DummyVecEnv([lambda: Monitor(env)])) is env.mode_features
    with pytest.raises(ValueError, match="changed by NormalizeObservation"):
        declared_mode_features(DummyVecEnv([lambda: wrappers.NormalizeObservation(env)]))


@pytest.mark.parametrize(("wrap", "known"), [(wrappers.NormalizeObservation, True), (Monitor, True), (Reversed, False)])
def test_in_other_processes_wrappers_are_asked_for(wrap, known):
    env = SubprocVecEnv([lambda: wrap(Numbered())], start_method="fork")
    try:
        if known:
            assert declared_mode_features(env).tolist() == [1, 3]
        else:
            with pytest.raises(ValueError, match="changed by a wrapper in another process"):
                declared_mode_features(env)
    finally:
        env.close()


def test_entries_behind_wrappers_of_vectorised_environments():
    def make():
        return wrappers.FilterObservation(NumberedDict(), ["place", "first"])

    assert declared_mode_features(DummyVecEnv([make])) == "place"
    for wrapped in (VecFrameStack(DummyVecEnv([make]), 2), VecExtractDictObs(DummyVecEnv([make]), "place")):
        with pytest.raises(ValueError, match="mode_features=place of its observations of shape"):
            declared_mode_features(wrapped)


def test_models_train_and_are_tested_there():
    """With the features given where they cannot be known, of which the evaluation of another's model needs none."""
    env = DummyVecEnv([lambda: wrappers.FrameStackObservation(TwoEnds(), 2)] * 2)
    model = small_model(env).learn(60)
    np.testing.assert_array_equal(model.replay_buffer.features.selection, [2])
    env = DummyVecEnv([lambda: Reversed(TwoEnds())] * 2)
    with pytest.raises(ValueError, match="changed by Reversed: say with mode_features="):
        small_model(env)
    model = small_model(env, mode_features=[1]).learn(60)
    assert run_episodes(model, env, 2)[0].path.shape[1] == 1

    class Anything:
        def predict(self, obs, **kwargs):
            return np.ones((len(obs), 1)), None

    assert run_episodes(Anything(), env, 2)[0].path.shape[1] == 2
