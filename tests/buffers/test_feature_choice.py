"""Which components tell places apart: on walks made by hand, in any unit, and on recorded episodes of tasks."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_ddiffpg import ModeReplayBuffer
from sb3_ddiffpg.buffers.feature_choice import MOST_FEATURES, choose_features, parts, travels
from sb3_ddiffpg.buffers.features import ModeFeatures


def steady_walks(seed=0, n=12, length=80):
    """
    Positions (0, 1) with momentum, their velocities (2, 3), a contact that comes and goes (4), a goal that is another in each
    episode (5), and a constant (6).
    """
    rng = np.random.default_rng(seed)
    episodes = []
    for _ in range(n):
        velocity = np.zeros((length, 2))
        for t in range(1, length):
            velocity[t] = 0.9 * velocity[t - 1] + rng.normal(scale=0.3, size=2)
        rest = np.stack([rng.integers(0, 2, length), np.full(length, rng.uniform(-5, 5)), np.full(length, 2.0)], axis=1)
        episodes.append(np.concatenate([velocity.cumsum(axis=0), velocity, rest], axis=1))
    return episodes


def test_travels_by_hand():
    straight = np.stack([np.arange(11.0), np.tile([0.0, 1.0], 6)[:11], np.full(11, 4.0)], axis=1)
    # Ten steps of 1 come 10 far; to and fro 1 far; what stays 0
    np.testing.assert_allclose(travels([straight]), [10.0, 1.0, 0.0])
    back = np.stack([np.abs(np.arange(11.0) - 5), np.zeros(11), np.zeros(11)], axis=1)
    np.testing.assert_allclose(travels([straight, back]), [(10 + 5) / 2, 1.0, 0.0])  # mean of the farthest, by the mean step
    np.testing.assert_array_equal(travels([np.ones((1, 3))]), 0.0)  # no step
    assert travels([]).size == 0


def test_parts_by_hand():
    """Two of three paths go up, one down; along the second component all go alike; the third is different from the start."""
    along = np.linspace(0, 1, 50)
    paths = [np.stack([sign * along, along, np.full(50, each)], axis=1) for sign, each in ((1, 0.0), (1, 1.0), (-1, 2.0))]
    found = parts(paths, np.array([1.0, 1.0, 1.0]))
    np.testing.assert_allclose(found, [np.std([1, 1, -1]), 0.0, 0.0], atol=1e-12)
    slower = [paths[0], paths[1].repeat(3, axis=0), paths[2]]  # laid side by side at shares of their lengths
    np.testing.assert_allclose(parts(slower, np.ones(3))[0], np.std([1, 1, -1]), atol=0.02)
    np.testing.assert_allclose(parts(paths, np.array([2.0, 1.0, 1.0]))[0], np.std([1, 1, -1]) / 2)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 20),
    st.lists(st.sampled_from([1e-6, 1e-3, 1.0, 1e3, 1e6, -1.0]), min_size=7, max_size=7),
    st.permutations(range(7)),
)
def test_what_is_chosen_depends_on_no_unit_and_no_order(seed, units, order):
    episodes = steady_walks(seed)
    chosen = choose_features(episodes)
    np.testing.assert_array_equal(choose_features([each * units for each in episodes]), chosen)
    np.testing.assert_allclose(travels([each * units for each in episodes]), travels(episodes), rtol=1e-6)
    permuted = choose_features([each[:, order] for each in episodes])
    assert {order[each] for each in permuted.tolist()} == set(chosen.tolist())


@pytest.mark.parametrize("seed", range(5))
def test_positions_are_told_from_velocities_contacts_and_goals(seed):
    assert choose_features(steady_walks(seed)).tolist() == [0, 1]


def test_of_those_that_say_the_same_one_is_chosen():
    episodes = [np.concatenate([each, -3.0 * each[:, :1] + 1.0, each[:, 1:2] + 1e-4], axis=1) for each in steady_walks()]
    chosen = choose_features(episodes)
    assert len(chosen) == 2 and len({*chosen.tolist()} & {0, 7}) == len({*chosen.tolist()} & {1, 8}) == 1


def test_goals_that_are_constant_within_an_episode_are_not_chosen():
    """However far apart they are between episodes."""
    episodes = steady_walks()
    assert travels(episodes)[5] == 0
    for each in episodes:
        each[:, 5] *= 1e6
    assert 5 not in choose_features(episodes) and 5 not in choose_features(episodes, episodes[:5])


def test_where_more_go_far_those_along_which_goal_reached_episodes_part():
    """Five positions; to the goal one goes by two ways along the fourth, all else alike."""
    rng = np.random.default_rng(0)
    time = np.linspace(0, 1, 60)
    random = [rng.normal(size=(60, 5)).cumsum(axis=0) for _ in range(20)]
    reached = []
    for number in range(8):
        path = np.stack([10 * time] * 5, axis=1) + rng.normal(scale=0.02, size=(60, 5)).cumsum(axis=0)
        path[:, 3] += (1 if number % 2 else -1) * 8 * np.sin(np.pi * time)
        reached.append(path)
    assert len(choose_features(random)) == MOST_FEATURES
    chosen = choose_features([*random, *reached], reached)
    assert 3 in chosen and len(chosen) == MOST_FEATURES  # places are told apart along others too
    for path in reached:
        path[:, 1] += 8 * np.sin(np.pi * time) * (1 if path[30, 3] > 5 else -1)
    assert {1, 3} <= {*choose_features([*random, *reached], reached).tolist()}


def test_where_nothing_moves_the_first_are_taken():
    assert choose_features([np.ones((20, 6))] * 3).tolist() == [0, 1, 2]
    assert choose_features([np.ones((20, 2))] * 3).tolist() == [0, 1]


def recorded(env, n, max_steps=100):
    """Random episodes, as the buffer holds them."""
    space = env.observation_space
    whole = ModeFeatures(space)
    env.action_space.seed(0)
    episodes = []
    for seed in range(n):
        observation, _ = env.reset(seed=seed)
        path, over = [observation], False
        while not over and len(path) <= max_steps:
            observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
            path.append(observation)
            over = terminated or truncated
        if isinstance(space, spaces.Dict):
            batch = {key: np.stack([each[key] for each in path]) for key in space.spaces}
        else:
            batch = np.stack(path)
        episodes.append(whole(batch))
    return episodes


def test_positions_of_a_point_maze():
    """Position and velocity: what the maze itself declares is found."""
    env = gym.make("PointMazeV1-v0")
    assert env.observation_space.shape == (4,)
    assert choose_features(recorded(env, 12)).tolist() == env.unwrapped.mode_features.tolist() == [0, 1]


def test_the_hand_of_an_arm():
    """The fingertips' position, of all that an arm observes."""
    pytest.importorskip("pybullet", reason="pybullet has no wheel for this Python")
    env = gym.make("FrankaReach-v0")
    assert choose_features(recorded(env, 8)).tolist() == [0, 1, 2]
    env.close()


