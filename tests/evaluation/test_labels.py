"""Whose ``info["mode"]`` is the ground truth of a route: only that of an environment which declares so."""

from functools import partial

import gymnasium as gym
import pytest
from environments import Says, TwoEnds, small_model
from gymnasium.wrappers import TimeLimit, TransformReward
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_ddiffpg import DDiffPG, ModeEvalCallback
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.envs.vec_env import WorkerVecEnv
from sb3_ddiffpg.evaluation import clustering_agreement, evaluate_modes, run_episodes
from sb3_ddiffpg.experiments.curve import CurveCallback
from sb3_ddiffpg.zoo.commands import OutcomeVecEnv

FOREIGN, LABELLED = partial(Says, what="train"), partial(Says, ())


def wrapped():
    return TransformReward(TimeLimit(LABELLED(), 6), lambda reward: 2 * reward)


def all_labels(model):
    return {trajectory.label for success in (True, False) for trajectory in model.replay_buffer.trajectories(success)}


def test_a_mode_of_another_meaning_is_no_label(tmp_path):
    logged = []

    class Recorder(KVWriter):
        def write(self, key_values, key_excluded, step=0):
            logged.append(dict(key_values))

        def close(self):
            pass

    env = DummyVecEnv([FOREIGN] * 4)
    model = small_model(env)
    model.set_logger(Logger(None, [Recorder()]))
    (tmp_path / "logs").mkdir()
    curve = CurveCallback(tmp_path, eval_env=env, eval_freq=200, n_episodes=2)
    model.learn(400, callback=[curve, ModeEvalCallback(FOREIGN(), eval_freq=50, n_eval_episodes=2, verbose=0, warn=False)])
    assert all_labels(model) == {None} and not curve.reached
    assert logged and not any("eval/n_modes" in each for each in logged) and any("eval/mean_reward" in each for each in logged)
    assert {episode.label for episode in run_episodes(model, env, 6)} == {None}
    assert evaluate_modes(model, env, 2).label_source == "clustering"
    assert clustering_agreement(model) != clustering_agreement(model)  # NaN: there is nothing to compare with
    outcomes = {}
    counting = OutcomeVecEnv([FOREIGN], outcomes)
    counting.reset()
    for _ in range(30):
        counting.step([counting.action_space.sample()])
    assert outcomes == {}


MAKERS = {
    "one process": lambda: DummyVecEnv([LABELLED] * 2),
    "gymnasium's wrappers": lambda: DummyVecEnv([wrapped] * 2),
    "SB3's wrappers": lambda: VecNormalize(VecFrameStack(VecMonitor(DummyVecEnv([LABELLED] * 2)), 2), norm_reward=False),
    "workers": lambda: WorkerVecEnv([LABELLED], 1),
    "processes": lambda: SubprocVecEnv([wrapped], start_method="fork"),
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS.keys())
def test_a_declared_one_is(make):
    env = make()
    model = small_model(env).learn(200)
    assert {"left", "right"} >= all_labels(model) > set()
    found = evaluate_modes(model, env, 4)
    assert found.label_source == "environment" and set(found.labels) <= {"left", "right"} and found.listed == ()
    env.close()


def test_what_is_counted_of_a_declared_one(tmp_path):
    (tmp_path / "logs").mkdir()
    env = DummyVecEnv([LABELLED] * 4)
    curve = CurveCallback(tmp_path, eval_env=env, eval_freq=400, n_episodes=2)
    small_model(env).learn(400, callback=curve)
    assert set(curve.reached) == {"left", "right"}


@pytest.mark.parametrize("single", [False, True])
def test_our_tasks_declare_theirs(single):
    kwargs = {"maze_map": ["#####", "#grg#", "#####"], "max_episode_steps": 20}
    env = gym.make("PointMazeV1-v0", **kwargs) if single else make_vec_env("PointMazeV1-v0", 4, seed=0, **kwargs)
    model = small_model(env).learn(400)
    labels = all_labels(model) - {None}
    assert labels and all(label[:2] in ("0:", "1:") for label in labels)


def test_a_model_without_its_buffer_tells_routes_by_standardised_features(tmp_path):
    """What they are divided by is measured in the buffer, which a file does not hold."""
    model = small_model(DummyVecEnv([TwoEnds] * 4), mode_features=[0], modes={"distance_threshold": None}).learn(400)
    assert model.replay_buffer.standardize
    model.save(tmp_path / "model")
    loaded = DDiffPG.load(tmp_path / "model")
    assert not loaded.replay_buffer.size()
    found = evaluate_modes(loaded, DummyVecEnv([TwoEnds]), n_episodes=5, deterministic=False)
    assert found.label_source == "clustering" and found.uncommanded.n_successes and found.uncommanded.labels
