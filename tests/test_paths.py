"""Paths: loops erased, resampled, cut to what can be compared."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_ddiffpg.paths import comparable_ends, erase_loops, resample_path


def test_resampling_a_corner_by_hand():
    # 3 m along x, then 1 m along y: arc lengths 0, 1, 2, 3, 4.
    path = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0]])
    expected = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [3.0, 1.0]]
    resampled = resample_path(path, 5)
    np.testing.assert_allclose(resampled, expected, atol=1e-6)
    assert resampled.dtype == np.float32


def test_resampling_forgets_speed_and_pauses():
    route = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [-2.0, 4.0]])
    slow = np.concatenate([np.linspace(a, b, 40) for a, b in pairwise(route)])
    pausing = np.repeat(slow, np.random.default_rng(0).integers(1, 6, size=len(slow)), axis=0)
    np.testing.assert_allclose(resample_path(pausing, 33), resample_path(route, 33), atol=1e-5)


@settings(max_examples=50, deadline=None)
@given(length=st.integers(1, 20), dims=st.integers(1, 4), n_points=st.integers(2, 40), seed=st.integers(0, 2**32 - 1))
def test_resampled_points_keep_the_ends_and_their_spacing(length, dims, n_points, seed):
    rng = np.random.default_rng(seed)
    path = np.repeat(rng.normal(size=(length, dims)), rng.integers(1, 4, size=length), axis=0)
    resampled = resample_path(path, n_points)
    assert resampled.shape == (n_points, dims)
    np.testing.assert_allclose(resampled[[0, -1]], path[[0, -1]], rtol=1e-6)
    # A chord is at most as long as the way between its ends, and most chords lie on one segment.
    spacing = np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / (n_points - 1)
    assert np.all(np.linalg.norm(np.diff(resampled, axis=0), axis=1) <= spacing * (1 + 1e-4) + 1e-5)


@pytest.mark.parametrize("length", [1, 5])
def test_resampling_a_path_that_never_moves(length):
    path = np.full((length, 3), 2.5)
    np.testing.assert_array_equal(resample_path(path, 4), np.full((4, 3), 2.5, dtype=np.float32))


def test_resampling_to_one_point_gives_the_first():
    np.testing.assert_array_equal(resample_path(np.array([[1.0], [5.0]]), 1), [[1.0]])


def test_resampling_checks_its_arguments():
    with pytest.raises(ValueError, match="n_points must be at least 1, got 0"):
        resample_path(np.zeros((2, 2)), 0)
    with pytest.raises(ValueError, match="path must have shape"):
        resample_path(np.zeros((0, 2)), 3)
    with pytest.raises(ValueError, match="path holds values"):
        resample_path(np.array([[0.0, np.nan]]), 3)


def test_loops_are_erased_by_hand():
    # right, a detour up and back, then on to the right
    path = np.array([[0, 0], [1, 0], [1, 1], [1, 2], [1, 1], [1, 0], [2, 0], [3, 0]], dtype=np.float32)
    np.testing.assert_array_equal(erase_loops(path, 0.1), [[0, 0], [1, 0], [1, 0], [2, 0], [3, 0]])
    np.testing.assert_array_equal(erase_loops(path[:4], 0.1), path[:4])


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), length=st.integers(1, 80), radius=st.floats(0.0, 3.0))
def test_erased_paths_keep_their_ends_and_come_back_to_no_point(seed, length, radius):
    path = np.cumsum(np.random.default_rng(seed).normal(size=(length, 2)), axis=0)
    erased = erase_loops(path, radius)
    np.testing.assert_array_equal(erased[[0, -1]], path[[0, -1]])
    steps = [int(np.flatnonzero((path == point).all(axis=1))[0]) for point in erased]
    assert steps == sorted(set(steps))
    for i, point in enumerate(erased[:-2]):
        # what comes after the next point is out of reach of this one
        assert (np.linalg.norm(erased[i + 2 :] - point, axis=1) > radius).all()


def test_the_end_of_a_path_by_hand():
    # 4 m along x, then 4 m along y: the last 5 m begin 1 m before the corner.
    path = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]])
    np.testing.assert_allclose(resample_path(path, 3, last=5.0), [[3.0, 0.0], [4.0, 1.5], [4.0, 4.0]], atol=1e-6)
    np.testing.assert_array_equal(resample_path(path, 5, last=100.0), resample_path(path, 5))
    np.testing.assert_array_equal(resample_path(path, 2, last=0.0), [[4.0, 4.0], [4.0, 4.0]])
    with pytest.raises(ValueError, match="last must not be negative, got -1"):
        resample_path(path, 5, last=-1.0)


def line(*corners):
    return resample_path(np.array(corners, dtype=float), 41)


def test_of_a_wanderer_only_the_end_is_compared():
    direct, wanderer = line([0, 0], [10, 0]), line([0, 0], [0, -15], [0, 5], [10, 5], [10, 0])
    lengths, (first, second) = comparable_ends([direct, wanderer], 1.5)
    assert first is direct and lengths[0] == np.inf
    # 15 m, and at most 10 % more: up to five metres of the way up, the ten along the top and down to the goal
    assert 15.0 <= lengths[1] < 16.5
    arc = np.linalg.norm(np.diff(second, axis=0), axis=1).sum()
    assert arc == pytest.approx(lengths[1], rel=0.05)
    np.testing.assert_allclose(second[-1], [10, 0])
    assert (second[:, 1] > 3.0).sum() > 20  # of the descent to -15 nothing is left
    assert second[:, 1].min() == 0.0


def test_ways_to_other_goals_and_from_other_starts_are_whole():
    near, far = line([0, 0], [3, 0]), line([0, 0], [0, 20], [20, 20])
    assert comparable_ends([near, far], 1.5)[0].tolist() == [np.inf, np.inf]
    # The second begins next to the goal of the first; what is possible from the first one's start stays ten metres
    from_afar, from_nearby = line([0, 0], [10, 0]), line([9, 0], [10, 0])
    assert comparable_ends([from_afar, from_nearby], 1.5)[0].tolist() == [np.inf, np.inf]


def test_a_slightly_shorter_way_changes_no_other():
    wanderer = line([0, 0], [0, -15], [0, 5], [10, 5], [10, 0])
    lengths = {comparable_ends([wanderer, line([0, 0], [x, 1], [10, 0])], 1.5)[0][0] for x in np.linspace(4, 6, 20)}
    assert len(lengths) == 1


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(0, 8), ratio=st.floats(1.0, 3.0), scale=st.floats(1e-3, 1e3))
def test_comparable_ends_against_a_slow_version(seed, n, ratio, scale):
    rng = np.random.default_rng(seed)
    paths = [resample_path(scale * rng.normal(size=(rng.integers(1, 9), 2)).cumsum(axis=0), 12) for _ in range(n)]
    lengths, parts = comparable_ends(paths, ratio)

    def arc(path):
        return sum(float(np.linalg.norm(b - a)) for a, b in pairwise(path.astype(float)))

    for path, length, part in zip(paths, lengths, parts, strict=True):
        shortest = min(arc(o) + np.linalg.norm(o[0] - path[0]) + np.linalg.norm(o[-1] - path[-1]) for o in paths)
        assert length == np.inf or ratio * shortest * 0.999 <= length <= ratio * shortest * 1.101
        assert (arc(path) <= ratio * shortest * 1.101) or length < np.inf or shortest == 0.0
        assert arc(part) <= min(arc(path), length) * 1.001
        np.testing.assert_array_equal(part[-1], path[-1])


def test_ways_that_begin_where_they_end_are_whole():
    still, loop = line([1, 1], [1, 1]), line([1, 1], [5, 1], [5, 5], [1, 1])
    assert comparable_ends([still, loop], 1.5)[0].tolist() == [np.inf, np.inf]
    assert comparable_ends([], 1.5)[1] == []
    with pytest.raises(ValueError, match="ratio must be at least 1, got 0.5"):
        comparable_ends([still], 0.5)
