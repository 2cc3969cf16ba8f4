"""Changes of an arm's world, against what bullet says and what scripts can still do."""

import copy
import pickle

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="pybullet has no wheel for this Python")

from test_franka import insert, push, reach, solve

from sb3_ddiffpg.envs import WorldChange, make_vec_env
from sb3_ddiffpg.envs.env_snapshots import env_snapshot, restore_env
from sb3_ddiffpg.envs.franka.tasks import FrankaCabinetOpen, FrankaDrawerClose, FrankaPegInHole, FrankaReach

CHANGES = {
    "motor_strength": {0: 0.1, 5: 0.5},
    "friction": 0.5,
    "gravity": 1.5,
    "joint_range": {1: 0.2},
    "obstacle": (-0.3, 0.15, 0.7, 0.05, 0.1, 0.1),
}


@pytest.mark.parametrize("task", [FrankaReach, FrankaPegInHole, FrankaDrawerClose, FrankaCabinetOpen])
def test_no_change_changes_nothing(task):
    runs = []
    for changes in (None, {"motor_strength": 1, "joint_range": {0: 1}, "gravity": 1.0}, WorldChange()):
        env, rng = task(obs_joints=True, changes=changes), np.random.default_rng(0)
        runs.append([env.reset(seed=0)[0], *(env.step(rng.uniform(-1, 1, 7))[0] for _ in range(15))])
        env.close()
    np.testing.assert_array_equal(runs[0], runs[1])
    np.testing.assert_array_equal(runs[0], runs[2])


def test_gravity_and_friction_are_the_worlds():
    plain, changed = FrankaReach(), FrankaReach(changes={"gravity": 0.5, "friction": 0.3})
    assert changed.arm.client.getPhysicsEngineParameters()["gravityAccelerationZ"] == pytest.approx(0.5 * -9.81)
    for link in range(-1, plain.arm.client.getNumJoints(plain.arm.body)):
        before, after = (env.arm.client.getDynamicsInfo(env.arm.body, link)[1] for env in (plain, changed))
        assert after == pytest.approx(0.3 * before)
    plain.close(), changed.close()


@pytest.mark.parametrize("strength", [0.0, 0.1, 1.0])
def test_a_motor_exerts_no_more_than_is_left(strength):
    env = FrankaReach(changes={"motor_strength": {1: strength}})
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.array([0, 1.0, 0, 0, 0, 0, 0]))  # forward and up: the arm leans back
        torque = env.arm.client.getJointState(env.arm.body, 1)[3]
        assert abs(torque) <= strength * 87.0 + 1e-6
    turned = env.arm.angles()[1] - env.start_angles[1]
    assert turned > 0.5 if strength == 1 else turned < -0.2  # too weak a one falls to where the joint ends
    env.close()


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_a_joint_keeps_its_part_of_the_range(share):
    """It turns as far as that, either way, and no farther; the others turn as ever."""
    whole = FrankaReach()
    low, high, start = whole.arm.low[0], whole.arm.high[0], whole.start_angles[0]
    whole.close()
    env = FrankaReach(changes={"joint_range": {0: share}})
    for side, end in ((1.0, high), (-1.0, low)):
        env.reset(seed=0)
        for _ in range(60):
            env.step(np.array([side, 0, 0, 0, 0, 0, side]))
        angles = env.arm.angles()
        assert angles[0] == pytest.approx(start + share * (end - start), abs=0.01)
        assert abs(angles[6] - env.start_angles[6]) > 0.8
    env.close()


def test_an_obstacle_is_in_the_way():
    """Bullet's ray hits it, and a quarter that is behind it is closed to the script that goes through it."""
    center, edges = (-0.3, 0.12, 0.84), (0.02, 0.3, 0.3)
    plain, changed = FrankaReach(), FrankaReach(changes={"obstacle": (*center, *edges)})
    rays = [env.arm.client.rayTest((-0.4, 0.2, 0.9), (-0.25, 0.2, 0.9))[0] for env in (plain, changed)]
    assert rays[0][0] == -1 and rays[1][3][0] == pytest.approx(center[0] - edges[0] / 2, abs=1e-3)
    assert solve(plain, reach("left-up"), 0)[0] == "left-up"
    assert solve(changed, reach("left-up"), 0)[0] != "left-up"
    assert solve(changed, reach("right-down"), 0)[0] == "right-down"
    plain.close(), changed.close()


@pytest.mark.parametrize(
    ("task", "script", "closed", "other"),
    [(FrankaDrawerClose, push, "left-up", "right-up"), (FrankaPegInHole, insert, "left", "right")],
)
def test_a_closed_route_cannot_be_gone_and_another_can(task, script, closed, other):
    env = task(changes={"closed": [closed]}, start_noise=0.0)
    assert solve(env, script(closed), 0)[0] is None
    if task is FrankaDrawerClose:
        assert env._extra()[0] == pytest.approx(env.OPENING, abs=0.003)
    assert solve(env, script(other), 0)[0] == other
    env.close()


@pytest.mark.parametrize("how", ["snapshot", "pickle", "copy"])
def test_changes_are_kept(how):
    env, rng = FrankaReach(obs_joints=True, changes=CHANGES), np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(10):
        env.step(rng.uniform(-1, 1, 7))
    if how == "snapshot":
        twin = FrankaReach(obs_joints=True, changes=CHANGES)
        restore_env(twin, env_snapshot(env))
    else:
        twin = pickle.loads(pickle.dumps(env)) if how == "pickle" else copy.deepcopy(env)
    for _ in range(10):
        action = rng.uniform(-1, 1, 7)
        np.testing.assert_array_equal(twin.step(action)[0], env.step(action)[0])
    twin.close(), env.close()


def test_workers_have_them():
    kwargs = {"changes": CHANGES, "obs_joints": True}
    many, one = make_vec_env("FrankaReach-v0", 2, seed=0, n_threads=1, **kwargs), FrankaReach(**kwargs)
    np.testing.assert_array_equal(many.reset()[0], one.reset(seed=0)[0])
    rng = np.random.default_rng(0)
    for _ in range(10):
        action = rng.uniform(-1, 1, 7).astype(np.float32)
        np.testing.assert_array_equal(many.step(np.stack([action] * 2))[0][0], one.step(action)[0])
    many.close(), one.close()


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        (FrankaReach, {"n_blocked": 1}, "changes.n_blocked: 1 given, but FrankaReach's arm has none; accepted are"),
        (FrankaReach, {"closed": ["left-up"]}, r"changes.closed: \('left-up',\) given, but FrankaReach's arm has none"),
        (FrankaDrawerClose, {"closed": ["left"]}, r"changes.closed: \['left'\] given; accepted are some of \('left-up'"),
        (FrankaPegInHole, {"closed": ["left", "right"]}, "accepted are some of .* but not all"),
        (FrankaReach, {"joint_range": {7: 0.5}}, r"changes.joint_range: \[7\] given; accepted are the numbers 0 to 6"),
        (FrankaReach, {"obstacle": (-0.6, 0, 0.3, 0.2, 0.2, 0.2)}, "changes.obstacle: .* given, but the arm begins there"),
    ],
)
def test_bad_changes(task, changes, message):
    with pytest.raises(ValueError, match=message):
        task(changes=changes)
