"""Every task of gymnasium-robotics runs, in its newest version, with the mujoco that is installed beside it."""

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import pytest
from gymnasium.envs.registration import find_highest_version

gym.register_envs(gymnasium_robotics)
# Family -> how many tasks it has, in the newest version of each
FAMILIES = {"Fetch": 8, "Hand": 56, "FrankaKitchen": 1, "AdroitHand": 8, "PointMaze_": 20, "AntMaze_": 20}


def newest(family):
    """Older versions of Fetch and Hand need mujoco_py."""
    specs = [spec for spec in gym.registry.values() if spec.name.startswith(family)]
    return sorted({gym.spec(f"{each.name}-v{find_highest_version(each.namespace, each.name)}").id for each in specs})


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
@pytest.mark.parametrize("family", FAMILIES)
def test_all_tasks_of_a_family_run(family):
    ids = newest(family)
    for env_id in ids:
        env = gym.make(env_id)
        observation, _ = env.reset(seed=0)
        env.action_space.seed(0)
        for _ in range(3):
            assert env.observation_space.contains(observation), env_id
            observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            assert np.isfinite(reward) and not terminated and not truncated, env_id
        env.close()
    assert len(ids) == FAMILIES[family]
