import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from dtaidistance import dtw_ndim
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from sb3_ddiffpg.clustering.dtw import LANES, dtw_distances
from sb3_ddiffpg.clustering.paths import erase_loops, resample_path


def slow_dtw(a: np.ndarray, b: np.ndarray) -> float:
    """The recursion as it is written in textbooks, cell by cell in float64."""
    table = np.full((len(a) + 1, len(b) + 1), np.inf)
    table[0, 0] = 0.0
    for i in range(len(a)):
        for j in range(len(b)):
            before = min(table[i, j], table[i, j + 1], table[i + 1, j])
            table[i + 1, j + 1] = np.sum((a[i] - b[j]) ** 2) + before
    return float(np.sqrt(table[-1, -1]))


def random_paths(rng: np.random.Generator, n_paths: int, dims: int, longest: int) -> list[np.ndarray]:
    return [rng.normal(size=(length, dims)).cumsum(axis=0) for length in rng.integers(1, longest + 1, size=n_paths)]


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.tuples(st.integers(1, 12), st.integers(1, 12)),
    dims=st.integers(1, 5),
    seed=st.integers(0, 2**32 - 1),
    scale=st.sampled_from([1e-3, 1.0, 1e3]),
)
def test_equals_the_textbook_recursion(lengths, dims, seed, scale):
    rng = np.random.default_rng(seed)
    # Numbers that float32 holds: of others, near ones differ by rounding already
    a, b = ((scale * rng.normal(size=(length, dims))).astype(np.float32) for length in lengths)
    expected = slow_dtw(a.astype(float), b.astype(float))
    np.testing.assert_allclose(dtw_distances([a], [b], normalize=False), [[expected]], rtol=1e-5)
    np.testing.assert_allclose(dtw_distances([a], [b]), [[expected / np.sqrt(max(lengths))]], rtol=1e-5)


@pytest.mark.parametrize("dims", [1, 2, 3, 7])
@pytest.mark.parametrize("n_paths", [2, LANES - 1, LANES, 2 * LANES + 3])
def test_equals_dtaidistance(dims, n_paths):
    paths = random_paths(np.random.default_rng(dims), n_paths, dims, longest=40)
    expected = [[dtw_ndim.distance_fast(a, b) for b in paths] for a in paths]
    np.testing.assert_allclose(dtw_distances(paths, normalize=False), expected, rtol=1e-5)


def test_equals_dtaidistance_on_long_paths():
    rng = np.random.default_rng(0)
    paths = [rng.normal(size=(length, 2)).cumsum(axis=0) for length in (700, 699, 301)]
    expected = [[dtw_ndim.distance_fast(a, b) for b in paths] for a in paths]
    np.testing.assert_allclose(dtw_distances(paths, normalize=False), expected, rtol=1e-5)


def test_worked_example():
    # The pause in the second path is free; its last point is 2 away from the first path's last point.
    a = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    b = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [2.0, 2.0]])
    assert dtw_distances([a], [b], normalize=False).item() == pytest.approx(2.0)
    assert dtw_distances([a], [b]).item() == pytest.approx(2.0 / np.sqrt(5))


def test_normalized_distance_is_in_the_features_unit_and_does_not_grow_with_the_episode():
    for length in (10, 100, 1000):
        a = np.stack([np.linspace(0.0, 50.0, length), np.zeros(length)], axis=1)
        assert dtw_distances([a], [a + np.array([0.0, 3.0])]).item() == pytest.approx(3.0, rel=1e-4)


def test_a_pair_does_not_depend_on_its_company():
    paths = random_paths(np.random.default_rng(1), 2 * LANES + 5, 3, longest=30)
    together = dtw_distances(paths)
    assert together.dtype == np.float32
    np.testing.assert_array_equal(together, together.T)
    np.testing.assert_array_equal(np.diagonal(together), 0.0)
    np.testing.assert_array_equal(dtw_distances(paths[:4], paths), together[:4])
    np.testing.assert_array_equal(dtw_distances(paths, paths[:4]), together[:, :4])
    np.testing.assert_array_equal(dtw_distances(paths[7:8], paths[9:10]), together[7:8, 9:10])


