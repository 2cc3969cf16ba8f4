from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import pdist, squareform

from sb3_ddiffpg.clustering.dtw import dtw_distances
from sb3_ddiffpg.clustering.linkage import LINKAGES, automatic_labels, cluster, without_outliers
from sb3_ddiffpg.clustering.matching import ModeMatching, assign_to_nearest, match_modes, medoid
from sb3_ddiffpg.clustering.paths import resample_path

# Ways through mazes of 4 m cells: round one block, two goals, two goals with several ways to each.
ONE_BLOCK = [[(0, 0), (0, 4), (-8, 4), (-8, 0)], [(0, 0), (0, -4), (-8, -4), (-8, 0)]]
TWO_GOALS = [[(0, 0), (-8, 0), (-8, 8)], [(0, 0), (8, 0)]]
FIVE_WAYS = [
    [(0, 0), (0, 12), (-12, 12)],
    [(0, 0), (0, 4), (-12, 4), (-12, 12)],
    [(0, 0), (0, -4), (-12, -4), (-12, 12)],
    [(0, 0), (0, -8), (12, -8), (12, -12)],
    [(0, 0), (12, 0), (12, -12)],
]
FOUR_WAYS = [
    [(0, 0), (0, 4), (-8, 4), (-8, 8), (-16, 8), (-16, 4)],
    [(0, 0), (0, 4), (-8, 4), (-8, 0), (-16, 0), (-16, 4)],
    [(0, 0), (0, -4), (-8, -4), (-8, 0), (-16, 0), (-16, -4)],
    [(0, 0), (0, -4), (-8, -4), (-8, -8), (-16, -8), (-16, -4)],
]
# Two goals 80 m apart, and two ways round a block to each: the ways differ by a fraction of what the goals do.
NESTED = [[(0, 0), (0, side * 4), (end * 8, side * 4), (end * 8, 0), (end * 40, 0)] for end in (-1, 1) for side in (-1, 1)]


def wobble(rng: np.random.Generator, n: int, scale: float, spacing: float) -> np.ndarray:
    """Smooth noise of deviation 1 along a way: white noise under a Gaussian window of ``scale`` metres."""
    reach = int(3 * scale / spacing)
    window = np.exp(-0.5 * (np.arange(-reach, reach + 1) * spacing / scale) ** 2)
    window /= np.linalg.norm(window)
    return np.stack([np.convolve(rng.normal(size=n + 2 * reach), window, "valid") for _ in range(2)], axis=1)


def trajectory(rng: np.random.Generator, route: list[tuple[int, int]], deviation: float, start: float = 0.5) -> np.ndarray:
    """One run along a route: lateral wobble inside the corridor, start noise, some going back, uneven pace, pauses."""
    spacing = 0.1
    line = resample_path(np.array(route, dtype=float), int(np.abs(np.diff(route, axis=0)).sum() / spacing)).astype(float)
    if rng.random() < 0.15:
        turn = rng.integers(40, len(line))
        back = turn - rng.integers(10, 40)
        line = np.concatenate([line[:turn], line[back:turn][::-1], line[back:]])
    fade = np.exp(-np.arange(len(line)) * spacing / 2.0)[:, None]
    sway = np.clip(deviation * wobble(rng, len(line), rng.uniform(1.5, 5.0), spacing), -1.6, 1.6)
    line += (1.0 - fade) * sway + fade * rng.uniform(-start, start, size=2)
    pace = rng.uniform(0.3, 0.8) * np.exp(0.3 * wobble(rng, len(line), 3.0, spacing)[:, 0])
    when = np.cumsum(spacing / pace)
    path = np.stack([np.interp(np.arange(when[0], when[-1]), when, column) for column in line.T], axis=1)
    if rng.random() < 0.15:
        pause = rng.integers(len(path))
        path = np.concatenate([path[:pause], np.repeat(path[pause : pause + 1], rng.integers(5, 40), axis=0), path[pause:]])
    return path


def runs(rng, routes, counts, deviation, start=0.5) -> tuple[list[np.ndarray], np.ndarray]:
    """Shuffled trajectories along some routes, and which route each took."""
    truth = rng.permutation(np.repeat(np.arange(len(counts)), counts))
    return [trajectory(rng, routes[route], deviation, start) for route in truth], truth


