"""Point masses that slide along the walls of a maze, many moved by the same array operations."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_ddiffpg.envs.drawing import Image, draw_body, draw_maze
from sb3_ddiffpg.envs.mazes import CELL_SIZE, FloatArray, HomotopyTracker, Maze, MazeMap

#: Seconds per step.
DT = 0.1
#: Half the side of the square body, in metres.
HALF_SIZE = 0.4
#: Share of the velocity that lasts from one step to the next; the action commands the rest.
INERTIA = 0.6

_START_NOISE = {"V1": (1.0, 2.0)}
_GOAL_REWARDS = {"V2": (2.0, 1.0)}


class PointSimulation:
    """
    n point masses, each in a copy of one maze of its own, moved together.

    An action a in [-1, 1]^2 sets the velocity to 0.6 v + 0.4 max_speed a. Then x and after it y moves by 0.1 s of it;
    where the square body (0.8 m) would overlap a wall that axis keeps its position and loses its velocity, so that
    bodies slide along walls. All arithmetic is elementwise in float64: what a body does depends on no other.

    :param n: number of bodies
    :param maze_map: name or map of a :class:`~sb3_ddiffpg.envs.mazes.Maze`
    :param start_noise: a body begins uniformly within this distance of the start, in x and y; one number or a pair.
        None: (1, 2) in maze V1, 0.5 in every other
    :param goal_rewards: reward for reaching each goal, in reading order of the map.
        None: (2, 1) in maze V2, 1 for every goal elsewhere
    :param goal_radius: a goal is reached within this distance of its centre, in metres; at most half a cell
    :param max_speed: speed per axis that an action of 1 commands, in m/s; at most 20, half a cell per step
    :raises ValueError: if an argument is out of its range or the start box overlaps a wall
    """

    def __init__(
        self,
        n: int,
        maze_map: MazeMap = "V1",
        start_noise: float | tuple[float, float] | None = None,
        goal_rewards: Sequence[float] | None = None,
        goal_radius: float = 1.0,
        max_speed: float = 8.0,
    ) -> None:
        self.maze = Maze(maze_map)
        name = self.maze.name or ""
        if start_noise is None:
            start_noise = _START_NOISE.get(name, 0.5)
        if goal_rewards is None:
            goal_rewards = _GOAL_REWARDS.get(name, (1.0,) * len(self.maze.goals))
        if np.shape(start_noise) not in ((), (2,)) or np.min(start_noise) < 0:
            raise ValueError(f"start_noise: {start_noise} given; accepted are a number >= 0 or a pair of them")
        if np.shape(goal_rewards) != (len(self.maze.goals),):
            raise ValueError(
                f"goal_rewards: {goal_rewards} given; accepted is one per goal, and there are {len(self.maze.goals)}"
            )
        if not 0 < goal_radius <= CELL_SIZE / 2:
            raise ValueError(f"goal_radius: {goal_radius} given; accepted are numbers above 0, at most {CELL_SIZE / 2}")
        if not 0 < max_speed <= CELL_SIZE / 2 / DT:
            raise ValueError(f"max_speed: {max_speed} given; accepted are numbers above 0, at most {CELL_SIZE / 2 / DT}")
        reach = np.broadcast_to(np.asarray(start_noise, dtype=np.float64), 2) + HALF_SIZE
        if not self.maze.is_open_box(self.maze.start - reach, self.maze.start + reach):
            raise ValueError(f"start_noise: {start_noise} given, but a body started that far from 'r' can overlap a wall")

        self.n = n
        self.start_noise = reach - HALF_SIZE
        self.goal_radius = goal_radius
        self.max_speed = max_speed
        # One more entry for -1, "no goal".
        self.rewards = np.array([*goal_rewards, 0.0])
        self._tracker = HomotopyTracker(self.maze, n)
        self._background: Image | None = None
        # Rows x, y, vx, vy: each contiguous.
        self._state = np.zeros((4, n))

    def observation_space(self) -> spaces.Box:
        """
        :return: position (m) within the cells that can be reached, velocity (m/s) within ``max_speed``
        """
        fastest = np.full(2, self.max_speed)
        low = np.concatenate([self.maze.low, -fastest]).astype(np.float32)
        high = np.concatenate([self.maze.high, fastest]).astype(np.float32)
        return spaces.Box(low, high, dtype=np.float32)

    def action_space(self) -> spaces.Box:
        """
        :return: commanded velocity per axis, in units of ``max_speed``
        """
        return spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)

    def observations(self) -> npt.NDArray[np.float32]:
        """
        :return: x, y, vx, vy of every body, shape (n, 4)
        """
        return self._state.T.astype(np.float32, order="C")

    def draw_start(self, rng: np.random.Generator, options: dict[str, Any] | None) -> FloatArray:
        """
        :param rng: of the environment that is reset
        :param options: ``{"position": (x, y)}`` begins exactly there
        :return: where a body begins, shape (2,)
        :raises ValueError: if there are other options, or a body there would overlap a wall
        """
        if not options:
            return self.maze.start + self.start_noise * rng.uniform(-1.0, 1.0, size=2)
        if set(options) != {"position"}:
            raise ValueError(f"options: {sorted(options)} given; accepted is 'position' alone")
        position = np.asarray(options["position"], dtype=np.float64)
        if position.shape != (2,) or not self.maze.is_open_box(position - HALF_SIZE, position + HALF_SIZE):
            raise ValueError(f"options: position {options['position']} given; accepted is a pair (x, y) clear of walls")
        return position

    def place(self, indices: Sequence[int] | npt.NDArray[np.intp], positions: npt.ArrayLike) -> None:
        """
        Begin new episodes, at rest.

        :param indices: which bodies, shape (k,)
        :param positions: where, shape (k, 2)
        """
        self._state[:2, indices] = np.asarray(positions).T
        self._state[2:, indices] = 0.0
        self._tracker.reset(indices, positions)

    def move(self, actions: npt.NDArray[Any]) -> npt.NDArray[np.intp]:
        """
        Move all bodies by one step.

        :param actions: clipped to [-1, 1], shape (n, 2)
        :return: index of the goal that each has reached, -1 where none, shape (n,)
        :raises ValueError: if an action is not a number or their shape is wrong
        """
        if actions.shape != (self.n, 2) or not np.isfinite(actions).all():
            raise ValueError(f"actions: shape {actions.shape} given; accepted are finite numbers of shape {(self.n, 2)}")
        position, velocity = self._state[:2], self._state[2:]
        velocity *= INERTIA
        velocity += (1 - INERTIA) * self.max_speed * np.clip(actions.T.astype(np.float64), -1.0, 1.0)
        for axis in (0, 1):
            target = [position[0], position[1]]
            target[axis] = position[axis] + velocity[axis] * DT
            free = ~self.maze.blocked(target[0], target[1], HALF_SIZE)
            np.copyto(position[axis], target[axis], where=free)
            velocity[axis] *= free
        self._tracker.step(position.T)
        offsets = position[:, None] - self.maze.goals.T[:, :, None]
        reached = (offsets**2).sum(axis=0) <= self.goal_radius**2
        return np.where(reached.any(axis=0), reached.argmax(axis=0), -1)

    def label(self, i: int, goal_id: int) -> str:
        """
        :param i: index of a body
        :param goal_id: the goal that it has reached
        :return: ground-truth mode of its episode
        """
        return self._tracker.label(i, goal_id)

    def draw(self, i: int) -> Image:
        """
        :param i: index of a body
        :return: RGB image of the maze and this body, shape (height, width, 3)
        """
        if self._background is None:
            self._background = draw_maze(self.maze, self.goal_radius)
        image = self._background.copy()
        draw_body(image, self.maze, self._state[:2, i], HALF_SIZE)
        return image
