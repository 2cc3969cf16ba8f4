"""Environments for an evaluation, as SB3's ``evaluate_policy`` takes them: single ones too."""

import gymnasium as gym
import numpy as np
import pytest
from environments import TwoEnds, small_model
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from test_rollout import Scripted

from sb3_ddiffpg import EvaluateModesCallback, ModeFigureCallback
from sb3_ddiffpg.evaluation import Replanner, evaluate_ensemble, evaluate_modes, run_episodes


class Above(Scripted):
    def predict(self, obs, **kwargs):
        return super().predict(obs, mode="above")


class Constant:
    """Goes to the right, to the goal in two or three steps."""

    def predict(self, obs, state=None, **kwargs):
        return np.full((len(obs), 1), 0.9, dtype=np.float32), state


def test_a_single_environment_is_one_of_many(trained):
    one, many = Monitor(TwoEnds()), DummyVecEnv([TwoEnds])
    assert evaluate_modes(trained, one, 3, seed=0) == evaluate_modes(trained, many, 3, seed=0)
    found = evaluate_ensemble([trained, trained], one, 2, seed=0)
    assert found.env_id == "DummyVecEnv" and [each.n_episodes for each in found.commanded] == [2, 2]
    assert len(run_episodes(trained, one, 3, mode=0)) == 3
    # Returns and lengths are those that SB3 counts
    agent = Constant()
    returns, lengths = evaluate_policy(agent, one, 5, return_episode_rewards=True)
    episodes = run_episodes(agent, one, 5)
    assert [(each.episode_return, each.length) for each in episodes] == list(zip(returns, lengths, strict=True))
    one.step(np.zeros(1, dtype=np.float32))  # it is the user's, and still open


def test_an_environment_of_gymnasium():
    with pytest.warns(UserWarning, match="not wrapped with a ``Monitor``"):
        found = evaluate_modes(Above(), gym.make("PointMazeV1-v0", start_noise=0.0), 2)
    assert found.env_id == "PointMazeV1-v0" and found.uncommanded.labels == {"0:a": 4} and found.start_spread == 0.0


def test_an_id():
    episodes = run_episodes(Above(), "PointMazeV1-v0", 3)
    assert [each.label for each in episodes] == ["0:a"] * 3 and len({tuple(each.path[0]) for each in episodes}) == 1


@pytest.mark.parametrize(("env", "warns"), [(TwoEnds(), True), (Monitor(TwoEnds()), False), (DummyVecEnv([TwoEnds]), False)])
def test_a_missing_monitor_is_told_where_sb3_would(env, warns, trained, recwarn):
    run_episodes(trained, env, 1)
    assert any("Monitor" in str(each.message) for each in recwarn) == warns


def test_a_replanner_in_a_single_environment(trained):
    agent = Replanner(trained)
    env = Monitor(TwoEnds())
    assert len(run_episodes(agent, env, 3)) == 3
    _, lengths = evaluate_policy(agent, env, 3, return_episode_rewards=True)
    assert len(lengths) == 3
    observation, _ = env.reset(seed=0)
    action, _ = agent.predict(observation)
    assert env.action_space.contains(action)


def test_callbacks():
    model = small_model(TwoEnds())
    evaluation, figures = EvaluateModesCallback(Monitor(TwoEnds()), 100, 1), ModeFigureCallback(150, Monitor(TwoEnds()), 1)
    model.learn(300, callback=[evaluation, figures])
    assert [step for step, _ in evaluation.evaluations] == [100, 200, 300]


@pytest.mark.parametrize("env", [None, 3, TwoEnds, "no module:Id-v0"])
def test_what_is_no_environment(env, trained):
    with pytest.raises(
        (ValueError, ModuleNotFoundError), match=r"env must be a VecEnv, a gymnasium.Env or the id|no module|env: not given"
    ):
        run_episodes(trained, env, 1)


def test_statistics_learn_again_after_a_test_that_breaks_off():
    """Whatever ends it: the run that it was a test of goes on learning them."""
    env = VecNormalize(DummyVecEnv([TwoEnds]))

    class Breaks:
        def predict(self, *args, **kwargs):
            raise ArithmeticError

    count = env.obs_rms.count
    with pytest.raises(ArithmeticError):
        run_episodes(Breaks(), env, 1)
    assert env.training and env.obs_rms.count == count
    env.training = False  # and stay as they are where they learned nothing
    with pytest.raises(ArithmeticError):
        run_episodes(Breaks(), env, 1)
    assert not env.training