def same_partition(labels: np.ndarray, truth: np.ndarray) -> bool:
    """Whether the labels are the truth renamed, with at most a tenth of the trajectories left out as outliers."""
    inside = labels >= 0
    pairs = set(zip(labels[inside].tolist(), truth[inside].tolist(), strict=True))
    return inside.mean() >= 0.9 and len(pairs) == len(set(labels[inside])) == len(set(truth.tolist()))


def distances_of(points) -> np.ndarray:
    """Distance matrix of points on a line."""
    points = np.asarray(points, dtype=float)
    return np.abs(points[:, None] - points[None, :])


# --- a given threshold ---------------------------------------------------------------------------------------------


def test_cut_by_hand():
    # Average linkage of 0 1 | 5 6 7.2 | 20: 1, 1 and (2.2 + 1.2) / 2 = 1.7 inside the groups, then
    # (5 + 6 + 7.2 + 4 + 5 + 6.2) / 6 = 5.57 between the two, and 20 joins at (20 + 19 + 15 + 14 + 12.8) / 5 = 16.16.
    distances = distances_of([0.0, 5.0, 1.0, 6.0, 20.0, 7.2])
    assert cluster(distances, 0.9, min_size=1).tolist() == [0, 1, 2, 3, 4, 5]
    assert cluster(distances, 1.6, min_size=1).tolist() == [0, 1, 0, 1, 2, 3]
    assert cluster(distances, 1.8, min_size=1).tolist() == [1, 0, 1, 0, 2, 0]
    assert cluster(distances, 5.5, min_size=1).tolist() == [1, 0, 1, 0, 2, 0]
    assert cluster(distances, 5.5, min_size=2).tolist() == [1, 0, 1, 0, -1, 0]
    assert cluster(distances, 5.5, min_size=3).tolist() == [-1, 0, -1, 0, -1, 0]
    assert cluster(distances, 5.6, min_size=1).tolist() == [0, 0, 0, 0, 1, 0]
    assert cluster(distances, 16.1, min_size=1).tolist() == [0, 0, 0, 0, 1, 0]
    assert cluster(distances, 16.2, min_size=1).tolist() == [0, 0, 0, 0, 0, 0]


def test_too_many_modes_cut_the_tree_higher():
    distances = distances_of([0.0, 1.0, 10.0, 11.0, 30.0, 31.0, 70.0, 71.0])
    assert cluster(distances, 2.0, min_size=2, max_modes=4).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert cluster(distances, 2.0, min_size=2, max_modes=3).tolist() == [0, 0, 0, 0, 1, 1, 2, 2]
    assert cluster(distances, 2.0, min_size=2, max_modes=2).tolist() == [0, 0, 0, 0, 0, 0, 1, 1]
    assert cluster(distances, 2.0, min_size=2, max_modes=1).tolist() == [0] * 8


@pytest.mark.parametrize("method", LINKAGES)
@pytest.mark.parametrize("threshold", [0.5, 1.0, 2.0])
def test_cut_equals_scipy(method, threshold):
    points = np.random.default_rng(0).normal(size=(40, 2))
    expected = fcluster(linkage(pdist(points), method), threshold, criterion="distance")
    labels = cluster(squareform(pdist(points)), threshold, linkage=method, max_modes=40, min_size=1)
    assert len(set(zip(labels.tolist(), expected.tolist(), strict=True))) == len(set(labels)) == len(set(expected))


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(0, 25),
    seed=st.integers(0, 2**32 - 1),
    threshold=st.one_of(st.none(), st.floats(0.01, 5.0)),
    method=st.sampled_from(LINKAGES),
    max_modes=st.integers(1, 6),
    min_size=st.integers(1, 5),
)
def test_labels_are_numbered_by_size_within_the_limits(n, seed, threshold, method, max_modes, min_size):
    points = np.random.default_rng(seed).normal(size=(n, 2)).round(1)
    labels = cluster(np.hypot(*(points[:, None] - points[None, :]).T), threshold, method, max_modes, min_size)
    assert labels.shape == (n,)
    sizes = np.bincount(labels[labels >= 0], minlength=0)
    assert labels.min(initial=0) >= -1 and len(sizes) <= max_modes
    assert all(sizes >= min_size)
    order = [(-sizes[label], np.flatnonzero(labels == label)[0]) for label in range(len(sizes))]
    assert order == sorted(order)


