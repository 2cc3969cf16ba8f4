"""Maps, walls and the labels of routes."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from maze_routes import ROUTES, polyline

from sb3_ddiffpg.envs.mazes.homotopy import HomotopyTracker
from sb3_ddiffpg.envs.mazes.maze import CELL_SIZE, LISTED_ROUTES, MAZES, Maze, cell_distances, reduce_word

# Four islands: a ring (with a room that nobody can enter, and a pillar in it), a pillar above the start, one that is two
# cells high, whose cut ends at a wall grown from the border, and one below the goal, whose cut passes through the goal.
OWN_MAP = [
    [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
    [1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1],
    [1, 0, 1, 1, 1, 1, 1, 0, 0, 0, 1],
    [1, 0, 1, 0, 0, 0, 1, 0, 1, 0, 1],
    [1, 0, 1, 0, 1, 0, 1, 0, "r", 0, 1],
    [1, 0, 1, 0, 0, 0, 1, 0, 1, 1, 1],
    [1, 0, 1, 1, 1, 1, 1, 0, 0, 0, 1],
    [1, 0, 0, 0, "g", 0, 0, 0, 1, 0, 1],
    [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 1],
    [1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1],
    [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
]


def slow_reduce(word):
    """Take out the first pair that cancels, until there is none."""
    for i in range(len(word) - 1):
        if word[i] != word[i + 1] and word[i].lower() == word[i + 1].lower():
            return slow_reduce(word[:i] + word[i + 2 :])
    return word


@given(st.text(alphabet="abcABC", max_size=30))
def test_reduce_word_like_a_slow_reference(word):
    assert reduce_word(word) == slow_reduce(word)


def test_reduce_word_with_numbered_letters():
    assert reduce_word("ab1B1c") == "ac"
    assert reduce_word("aA1") == "aA1"
    assert reduce_word("b1B2B1") == "b1B2B1"


def test_cuts_of_the_paper_mazes():
    cuts = {name: [tuple(cut) for cut in Maze(name).cuts] for name in MAZES}
    assert cuts == {
        "V1": [("a", -4, 2, 6)],
        "V2": [],
        "V3": [("a", -8, 10, 14), ("b", 8, 10, 14), ("c", -8, 2, 6), ("d", 8, -2, 2), ("e", -8, -6, -2)],
        "V4": [("a", -12, 6, 10), ("b", -4, 2, 6), ("c", -12, -2, 2)],
    }


def test_goals_and_extents_of_the_paper_mazes():
    goals = {name: Maze(name).goals.tolist() for name in MAZES}
    assert goals == {"V1": [[-8, 0]], "V2": [[-8, 8], [8, 0]], "V3": [[-12, 12], [12, -12]], "V4": [[-16, 4], [-16, -4]]}
    assert all(Maze(name).start.tolist() == [0, 0] for name in MAZES)
    assert Maze("V1").extent == (-14, 6, -10, 10)
    assert (Maze("V1").low.tolist(), Maze("V1").high.tolist()) == ([-10, -6], [2, 6])


@pytest.mark.parametrize(("name", "label"), ROUTES)
def test_label_of_listed_routes_with_jitter(name, label):
    maze = Maze(name)
    rng = np.random.default_rng(0)
    corners = np.array([(0, 0), *ROUTES[name, label]], dtype=float)
    for _ in range(200):
        path = polyline(corners + rng.uniform(-1, 1, corners.shape))
        path += rng.normal(0, 0.1, path.shape)
        assert not maze.blocked(*path.T, 0.2).any()
        assert maze.label(path, int(label[0])) == label


def test_listed_routes_are_those_tested():
    for name, labels in LISTED_ROUTES.items():
        assert set(labels) == {label for maze, label in ROUTES if maze == name}
        assert Maze(name).listed_routes == labels
    assert Maze(MAZES["V1"]).listed_routes == ()


def test_loops_and_detours_leave_the_word_alone():
    maze = Maze("V3")
    detour = [(0, 0), (0, 12), (-6, 12), (-10, 12), (-10, 12.5), (-6, 11.5), (0, 12), (0, -4), (-12, -4), (-12, 12)]
    assert maze.label(polyline(detour), 0) == "0:e"
    once_around = [(0, 0), (0, 4), (-12, 4), (-12, -4), (0, -4), (0, 4), (-12, 4), (-12, 12)]
    # Leftwards above the island (c), back below it (E), leftwards above it again
    assert maze.label(polyline(once_around), 0) == "0:cEc"


def test_tracker_agrees_with_label_of_the_whole_path():
    maze = Maze("V4")
    labels = [label for name, label in ROUTES if name == "V4"]
    paths = [polyline([(0, 0), *ROUTES["V4", label]]) for label in labels]
    length = max(map(len, paths))
    # The shorter routes wait at their goals
    together = np.stack([np.vstack([path, np.repeat(path[-1:], length - len(path), axis=0)]) for path in paths], axis=1)
    tracker = HomotopyTracker(maze, len(paths))
    tracker.reset([0, 1, 2, 3], together[0])
    for positions in together[1:]:
        tracker.step(positions)
    assert [tracker.label(i, int(label[0])) for i, label in enumerate(labels)] == labels
    assert [tracker.word(i) for i in range(4)] == ["ba", "bc", "c", ""]

    twin = pickle.loads(pickle.dumps(copy.deepcopy(tracker)))
    tracker.reset([1], together[0][1:2])
    assert (tracker.word(1), tracker.word(0), twin.word(1)) == ("", "ba", "bc")


def test_own_map_with_islands():
    maze = Maze(OWN_MAP)
    x = {j: CELL_SIZE * (j - 8) for j in range(11)}
    y = {i: CELL_SIZE * (4 - i) for i in range(11)}
    assert [tuple(cut) for cut in maze.cuts] == [
        ("a", x[2], y[2] + 2, y[1] + 2),
        ("b", x[8], y[3] + 2, y[1] + 2),
        ("c", x[8], y[7] + 2, y[6] + 2),
        ("d", x[4], y[8] + 2, y[7] + 2),
    ]


def test_start_and_goal_on_a_cut():
    """A route keeps its label wherever in the start and goal cells it begins and ends."""
    maze = Maze(["#####", "#.r.#", "#.#.#", "#.g.#", "#.#.#", "#...#", "#####"])
    assert [cut.x for cut in maze.cuts] == [0, 0]
    rng = np.random.default_rng(0)
    for corners, label in [([(-4, 0), (-4, -8)], "0:aB"), ([(4, 0), (4, -8)], "0:-")]:
        for _ in range(50):
            start, end = rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2) + maze.goals[0]
            path = polyline([start, *corners, end])
            assert maze.label(path, 0) == label
            tracker = HomotopyTracker(maze, 1)
            tracker.reset([0], path[:1])
            for position in path[1:]:
                tracker.step(position[None])
            assert tracker.label(0, 0) == label


def test_walls_that_touch_at_a_corner_are_one_island():
    maze = Maze(["######", "#r...#", "#..#.#", "#.#..#", "#...g#", "######"])
    assert [tuple(cut) for cut in maze.cuts] == [("a", 8, -2, 2)]
    hanging = Maze(["#####", "#r..#", "##..#", "#.#g#", "#...#", "#####"])
    assert hanging.cuts == []


def test_many_islands_have_letters_of_their_own():
    rows = ["#" * 17] + ["#" + ("." * 15 if i % 2 == 0 else ".#" * 7 + ".") + "#" for i in range(9)] + ["#" * 17]
    rows[1] = "#r" + "." * 13 + "g#"
    letters = [cut.letter for cut in Maze(rows).cuts]
    assert len(letters) == len(set(letters)) == 28
    assert letters[24:] == ["y", "z", "a1", "b1"]


def winding_number(path, point):
    """TracedEnvs of a closed path around a point, counter-clockwise positive, by summing angles."""
    angles = np.unwrap(np.arctan2(*(path - point).T[::-1]))
    return round((angles[-1] - angles[0]) / (2 * np.pi))


@st.composite
def mazes_with_loops(draw):
    """A random maze and a walk through its cells that ends where it began."""
    n_rows, n_columns = draw(st.integers(5, 9)), draw(st.integers(5, 9))
    cells = np.array(draw(st.lists(st.sampled_from("...#"), min_size=n_rows * n_columns, max_size=n_rows * n_columns)))
    cells = cells.reshape(n_rows, n_columns)
    cells[[0, -1], :] = cells[:, [0, -1]] = "#"
    cells[1, 1], cells[1, 2] = "r", "g"
    maze = Maze(["".join(row) for row in cells])
    walk = [maze.start_cell]
    for choice in draw(st.lists(st.integers(0, 3), max_size=60)):
        walk.append(_free_neighbours(maze, walk[-1])[choice % len(_free_neighbours(maze, walk[-1]))])
    home = cell_distances(~maze.walls, maze.start_cell)
    while walk[-1] != maze.start_cell:
        walk.append(min(_free_neighbours(maze, walk[-1]), key=lambda cell: home[cell]))
    return maze, np.array([maze.cell_center(cell) for cell in walk])


def _free_neighbours(maze, cell):
    i, j = cell
    return [c for c in [(i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)] if not maze.walls[c]]


@given(mazes_with_loops(), st.randoms(use_true_random=False))
@settings(max_examples=60, deadline=None)
def test_words_count_windings_and_undo_themselves(maze_and_loop, random):
    """
    The crossings of an island's cut, leftwards minus rightwards, are the loop's turns around it minus its turns around
    the wall where the cut ends. A loop followed by its reverse has the empty word.
    """
    maze, loop = maze_and_loop
    # Begin a little to the left of the centres, so that no corner lies on a cut
    loop = loop - [random.uniform(0.1, 1.5), random.uniform(-1.5, 1.5)]
    word = [letter for _, letter in maze.crossings(loop[:-1], loop[1:])]
    for cut in maze.cuts:
        island = winding_number(loop, [cut.x, cut.y_low - 0.1])
        ceiling = winding_number(loop, [cut.x, cut.y_high + 0.1])
        assert word.count(cut.letter) - word.count(cut.letter.upper()) == island - ceiling
    there_and_back = np.vstack([loop, loop[::-1]])
    assert reduce_word("".join(letter for _, letter in maze.crossings(there_and_back[:-1], there_and_back[1:]))) == ""


def test_several_crossings_in_one_segment_are_in_order():
    maze = Maze(["#########", "#.......#", "#.#.#.#.#", "#r......#", "#....g..#", "#########"])
    old, new = np.array([[-2.0, 8.0], [26.0, 8.0]]), np.array([[26.0, 8.0], [-2.0, 8.0]])
    assert maze.crossings(old, new) == [(0, "A"), (0, "B"), (0, "C"), (1, "c"), (1, "b"), (1, "a")]


def slow_blocked(maze, x, y, half_size):
    """Overlap of open squares, cell by cell; outside is wall."""
    x_min, x_max, y_min, y_max = maze.extent
    if x - half_size < x_min or x + half_size > x_max or y - half_size < y_min or y + half_size > y_max:
        return True
    reach = CELL_SIZE / 2 + half_size
    centers = [maze.cell_center(tuple(cell)) for cell in np.argwhere(maze.walls)]
    return any(abs(x - cx) < reach and abs(y - cy) < reach for cx, cy in centers)


@pytest.mark.parametrize("half_size", [0.1, 0.4, 2.0])
def test_blocked_like_a_slow_reference(half_size):
    maze = Maze("V3")
    x, y = np.random.default_rng(0).uniform(-20, 20, (2, 2000))
    expected = [slow_blocked(maze, *point, half_size) for point in zip(x, y, strict=True)]
    assert maze.blocked(x, y, half_size).tolist() == expected
    boxes = [
        not maze.is_open_box([a - half_size, b - half_size], [a + half_size, b + half_size]) for a, b in zip(x, y, strict=True)
    ]
    assert boxes == expected


def test_maps_of_gymnasium_robotics_are_read():
    rows = [[1, 1, 1, 1], [1, "r", 0, 1], [1, 1, "g", 1], [1, 1, 1, 1]]
    assert Maze(rows).rows == Maze(np.array(rows, dtype=object)).rows == ("####", "#r.#", "##g#", "####")


@pytest.mark.parametrize(
    ("maze_map", "message"),
    [
        ("V9", "'V9' is no known maze; give one of V1, V2, V3, V4 or a list of rows"),
        (["####", "#.g#", "####"], "exactly one start 'r', but there are 0"),
        (["#####", "#rgr#", "#####"], "exactly one start 'r', but there are 2"),
        (["####", "#r.#", "####"], "at least one goal"),
        (["####", "#rg#", "###"], r"equally long, but their lengths are \[3, 4\]"),
        ([], "equally long"),
        (["####", "#rg.", "####"], "outermost cells must all be walls"),
        (["##.#", "#rg#", "####"], "outermost cells must all be walls"),
        (["####", "#rc#", "#g.#", "####"], "unknown cell 'c'"),
        ([[1, 1, 1], [1, 2, 1], [1, 1, 1]], "unknown cell 2"),
        (["#####", "#g#r#", "#####"], r"no way from the start \(1, 3\) to the goal \(1, 1\)"),
        (["#####", "#g#.#", "##r.#", "#####"], "no way"),
    ],
)
def test_bad_maps(maze_map, message):
    with pytest.raises(ValueError, match=f"maze_map: .*{message}"):
        Maze(maze_map)
