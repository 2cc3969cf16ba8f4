"""What all bodies in mazes have in common: starts, goals, obstacles that change, and the label of the route taken."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from math import comb
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_ddiffpg.envs.mazes.drawing import OBSTACLE, Image, draw_maze, fill_square
from sb3_ddiffpg.envs.mazes.homotopy import HomotopyTracker
from sb3_ddiffpg.envs.mazes.maze import CELL_SIZE, FloatArray, Maze, MazeMap, cell_distances
from sb3_ddiffpg.envs.world_change import WorldChange
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert

Cell = tuple[int, int]

# Sets of blocked cells that are listed and checked at the beginning
_MOST_CHOICES = 10_000


class Start(NamedTuple):
    """Where a body begins an episode, and which gap cells are walled in it."""

    position: FloatArray
    blocked: tuple[Cell, ...] = ()


class _State(msgspec.Struct, forbid_unknown_fields=True):
    bodies: np.ndarray
    blocked: list[list[Cell]]
    routes: Any


class MazeSimulation:
    """
    n bodies, each in a copy of one maze of its own, moved together. Subclasses say what the bodies are.

    :param n: number of bodies
    :param maze_map: name or map of a :class:`~sb3_ddiffpg.envs.mazes.maze.Maze`
    :param start_noise: a body begins uniformly within this distance of the start, in x and y; one number or a pair
    :param goal_rewards: reward for reaching each goal, in reading order of the map.
        None: (2, 1) in maze V2, 1 for every goal elsewhere
    :param goal_radius: a goal is reached within this distance of its centre, in metres; at most half a cell
    :param n_blocked: so many of the maze's gap cells (:attr:`Maze.gap_cells`) are walled in each episode, drawn anew such that
        every goal can still be reached
    :param changes: what is different in the world, a dict or a :class:`~sb3_ddiffpg.envs.WorldChange`
    :raises ValueError: if an argument is out of its range or the start box overlaps a wall
    """

    #: Half the side of the square in which a body fits, in metres.
    half_size: float
    #: Of all bodies, as the subclass arranges it.
    _state: FloatArray
    #: Components of an action.
    action_dim: int
    #: What a body is, in words, and what of it can be different, see :class:`~sb3_ddiffpg.envs.WorldChange`.
    body: str
    changeable: tuple[str, ...]

    def __init__(
        self,
        n: int,
        maze_map: MazeMap,
        start_noise: float | tuple[float, float],
        goal_rewards: Sequence[float] | None,
        goal_radius: float,
        n_blocked: int,
        changes: WorldChange | Mapping[str, Any] | None,
    ) -> None:
        self.maze = Maze(maze_map)
        self.changes = WorldChange.of(changes)
        self.changes.check(f"{self.body} in a maze", self.changeable)
        if goal_rewards is None:
            goal_rewards = (2.0, 1.0) if self.maze.name == "V2" else (1.0,) * len(self.maze.goals)
        if np.shape(start_noise) not in ((), (2,)) or np.min(start_noise) < 0:
            raise ValueError(f"start_noise: {start_noise} given; accepted are a number >= 0 or a pair of them")
        if np.shape(goal_rewards) != (len(self.maze.goals),):
            raise ValueError(
                f"goal_rewards: {goal_rewards} given; accepted is one per goal, and there are {len(self.maze.goals)}"
            )
        if not 0 < goal_radius <= CELL_SIZE / 2:
            raise ValueError(f"goal_radius: {goal_radius} given; accepted are numbers above 0, at most {CELL_SIZE / 2}")
        noise = np.broadcast_to(np.asarray(start_noise, dtype=np.float64), 2)
        reach = noise + self.half_size
        if not self.maze.is_open_box(self.maze.start - reach, self.maze.start + reach):
            raise ValueError(f"start_noise: {start_noise} given, but a body started that far from 'r' can overlap a wall")

        self.n = n
        self.start_noise = noise
        self.goal_radius = goal_radius
        # One more entry for -1, "no goal".
        self.rewards = np.array([*goal_rewards, 0.0])
        every_goal = self.changes.n_blocked is None
        n_blocked = n_blocked if self.changes.n_blocked is None else self.changes.n_blocked
        solvable = self._solvable_choices(n_blocked, every_goal)
        self._choices = [cells for cells in solvable if self._is_clear(cells, self.maze.start, reach)]
        if not self._choices:
            raise ValueError(f"n_blocked: {n_blocked} given, but wherever they are, they stand on the start")
        #: Whether gap cells can be walled
        self.has_obstacles = n_blocked > 0
        self.blocked: list[tuple[Cell, ...]] = [()] * n
        self._tracker = HomotopyTracker(self.maze, n)
        self._background: Image | None = None

    # ------------------------------------------------------------------ what a body is

    def observation_space(self) -> spaces.Box:
        """
        :return: of one body
        """
        raise NotImplementedError

    def action_space(self) -> spaces.Box:
        """
        :return: of one body, within [-1, 1]
        """
        return spaces.Box(-1.0, 1.0, shape=(self.action_dim,), dtype=np.float32)

    def observations(self) -> npt.NDArray[np.float32]:
        """
        :return: of every body, shape (n, observation dim)
        """
        raise NotImplementedError

    def positions(self) -> FloatArray:
        """
        :return: (x, y) of every body, shape (n, 2)
        """
        raise NotImplementedError

    def _place(self, indices: Sequence[int] | npt.NDArray[np.intp], positions: FloatArray) -> None:
        """Put bodies (k,) at positions (k, 2), at rest; their obstacles stand already."""
        raise NotImplementedError

    def _move(self, actions: npt.NDArray[Any]) -> None:
        """Move all bodies by one step, actions (n, action_dim) in [-1, 1]."""
        raise NotImplementedError

    def draw(self, i: int) -> Image:
        """
        :param i: index of a body
        :return: RGB image of the maze and this body, shape (height, width, 3)
        """
        raise NotImplementedError

    def close(self) -> None:
        """Release what pictures needed."""

    # ------------------------------------------------------------------ episodes

    def draw_start(self, rng: np.random.Generator, options: dict[str, Any] | None) -> Start:
        """
        :param rng: of the environment that is reset
        :param options: ``{"position": (x, y)}`` begins exactly there, ``{"blocked": [(row, column), ...]}`` walls exactly
            these gap cells
        :return: where a body begins, and behind what
        :raises ValueError: if there are other options, a body there would overlap a wall, or no goal could be reached
        """
        options = options or {}
        accepted = {"position", "blocked"} if self.has_obstacles else {"position"}
        if not set(options) <= accepted:
            raise ValueError(f"options: {sorted(options)} given; accepted are {sorted(accepted)}")
        if "position" in options:
            position = np.asarray(options["position"], dtype=np.float64)
            if position.shape != (2,) or not self.maze.is_open_box(position - self.half_size, position + self.half_size):
                raise ValueError(f"options: position {options['position']} given; accepted is a pair (x, y) clear of walls")
        else:
            position = self.maze.start + self.start_noise * rng.uniform(-1.0, 1.0, size=2)
        if not self.has_obstacles:
            return Start(position)
        if "blocked" in options:
            blocked = self._checked(options["blocked"])
            if not self._is_clear(blocked, position, self.half_size):
                raise ValueError(f"options: blocked {options['blocked']} given, but the body begins there")
            return Start(position, blocked)
        choices = self._choices
        if "position" in options:
            choices = [cells for cells in choices if self._is_clear(cells, position, self.half_size)]
            if not choices:
                raise ValueError(f"options: position {options['position']} given, where obstacles always stand")
        return Start(position, choices[rng.integers(len(choices))])

    def place(self, indices: Sequence[int] | npt.NDArray[np.intp], starts: Sequence[Start]) -> None:
        """
        Begin new episodes, at rest.

        :param indices: which bodies, shape (k,)
        :param starts: where, k of them
        """
        for i, start in zip(indices, starts, strict=True):
            self.blocked[i] = start.blocked
        positions = np.array([start.position for start in starts])
        self._place(indices, positions)
        self._tracker.reset(indices, positions)

    def move(self, actions: npt.NDArray[Any]) -> npt.NDArray[np.intp]:
        """
        Move all bodies by one step.

        :param actions: clipped to [-1, 1], shape (n, action_dim)
        :return: index of the goal that each has reached, -1 where none, shape (n,)
        :raises ValueError: if an action is not a number or their shape is wrong
        """
        if actions.shape != (self.n, self.action_dim) or not np.isfinite(actions).all():
            raise ValueError(
                f"actions: shape {actions.shape} given; accepted are finite numbers of shape {(self.n, self.action_dim)}"
            )
        self._move(np.clip(actions.astype(np.float64), -1.0, 1.0))
        positions = self.positions()
        self._tracker.step(positions)
        offsets = positions.T[:, None] - self.maze.goals.T[:, :, None]
        reached = (offsets**2).sum(axis=0) <= self.goal_radius**2
        return np.where(reached.any(axis=0), reached.argmax(axis=0), -1)

    def lost(self) -> npt.NDArray[np.bool_]:
        """
        :return: whether each body cannot go on, so that its episode ends, shape (n,)
        """
        return np.zeros(self.n, dtype=bool)

    def state_dict(self) -> dict[str, Any]:
        """
        :return: where every body's episode is, for ``load_state_dict``
        """
        blocked = [[list(cell) for cell in cells] for cells in self.blocked]
        return {"bodies": self._state, "blocked": blocked, "routes": self._tracker.state_dict()}

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: what ``state_dict`` gave
        :raises ValueError: if it is of other bodies or another maze
        """
        known = convert(state, _State, "simulation")
        bodies = check_array(known.bodies, self._state.dtype, self._state.shape, "simulation.bodies")
        if not np.isfinite(bodies).all():
            raise ValueError("simulation.bodies: not finite")
        if len(known.blocked) != self.n:
            raise ValueError(f"simulation.blocked: of {len(known.blocked)} bodies, there are {self.n}")
        blocked = [self._checked(cells) if cells else () for cells in known.blocked]
        self._tracker.load_state_dict(known.routes)
        self.blocked = blocked
        self._place(range(self.n), self.positions())  # what stands around them
        self._state = bodies.copy()

    def label(self, i: int, goal_id: int) -> str:
        """
        :param i: index of a body
        :param goal_id: the goal that it has reached
        :return: ground-truth mode of its episode
        """
        return self._tracker.label(i, goal_id)

    def background(self, i: int) -> Image:
        """
        :param i: index of a body
        :return: a picture of the maze around it, its obstacles included; the caller's own
        """
        if self._background is None:
            self._background = draw_maze(self.maze, self.goal_radius)
        image = self._background.copy()
        for cell in self.blocked[i]:
            fill_square(image, self.maze, self.maze.cell_center(cell), CELL_SIZE / 2, OBSTACLE)
        return image

    # ------------------------------------------------------------------ obstacles

    def _solvable_choices(self, n_blocked: int, every_goal: bool) -> list[tuple[Cell, ...]]:
        """All sets of so many gap cells that leave a way to every goal, or to one."""
        if n_blocked == 0:
            return [()]
        gaps = self.maze.gap_cells
        if not 0 <= n_blocked <= len(gaps):
            raise ValueError(f"n_blocked: {n_blocked} given; accepted are 0 to {len(gaps)}, the gap cells of this maze")
        if comb(len(gaps), n_blocked) > _MOST_CHOICES:
            raise ValueError(f"n_blocked: {n_blocked} of {len(gaps)} gap cells are more than {_MOST_CHOICES} choices")
        least = len(self.maze.goals) if every_goal else 1
        choices = [cells for cells in combinations(gaps, n_blocked) if len(self._reachable(cells)) >= least]
        if not choices:
            which = "a goal cannot" if every_goal else "no goal can"
            raise ValueError(f"n_blocked: {n_blocked} given, but wherever they are, {which} be reached")
        return choices

    def _is_clear(self, blocked: tuple[Cell, ...], position: FloatArray, reach: FloatArray | float) -> bool:
        """Whether no obstacle comes within reach of a position, in x and y."""
        offsets = [np.abs(self.maze.cell_center(cell) - position) - reach for cell in blocked]
        return all((offset >= CELL_SIZE / 2).any() for offset in offsets)

    def _reachable(self, blocked: tuple[Cell, ...]) -> list[int]:
        """Goals that can be reached behind these obstacles."""
        free = ~self.maze.walls
        for cell in blocked:
            free[cell] = False
        distances = cell_distances(free, self.maze.start_cell)
        return [goal for goal, cell in enumerate(self.maze.goal_cells) if distances[cell] >= 0]

    def _checked(self, cells: Any) -> tuple[Cell, ...]:
        blocked = tuple(sorted({(int(i), int(j)) for i, j in cells}))
        if not set(blocked) <= set(self.maze.gap_cells):
            raise ValueError(f"options: blocked {cells} given; accepted are gap cells of this maze: {self.maze.gap_cells}")
        if not self._reachable(blocked):
            raise ValueError(f"options: blocked {cells} given, but then no goal can be reached")
        return blocked
