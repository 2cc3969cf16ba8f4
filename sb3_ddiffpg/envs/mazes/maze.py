"""
Mazes: the map, its walls, and which way round the walls a route went.

Positions are in metres, x to the right and y upwards. The centre of the start cell is the origin.
"""

import re
from collections import deque
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

#: Of a map: islands are found and told apart in a second then.
MOST_CELLS = 20_000
#: Side of a map cell, in metres.
CELL_SIZE = 4.0

V1 = ("#####", "#...#", "#g#r#", "#...#", "#####")
V2 = ("#######", "#g###.#", "#.###.#", "#..r.g#", "#.###.#", "#.###.#", "#######")
V3 = (
    "#########",
    "#g......#",
    "#.##..#.#",
    "#.....#.#",
    "#.#.r...#",
    "#.....#.#",
    "#.##....#",
    "#.....#g#",
    "#########",
)
V4 = ("#######", "#...#.#", "#g#...#", "#...#r#", "#g#...#", "#...#.#", "#######")

#: The maps of the DDiffPG paper, by name.
MAZES = {"V1": V1, "V2": V2, "V3": V3, "V4": V4}

#: The routes the paper counts in each of them, as labels (see :meth:`Maze.label`).
LISTED_ROUTES = {
    "V1": ("0:-", "0:a"),
    "V2": ("0:-", "1:-"),
    "V3": ("0:a", "0:c", "0:e", "1:-", "1:D"),
    "V4": ("0:ba", "0:bc", "1:-", "1:c"),
}

FloatArray = npt.NDArray[np.float64]
MazeMap = str | Sequence[Sequence[str | int]]

_CELL_SYMBOLS = {"#": "#", "1": "#", ".": ".", "0": ".", "r": "r", "g": "g"}
_SIDES = ((-1, 0), (0, -1), (0, 1), (1, 0))
_DIAGONALS = ((-1, -1), (-1, 1), (1, -1), (1, 1))


class Cut(NamedTuple):
    """A vertical line from an island of walls up to the next wall, whose crossings are written down."""

    letter: str
    x: float
    y_low: float
    y_high: float


def cell_distances(free: npt.NDArray[np.bool_], cell: tuple[int, int], diagonal: bool = False) -> npt.NDArray[np.int64]:
    """
    Steps from one cell to every other through free cells.

    :param free: grid of cells that may be entered, shape (rows, columns)
    :param cell: row and column to start from
    :param diagonal: whether cells that share only a corner are neighbours
    :return: shape (rows, columns), -1 where there is no way
    """
    distances = np.full(free.shape, -1)
    distances[cell] = 0
    queue = deque([cell])
    while queue:
        i, j = queue.popleft()
        for di, dj in _SIDES + _DIAGONALS if diagonal else _SIDES:
            k, m = i + di, j + dj
            if 0 <= k < free.shape[0] and 0 <= m < free.shape[1] and free[k, m] and distances[k, m] < 0:
                distances[k, m] = distances[i, j] + 1
                queue.append((k, m))
    return distances


def append_crossing(word: list[str], letter: str) -> None:
    """
    Append a crossing to a reduced word, keeping it reduced.

    :param word: changed in place
    :param letter: cancels the last one if that is the same crossing backwards (the other case)
    """
    if word and word[-1] == letter.swapcase():
        word.pop()
    else:
        word.append(letter)


