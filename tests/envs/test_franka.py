"""Franka tasks: every way of doing them can be done, and is told apart."""

import copy
import pickle
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("pybullet", reason="pybullet has no wheel for this Python")

from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from scipy.spatial.transform import Rotation
from stable_baselines3.common.env_checker import check_env as check_sb3_env

from sb3_ddiffpg.envs.franka.tasks import QUARTERS, FrankaCabinetOpen, FrankaDrawerClose, FrankaPegInHole, FrankaReach

IDS = ["FrankaReach-v0", "FrankaPegInHole-v0", "FrankaDrawerClose-v0", "FrankaCabinetOpen-v0"]
DOWNWARDS, FORWARDS = Rotation.from_euler("xyz", [np.pi, 0, 0]), Rotation.from_euler("xyz", [np.pi, -np.pi / 2, 0])


def towards(env, target, rotation=None):
    """The action that turns the joints to where inverse kinematics wants them for the fingertips to be at a target."""
    arm = env.arm
    solution = arm.client.calculateInverseKinematics(
        arm.body,
        11,
        list(target),
        *([] if rotation is None else [rotation.as_quat().tolist()]),
        maxNumIterations=300,
        residualThreshold=1e-5,
        lowerLimits=[*arm.low, 0.0, 0.0],
        upperLimits=[*arm.high, 0.04, 0.04],
        jointRanges=[*(arm.high - arm.low), 0.04, 0.04],
        restPoses=[*arm.angles(), 0.02, 0.02],
    )
    return np.clip((np.array(solution[:7]) - arm.angles()) / 0.05, -1, 1)


def follow(waypoints, rotation=None, near=0.05):
    """A controller that goes from one waypoint to the next."""
    at = 0

    def act(env):
        nonlocal at
        position, _ = env.arm.end_effector()
        if at < len(waypoints) - 1 and np.linalg.norm(position - waypoints[at]) < near:
            at += 1
        return towards(env, waypoints[at], rotation)

    return act


def reach(mode):
    side, level = (1 if word in ("left", "up") else -1 for word in mode.split("-"))
    y, z = side * 0.12, 0.67 + level * 0.17
    return follow([(-0.32, y, z), (-0.15, y, z), (-0.05, 0.0, 0.65)])


def insert(mode):
    x, y = FrankaPegInHole.HOLES[mode]

    def act(env):
        tip = env.tip()
        over_hole = np.hypot(tip[0] - x, tip[1] - y) < 0.006
        return towards(env, (x, y, env.PEG_TIP + (0.0 if over_hole else 0.05)), DOWNWARDS)

    return act


def push(mode):
    _, y, z = FrankaDrawerClose.DRAWERS[mode]
    share, higher = (0.7, 0.03) if mode.endswith("up") else (0.9, 0.0)
    return follow([(-0.82, share * y, z + higher), (-0.4, y, z + higher)], FORWARDS, near=0.06)


def pull(mode):
    z = 0.7 if mode == "up" else 0.38
    inwards = Rotation.from_euler("z", 30, degrees=True) * FORWARDS * Rotation.from_euler("z", 90, degrees=True)
    corners = [(-0.5, -0.2, z), (-0.3, -0.18, z), (-0.3, 0.05, z), (-0.4, 0.1, z), (-0.65, 0.1, z)]
    return follow(corners, inwards, near=0.08 if mode == "up" else 0.05)


SOLUTIONS = [
    *((FrankaReach, reach, mode) for mode in QUARTERS),
    *((FrankaPegInHole, insert, mode) for mode in ("left", "right")),
    *((FrankaDrawerClose, push, mode) for mode in QUARTERS),
    *((FrankaCabinetOpen, pull, mode) for mode in ("up", "down")),
]


def solve(env, controller, seed):
    """Way and number of steps; a little noise tells the seeds apart where the start does not."""
    env.reset(seed=seed)
    noise = np.random.default_rng(seed)
    for step in range(1, 101):
        _, reward, terminated, truncated, info = env.step(controller(env) + 0.1 * noise.normal(size=7))
        assert (reward, info["is_success"], info["mode"] is None) == (float(terminated), terminated, not terminated)
        assert not truncated
        if terminated:
            return info["mode"], step
    return None, step


