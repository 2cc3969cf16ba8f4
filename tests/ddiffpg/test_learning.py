"""It learns: a trivial task, a dense reward without any success flag, and runs other people's mazes."""

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import pytest
from environments import small_model
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.envs import HideGoal

gym.register_envs(gymnasium_robotics)


@pytest.mark.parametrize("length", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_learns_the_identity(length):
    """The action that equals the observation is rewarded, in episodes of one step or more; there is nothing to cluster."""
    env = make_vec_env(lambda: IdentityEnvBox(eps=0.3, ep_length=length), 4, seed=0)
    model = small_model(
        env,
        learning_starts=200,
        train_freq=1,
        gradient_steps=2,
        learning_rate=3e-3,
        batch_size=64,
        policy_kwargs={"net_arch": [64]},
        modes={"max_modes": 1, "max_successes": 1000, "max_failures": 1000},
        gamma=0.0,
        critic={"v_max": 1.0},
    )
    evaluation = make_vec_env(lambda: IdentityEnvBox(eps=0.3, ep_length=length), 1, seed=1)

    def success():
        return evaluate_policy(model, evaluation, n_eval_episodes=200 // length, warn=False)[0] / length

    assert success() < 0.4  # a fixed action is right in 15 % to 30 %
    model.learn(1000)
    assert success() > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_pendulum_improves_without_any_success_flag(seed):
    """
    At the settings of the package: from about -1400 (untrained) to about -170, which is as good as it gets. The best fifth of
    the episodes counts as success.
    """
    model = DDiffPG("MlpPolicy", make_vec_env("Pendulum-v1", 4, seed=seed), seed=seed)
    evaluation = make_vec_env("Pendulum-v1", 10, seed=100)
    before, _ = evaluate_policy(model, evaluation, n_eval_episodes=10)
    model.learn(16_000)
    after, _ = evaluate_policy(model, evaluation, n_eval_episodes=10)
    assert before < -900 and after > -400


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_learns_the_identity_at_the_settings_of_the_package(seed):
    """In as many updates as steps; there is no success, no way, and nothing to set."""
    model = DDiffPG("MlpPolicy", make_vec_env(lambda: IdentityEnvBox(eps=0.5), 1, seed=seed), seed=seed).learn(3000)
    evaluation = make_vec_env(lambda: IdentityEnvBox(eps=0.5), 1, seed=100)
    assert evaluate_policy(model, evaluation, n_eval_episodes=20, warn=False)[0] > 90  # of 100


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "n_steps", "changes"),
    [
        # The start is in one corner of an open room of 5 x 3 m, the goal in the other
        ("PointMaze_Open-v3", 16000, {"learning_starts": 1000}),
        ("AntMaze_UMaze-v5", 3000, {"learning_starts": 500, "batch_size": 128}),
    ],
)
def test_mazes_of_gymnasium_robotics(env_id, n_steps, changes, tmp_path):
    env = make_vec_env(env_id, 8, seed=0, wrapper_class=HideGoal, env_kwargs={"max_episode_steps": 250})
    model = DDiffPG("DiffusionPolicy", env, seed=0, policy_kwargs={"net_arch": [64, 64]}, **changes).learn(n_steps)
    assert model.num_timesteps >= n_steps and model._n_updates > 250
    buffer = model.replay_buffer
    assert buffer.features.selection.tolist() == [0, 1]
    for success in (True, False):
        for trajectory in buffer.trajectories(success):
            # Positions in metres, without a leap between two steps
            assert np.linalg.norm(np.diff(buffer.full_path(trajectory), axis=0), axis=1).max() < 1.0
    if env_id.startswith("PointMaze"):
        assert len(model.modes) > 0 and len(buffer.trajectories(success=True)) > 10
        for mode in model.modes:
            goal = env.get_attr("unwrapped", indices=0)[0].goal
            assert np.linalg.norm(mode.representative[-1] - goal) < 0.5
    model.save(tmp_path / "model")
    obs = env.reset()
    expected, _ = model.predict(obs, deterministic=True)
    np.testing.assert_array_equal(DDiffPG.load(tmp_path / "model").predict(obs, deterministic=True)[0], expected)
