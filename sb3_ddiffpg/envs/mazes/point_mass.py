"""Point masses that slide along the walls of a maze, many moved by the same array operations."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_ddiffpg.envs.mazes.drawing import Image, draw_body
from sb3_ddiffpg.envs.mazes.maze import CELL_SIZE, FloatArray, MazeMap
from sb3_ddiffpg.envs.mazes.simulation import MazeSimulation
from sb3_ddiffpg.envs.world_change import WorldChange

#: Seconds per step.
DT = 0.1
#: Half the side of the square body, in metres.
HALF_SIZE = 0.4
#: Share of the velocity that lasts from one step to the next; the action commands the rest.
INERTIA = 0.6

_START_NOISE = {"V1": (1.0, 2.0)}


class PointSimulation(MazeSimulation):
    """
    n point masses, each in a copy of one maze of its own, moved together.

    An action a in [-1, 1]^2 sets the velocity to 0.6 v + 0.4 max_speed a. Then x and after it y moves by 0.1 s of it;
    where the square body (0.8 m) would overlap a wall that axis keeps its position and loses its velocity, so that
    bodies slide along walls. All arithmetic is elementwise in float64: what a body does depends on no other.

    :param n: number of bodies
    :param maze_map: name or map of a :class:`~sb3_ddiffpg.envs.mazes.maze.Maze`
    :param start_noise: a body begins uniformly within this distance of the start, in x and y; one number or a pair.
        None: (1, 2) in maze V1, 0.5 in every other
    :param goal_rewards: reward for reaching each goal, in reading order of the map.
        None: (2, 1) in maze V2, 1 for every goal elsewhere
    :param goal_radius: a goal is reached within this distance of its centre, in metres; at most half a cell
    :param max_speed: speed per axis that an action of 1 commands, in m/s; at most 20, half a cell per step
    :param n_blocked: gap cells that are walled in each episode, see :class:`MazeSimulation`
    :param changes: what is different in the world, a dict or a :class:`~sb3_ddiffpg.envs.WorldChange`
    :raises ValueError: if an argument is out of its range or the start box overlaps a wall
    """

    half_size = HALF_SIZE
    action_dim = 2
    body = "a point mass"
    changeable = ("motor_strength", "friction", "n_blocked", "ends_at_goal")

    def __init__(
        self,
        n: int,
        maze_map: MazeMap = "V1",
        start_noise: float | tuple[float, float] | None = None,
        goal_rewards: Sequence[float] | None = None,
        goal_radius: float = 1.0,
        max_speed: float = 8.0,
        n_blocked: int = 0,
        changes: WorldChange | Mapping[str, Any] | None = None,
    ) -> None:
        if start_noise is None:
            start_noise = _START_NOISE.get(maze_map, 0.5) if isinstance(maze_map, str) else 0.5
        if not 0 < max_speed <= CELL_SIZE / 2 / DT:
            raise ValueError(f"max_speed: {max_speed} given; accepted are numbers above 0, at most {CELL_SIZE / 2 / DT}")
        super().__init__(n, maze_map, start_noise, goal_rewards, goal_radius, n_blocked, changes)
        self.max_speed = max_speed
        lost = (1 - INERTIA) * self.changes.friction
        if lost > 1:
            raise ValueError(
                f"changes.friction: {self.changes.friction} given; accepted of a point mass are 0 to {1 / (1 - INERTIA)}"
            )
        self._lasting = 1 - lost
        strengths = np.array(self.changes.shares("motor_strength", 2))
        # Velocity that an action of 1 adds in one step, per axis, shape (2, 1)
        self._push = ((1 - INERTIA) * max_speed * strengths)[:, None]
        # Rows x, y, vx, vy: each contiguous.
        self._state = np.zeros((4, n))
        self._walls = np.tile(self.maze.walls.ravel(), (n, 1)) if self.has_obstacles else None

    def observation_space(self) -> spaces.Box:
        """
        :return: position (m) within the cells that can be reached, velocity (m/s) within ``max_speed``
        """
        fastest = np.full(2, self.max_speed)
        low = np.concatenate([self.maze.low, -fastest]).astype(np.float32)
        high = np.concatenate([self.maze.high, fastest]).astype(np.float32)
        return spaces.Box(low, high, dtype=np.float32)

    def observations(self) -> npt.NDArray[np.float32]:
        """
        :return: x, y, vx, vy of every body, shape (n, 4)
        """
        return self._state.T.astype(np.float32, order="C")

    def positions(self) -> FloatArray:
        """
        :return: (x, y) of every body, shape (n, 2)
        """
        return self._state[:2].T

    def _place(self, indices: Sequence[int] | npt.NDArray[np.intp], positions: FloatArray) -> None:
        self._state[:2, indices] = positions.T
        self._state[2:, indices] = 0.0
        if self._walls is not None:
            for i in indices:
                walls = self.maze.walls.copy()
                for cell in self.blocked[i]:
                    walls[cell] = True
                self._walls[i] = walls.ravel()

    def _move(self, actions: npt.NDArray[Any]) -> None:
        position, velocity = self._state[:2], self._state[2:]
        velocity *= self._lasting
        velocity += self._push * actions.T
        if self.changes.friction < 1:  # else it cannot become faster
            velocity.clip(-self.max_speed, self.max_speed, out=velocity)
        for axis in (0, 1):
            target = [position[0], position[1]]
            target[axis] = position[axis] + velocity[axis] * DT
            free = ~self.maze.blocked(target[0], target[1], HALF_SIZE, self._walls)
            np.copyto(position[axis], target[axis], where=free)
            velocity[axis] *= free

    def draw(self, i: int) -> Image:
        """
        :param i: index of a body
        :return: RGB image of the maze and this body, shape (height, width, 3)
        """
        image = self.background(i)
        draw_body(image, self.maze, self._state[:2, i], HALF_SIZE)
        return image
