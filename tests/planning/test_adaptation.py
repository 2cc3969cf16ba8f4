"""Which mode is best now: the trials against those of the environment, and by hand."""

import numpy as np
import pytest
from environments import TwoEnds, small_model
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ddiffpg.planning import Adaptation, adapt


class Works(TwoEnds):
    """An episode is one step, and a success where the action is one that works now."""

    action_space = spaces.Box(0.0, 9.0, (1,))
    says = True

    def __init__(self, works=(1,)):
        super().__init__()
        self.works = works

    def step(self, action):
        obs, *_ = super().step(np.zeros(self.action_space.shape))
        info = {"is_success": round(float(action[0])) in self.works} if self.says else {}
        return obs, 0.0, True, False, info


class Stub:
    """Three modes; an action is the number of the mode."""

    success_key, resolved_features = None, None

    def __init__(self, values=(0.0, 0.0, 0.0)):
        self.values = np.array(values)
        self.modes = [type("Mode", (), {"name": f"mode_{i}"}) for i in range(len(values))]

    def mode_values(self, obs):
        return np.repeat(self.values[None], len(obs), axis=0)

    def predict(self, obs, state=None, episode_start=None, deterministic=False, mode=None):
        return np.full((len(obs), 1), int(mode[-1]), dtype=np.float32), state


@pytest.mark.parametrize("works", [0, 1, 2])
@pytest.mark.parametrize("values", [(0.0, 0.0, 0.0), (5.0, 1.0, -3.0)])
def test_finds_the_one_that_works(works, values):
    for seed in range(10):
        np.random.seed(seed)
        found = adapt(Stub(values), DummyVecEnv([lambda: Works((works,))]), 20)
        assert found.mode == f"mode_{works}" and found.success_rate == 1.0
        assert sum(found.n_trials.values()) == 20 and found.n_trials[found.mode] == max(found.n_trials.values())
        assert all(n == 0 for name, n in found.n_successes.items() if name != found.mode)


def test_what_critics_like_is_tried_first():
    """One trial: it is the most valued mode's more often than any other's."""
    np.random.seed(0)
    tried = [max((t := adapt(Stub((0.0, 9.0, 1.0)), DummyVecEnv([Works]), 1).n_trials), key=t.get) for _ in range(60)]
    assert tried.count("mode_1") > max(tried.count("mode_0"), tried.count("mode_2"))


def test_each_of_several_environments_is_a_trial():
    found = adapt(Stub(), DummyVecEnv([Works] * 3), 7)
    assert sum(found.n_trials.values()) == 7


def test_interval_by_hand():
    """Wilson (1927): 8 of 10, 95 %."""
    found = Adaptation("a", {"a": 10, "b": 0}, {"a": 8, "b": 0})
    z, p, n = 1.959964, 0.8, 10
    middle, half = (p + z * z / 2 / n) / (1 + z * z / n), z / (1 + z * z / n) * np.sqrt(p * (1 - p) / n + z * z / 4 / n / n)
    assert found.interval() == pytest.approx((middle - half, middle + half), abs=1e-6) and found.success_rate == 0.8
    nothing = Adaptation("b", {"a": 10, "b": 0}, {"a": 0, "b": 0})
    assert nothing.interval() == (0.0, 1.0) and np.isnan(nothing.success_rate)


def test_refuses_what_cannot_work():
    silent = type("Silent", (Works,), {"says": False})
    for model, env, n, message in (
        (small_model(DummyVecEnv([TwoEnds])), DummyVecEnv([TwoEnds]), 5, "without modes"),
        (Stub(), DummyVecEnv([Works]), 0, "n_trials"),
        (Stub(), DummyVecEnv([Works]), 2.5, "n_trials"),
        (Stub(), DummyVecEnv([silent]), 5, "success"),
    ):
        with pytest.raises(ValueError, match=message):
            adapt(model, env, n)


def test_some_speak_only_of_successes():
    class Praises(Works):
        def step(self, action):
            *rest, info = super().step(action)
            return *rest, info if info["is_success"] else {}

    np.random.seed(0)
    found = adapt(Stub(), DummyVecEnv([Praises]), 20)
    assert found.mode == "mode_1" and found.n_successes["mode_1"] == found.n_trials["mode_1"]


def test_a_normaliser_does_not_learn_from_trials():
    env = VecNormalize(DummyVecEnv([Works]))
    count = env.obs_rms.count
    adapt(Stub(), env, 3)
    assert env.obs_rms.count == count and env.training
