"""Point mazes: dynamics, labels, one environment against many."""

import copy
import math
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from maze_routes import ROUTES
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from stable_baselines3.common.env_util import make_vec_env as make_sb3_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecVideoRecorder

from sb3_ddiffpg.envs import PointMazeEnv, PointMazeVecEnv, make_vec_env
from sb3_ddiffpg.envs.mazes.drawing import BODY, FLOOR, GOAL, START, WALL
from sb3_ddiffpg.envs.mazes.maze import MAZES

IDS = [f"PointMaze{name}-v0" for name in MAZES]
PILLAR = [[1, 1, 1, 1, 1], [1, 0, "r", 0, 1], [1, 0, 1, 0, 1], [1, 0, "g", 0, 1], [1, 1, 1, 1, 1]]


class Driver:
    """Steers towards one corner of a route after the other, with jitter; ``policy(observations)`` as in SB3."""

    def __init__(self, routes, jitter, seed=0):
        self.routes, self.jitter = routes, jitter
        self.rng = np.random.default_rng(seed)
        self.at = np.zeros(len(routes), dtype=int)

    def __call__(self, observations):
        actions = self.rng.normal(0, self.jitter, (len(self.routes), 2))
        for i, route in enumerate(self.routes):
            offset = route[self.at[i]] - observations[i, :2]
            if np.abs(offset).max() < 1.2 and self.at[i] < len(route) - 1:
                self.at[i] += 1
            actions[i] += offset / max(np.abs(offset).max(), 1.0)
        return actions.astype(np.float32)

    def restart(self, i):
        self.at[i] = 0