@pytest.mark.parametrize(("task", "script", "mode"), SOLUTIONS)
def test_every_mode_can_be_done(task, script, mode):
    env = task()
    for seed in range(2):
        assert solve(env, script(mode), seed)[0] == mode
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize(("task", "script", "mode"), SOLUTIONS)
def test_every_mode_can_be_done_from_most_starts(task, script, mode):
    env = task()
    outcomes = [solve(env, script(mode), seed) for seed in range(20)]
    steps = [step for reached, step in outcomes if reached == mode]
    print(f"{task.__name__} {mode}: {len(steps)} of 20, {np.mean(steps):.1f} steps")
    assert len(steps) >= 18
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_checkers_of_gymnasium_and_sb3_are_content(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # As for gymnasium's robots: nothing bounds their speed
        warnings.filterwarnings("ignore", message=".*A Box observation space (min|max)imum value is -?infinity")
        env = gym.make(env_id)
        check_gymnasium_env(env.unwrapped, skip_render_check=True)
        check_sb3_env(env)
    assert env.spec.max_episode_steps == 100
    # What the arm does, or what it does it to
    expected = [6, 7, 8, 9] if env_id == "FrankaDrawerClose-v0" else [0, 1, 2]
    assert env.unwrapped.mode_features.tolist() == expected
    assert env.observation_space.shape == ({"FrankaDrawerClose-v0": 10, "FrankaCabinetOpen-v0": 7}.get(env_id, 6),)
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_seeds_reproduce_whatever_was_done_before(env_id):
    env, other = gym.make(env_id, obs_joints=True), gym.make(env_id, obs_joints=True)
    rng = np.random.default_rng(0)
    other.reset(seed=9)
    for _ in range(20):
        other.step(rng.uniform(-1, 1, 7))
    first, _ = env.reset(seed=4)
    np.testing.assert_array_equal(first, other.reset(seed=4)[0])
    assert (first[-7:] != np.float32(env.unwrapped.start_angles)).any() == (env.unwrapped.start_noise > 0)
    for _ in range(30):
        action = rng.uniform(-1, 1, 7)
        for ours, theirs in zip(env.step(action), other.step(action), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    env.close()
    other.close()


@pytest.mark.parametrize("env_id", IDS)
def test_a_copy_goes_on_from_where_it_was_made(env_id):
    """Also where things press on each other."""
    env = gym.make(env_id, obs_joints=True)
    unused = copy.deepcopy(env)
    start, _ = env.reset(seed=1)
    np.testing.assert_array_equal(unused.reset(seed=1)[0], start)
    unused.close()
    world = env.unwrapped
    into = {"Reach": (-0.22, 0.1, 0.67), "PegIn": (0.1, 0.15, -0.1), "Drawe": (-0.3, 0.2, 0.7), "Cabin": (-0.1, 0.1, 0.5)}
    for _ in range(30):
        env.step(towards(world, into[env_id[6:11]]))
    assert world.arm.penetration() > 0 or env_id == "FrankaDrawerClose-v0"  # which gives way
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for _ in range(20):
        action = towards(world, into[env_id[6:11]])
        expected = env.step(action)
        for other in copies:
            np.testing.assert_array_equal(other.step(action)[0], expected[0])
    start, _ = env.reset()
    for other in copies:
        np.testing.assert_array_equal(other.reset()[0], start)
        other.close()
    env.close()


def test_no_start_is_within_something():
    env = FrankaPegInHole(start_noise=0.3)  # more than its own, so that many would be
    assert max(env.reset(seed=seed) and env.arm.penetration() for seed in range(200)) < 1e-3
    env.close()


@pytest.mark.parametrize("y", [0.04, 0.2, 0.4, 0.52])
def test_the_door_cannot_be_opened_from_outside(y):
    env = FrankaCabinetOpen()
    observation, _ = env.reset(seed=0)
    for step in range(60):
        x = -0.2 if 10 < step < 40 else -0.65
        observation, _, terminated, _, _ = env.step(towards(env, (x, y, 0.6), FORWARDS))
        assert not terminated and -0.05 < observation[6] < 0.15  # friction moves it a little
    env.close()


def test_the_layer_is_where_the_hand_was_when_the_door_began_to_open():
    env = FrankaCabinetOpen()
    env.reset(seed=0)
    angles = iter([0.02, 0.06, 0.2, 0.02, 0.3, 0.41])
    heights = [0.7, 0.6, 0.4, 0.3, 0.3, 0.8]
    modes = []
    for height in heights:
        env.arm.client.resetJointState(env._door, 0, next(angles))
        env._follow(np.array([0, 0, height]), np.array([0, 0, height]))
        modes.append(env._done_by())
    assert modes == [None] * 5 + ["down"]
    env.close()


def test_a_closed_environment_says_so():
    env = FrankaReach()
    env.reset()
    env.close()
    for use in (env.reset, lambda: env.step(np.zeros(7))):
        with pytest.raises(RuntimeError, match="FrankaReach is closed"):
            use()


def test_start_noise():
    env = FrankaPegInHole(obs_joints=True, start_noise=0.0)
    starts = [env.reset(seed=seed)[0] for seed in range(2)]
    np.testing.assert_array_equal(*starts)
    np.testing.assert_array_equal(starts[0][-7:], np.float32(env.start_angles))
    with pytest.raises(ValueError, match="start_noise: -1 given"):
        FrankaReach(start_noise=-1)
    env.close()


def test_the_listed_ways_are_those_that_scripts_go():
    assert {task: task.listed_modes for task, _, _ in SOLUTIONS} == {
        task: tuple(mode for each, _, mode in SOLUTIONS if each is task) for task, _, _ in SOLUTIONS
    }


def test_a_joint_turns_by_at_most_what_the_action_says():
    env = FrankaReach(obs_joints=True)
    before = env.reset(seed=0)[0][-7:]
    after = env.step(np.array([1.0, 0, 0, 0, 0, 0, -0.5]))[0][-7:]
    np.testing.assert_allclose((after - before)[[0, 6]], [0.05, -0.025], atol=0.012)
    np.testing.assert_allclose((after - before)[1:6], 0.0, atol=0.005)
    env.close()


def test_velocity_is_that_of_the_fingertips():
    """At the end of the step: by one more step of the simulator."""
    env = FrankaReach()
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.array([1.0, 0.5, 0, 0.5, 0, 0, 0]))
    env.arm.targets += 0.5
    env.arm._hold()
    for _ in range(10):
        env.arm.client.stepSimulation()
    before, _ = env.arm.end_effector()
    env.arm.client.stepSimulation()
    after, velocity = env.arm.end_effector()
    np.testing.assert_allclose((after - before) * 500, velocity, atol=0.05)
    assert np.linalg.norm(velocity) > 0.3
    np.testing.assert_allclose(env._observation(), np.float32([*after, *velocity]))
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_pictures(env_id, capfd):
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image.shape == (480, 480, 3) and image.dtype == np.uint8 and 10 < image.std()
    env.close()
    assert "argv" not in capfd.readouterr().out


def test_bad_arguments():
    env = FrankaReach()
    env.reset()
    for action in (np.zeros(6), np.full(7, np.nan)):
        with pytest.raises(ValueError, match=r"action: \[.*\] given; accepted are finite numbers of shape \(7,\)"):
            env.step(action)
    with pytest.raises(ValueError, match="options"):
        env.reset(options={"goal": 1})
    with pytest.raises(ValueError, match="render_mode: 'human'"):
        FrankaReach(render_mode="human")
    env.close()


def test_without_pybullet_one_clear_line(monkeypatch):
    for name in list(sys.modules):
        if name.startswith("sb3_ddiffpg.envs.franka"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ImportError, match=r"Franka tasks need pybullet .* pip install 'sb3_ddiffpg\[franka\]'"):
        gym.make("FrankaReach-v0")
