"""HideGoal around the mazes of gymnasium-robotics."""

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from stable_baselines3.common.env_util import make_vec_env

from sb3_ddiffpg.envs import HideGoal

gym.register_envs(gymnasium_robotics)

# id, metres per cell, length of the environment's own observation, start, farthest cell from it
MAZES = [
    ("PointMaze_Open-v3", 1, 4, (1, 1), (3, 5)),
    ("PointMaze_UMazeDense-v3", 1, 4, (1, 1), (3, 1)),
    ("PointMaze_Medium_Diverse_G-v3", 1, 4, (1, 1), (6, 5)),
    ("AntMaze_UMaze-v5", 4, 105, (1, 1), (3, 1)),
]


@pytest.fixture(scope="module", params=MAZES, ids=[maze[0] for maze in MAZES])
def maze(request):
    env = HideGoal(gym.make(request.param[0]))
    yield env, *request.param[1:]
    env.close()


def center(env, cell, scale):
    n_rows, n_columns = np.shape(env.unwrapped.maze.maze_map)
    return [scale * (cell[1] + 0.5 - n_columns / 2), scale * (n_rows / 2 - cell[0] - 0.5)]


def test_position_is_observed_once_and_the_goal_never(maze):
    env, _, size, _, _ = maze
    own_position = size == 4
    assert env.observation_space.shape == (size + (0 if own_position else 2),)
    assert env.get_wrapper_attr("mode_features").tolist() == [0, 1]
    observation, _ = env.reset(seed=0)
    for k in range(20):
        inner = env.unwrapped._get_obs(simulation_state(env))
        expected = inner["observation"] if own_position else [*inner["achieved_goal"], *inner["observation"]]
        assert observation.dtype == np.float32 and observation in env.observation_space
        np.testing.assert_array_equal(observation, np.float32(expected))
        np.testing.assert_array_equal(observation[:2], np.float32(env.unwrapped.data.qpos[:2]))
        # The same state whatever the goal: it is nowhere in the observation
        env.unwrapped.goal = np.array([float(k), 0.0])
        observation = env.step(env.action_space.sample())[0]


def simulation_state(env):
    base = env.unwrapped
    return base.point_env._get_obs()[0] if hasattr(base, "point_env") else base.ant_env._get_obs()


def test_goal_is_the_same_in_every_episode_and_the_start_one_cell(maze):
    env, scale, _, start, goal = maze
    assert (env.reset_cell, env.goal_cell) == (start, goal)
    starts = []
    for seed in [*range(8), None]:
        observation, info = env.reset(seed=seed)
        assert "success" not in info
        assert env.unwrapped.goal.tolist() == center(env, goal, scale)
        starts.append(observation[:2] - center(env, start, scale))
    assert np.abs(starts).max() <= 0.25 * scale
    assert len({tuple(offset) for offset in starts}) == len(starts)
    assert np.array_equal(env.reset(seed=3)[0], env.reset(seed=3)[0])


def test_the_goal_ends_the_episode_with_reward_one(maze):
    env, scale, _, start, goal = maze
    observation, _ = env.reset(seed=0)
    _, reward, terminated, _, info = env.step(np.zeros(env.action_space.shape))
    assert (reward, terminated, info["success"], info["is_success"]) == (0.0, False, False, False)
    # Begin in the goal cell until the noise of the start is small enough
    for seed in range(100):
        observation, _ = env.reset(seed=seed, options={"reset_cell": goal})
        if np.hypot(*observation[:2] - center(env, goal, scale)) < 0.3:
            break
    _, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
    assert (reward, terminated, truncated, info["success"], info["is_success"]) == (1.0, True, False, True, True)
    env.reset(options={"goal_cell": start})
    assert env.unwrapped.goal.tolist() == center(env, start, scale)
    env.reset()
    assert env.unwrapped.goal.tolist() == center(env, goal, scale)


def test_a_goal_that_moves_and_an_episode_that_ends():
    """Both settings of ``continuing_task``; with ``reset_target`` gymnasium-robotics moves a goal once it is reached."""
    for kwargs in [{"continuing_task": False}, {"continuing_task": True, "reset_target": True}]:
        env = HideGoal(gym.make("PointMaze_Open-v3", **kwargs), goal_cell=(1, 3), reset_cell=(1, 1))
        for episode in range(3):
            observation, _ = env.reset(seed=episode)
            terminated = truncated = False
            while not (terminated or truncated):
                assert env.unwrapped.goal.tolist() == center(env, (1, 3), 1)
                action = np.clip(5 * (env.unwrapped.goal - observation[:2]) - observation[2:], -1, 1)
                observation, reward, terminated, truncated, info = env.step(action)
            assert (reward, info["is_success"], truncated) == (1.0, True, False)


class Bare(gym.Env):
    """The environment without its ``unwrapped``, whose ``compute_reward`` makes SB3 expect a dict of goals."""

    def __init__(self, env):
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.reset, self.step = env.reset, env.step


@pytest.mark.filterwarnings("ignore:.*infinity")
@pytest.mark.parametrize("env_id", ["PointMaze_UMaze-v3", "AntMaze_UMaze-v5"])
def test_checkers_of_gymnasium_and_sb3_are_content(env_id):
    env = HideGoal(gym.make(env_id))
    check_gymnasium_env(env, skip_render_check=True)
    check_sb3_env(Bare(env))
    twin = gym.make(env.spec)
    assert np.array_equal(env.reset(seed=0)[0], twin.reset(seed=0)[0])


def test_in_a_vec_env_of_sb3():
    env = make_vec_env(
        "PointMaze_OpenDense-v3", 2, seed=0, wrapper_class=HideGoal, wrapper_kwargs={"goal_cell": (3, 1), "reset_cell": (1, 1)}
    )
    observations = env.reset()
    assert observations.shape == (2, 4)
    assert [features.tolist() for features in env.get_attr("mode_features")] == [[0, 1]] * 2
    episodes = []
    for _ in range(700):
        observations, _, _, infos = env.step(np.clip(5 * ([-2, -1] - observations[:, :2]) - observations[:, 2:], -1, 1))
        episodes += [info for info in infos if "episode" in info]
    # Monitor, which is inside, sees the ends and rewards of the wrapped task
    assert len(episodes) > 4
    assert all(info["is_success"] and info["episode"]["r"] == 1.0 and info["episode"]["l"] < 300 for info in episodes)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"goal_cell": (0, 0)}, r"goal_cell: \(0, 0\) given; accepted are the open cells"),
        ({"goal_cell": (1, 9)}, r"goal_cell: \(1, 9\)"),
        ({"reset_cell": (2, 1)}, r"reset_cell: \(2, 1\)"),
        ({"goal_cell": (1, 1), "reset_cell": (1, 1)}, "goal_cell: .* no way"),
        ({"goal_cell": (1, 3)}, "goal_cell: .* no way"),
    ],
)
def test_bad_cells(kwargs, message):
    apart = [[1, 1, 1, 1, 1], [1, 0, 1, 0, 1], [1, 1, 1, 1, 1]]
    maze = {"maze_map": apart} if kwargs == {"goal_cell": (1, 3)} else {}
    with pytest.raises(ValueError, match=message):
        HideGoal(gym.make("PointMaze_UMaze-v3", **maze), **kwargs)


def test_other_environments_are_refused():
    with pytest.raises(ValueError, match=r"env: .*PointMaze and AntMaze"):
        HideGoal(gym.make("PointMazeV1-v0"))
    with pytest.raises(ValueError, match="reset_cell"):
        HideGoal(gym.make("PointMaze_UMaze-v3")).reset(options={"reset_cell": (0, 0)})