@pytest.mark.parametrize("threshold", [None, 1.0])
def test_few_trajectories(threshold):
    pair = np.array([[0.0, 0.5], [0.5, 0.0]])
    assert cluster(np.zeros((0, 0)), threshold).tolist() == []
    assert cluster(np.zeros((1, 1)), threshold).tolist() == [-1]
    assert cluster(np.zeros((1, 1)), threshold, min_size=1).tolist() == [0]
    assert cluster(pair, threshold).tolist() == [-1, -1]
    assert cluster(pair, threshold, min_size=2).tolist() == [0, 0]


@pytest.mark.parametrize("threshold", [None, 1.5])
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_equal_distances_are_one_mode(threshold, value):
    distances = value * (1.0 - np.eye(8))
    assert cluster(distances, threshold).tolist() == [0] * 8


def test_equal_distances_above_the_threshold_are_outliers():
    assert cluster(2.0 * (1.0 - np.eye(8)), 1.5).tolist() == [-1] * 8


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"threshold": 0.0}, "threshold must be greater than 0.*got 0.0"),
        ({"threshold": float("nan")}, "threshold must be greater than 0"),
        ({"linkage": "ward"}, "linkage must be one of average, complete, single, weighted, got 'ward'"),
        ({"max_modes": 0}, "max_modes must be an integer of at least 1, got 0"),
        ({"max_modes": 1.5}, "max_modes must be an integer of at least 1, got 1.5"),
        ({"min_size": 0}, "min_size must be an integer of at least 1, got 0"),
        ({"min_size": float("nan")}, "min_size must be an integer of at least 1, got nan"),
    ],
)
def test_arguments_out_of_range(arguments, message):
    with pytest.raises(ValueError, match=message):
        cluster(np.zeros((4, 4)), **{"threshold": 1.0, **arguments})


def test_matrices_that_hold_no_distances():
    distances = distances_of(range(4))
    with pytest.raises(ValueError, match=r"square matrix, got shape \(4, 3\)"):
        cluster(distances[:, :3], 1.0)
    with pytest.raises(ValueError, match="symmetric"):
        cluster(np.triu(distances), 1.0)
    with pytest.raises(ValueError, match="zero diagonal"):
        cluster(distances + np.eye(4), 1.0)
    for value in (np.nan, np.inf, -1.0):
        distances[1, 2] = value
        with pytest.raises(ValueError, match=r"distances\[1, 2\] is"):
            cluster(distances, 1.0)


# --- the automatic rule --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [5, 8, 20, 60])
@pytest.mark.parametrize("deviation", [0.2, 0.8])
def test_one_route_is_one_mode(n, deviation):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        paths, _ = runs(rng, [FOUR_WAYS[seed]], [n], deviation)
        assert cluster(dtw_distances(paths), None).tolist() == [0] * n
        paths, _ = runs(rng, ONE_BLOCK[:1], [n], deviation, start=2.0)
        assert cluster(dtw_distances(paths), None).tolist() == [0] * n


@pytest.mark.slow
def test_one_route_of_many_runs_is_one_mode():
    paths, _ = runs(np.random.default_rng(0), FIVE_WAYS[:1], [200], 0.5)
    assert cluster(dtw_distances(paths), None).tolist() == [0] * 200


@pytest.mark.parametrize("resampled", [False, True])
@pytest.mark.parametrize("deviation", [0.2, 0.8])
@pytest.mark.parametrize(
    "routes, counts",
    [
        (ONE_BLOCK, [20, 20]),
        (ONE_BLOCK, [40, 5]),
        (ONE_BLOCK, [4, 3]),
        (TWO_GOALS, [20, 20]),
        (FIVE_WAYS, [8] * 5),
        (FIVE_WAYS, [40, 5, 5, 10, 10]),
        (FOUR_WAYS, [10] * 4),
        (FOUR_WAYS, [5, 40, 5, 5]),
        (NESTED, [10, 10, 10, 5]),
    ],
)
def test_routes_are_told_apart(routes, counts, deviation, resampled):
    for seed in range(3):
        paths, truth = runs(np.random.default_rng(seed), routes, counts, deviation)
        if resampled:
            paths = [resample_path(path, 48) for path in paths]
        assert same_partition(cluster(dtw_distances(paths), None), truth)