@pytest.mark.parametrize("env_id", IDS)
def test_checkers_of_gymnasium_and_sb3_are_content(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(env_id, render_mode="rgb_array")
        check_gymnasium_env(env.unwrapped)
        check_sb3_env(env)
    assert env.spec.max_episode_steps == 150
    assert env.unwrapped.mode_features.tolist() == [0, 1]


@pytest.mark.parametrize(("name", "label"), ROUTES)
def test_driven_routes_get_their_labels(name, label):
    n = 50
    env = PointMazeVecEnv(n, name)
    env.seed(0)
    driver, observations, steps = Driver([ROUTES[name, label]] * n, jitter=0.5), env.reset(), 0
    modes, lengths = {}, {}
    while len(modes) < n:
        observations, rewards, dones, infos = env.step(driver(observations))
        steps += 1
        for i in np.flatnonzero(dones):
            modes.setdefault(i, infos[i]["mode"])
            lengths.setdefault(i, steps)
            assert infos[i]["goal_id"] == int(label[0])
            assert rewards[i] == (2.0 if (name, label) == ("V2", "0:-") else 1.0)
            driver.restart(i)
    print(
        f"{name} {label}: {sum(mode == label for mode in modes.values())} of {n}, {np.mean(list(lengths.values())):.1f} steps"
    )
    assert set(modes.values()) == {label}
    assert steps < 100


def reference_step(maze, state, action, max_speed=8.0):
    """One step of one body, written out for scalars."""
    x, y, vx, vy = state

    def hits(px, py):
        for i, row in enumerate(maze.rows):
            for j, cell in enumerate(row):
                cx, cy = 4 * (j - maze.start_cell[1]), 4 * (maze.start_cell[0] - i)
                if cell == "#" and abs(px - cx) < 2.4 and abs(py - cy) < 2.4:
                    return True
        return False

    vx = 0.6 * vx + 0.4 * max_speed * min(max(action[0], -1), 1)
    vy = 0.6 * vy + 0.4 * max_speed * min(max(action[1], -1), 1)
    x, vx = (x, 0.0) if hits(x + 0.1 * vx, y) else (x + 0.1 * vx, vx)
    y, vy = (y, 0.0) if hits(x, y + 0.1 * vy) else (y + 0.1 * vy, vy)
    return x, y, vx, vy


@pytest.mark.parametrize(("name", "max_speed"), [("V1", 8.0), ("V3", 20.0), ("V4", 3.0)])
def test_dynamics_like_a_scalar_reference(name, max_speed):
    env = PointMazeEnv(name, max_speed=max_speed)
    env.reset(options={"position": (0.3, -0.2)})
    state, bumps = (0.3, -0.2, 0.0, 0.0), 0
    rng, action = np.random.default_rng(1), np.zeros(2)
    for k in range(600):
        # Held for a while, and sometimes out of bounds, so that walls are met
        action = rng.uniform(-1.3, 1.3, 2) if k % 8 == 0 else action
        observation, reward, terminated, truncated, info = env.step(action)
        state = reference_step(env.maze, state, action, max_speed)
        np.testing.assert_allclose(observation, np.float32(state), rtol=1e-5, atol=1e-5)
        bumps += 0.0 in state[2:]
        distances = [math.dist(state[:2], goal) for goal in env.maze.goals]
        assert terminated == info["is_success"] == (reward > 0) == (min(distances) <= 1)
        assert not truncated
        assert observation in env.observation_space
    assert bumps > 50


@pytest.mark.parametrize("env_id", [*IDS, "own"])
def test_many_like_single_ones_bit_for_bit(env_id):
    """Against SB3's DummyVecEnv over gym.make: every array and info, over several episodes, ended by goal and by time."""
    n = 6
    kwargs = {"max_episode_steps": 60}
    if env_id == "own":
        env_id, kwargs = "PointMazeV1-v0", kwargs | {"maze_map": PILLAR, "goal_radius": 0.7, "start_noise": (0.2, 1.0)}
    ours, theirs = make_vec_env(env_id, n, seed=5, **kwargs), make_sb3_vec_env(env_id, n, seed=5, env_kwargs=kwargs)
    assert isinstance(ours.venv, PointMazeVecEnv)
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    assert np.array_equal(ours.action_space.sample(), theirs.action_space.sample())
    observations = ours.reset()
    assert np.array_equal(observations, theirs.reset())
    name = env_id[9:11]
    routes = [[(-4, 0), (-4, -8), (0, -8)]] if "maze_map" in kwargs else [r for (maze, _), r in ROUTES.items() if maze == name]
    driver, ends = Driver([routes[i % len(routes)] for i in range(n)], jitter=0.8), set()
    for _ in range(250):
        actions = driver(observations)
        actions[-1] = driver.rng.uniform(-1, 1, 2)
        observations, rewards, dones, infos = ours.step(actions)
        for ours_part, theirs_part in zip((observations, rewards, dones), theirs.step(actions)[:3], strict=True):
            assert ours_part.dtype == theirs_part.dtype
            assert np.array_equal(ours_part, theirs_part)
        for i, (info, other) in enumerate(zip(infos, theirs.buf_infos, strict=True)):
            assert np.array_equal(info.pop("terminal_observation", 0), other.pop("terminal_observation", 0))
            episode, other_episode = info.pop("episode", {}), other.pop("episode", {})
            assert [episode.get(key) for key in "rl"] == [other_episode.get(key) for key in "rl"]
            assert info == other
            if dones[i]:
                driver.restart(i)
                ends.add((info["is_success"], info["TimeLimit.truncated"]))
    assert ends == {(True, False), (False, True)}


def test_what_a_body_does_depends_on_no_other():
    many = PointMazeVecEnv(7, "V3")
    many.seed(0)
    many.reset()
    lone = PointMazeVecEnv(1, "V3")
    lone.seed(4)
    lone.reset()
    rng = np.random.default_rng(0)
    for _ in range(400):
        actions = rng.uniform(-1, 1, (7, 2)).astype(np.float32)
        assert np.array_equal(many.step(actions)[0][4:5], lone.step(actions[4:5])[0])


def test_start_noise():
    env = PointMazeVecEnv(500, "V1")
    env.seed(0)
    x, y, vx, vy = env.reset().T
    assert 0.95 < np.abs(x).max() <= 1
    assert 1.95 < np.abs(y).max() <= 2
    assert not vx.any() and not vy.any()
    assert np.abs(PointMazeVecEnv(500, "V3").reset()[:, :2]).max() <= 0.5
    fixed = gym.make("PointMazeV4-v0", start_noise=0.0)
    assert all(np.array_equal(fixed.reset()[0], np.zeros(4)) for _ in range(3))


def test_options_and_seeds_are_used_once():
    env = PointMazeVecEnv(3, "V1")
    env.seed(7)
    first = env.reset()
    assert not np.array_equal(env.reset(), first)
    env.seed(7)
    assert np.array_equal(env.reset(), first)
    env.set_options({"position": (-4, 4)})
    assert env.reset().tolist() == [[-4, 4, 0, 0]] * 3
    assert np.abs(env.reset()[:, 0]).max() <= 1
    env.set_options([{"position": (0, 4)}, {}, {"position": (0, -4)}])
    assert env.reset()[[0, 2], 1].tolist() == [4, -4]


def test_truncation_and_terminal_observation():
    env = make_vec_env("PointMazeV1-v0", 2, seed=0, max_episode_steps=4, start_noise=0)
    env.reset()
    east = np.array([[1.0, 0.0]] * 2)
    for _ in range(3):
        _, _, dones, infos = env.step(east)
        assert not dones.any()
        assert infos[0] == {"is_success": False, "goal_id": None, "mode": None, "TimeLimit.truncated": False}
    observations, rewards, dones, infos = env.step(east)
    assert dones.all() and not rewards.any() and not observations.any()
    for info in infos:
        assert info["TimeLimit.truncated"] and not info["is_success"]
        assert info["mode"] is None and info["goal_id"] is None
        # Speeds 3.2, 5.12, 6.272 m/s, then the wall
        np.testing.assert_allclose(info["terminal_observation"], [1.4592, 0, 0, 0], rtol=1e-6)
        assert info["episode"]["l"] == 4


def test_goal_rewards_and_own_map():
    env = gym.make("PointMazeV2-v0", maze_map=PILLAR, goal_rewards=[5.0], max_speed=10.0, max_episode_steps=30)
    driver = Driver([[(4, 0), (4, -8), (0, -8)]], jitter=0.0)
    observation, _ = env.reset(seed=0)
    terminated = False
    while not terminated:
        observation, reward, terminated, truncated, info = env.step(driver(observation[None])[0])
        assert not truncated
    assert (reward, info["mode"], info["goal_id"]) == (5.0, "0:-", 0)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"start_noise": -1}, "start_noise: -1"),
        ({"start_noise": (1, 2, 3)}, "start_noise"),
        ({"start_noise": (2.0, 1.0)}, "start_noise: .* can overlap a wall"),
        ({"goal_rewards": (1, 1)}, "goal_rewards: .* there are 1"),
        ({"goal_radius": 0}, "goal_radius: 0"),
        ({"goal_radius": 2.1}, "goal_radius"),
        ({"max_speed": 21}, "max_speed: 21 given; accepted are numbers above 0, at most 20"),
        ({"render_mode": "human"}, "render_mode"),
        ({"maze_map": "V7"}, "maze_map"),
    ],
)
@pytest.mark.parametrize("make", [PointMazeEnv, lambda **kwargs: PointMazeVecEnv(2, **kwargs)])
def test_bad_arguments(make, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_bad_calls():
    env = PointMazeVecEnv(2)
    env.reset()
    with pytest.raises(ValueError, match=r"actions: shape \(2,\)"):
        env.step(np.zeros(2))
    with pytest.raises(ValueError, match="finite"):
        env.step(np.full((2, 2), np.nan))
    for options, message in [({"goal": 1}, "'goal'"), ({"position": (-4, 0)}, "clear of walls"), ({"position": 3}, "pair")]:
        with pytest.raises(ValueError, match=f"options: .*{message}"):
            PointMazeEnv().reset(options=options)
    with pytest.raises(ValueError, match="n_envs: 0"):
        PointMazeVecEnv(0)
    with pytest.raises(ValueError, match="max_episode_steps: 0"):
        PointMazeVecEnv(1, max_episode_steps=0)
    with pytest.raises(ValueError, match="indices"):
        env.set_attr("tag", 1, indices=[0])
    with pytest.raises(AttributeError, match="'jump'"):
        env.env_method("jump")


def test_vec_env_interface():
    env = make_vec_env("PointMazeV3-v0", 3, seed=0)
    assert isinstance(env, VecMonitor)
    env.reset()
    assert [features.tolist() for features in env.get_attr("mode_features")] == [[0, 1]] * 3
    assert env.get_attr("maze", 1)[0].name == "V3"
    assert len({id(rng) for rng in env.get_attr("np_random")}) == 3
    assert env.get_attr("spec")[0].id == "PointMazeV3-v0"
    assert env.env_is_wrapped(Monitor) == [False] * 3
    assert not env.has_attr("does_not_exist")
    env.set_attr("tag", "x")
    assert env.get_attr("tag", [0, 2]) == ["x", "x"]
    with pytest.warns(UserWarning, match="rgb_array"):
        assert PointMazeVecEnv(2).get_images() == [None, None]


def test_evaluate_policy_runs_on_it():
    class Still:
        def predict(self, observation, **_):
            return np.zeros((len(observation), 2), dtype=np.float32), None

    env = make_vec_env("PointMazeV1-v0", 4, max_episode_steps=9)
    assert evaluate_policy(Still(), env, n_eval_episodes=8, return_episode_rewards=True) == ([0.0] * 8, [9] * 8)


def test_other_ids_go_to_sb3():
    env = make_vec_env("Pendulum-v1", 2, seed=0, g=9.0)
    assert env.env_is_wrapped(Monitor) == [True, True]
    assert env.get_attr("unwrapped")[0].g == 9.0
    with pytest.raises(gym.error.Error):
        make_vec_env("NoSuchEnv-v0", 2)


def test_id_with_its_module():
    assert make_vec_env("sb3_ddiffpg.envs:PointMazeV2-v0", 2).get_attr("maze")[1].name == "V2"
    assert make_vec_env("gymnasium.envs.classic_control:Pendulum-v1", 2).num_envs == 2


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("make", [lambda: PointMazeVecEnv(5, "V4", max_episode_steps=20), lambda: PointMazeEnv("V4")])
def test_copies_go_on_like_the_original(make, clone):
    env, rng = make(), np.random.default_rng(0)
    env.reset()

    def follow(env, actions):
        return np.array([env.step(action)[0] for action in actions])

    shape = (30, *env.action_space.shape) if isinstance(env, gym.Env) else (30, 5, 2)
    first, second = rng.uniform(-1, 1, (2, *shape))
    follow(env, first)
    twin = clone(env)
    assert np.array_equal(follow(env, second), follow(twin, second))


def test_pictures_show_walls_start_goals_and_body():
    env = gym.make("PointMazeV1-v0", render_mode="rgb_array")
    env.reset(seed=0, options={"position": (-4, 4)})
    image = env.render()
    assert image.shape == (200, 200, 3) and image.dtype == np.uint8
    at = {
        (x, y): tuple(image[round(100 - 10 * y), round(140 + 10 * x)]) for x, y in [(-4, 0), (0, 0), (-8, 0), (-4, 4), (-8, 4)]
    }
    assert at == {(-4, 0): WALL, (0, 0): START, (-8, 0): GOAL, (-4, 4): BODY, (-8, 4): FLOOR}
    assert gym.make("PointMazeV1-v0").unwrapped.render() is None


def test_pictures_of_many(tmp_path):
    env = make_vec_env("PointMazeV1-v0", 4, seed=0)
    env.reset()
    assert env.render("rgb_array").shape == (400, 400, 3)
    assert [image.shape for image in env.env_method("render", indices=[1])] == [(200, 200, 3)]
    assert VecVideoRecorder(env, str(tmp_path), lambda _: False).render_mode == "rgb_array"
