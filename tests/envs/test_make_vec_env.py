"""``make_vec_env`` takes what SB3's takes, and gives what SB3's gives."""

import inspect

import gymnasium as gym
import numpy as np
import pytest
from environments import TwoEnds
from gymnasium.wrappers import TimeLimit, TransformReward
from stable_baselines3.common.env_util import make_vec_env as make_sb3_vec_env
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_ddiffpg.envs import PointMazeVecEnv, make_vec_env
from sb3_ddiffpg.evaluation import run_episodes


class Seeded(TwoEnds):
    """Its own argument is called as one of ``make_vec_env``, as Meta-World's is."""

    def __init__(self, seed=None, n_envs=1, **kwargs):
        super().__init__(**kwargs)
        self.own_seed, self.own_number = seed, n_envs


gym.register("Seeded-v0", entry_point=Seeded, max_episode_steps=20)


def rollout(env, n=12):
    """Actions are drawn by the space, which was seeded with the environments."""
    steps = [env.reset()]
    for _ in range(n):
        observations, rewards, dones, _ = env.step(np.stack([env.action_space.sample() for _ in range(env.num_envs)]))
        steps += [observations, rewards, dones]
    env.close()
    return np.concatenate([np.ravel(each) for each in steps])


def test_the_arguments_are_sb3s_and_in_its_order():
    theirs = list(inspect.signature(make_sb3_vec_env).parameters.values())
    ours = list(inspect.signature(make_vec_env).parameters.values())[: len(theirs)]
    assert [(each.name, each.default) for each in ours] == [(each.name, each.default) for each in theirs]


def test_arguments_that_are_called_as_ours():
    env = make_vec_env("Seeded-v0", 2, seed=3, env_kwargs={"seed": 7, "n_envs": 5}, limit=4)
    assert env.get_attr("own_seed") == [7, 7] and env.get_attr("own_number") == [5, 5] and env.get_attr("limit") == [4, 4]
    theirs = make_sb3_vec_env("Seeded-v0", 2, seed=3, env_kwargs={"seed": 7, "n_envs": 5, "limit": 4})
    np.testing.assert_array_equal(rollout(env), rollout(theirs))
    with pytest.raises(ValueError, match=r"env_kwargs: \['limit'\] given beside the same"):
        make_vec_env("Seeded-v0", 2, env_kwargs={"limit": 3}, limit=4)

    class Right:
        def predict(self, obs, **kwargs):
            return np.ones((len(obs), 1), dtype=np.float32), None

    assert len(run_episodes(Right(), "Seeded-v0", 2)) == 2


@pytest.mark.parametrize("env_id", ["PointMazeV2-v0", "Seeded-v0", Seeded], ids=["maze", "id", "class"])
@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"start_index": 5},
        {"wrapper_class": TransformReward, "wrapper_kwargs": {"func": lambda reward: 2 * reward - 1}},
        {"vec_env_cls": DummyVecEnv, "monitor_kwargs": {"info_keywords": ("is_success",)}},
    ],
    ids=["nothing", "start_index", "wrapper", "vec_env_cls"],
)
def test_the_same_as_sb3s(env_id, arguments):
    ours, theirs = (make(env_id, 3, 4, **arguments) for make in (make_vec_env, make_sb3_vec_env))
    np.testing.assert_array_equal(rollout(ours), rollout(theirs))


def test_what_is_said_of_single_ones_makes_single_ones():
    assert isinstance(make_vec_env("PointMazeV1-v0", 2, maze_map="V2").venv, PointMazeVecEnv)
    wrapped = make_vec_env(
        "PointMazeV1-v0", 2, wrapper_class=TimeLimit, wrapper_kwargs={"max_episode_steps": 3}, maze_map="V2"
    )
    assert isinstance(wrapped, DummyVecEnv) and wrapped.env_is_wrapped(Monitor) == [True, True]
    assert [type(env) for env in wrapped.envs] == [TimeLimit, TimeLimit] and wrapped.get_attr("maze")[0].name == "V2"
    processes = make_vec_env("Seeded-v0", 1, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "fork"})
    assert isinstance(processes, SubprocVecEnv)
    processes.close()


@pytest.mark.parametrize("env_id", ["PointMazeV1-v0", "Seeded-v0"])
def test_monitors_write_where_sb3_looks(env_id, tmp_path):
    env = make_vec_env(env_id, 2, 0, monitor_dir=str(tmp_path), env_kwargs={"max_episode_steps": 4})
    assert isinstance(env, VecMonitor) == (env_id == "PointMazeV1-v0")
    rollout(env)
    assert len(load_results(str(tmp_path))) >= 6  # three episodes of each, or shorter ones
