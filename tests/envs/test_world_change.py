"""Changes of a maze's world, against physics by hand and what MuJoCo says of itself."""

import copy
import json
import pickle

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env as make_sb3_vec_env

from sb3_ddiffpg.envs import WorldChange, make_vec_env
from sb3_ddiffpg.envs.description import RememberedEnv, describe_env
from sb3_ddiffpg.envs.mazes.ant import AntMazeEnv
from sb3_ddiffpg.envs.mazes.point import PointMazeEnv, PointMazeVecEnv
from sb3_ddiffpg.envs.snapshots import restore_vec_env, vec_env_snapshot

OPEN = ["#" * 9, *["#" + "." * 7 + "#"] * 3, "#...r..g#", *["#" + "." * 7 + "#"] * 3, "#" * 9]
ANT = {"motor_strength": {3: 0.5, 6: 0.0}, "friction": 0.3, "gravity": 1.2, "n_blocked": 1}
POINT = {"motor_strength": {1: 0.5}, "friction": 0.3, "n_blocked": 2}


def trajectory(env, seed=0, n_steps=40):
    """Observations of random actions, the start's first."""
    found, rng = [env.reset(seed=seed)[0]], np.random.default_rng(seed)
    for _ in range(n_steps):
        found.append(env.step(rng.uniform(-1, 1, env.action_space.shape))[0])
    return np.array(found)


# ---------------------------------------------------------------------- without a change


@pytest.mark.parametrize("env_id", ["PointMazeV3-v0", "AntMazeV1-v0", "PointMazeRandom-v0", "AntMazeRandom-v0"])
def test_no_change_changes_nothing(env_id):
    expected = trajectory(gym.make(env_id))
    whole = {"motor_strength": {0: 1.0, 1: 1.0}, "friction": 1.0, "gravity": 1.0, "joint_range": 1.0}
    for changes in (None, {}, whole if "Ant" in env_id else {"motor_strength": 1.0}, WorldChange()):
        np.testing.assert_array_equal(trajectory(gym.make(env_id, changes=changes)), expected)


# ---------------------------------------------------------------------- a goal that does not end an episode


def test_an_episode_may_go_on_after_a_goal():
    """A single environment and many: at each step in the goal there is its reward and its label. The time limit ends it."""
    maze, kwargs = ["#####", "#rg.#", "#####"], {"start_noise": 0.0, "changes": {"ends_at_goal": False}}
    one = gym.wrappers.TimeLimit(PointMazeEnv(maze, **kwargs), 30)
    many = PointMazeVecEnv(2, maze_map=maze, max_episode_steps=30, **kwargs)
    ended = PointMazeEnv(maze, start_noise=0.0)
    position, inside = one.reset()[0][:1], []
    many.reset()
    ended.reset()
    for step in range(30):
        observation, reward, terminated, truncated, info = one.step(np.array([1.0, 0.0]))
        _, rewards, dones, infos = many.step(np.tile([1.0, 0.0], (2, 1)))
        position = observation[0]
        at_goal = abs(position - one.unwrapped.maze.goals[0][0]) <= 1.0
        inside.append(at_goal)
        assert reward == rewards[0] == rewards[1] == float(at_goal) and info["is_success"] == infos[0]["is_success"] == at_goal
        assert info["mode"] == infos[1]["mode"] and (info["mode"] is not None) == at_goal
        assert not terminated and truncated == (step == 29) and dones.tolist() == [step == 29] * 2
        if at_goal and sum(inside) == 1:
            assert ended.step(np.array([1.0, 0.0]))[2]  # where it usually ends
        elif not sum(inside):
            assert not ended.step(np.array([1.0, 0.0]))[2]
    assert 0 < sum(inside) < 30 and not inside[-1]  # through it, to the wall beyond


# ---------------------------------------------------------------------- the ant


@pytest.mark.parametrize("strength", [0.0, 0.25, 0.5])
def test_a_weak_motor_is_one_that_is_told_less(strength):
    """Powers of two, so that it is bit for bit the same."""
    weak, told_less = AntMazeEnv(OPEN, changes={"motor_strength": {3: strength}}), AntMazeEnv(OPEN)
    rng, factor = np.random.default_rng(0), np.where(np.arange(8) == 3, strength, 1.0)
    np.testing.assert_array_equal(weak.reset(seed=0)[0], told_less.reset(seed=0)[0])
    for _ in range(40):
        action = rng.uniform(-1, 1, 8)
        np.testing.assert_array_equal(weak.step(action)[0], told_less.step(factor * action)[0])


def test_all_motors_may_be_dead():
    dead, idle = AntMazeEnv(OPEN, changes={"motor_strength": 0}), AntMazeEnv(OPEN)
    dead.reset(seed=0), idle.reset(seed=0)
    for _ in range(10):
        np.testing.assert_array_equal(dead.step(np.ones(8))[0], idle.step(np.zeros(8))[0])