def test_empty_lists():
    path = np.zeros((3, 2))
    assert dtw_distances([]).shape == (0, 0)
    assert dtw_distances([], [path]).shape == (0, 1)
    assert dtw_distances([path], []).shape == (1, 0)
    assert dtw_distances([path]).tolist() == [[0.0]]


def test_integer_and_strided_paths():
    path = np.arange(12).reshape(6, 2)
    shifted = path[::2] + np.array([0.0, 0.5])
    assert dtw_distances([path[::2]], [shifted], normalize=False).item() == pytest.approx(np.sqrt(3 * 0.25))
    assert dtw_distances([np.asfortranarray(path)], [path]).item() == 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e60])
def test_values_that_are_not_finite(value):
    good, bad = np.zeros((4, 2)), np.zeros((4, 2))
    bad[2, 1] = value
    with pytest.raises(ValueError, match=r"paths_a\[1\].*NaN, infinite"):
        dtw_distances([good, bad])
    with pytest.raises(ValueError, match=r"paths_b\[0\]"):
        dtw_distances([good], [bad])


def test_wrong_shapes():
    path = np.zeros((4, 2))
    with pytest.raises(ValueError, match=r"paths_a\[0\] must have shape \[length, dims\]"):
        dtw_distances([np.zeros(4)])
    with pytest.raises(ValueError, match=r"paths_a\[1\].*at least one point"):
        dtw_distances([path, np.zeros((0, 2))])
    with pytest.raises(ValueError, match=r"paths_a\[1\] has 3 dims"):
        dtw_distances([path, np.zeros((4, 3))])
    with pytest.raises(ValueError, match="must agree"):
        dtw_distances([path], [np.zeros((4, 3))])


def test_resampling_a_corner_by_hand():
    # 3 m along x, then 1 m along y: arc lengths 0, 1, 2, 3, 4.
    path = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0]])
    expected = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [3.0, 1.0]]
    resampled = resample_path(path, 5)
    np.testing.assert_allclose(resampled, expected, atol=1e-6)
    assert resampled.dtype == np.float32


def test_resampling_the_end_of_a_corner_by_hand():
    path = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0]])
    np.testing.assert_allclose(resample_path(path, 4, 1.5), [[2.5, 0.0], [3.0, 0.0], [3.0, 0.5], [3.0, 1.0]], atol=1e-6)
    np.testing.assert_array_equal(resample_path(path, 5, 4.5), resample_path(path, 5))


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
    for arc_length in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="arc_length must be positive, or None"):
            resample_path(np.zeros((2, 2)), 3, arc_length)
    with pytest.raises(ValueError, match="path must have shape"):
        resample_path(np.zeros((0, 2)), 3)
    with pytest.raises(ValueError, match="path holds values"):
        resample_path(np.array([[0.0, np.nan]]), 3)


def test_paths_too_far_apart_for_a_distance():
    for normalize in (True, False):
        with pytest.raises(ValueError, match="farther apart than float32 can tell"):
            dtw_distances([np.zeros((2, 1)), np.full((2, 1), 1e30)], normalize=normalize)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), length=st.integers(1, 80), radius=st.floats(0.0, 3.0))
def test_loops_are_erased_as_by_the_matrix_of_all_distances(seed, length, radius):
    path = np.cumsum(np.random.default_rng(seed).normal(size=(length, 2)), axis=0)
    near = cdist(path, path) <= radius
    place, kept = 0, [0]
    while place < length - 1:
        place = max(place + 1, max(i for i in range(length) if near[place, i]))
        kept.append(place)
    np.testing.assert_array_equal(erase_loops(path, radius), path[kept])


def test_a_long_path_needs_no_matrix():
    path = np.linspace((0.0, 0.0), (1.0, 1.0), 20_000)
    tracemalloc.start()
    erase_loops(path, 0.05)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


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