def test_asking_draws_nothing_from_a_space():
    """Some environments draw their observations from it."""
    space = spaces.Dict({"a": spaces.Box(-1, 1, (3,)), "b": spaces.Box(-1, 1, (2,))})
    space.seed(0)
    expected = space.sample()
    space.seed(0)
    ModeFeatures(space)
    np.testing.assert_array_equal(space.sample()["a"], expected["a"])


def test_indices_of_a_dict_are_of_its_parts_sorted_by_key():
    space = spaces.Dict({"b": spaces.Box(-1, 1, (2,)), "a": spaces.Box(-1, 1, (3,)), "c": spaces.Discrete(5)})
    batch = {"a": np.arange(6.0).reshape(2, 3), "b": 10 + np.arange(4.0).reshape(2, 2), "c": np.array([3, 4])}
    np.testing.assert_array_equal(ModeFeatures(space)(batch), [[0, 1, 2, 10, 11, 3], [3, 4, 5, 12, 13, 4]])
    np.testing.assert_array_equal(ModeFeatures(space, [2, 4, 5])(batch), [[2, 11, 3], [5, 13, 4]])
    with pytest.raises(ValueError, match=r"mode_features=\[6\] exceeds the observation's 6 components"):
        ModeFeatures(space, [6])


@pytest.mark.parametrize("shape", [(8, 12, 3), (3, 8, 12)])
def test_an_image_is_its_brightness_in_sixteen_parts(shape):
    space = spaces.Box(0, 255, shape, np.uint8)
    images = np.random.default_rng(0).integers(0, 256, (5, *shape), dtype=np.uint8)
    gray = images.astype(np.float64).mean(axis=1 if shape[0] == 3 else -1)
    expected = gray.reshape(5, 4, 2, 4, 3).mean(axis=(2, 4)).reshape(5, 16)
    np.testing.assert_allclose(ModeFeatures(space)(images), expected, rtol=1e-5)


def moved(buffer, far):
    """One environment goes along a line, one step after the other."""
    for k in range(60):
        step = np.array([[far * k, 0.1 * (k % 2)]], dtype=np.float32)
        done = np.array([k % 20 == 19])
        buffer.add(step, step + np.float32([far, 0.0]), np.zeros((1, 1), np.float32), np.zeros(1), done, [{}])


def test_paths_are_compared_in_deviations_measured_anew_when_the_run_goes_farther():
    buffer = ModeReplayBuffer(500, spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(-1, 1, (1,)), "cpu", standardize=True)
    moved(buffer, 1.0)
    scale = buffer.measured_scale().copy()
    rows = buffer.stored_rows.rows[: buffer.size()]
    positions = buffer.observations[rows].reshape(-1, 2).astype(np.float64)
    np.testing.assert_allclose(scale, positions.std(axis=0), rtol=1e-5)
    assert not buffer.review_scale()
    moved(buffer, 9.0)
    assert buffer.review_scale() and buffer.feature_scale[0] > 2 * scale[0]
    assert not buffer.review_scale()
    unit = ModeReplayBuffer(500, spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(-1, 1, (1,)), "cpu", standardize=False)
    moved(unit, 1.0)
    np.testing.assert_array_equal(unit.measured_scale(), 1.0)
    assert not unit.review_scale()
    buffer.reset()
    assert buffer.standardize and buffer.feature_scale is None
    with pytest.raises(ValueError, match="standardize must be"):
        ModeReplayBuffer(500, spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (1,)), "cpu", standardize="yes")


def test_a_direction_in_which_goal_reached_paths_go_less_far_is_kept():
    """To a goal straight ahead, round a wall on either side: across is where the ways part, though it is the shorter part."""
    times = np.linspace(0, 1, 60)
    wiggle = np.random.default_rng(0).normal(0, 0.3, size=(12, 60, 2))
    ways = [np.stack((side * np.sin(np.pi * times) * 4, 20 * times), axis=1) for side in (-1.0, 1.0) * 6]
    goal_reached = [np.concatenate((way, noise), axis=1) for way, noise in zip(ways, wiggle, strict=True)]
    wandering = [each[:30].copy() for each in goal_reached]
    for each in wandering:
        each[:, 0] *= 5
    assert choose_features(wandering + goal_reached, goal_reached).tolist() == [0, 1]