ROUTES_AND_COUNTS = [
    *((routes[:1], [n]) for routes, n in ((ONE_BLOCK, 20), (FOUR_WAYS, 30), (FIVE_WAYS, 40))),
    *((ONE_BLOCK, counts) for counts in ([20, 20], [40, 5])),
    *((FIVE_WAYS, counts) for counts in ([8] * 5, [40, 5, 5, 10, 10])),
    (TWO_GOALS, [20, 20]),
    (FOUR_WAYS, [10] * 4),
    (NESTED, [10, 10, 10, 5]),
]


@pytest.mark.slow
@pytest.mark.parametrize("silhouette", [0.52, 0.55, 0.6])
@pytest.mark.parametrize("deviation", [0.2, 0.5, 0.8])
def test_the_automatic_rule_does_not_stand_on_an_edge(silhouette, deviation, monkeypatch):
    """It is right in all of 240 cases, and would be with a silhouette a little smaller or larger."""
    monkeypatch.setattr("sb3_ddiffpg.clustering.linkage._CLEAR_SILHOUETTE", silhouette)
    for routes, counts in ROUTES_AND_COUNTS:
        for seed in range(10, 18):
            paths, truth = runs(np.random.default_rng(seed), routes, counts, deviation)
            distances = dtw_distances([resample_path(path, 48) for path in paths])
            assert same_partition(cluster(distances, None, min_size=5), truth)


@pytest.mark.parametrize("deviation", [0.2, 0.5])
@pytest.mark.parametrize("counts", [[60, 1], [60, 4], [20, 3], [8, 1]])
def test_the_first_of_a_rarer_way_are_not_taken_for_the_other(counts, deviation):
    """Too few for a mode, they wait outside: as members they would be forgotten among the many before there are enough."""
    for seed in range(6):
        for routes in (ONE_BLOCK, TWO_GOALS):
            paths, truth = runs(np.random.default_rng(seed), routes, counts, deviation)
            labels = cluster(dtw_distances([resample_path(path, 48) for path in paths]), None, min_size=5)
            often = truth == np.bincount(truth).argmax()
            assert (labels[~often] == -1).all() and (labels[often] == 0).mean() > 0.95


def test_wanderers_are_neither_a_mode_nor_in_the_way():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        paths, truth = runs(rng, FIVE_WAYS, [12] * 5, 0.4)
        corners = [rng.integers(-3, 4, size=(rng.integers(4, 9), 2)) * 4 for _ in range(8)]
        wanderers = [trajectory(rng, [(0, 0), *map(tuple, points), (-12, 12)], 0.4) for points in corners]
        labels = cluster(dtw_distances(paths + wanderers), None)
        assert same_partition(labels[: len(truth)], truth)
        assert np.mean(labels[len(truth) :] == -1) >= 0.5


def test_a_few_alike_among_many_strangers_are_no_modes():
    # Two triples, each of its own kind, among 20 trajectories as far from them as from one another.
    distances = 1.0 - np.eye(26)
    for triple in (slice(0, 3), slice(3, 6)):
        distances[triple, triple] *= 0.1
    assert automatic_labels(distances).tolist() == [0] * 26
    assert automatic_labels(distances[:12, :12]).tolist() == [0, 0, 0, 1, 1, 1] + [-1] * 6


def test_the_automatic_rule_has_no_unit():
    paths, _ = runs(np.random.default_rng(0), FIVE_WAYS, [6] * 5, 0.5)
    distances = dtw_distances(paths)
    for factor in (1e-6, 0.01, 1e5):
        np.testing.assert_array_equal(automatic_labels(distances * factor), automatic_labels(distances))


