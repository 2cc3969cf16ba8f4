"""Ant mazes: the body, its walls, one environment against many."""

import copy
import pickle
import warnings
from importlib.resources import files
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from maze_routes import ROUTES, polyline
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from stable_baselines3.common.env_util import make_vec_env as make_sb3_vec_env
from stable_baselines3.common.monitor import Monitor

from sb3_ddiffpg.envs import MAZES, Maze, make_vec_env
from sb3_ddiffpg.envs.mazes.ant import AntMazeEnv, AntMazeVecEnv
from sb3_ddiffpg.envs.mazes.ant_model import ant_model, wall_boxes

IDS = ["AntMazeV1-v0", "AntMazeV4-v0", "AntMazeRandom-v0"]


@pytest.mark.parametrize("env_id", IDS)
def test_checkers_of_gymnasium_and_sb3_are_content(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # As for gymnasium's own ant: nothing bounds its speed
        warnings.filterwarnings("ignore", message=".*A Box observation space (min|max)imum value is -?infinity")
        env = gym.make(env_id, render_mode="rgb_array")
        check_gymnasium_env(env.unwrapped, skip_render_check=True)
        check_sb3_env(env)
    assert env.spec.max_episode_steps == (500 if "V1" in env_id else 700)
    assert env.unwrapped.mode_features.tolist() == [0, 1] and env.observation_space.shape == (29,)


def plain_model(integrator="RK4"):
    """D4RL's ant, written from its description, without walls."""
    text = (files("gymnasium.envs.mujoco") / "assets" / "ant.xml").read_text()
    for old, new in (
        ('integrator="RK4" timestep="0.01"', f'integrator="{integrator}" timestep="0.02"'),
        ('gear="150"', 'gear="30"'),
        ('<geom conaffinity="0"', '<geom solimp="0.8 0.8 0.01" conaffinity="0"'),
    ):
        assert old in text
        text = text.replace(old, new)
    return mujoco.MjModel.from_xml_string(text)


@pytest.mark.parametrize("integrator", ["rk4", "euler"])
def test_the_body_is_d4rls_bit_for_bit(integrator):
    """Against MuJoCo's own step, one substep after the other, in the open and with walls far away."""
    model = plain_model({"rk4": "RK4", "euler": "Euler"}[integrator])
    data = mujoco.MjData(model)
    open_map = ["#" * 9, *["#" + "." * 7 + "#"] * 3, "#...r..g#", *["#" + "." * 7 + "#"] * 3, "#" * 9]
    env = AntMazeEnv(open_map, integrator=integrator)
    observation, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(60):
        np.testing.assert_array_equal(observation, np.float32([*data.qpos, *data.qvel]))
        action = rng.uniform(-1, 1, 8).astype(np.float32)
        observation = env.step(action)[0]
        data.ctrl[:] = action
        data.qacc_warmstart[:] = 0.0
        for _ in range(5):
            mujoco.mj_step(model, data)
    assert np.abs(data.qpos[:2]).max() > 0.05 and data.time == pytest.approx(6.0)


@pytest.mark.parametrize("env_id", ["AntMazeV1-v0", "AntMazeRandom-v0"])
@pytest.mark.parametrize("n_threads", [0, 2])
def test_many_like_single_ones_bit_for_bit(env_id, n_threads):
    n, kwargs = 4, {"max_episode_steps": 12, "integrator": "euler"}
    ours = make_vec_env(env_id, n, seed=5, n_threads=n_threads, **kwargs)
    theirs = make_sb3_vec_env(env_id, n, seed=5, env_kwargs=kwargs)
    assert isinstance(ours.venv, AntMazeVecEnv) and ours.venv.simulation.n_threads == n_threads
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    assert np.array_equal(ours.reset(), theirs.reset()) and ours.venv.reset_infos == theirs.reset_infos
    rng, n_done = np.random.default_rng(1), 0
    for _ in range(40):
        actions = rng.uniform(-1, 1, (n, 8)).astype(np.float32)
        observations, rewards, dones, infos = ours.step(actions)
        for ours_part, theirs_part in zip((observations, rewards, dones), theirs.step(actions)[:3], strict=True):
            assert ours_part.dtype == theirs_part.dtype and np.array_equal(ours_part, theirs_part)
        for info, other in zip(infos, theirs.buf_infos, strict=True):
            assert np.array_equal(info.pop("terminal_observation", 0), other.pop("terminal_observation", 0))
            episode, other_episode = info.pop("episode", {}), other.pop("episode", {})
            assert [episode.get(key) for key in "rl"] == [other_episode.get(key) for key in "rl"]
            assert info == other
        n_done += dones.sum()
    assert n_done == 3 * n and ours.venv.reset_infos == theirs.reset_infos


@pytest.mark.parametrize("name", MAZES)
def test_boxes_are_the_walls(name):
    walls = Maze(name).walls
    boxes = wall_boxes(walls)
    covered = np.zeros(walls.shape, dtype=int)
    for (top, left), (bottom, right) in boxes:
        covered[top : bottom + 1, left : right + 1] += 1
    np.testing.assert_array_equal(covered, walls)  # each cell once, and no open one
    assert len(boxes) <= 11 < walls.sum()


def test_walls_and_obstacles_are_where_the_map_says():
    """A ray from above hits a box 2 m high over each wall cell, and the floor elsewhere."""
    maze = Maze("V3")
    for blocked in ((), ((1, 2), (5, 2))):
        model = ant_model(maze.rows, 0.5, "rk4", blocked)
        data = mujoco.MjData(model)
        data.qpos[2] = 50.0  # out of the way
        mujoco.mj_forward(model, data)
        for cell in np.ndindex(maze.walls.shape):
            for offset in ((0, 0), (1.9, -1.9)):
                start = np.array([*(maze.cell_center(cell) + offset), 10.0])
                height = 10.0 - mujoco.mj_ray(model, data, start, np.array([0, 0, -1.0]), None, 1, -1, np.zeros(1, np.int32))
                expected = 2.0 if maze.walls[cell] or cell in blocked else 0.0
                assert height == pytest.approx(expected, abs=0.05)


def test_an_obstacle_stops_the_ant_and_only_in_its_episode():
    env = AntMazeEnv("V3", n_blocked=2, integrator="euler")
    west = (-4.0, 0.0)
    start, gap = (0.0, 4.0), (3, 2)
    assert gap in env.maze.gap_cells

    def reached(blocked):
        env.reset(seed=0, options={"position": start, "blocked": blocked})
        for _ in range(40):
            env.simulation._state[0, 16:18] = west
            env.step(np.zeros(8))
        return env.simulation.positions()[0]

    assert reached([])[0] < -9
    assert -6.2 < reached([gap])[0] < -4
    assert reached([(1, 2)])[0] < -9


def test_labels_follow_the_way():
    """The body is carried along the routes."""
    for (name, label), route in ROUTES.items():
        env = AntMazeEnv(name)
        env.reset(seed=0, options={"position": tuple(env.maze.start)})
        terminated = False
        for point in polyline([tuple(env.maze.start), *route], step=0.3):
            env.simulation._state[0] = env.simulation._begin
            env.simulation._state[0, 1:4] = *point, 0.75
            _, reward, terminated, _, info = env.step(np.zeros(8))
            if terminated:
                break
        assert terminated and info["is_success"] and info["mode"] == label and info["goal_id"] == int(label[0])
        assert reward == (2.0 if (name, label) == ("V2", "0:-") else 1.0)


def test_starts():
    env = AntMazeVecEnv(200, "V1", n_threads=0)
    env.seed(0)
    x, y, z, *rest = env.reset().T
    assert 0.95 < np.abs(x).max() <= 1 and 1.9 < np.abs(y).max() <= 2
    assert (z == 0.75).all() and (rest[0] == 1).all() and not np.any(rest[1:])
    for name in ("V2", "V3", "V4"):
        observation, info = AntMazeEnv(name).reset(seed=1)
        assert not observation[:2].any() and info == {}


def test_seeds_reproduce_and_nothing_ends_on_a_fall():
    env = AntMazeVecEnv(2, "V3", n_threads=0, integrator="euler", max_episode_steps=30)
    runs = []
    for _ in range(2):
        env.seed(3)
        env.reset()
        env.simulation._state[0, 4:8] = 0, 1, 0, 0  # on its back
        rng, dones = np.random.default_rng(0), []
        for _ in range(30):
            observations, _, done, _ = env.step(rng.uniform(-1, 1, (2, 8)))
            dones.append(done.any())
        assert dones == [False] * 29 + [True]
        runs.append(observations)
    np.testing.assert_array_equal(*runs)


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("n_blocked", [0, 2])
def test_copies_go_on_like_the_original(clone, n_blocked):
    env = AntMazeVecEnv(3, "V3", n_blocked=n_blocked, max_episode_steps=9, n_threads=2)
    env.seed(0)
    env.reset()
    first, second = np.random.default_rng(0).uniform(-1, 1, (2, 12, 3, 8))
    for actions in first:
        env.step(actions)
    twin = clone(env)
    for actions in second:
        for ours, theirs in zip(env.step(actions)[:3], twin.step(actions)[:3], strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_closing_ends_the_threads():
    before = len(list(Path("/proc/self/task").iterdir())) if Path("/proc/self/task").exists() else pytest.skip("no /proc")
    envs = [AntMazeVecEnv(2, "V1", n_threads=3) for _ in range(3)]
    for env in envs:
        env.reset()
        first = env.step(np.zeros((2, 8)))[0]
        env.close()
    assert len(list(Path("/proc/self/task").iterdir())) == before
    assert first.shape == envs[0].step(np.zeros((2, 8)))[0].shape  # made anew
    envs[0].close()


def test_interface_and_arguments():
    env = make_vec_env("AntMazeV2-v0", 2, seed=0, n_threads=1)
    assert env.get_attr("spec")[0].id == "AntMazeV2-v0" and env.get_attr("maze", 0)[0].name == "V2"
    assert env.env_is_wrapped(Monitor) == [False] * 2
    for arguments, message in (
        ({"integrator": "leapfrog"}, "integrator: 'leapfrog' given; accepted are 'rk4', 'euler'"),
        ({"n_threads": -1}, "n_threads: -1"),
        ({"start_noise": 5.5}, "start_noise: 5.5 given, but a body"),
        ({"goal_radius": 0}, "goal_radius: 0"),
        ({"n_blocked": 9}, "n_blocked: 9 given; accepted are 0 to 7"),
    ):
        with pytest.raises(ValueError, match=message):
            AntMazeEnv("V3", **arguments)
    with pytest.raises(ValueError, match=r"actions: shape \(8,\)"):
        env.step(np.zeros(8))


def test_a_fall_ends_the_episode_if_asked_for():
    """One ant upside down, one on its side, one upright; alone and many at once."""
    turns = {"back": (0.0, 1.0, 0.0, 0.0), "side": (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0), "feet": (1.0, 0.0, 0.0, 0.0)}
    for ends_on_fall in (False, True):
        kwargs = {"integrator": "euler", "ends_on_fall": ends_on_fall}
        many = AntMazeVecEnv(3, "V1", max_episode_steps=50, **kwargs)
        many.seed(0)
        many.reset()
        many.simulation._state[:, 4:8] = list(turns.values())
        _, rewards, dones, infos = many.step(np.zeros((3, 8), dtype=np.float32))
        assert dones.tolist() == [ends_on_fall, False, False] and not rewards.any()
        assert [info["is_success"] or info["TimeLimit.truncated"] for info in infos] == [False] * 3
        assert ("terminal_observation" in infos[0]) == ends_on_fall
        many.close()
        for name, turn in turns.items():
            env = AntMazeEnv("V1", **kwargs)
            env.reset(seed=0)
            env.simulation._state[0, 4:8] = turn
            _, _, terminated, truncated, info = env.step(np.zeros(8, dtype=np.float32))
            assert terminated == (ends_on_fall and name == "back") and not truncated and not info["is_success"]
            env.close()