@pytest.mark.parametrize("gravity", [0.5, 1.0, 1.2])
def test_an_ant_falls_as_gravity_says(gravity):
    """Beside a weightless one, whose legs draw in just the same, which moves the torso."""
    heights = []
    for factor in (0.0, gravity):
        env = AntMazeEnv(OPEN, changes={"gravity": factor})
        env.reset(seed=0)
        env.simulation._state[0, 3] = 30.0
        for _ in range(10):
            observation = env.step(np.zeros(8))[0]
        heights.append(observation[2])
    assert heights[0] - heights[1] == pytest.approx(0.5 * gravity * 9.81 * 1.0**2, abs=1e-5)


def mujoco_data(env):
    """Of the ant where it is."""
    model = env.simulation._models[0]
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, env.simulation._state[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("friction", [0.0, 0.3, 2.0])
def test_contacts_have_the_friction(friction):
    """As MuJoCo says where the feet stand, and by how far an ant slides that is pushed along the floor."""
    far = []
    for factor in (1.0, friction):
        env = AntMazeEnv("V3", n_blocked=1, changes={"friction": factor})
        env.reset(seed=0)
        for _ in range(60):
            env.step(np.zeros(8))  # it comes down on its feet
        slides = [contact.friction[0] for contact in mujoco_data(env).contact]
        assert slides and slides == pytest.approx([max(factor, 1e-5)] * len(slides))
        before = env.simulation.positions()[0].copy()
        env.simulation._state[0, 16] = 2.0
        for _ in range(10):
            env.step(np.zeros(8))
        far.append(np.linalg.norm(env.simulation.positions()[0] - before))
    assert (far[1] > far[0]) == (friction < 1)


# ---------------------------------------------------------------------- the point mass


@settings(max_examples=30, deadline=None)
@given(st.tuples(st.floats(0, 1), st.floats(0, 1)), st.floats(0, 2.5), st.floats(1, 10), st.integers(0, 2**20))
def test_a_point_mass_moves_as_written(strengths, friction, max_speed, seed):
    changes = {"motor_strength": dict(enumerate(strengths)), "friction": friction}
    env = PointMazeEnv(OPEN, start_noise=0.0, max_speed=max_speed, changes=changes)
    observation, _ = env.reset(seed=seed)
    rng, velocity, position = np.random.default_rng(seed), np.zeros(2), np.zeros(2)
    for _ in range(20):
        action = rng.uniform(-1, 1, 2)
        velocity = velocity - 0.4 * friction * velocity + 0.4 * max_speed * np.array(strengths) * action
        velocity = np.clip(velocity, -max_speed, max_speed)
        position = position + 0.1 * velocity
        if np.abs(position).max() > 13:  # walls are at 14, and the body is 0.4 wide
            break
        observation, _, terminated, _, _ = env.step(action)
        np.testing.assert_allclose(observation, [*position, *velocity], atol=1e-4)
        assert env.observation_space.contains(observation)
        if terminated:
            break


# ---------------------------------------------------------------------- passages


@pytest.mark.parametrize(("name", "most"), [("V1", 1), ("V2", 1), ("V3", 6), ("V4", 3)])
def test_as_many_passages_are_walled_as_leave_a_goal(name, most):
    for n_blocked in range(1, most + 1):
        env = PointMazeVecEnv(60, name, changes={"n_blocked": n_blocked})
        env.seed(0)
        env.reset()
        drawn = {info["blocked"] for info in env.reset_infos}
        assert len(drawn) > 1
        for blocked in drawn:
            assert len(blocked) == n_blocked and set(blocked) <= set(env.maze.gap_cells)
            assert reachable_goals(env.maze, blocked) >= 1
    with pytest.raises(ValueError, match=f"n_blocked: {most + 1} given, but wherever they are, no goal can be reached"):
        PointMazeVecEnv(1, name, changes={"n_blocked": most + 1})


def reachable_goals(maze, blocked):
    """Flood fill, written out."""
    rows = [list(row) for row in maze.rows]
    for i, j in blocked:
        rows[i][j] = "#"
    seen, stack = {maze.start_cell}, [maze.start_cell]
    while stack:
        i, j = stack.pop()
        for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if cell not in seen and rows[cell[0]][cell[1]] != "#":
                seen.add(cell)
                stack.append(cell)
    return len(seen & set(maze.goal_cells))


def test_one_goal_is_enough_only_where_it_is_asked_for():
    """Two passages of V3 lead to its second goal. The maze's own obstacles leave both goals, these need not."""
    own, changed = (PointMazeVecEnv(400, "V3", **given) for given in ({"n_blocked": 5}, {"changes": {"n_blocked": 5}}))
    fewest = []
    for env in (own, changed):
        env.seed(0)
        env.reset()
        fewest.append(min(reachable_goals(env.maze, info["blocked"]) for info in env.reset_infos))
    assert fewest == [2, 1]
    none = gym.make("PointMazeRandom-v0", changes={"n_blocked": 0})
    assert none.reset()[1] == {}  # instead of the two that are registered


# ---------------------------------------------------------------------- every way to make and keep them


@pytest.mark.parametrize(("env_id", "changes"), [("PointMazeV3-v0", POINT), ("AntMazeV4-v0", ANT)])
def test_many_like_single_ones_bit_for_bit(env_id, changes):
    kwargs = {"max_episode_steps": 15, "changes": changes}
    n = 3
    ours, theirs = make_vec_env(env_id, n, seed=2, **kwargs), make_sb3_vec_env(env_id, n, seed=2, env_kwargs=kwargs)
    plain = make_vec_env(env_id, n, seed=2, max_episode_steps=15)
    rng, differs = np.random.default_rng(0), False
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    plain.reset()
    for _ in range(35):
        actions = rng.uniform(-1, 1, (n, *ours.action_space.shape)).astype(np.float32)
        assert ours.venv.reset_infos == theirs.reset_infos
        observations, rewards, dones, _ = ours.step(actions)
        for part, other in zip((observations, rewards, dones), theirs.step(actions)[:3], strict=True):
            np.testing.assert_array_equal(part, other)
        differs |= not np.array_equal(observations, plain.step(actions)[0])
    assert differs
    for env in (ours, theirs, plain):
        env.close()


@pytest.mark.parametrize(("env_id", "changes"), [("PointMazeV3-v0", POINT), ("AntMazeV4-v0", ANT)])
@pytest.mark.parametrize("how", ["snapshot", "pickle", "copy"])
def test_changes_are_kept(env_id, changes, how):
    def make():
        return make_vec_env(env_id, 2, seed=1, max_episode_steps=20, changes=changes)

    env, rng = make().venv, np.random.default_rng(0)
    first, second = rng.uniform(-1, 1, (2, 30, 2, *env.action_space.shape))
    env.reset()
    for actions in first:
        env.step(actions)
    if how == "snapshot":
        twin = make().venv
        twin.reset()
        restore_vec_env(twin, vec_env_snapshot(env))
    else:
        twin = pickle.loads(pickle.dumps(env)) if how == "pickle" else copy.deepcopy(env)
    for actions in second:
        for ours, theirs in zip(env.step(actions)[:3], twin.step(actions)[:3], strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("given", [ANT, WorldChange(**ANT)])
def test_a_model_remembers_the_change(given):
    """Through JSON, which makes words of the numbers of motors."""
    for env in (
        make_vec_env("AntMazeV4-v0", 2, changes=given),
        make_sb3_vec_env("AntMazeV4-v0", 2, env_kwargs={"changes": given}),
    ):
        remembered = RememberedEnv.of(describe_env(env)).kwargs["changes"]
        assert WorldChange.of(remembered) == WorldChange(**ANT)
        env.close()


@pytest.mark.parametrize("load", [yaml.safe_load, json.loads])
def test_changes_come_from_files(load):
    text = '{"motor_strength": {"3": 0.5}, "joint_range": 0.5, "obstacle": [0, 0, 1, 0.1, 0.1, 0.1], "closed": ["left"]}'
    change = WorldChange.of(load(text))
    assert change.motor_strength == {3: 0.5} and change.obstacle == (0.0, 0.0, 1.0, 0.1, 0.1, 0.1)
    assert WorldChange.of(load(json.dumps(change.to_dict()))) == change
    assert change.closed == ("left",) and change.shares("motor_strength", 4) == (1.0, 1.0, 1.0, 0.5)


# ---------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gravitiy": 1.0}, r"changes\['gravitiy'\] is no setting: did you mean 'gravity'"),
        ({"gravity": -1.0}, r"changes.gravity must lie in \[0, 10\], got -1.0"),
        ({"friction": np.nan}, r"changes.friction must lie in \[0, 10\], got nan"),
        ({"motor_strength": {"left": 0.5}}, "changes.motor_strength must be a share in .* got {'left': 0.5}"),
        ({"motor_strength": {0: 1.5}}, "changes.motor_strength must be a share"),
        ({"motor_strength": {-1: 0.5}}, "changes.motor_strength must be a share"),
        ({"motor_strength": {8: 0.5}}, r"changes.motor_strength: \[8\] given; accepted are the numbers 0 to 7"),
        ({"n_blocked": 1.5}, "changes.n_blocked must be an integer of at least 0, or be None, got 1.5"),
        (
            {"joint_range": 0.5},
            r"changes.joint_range: 0.5 given, but an ant in a maze has none; accepted are \['ends_at_goal', 'friction'",
        ),
        ({"obstacle": (0, 0, 0, 1, 1, 0)}, "changes.obstacle must be x, y and z of a box's centre"),
        ({"closed": "left"}, "changes.closed must be a list of names, got 'left'"),
        (0.5, "changes must be WorldChange or a dict of some of them, got 0.5"),
    ],
)
def test_bad_changes(changes, message):
    with pytest.raises(ValueError, match=message):
        AntMazeEnv("V1", changes=changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gravity": 0.5}, "changes.gravity: 0.5 given, but a point mass in a maze has none; accepted are"),
        ({"friction": 2.6}, "changes.friction: 2.6 given; accepted of a point mass are 0 to 2.5"),
        ({"motor_strength": {2: 0.5}}, r"changes.motor_strength: \[2\] given; accepted are the numbers 0 to 1"),
    ],
)
def test_what_a_point_mass_has_not(changes, message):
    with pytest.raises(ValueError, match=message):
        PointMazeVecEnv(2, "V1", changes=changes)