def test_the_automatic_rule_joins_the_nearest_modes_when_there_are_too_many():
    centres = np.repeat([0.0, 10.0, 100.0, 130.0], 4)
    distances = distances_of(centres + np.tile([0.0, 0.1, 0.2, 0.3], 4))
    four = np.repeat([0, 1, 2, 3], 4)
    assert automatic_labels(distances).tolist() == four.tolist()
    assert automatic_labels(distances, max_modes=3).tolist() == np.repeat([0, 0, 1, 2], 4).tolist()
    assert automatic_labels(distances, max_modes=2).tolist() == np.repeat([0, 0, 1, 1], 4).tolist()
    assert automatic_labels(distances, max_modes=1).tolist() == [0] * 16


# --- failed trajectories, medoids ----------------------------------------------------------------------------------


def test_failed_trajectories_join_the_mode_they_resemble():
    rng = np.random.default_rng(0)
    members = [[trajectory(rng, route, 0.3) for _ in range(6)] for route in ONE_BLOCK]
    failed = [path[: len(path) // 2] for mode in (1, 0, 1) for path in [trajectory(rng, ONE_BLOCK[mode], 0.3)]]
    assert assign_to_nearest(failed, members, np.random.default_rng(1)).tolist() == [1, 0, 1]
    assert assign_to_nearest(failed, members, np.random.RandomState(1)).tolist() == [1, 0, 1]


def test_assignment_takes_the_mean_over_the_drawn_members():
    def at(x: float) -> np.ndarray:
        return np.full((3, 1), x)

    # Mode 0 has the nearest member, mode 1 the smaller mean: 1 and 9 against 3, 3 and 3.
    members = [[at(1.0), at(9.0)], [at(3.0), at(-3.0), at(3.0)]]
    assert assign_to_nearest([at(0.0)], members, np.random.default_rng(0)).tolist() == [1]
    # With one sample each the draw decides, and the generator's state decides the draw.
    rng = np.random.default_rng(0)
    single = {assign_to_nearest([at(0.0)], members, rng, n_samples=1).item() for _ in range(40)}
    assert single == {0, 1}


def test_assignment_of_nothing_and_to_nothing():
    path = np.zeros((2, 2))
    assigned = assign_to_nearest([], [[path]], np.random.default_rng(0))
    assert assigned.shape == (0,) and assigned.dtype.kind == "i"
    with pytest.raises(ValueError, match="no mode"):
        assign_to_nearest([path], [], np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"members\[1\] is empty"):
        assign_to_nearest([path], [[path], []], np.random.default_rng(0))
    with pytest.raises(ValueError, match="n_samples must be at least 1, got 0"):
        assign_to_nearest([path], [[path]], np.random.default_rng(0), n_samples=0)


def test_medoid():
    assert medoid(distances_of([0.0, 10.0, 4.0, 5.0, 30.0])) == 3
    assert medoid(np.zeros((3, 3))) == 0
    with pytest.raises(ValueError, match="at least one member"):
        medoid(np.zeros((0, 0)))


# --- inheritance ---------------------------------------------------------------------------------------------------


def matched(old: list[int], new: list[int], n_old: int, n_new: int) -> ModeMatching:
    return match_modes(np.array(old, dtype=int), np.array(new, dtype=int), n_old, n_new)


def test_renumbering_changes_nobody():
    assert matched([0, 0, 1, 1, 2], [2, 2, 0, 0, 1], 3, 3) == ModeMatching([1, 2, 0], [True] * 3, {}, [])


def test_a_split_keeps_the_larger_part_and_copies_to_the_other():
    old, new = [0, 0, 0, 0, 0, 1, 1], [0, 0, 2, 2, 2, 1, 1]
    assert matched(old, new, 2, 3) == ModeMatching([0, 1, 0], [False, True, True], {}, [])


def test_a_merge_keeps_the_larger_mode():
    assert matched([0, 0, 1, 1, 1], [0, 0, 0, 0, 0], 2, 1) == ModeMatching([1], [True], {0: 0}, [])


def test_a_birth_has_no_parent():
    assert matched([0, 0, -1, -1], [1, 1, 0, 0], 1, 2) == ModeMatching([None, 0], [False, True], {}, [])


def test_a_mode_without_trajectories_retires():
    assert matched([0, 0, 2, 2], [0, 0, -1, -1], 3, 1) == ModeMatching([0], [True], {}, [1, 2])


def test_first_clustering_and_last():
    assert matched([-1, -1], [0, 0], 0, 1) == ModeMatching([None], [False], {}, [])
    assert matched([0, 1], [-1, -1], 2, 0) == ModeMatching([], [], {}, [0, 1])
    assert matched([], [], 0, 0) == ModeMatching([], [], {}, [])


def test_total_overlap_goes_before_the_single_largest():
    # Greedy would pair 0 with 0 (5 shared) and leave 1 with nothing; 4 + 4 is more.
    old = [0] * 5 + [0] * 4 + [1] * 4
    new = [0] * 5 + [1] * 4 + [0] * 4
    assert matched(old, new, 2, 2) == ModeMatching([1, 0], [True, True], {}, [])


def test_ties_go_to_the_lowest_index():
    assert matched([0, 0, 1, 1], [0, 1, 0, 1], 2, 2) == ModeMatching([0, 1], [True, True], {}, [])
    assert matched([0, 1, 2], [0, 0, 0], 3, 1) == ModeMatching([0], [True], {1: 0, 2: 0}, [])
    assert matched([0, 0, 0], [0, 1, 2], 1, 3) == ModeMatching([0, 0, 0], [True, False, False], {}, [])
    # scipy's own choice would be cluster 2, the last.
    assert matched([2, 2], [1, 2], 3, 3) == ModeMatching([None, 2, 2], [False, True, False], {}, [0, 1])


def test_labels_out_of_range():
    with pytest.raises(ValueError, match="new_labels must lie between -1 and 0, got 0 to 1"):
        matched([0, 0], [0, 1], 1, 1)
    with pytest.raises(ValueError, match="one shape"):
        matched([0, 0], [0], 1, 1)
    with pytest.raises(ValueError, match="old_labels must be one-dimensional"):
        match_modes(np.zeros((2, 2), dtype=int), np.zeros(4, dtype=int), 1, 1)


@settings(max_examples=150, deadline=None)
@given(data=st.data(), n_old=st.integers(0, 4), n_new=st.integers(0, 4), n=st.integers(0, 20))
def test_every_mode_has_one_fate(data, n_old, n_new, n):
    old = data.draw(st.lists(st.integers(-1, n_old - 1), min_size=n, max_size=n))
    new = data.draw(st.lists(st.integers(-1, n_new - 1), min_size=n, max_size=n))
    result = matched(old, new, n_old, n_new)
    overlap = np.zeros((n_old, n_new), dtype=int)
    for before, after in zip(old, new, strict=True):
        if before >= 0 and after >= 0:
            overlap[before, after] += 1

    survivors = [p for p, kept in zip(result.parents, result.kept, strict=True) if kept and p is not None]
    assert len(survivors) == sum(result.kept)
    assert sorted([*survivors, *result.merged, *result.retired]) == list(range(n_old))
    for cluster_index, (parent, kept) in enumerate(zip(result.parents, result.kept, strict=True)):
        shares = overlap[:, cluster_index]
        assert (parent is None) == (not shares.any())
        if parent is not None:
            assert shares[parent] > 0 and (kept or shares[parent] == shares.max())
    for mode, heir in result.merged.items():
        assert overlap[mode, heir] == overlap[mode].max() > 0
    assert all(not overlap[mode].any() for mode in result.retired)

    # No other one-to-one matching shares more: all of them tried, the smaller side padded with empty rows.
    padded = np.zeros((max(n_old, n_new),) * 2, dtype=int)
    padded[:n_old, :n_new] = overlap
    best = max(sum(padded[i, j] for i, j in enumerate(order)) for order in permutations(range(len(padded))))
    kept_overlap = sum(overlap[p, i] for i, (p, k) in enumerate(zip(result.parents, result.kept, strict=True)) if k)
    assert kept_overlap == best


@pytest.mark.parametrize("seed", range(5))
def test_outliers_go_with_the_nearest_member(seed):
    """By brute force; without any group, all are one."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(12, 2))
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    labels = rng.integers(-1, 3, 12)
    found = without_outliers(labels, distances)
    for i, label in enumerate(labels):
        others = [j for j in range(12) if labels[j] >= 0]
        assert found[i] == (label if label >= 0 else labels[min(others, key=lambda j: distances[i, j])])
    np.testing.assert_array_equal(without_outliers(np.full(3, -1), distances[:3, :3]), 0)