def _cells_where(mask: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """
    :param mask: grid, shape (rows, columns)
    :return: cells where it holds, in reading order
    """
    return [(i, j) for i, j in np.argwhere(mask).tolist()]


def _has_entries(value: Any) -> bool:
    return isinstance(value, Sequence) or (isinstance(value, np.ndarray) and value.ndim > 0)


def _read_map(maze_map: MazeMap) -> tuple[str, ...]:
    """
    :param maze_map: name or map
    :return: its rows, written with ``#``, ``.``, ``r`` and ``g``
    :raises ValueError: if it is not the map of a maze
    """
    if isinstance(maze_map, str):
        if maze_map not in MAZES:
            raise ValueError(f"maze_map: {maze_map!r} is no known maze; give one of {', '.join(MAZES)} or a list of rows")
        maze_map = MAZES[maze_map]
    if not (_has_entries(maze_map) and all(map(_has_entries, maze_map))):
        raise ValueError(f"maze_map: accepted are a name, or rows of cells, got {maze_map!r}")
    for row in maze_map:
        for cell in row:
            if str(cell) not in _CELL_SYMBOLS:
                raise ValueError(f"maze_map: unknown cell {cell!r}; accepted are 1 or '#' (wall), 0 or '.' (open), 'r', 'g'")
    rows = tuple("".join(_CELL_SYMBOLS[str(cell)] for cell in row) for row in maze_map)
    widths = sorted({len(row) for row in rows})
    if len(widths) != 1:
        raise ValueError(f"maze_map: all rows must be equally long, but their lengths are {widths}")
    border = rows[0] + rows[-1] + "".join(row[:1] + row[-1:] for row in rows)
    if set(border) != {"#"}:
        raise ValueError("maze_map: the outermost cells must all be walls")
    n_starts, n_goals = (sum(row.count(letter) for row in rows) for letter in "rg")
    if n_starts != 1:
        raise ValueError(f"maze_map: there must be exactly one start 'r', but there are {n_starts}")
    if n_goals == 0:
        raise ValueError("maze_map: there must be at least one goal 'g', but there is none")
    if len(rows) * len(rows[0]) > MOST_CELLS:
        raise ValueError(f"maze_map: {len(rows)} x {len(rows[0])} cells given; accepted are up to {MOST_CELLS} in all")
    return rows


def _islands(solid: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """
    Groups of solid cells, joined at sides or corners, that the border is no part of.

    :param solid: cells that cannot be entered, shape (rows, columns); the border is solid
    :return: first cell of each in reading order, in reading order
    """
    seen = cell_distances(solid, (0, 0), diagonal=True) >= 0
    first_cells = []
    for cell in _cells_where(solid):
        if not seen[cell]:
            first_cells.append(cell)
            seen |= cell_distances(solid, cell, diagonal=True) >= 0
    return first_cells


def reduce_word(word: str) -> str:
    """
    Cancel every ``xX`` and ``Xx`` until none is left.

    :param word: letters, each perhaps followed by a number (mazes with more than 26 islands have letters such as ``b1``)
    :return: the reduced word, the same whatever the order of cancelling
    """
    reduced: list[str] = []
    for letter in re.findall(r"[A-Za-z]\d*", word):
        append_crossing(reduced, letter)
    return "".join(reduced)


class Maze:
    """
    A maze of square cells, surrounded by walls, with one start and one or more goals.

    The map is read as gymnasium-robotics reads its ``maze_map``: ``1`` (or ``#``) is a wall, ``0`` (or ``.``) is
    open, ``r`` the start and ``g`` a goal. Goals are numbered in reading order.

    Two routes to a goal are the same *mode* if one can be pulled into the other without passing a wall. To tell them
    apart every island of walls gets a letter and a :class:`Cut`; the letters of the cuts that a route crosses, with
    ``xX`` and ``Xx`` cancelled, are a word that is the same for two routes exactly if they are the same mode.

    :param maze_map: ``"V1"`` to ``"V4"``, or a map as a list of rows, each a string or a list of cells
    :raises ValueError: if the map has ragged rows, unknown cells, an open border, no or several starts, no goal, or a
        goal that cannot be reached
    """

    def __init__(self, maze_map: MazeMap = "V1") -> None:
        self.name = maze_map if isinstance(maze_map, str) else None
        self.rows = _read_map(maze_map)
        cells = np.array([list(row) for row in self.rows])
        #: Wall cells, shape (rows, columns).
        self.walls: npt.NDArray[np.bool_] = cells == "#"
        self.start_cell = _cells_where(cells == "r")[0]
        self.goal_cells = _cells_where(cells == "g")
        self._flat_walls = self.walls.ravel()

        reachable = cell_distances(~self.walls, self.start_cell) >= 0
        self._reachable = reachable
        for cell in self.goal_cells:
            if not reachable[cell]:
                raise ValueError(f"maze_map: there is no way from the start {self.start_cell} to the goal {cell}")
        #: Outer edges of the map: x_min, x_max, y_min, y_max.
        self.extent = self._edges(0, len(self.rows) - 1, 0, len(self.rows[0]) - 1)
        i, j = np.nonzero(reachable)
        x_min, x_max, y_min, y_max = self._edges(i.min(), i.max(), j.min(), j.max())
        #: Corners (x, y) of the box around all cells that can be reached.
        self.low, self.high = np.array([x_min, y_min]), np.array([x_max, y_max])

        self.start: FloatArray = self.cell_center(self.start_cell)
        #: Centres of the goal cells, shape (n_goals, 2).
        self.goals: FloatArray = np.array([self.cell_center(cell) for cell in self.goal_cells])
        #: One cut per island, in the order of their letters.
        self.cuts = [self._cut(k, cell, ~reachable) for k, cell in enumerate(_islands(~reachable))]
        self._cut_x = np.array([cut.x for cut in self.cuts])

    def _edges(self, top: int, bottom: int, left: int, right: int) -> tuple[float, float, float, float]:
        x_min, y_max = self.cell_center((top, left)) + CELL_SIZE / 2 * np.array([-1, 1])
        x_max, y_min = self.cell_center((bottom, right)) + CELL_SIZE / 2 * np.array([1, -1])
        return float(x_min), float(x_max), float(y_min), float(y_max)

    def _cut(self, k: int, cell: tuple[int, int], solid: npt.NDArray[np.bool_]) -> Cut:
        i, j = cell
        ceiling = int(np.flatnonzero(solid[:i, j])[-1])
        letter = chr(ord("a") + k % 26) + (str(k // 26) if k >= 26 else "")
        x, y = self.cell_center(cell)
        y_high = self.cell_center((ceiling, j))[1] - CELL_SIZE / 2
        return Cut(letter, float(x), float(y + CELL_SIZE / 2), float(y_high))

    @property
    def listed_routes(self) -> tuple[str, ...]:
        """Labels of the routes the paper counts in this maze; empty for a map of one's own."""
        return LISTED_ROUTES.get(self.name or "", ())

    @cached_property
    def gap_cells(self) -> list[tuple[int, int]]:
        """
        Passages. Beside islands: the open cells between two walls, one above and one below, in a column where an island has
        its cut. In a maze without islands: of each goal the first cell on the way that leads to it alone.
        """
        if not self.cuts:
            return self._own_cells()
        columns = {round((cut.x - self.extent[0]) / CELL_SIZE - 0.5) for cut in self.cuts}
        middle = np.zeros_like(self.walls)
        middle[1:-1] = self._reachable[1:-1] & ~self._reachable[:-2] & ~self._reachable[2:]
        taken = {self.start_cell, *self.goal_cells}
        return [cell for cell in _cells_where(middle) if cell[1] in columns and cell not in taken]

    def _own_cells(self) -> list[tuple[int, int]]:
        """Of each goal the cell nearest to the start without which it, and no other, is out of reach, in reading order."""
        distances = cell_distances(~self.walls, self.start_cell)
        taken = {self.start_cell, *self.goal_cells}
        own = []
        for goal in self.goal_cells:
            # It lies on every way to the goal, so on this one
            for cell in self._shortest_way(goal, distances):
                free = ~self.walls
                free[cell] = False
                left = cell_distances(free, self.start_cell)
                if cell not in taken and [other for other in self.goal_cells if left[other] < 0] == [goal]:
                    own.append(cell)
                    break
        return sorted(own)

    def _shortest_way(self, goal: tuple[int, int], distances: npt.NDArray[np.int64]) -> list[tuple[int, int]]:
        """Cells from the start to a goal, given the steps from the start to each cell."""
        way = [goal]
        while distances[way[-1]] > 0:
            i, j = way[-1]
            # Walls and closed rooms are at -1, and the border is a wall: no neighbour is outside
            way.append(next((i + di, j + dj) for di, dj in _SIDES if distances[i + di, j + dj] == distances[i, j] - 1))
        return way[::-1]

    def cell_center(self, cell: tuple[int, int]) -> FloatArray:
        """
        :param cell: row and column
        :return: position (x, y) of the cell's centre
        """
        return CELL_SIZE * np.array([cell[1] - self.start_cell[1], self.start_cell[0] - cell[0]], dtype=np.float64)

    def blocked(
        self, x: FloatArray, y: FloatArray, half_size: float, walls: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.bool_]:
        """
        Whether square bodies overlap a wall, or lie outside the map.

        :param x: x of the centres, shape (n,)
        :param y: y of the centres, shape (n,)
        :param half_size: half the side of the bodies, at most half a cell
        :param walls: wall cells of each body's own maze, shape (n, rows * columns); None: the map's
        :return: shape (n,)
        """
        n_rows, n_columns = self.walls.shape
        corners = np.array([[-half_size], [half_size]])
        # No body is larger than a cell, so that a wall below it lies below one of its corners
        columns = ((x + (corners - self.extent[0])) * (1 / CELL_SIZE)).clip(0, n_columns - 1).astype(np.intp)
        rows = (((corners + self.extent[3]) - y) * (1 / CELL_SIZE)).clip(0, n_rows - 1).astype(np.intp)
        cells = (rows * n_columns)[:, None] + columns[None]  # (2, 2, n)
        if walls is None:
            hits = self._flat_walls.take(cells)
        else:
            hits = walls.ravel().take(cells + np.arange(len(walls)) * walls.shape[1])
        return hits[0, 0] | hits[0, 1] | hits[1, 0] | hits[1, 1]

    def is_open_box(self, low: npt.ArrayLike, high: npt.ArrayLike) -> bool:
        """
        :param low: lower left corner (x, y) of a rectangle
        :param high: upper right corner
        :return: whether it touches no wall and lies inside the map
        """
        (left, bottom), (right, top) = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        x_min, x_max, y_min, y_max = self.extent
        if left < x_min or bottom < y_min or right > x_max or top > y_max:
            return False
        columns = np.arange(int((left - x_min) // CELL_SIZE), int(np.ceil((right - x_min) / CELL_SIZE)))
        rows = np.arange(int((y_max - top) // CELL_SIZE), int(np.ceil((y_max - bottom) / CELL_SIZE)))
        return not self.walls[np.ix_(rows, columns)].any()

    def crossings(self, old: FloatArray, new: FloatArray) -> list[tuple[int, str]]:
        """
        The cuts that straight segments cross: a letter leftwards, its capital rightwards.

        :param old: where the segments begin, shape (n, 2)
        :param new: where they end, shape (n, 2)
        :return: pairs (segment, letter), by segment and, within one segment, in the order of crossing
        """
        # A point on the line counts as right of it
        left = new[:, :1] < self._cut_x
        changed = left != (old[:, :1] < self._cut_x)
        if not changed.any():
            return []
        segments, cuts = np.nonzero(changed)
        (x0, y0), (x1, y1) = old[segments].T, new[segments].T
        share = (self._cut_x[cuts] - x0) / (x1 - x0)
        y = y0 + share * (y1 - y0)
        found = []
        for segment, k, s, height in zip(segments.tolist(), cuts.tolist(), share.tolist(), y.tolist(), strict=True):
            cut = self.cuts[k]
            if cut.y_low <= height <= cut.y_high:
                found.append((segment, s, cut.letter if left[segment, k] else cut.letter.upper()))
        return [(segment, letter) for segment, _, letter in sorted(found)]

    def label(self, path: npt.ArrayLike, goal_id: int) -> str:
        """
        Ground-truth mode of a route: the goal it reached and the reduced word of its crossings.

        The word is that of the route prolonged by straight lines to the centres of the start cell and of the goal
        cell, so that where exactly it began and ended makes no difference.

        :param path: positions from near the start to near the goal, shape (length, 2), straight lines in between
        :param goal_id: index of the goal
        :return: for example ``"0:a"``, ``"1:D"``, or ``"0:-"`` for the empty word
        """
        points = np.vstack([self.start, np.asarray(path, dtype=np.float64).reshape(-1, 2), self.goals[goal_id]])
        word: list[str] = []
        for _, letter in self.crossings(points[:-1], points[1:]):
            append_crossing(word, letter)
        return format_label(goal_id, "".join(word))


def format_label(goal_id: int, word: str) -> str:
    """
    :param goal_id: index of the goal
    :param word: reduced word
    :return: the label of a mode, with ``-`` for the empty word
    """
    return f"{goal_id}:{word or '-'}"
