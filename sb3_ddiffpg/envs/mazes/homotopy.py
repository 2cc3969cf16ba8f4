"""The routes of many bodies through one maze, kept step by step as reduced words."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from sb3_ddiffpg.envs.mazes.maze import FloatArray, Maze, append_crossing, format_label
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert


class _TrackerState(msgspec.Struct, forbid_unknown_fields=True):
    positions: np.ndarray
    words: list[list[str]]


class HomotopyTracker:
    """
    Keeps the reduced words of n bodies that move through one maze together.

    :param maze: the maze
    :param n: number of bodies
    """

    def __init__(self, maze: Maze, n: int) -> None:
        self.maze = maze
        self._positions = np.tile(maze.start, (n, 1))
        self._words: list[list[str]] = [[] for _ in range(n)]

    def reset(self, indices: Sequence[int] | npt.NDArray[np.intp], positions: npt.ArrayLike) -> None:
        """
        Begin new routes. Each word starts with the straight line from the start's centre to the position given.

        :param indices: which bodies, shape (k,)
        :param positions: where they begin, shape (k, 2)
        """
        positions = np.asarray(positions, dtype=np.float64)
        for i in indices:
            self._words[i] = []
        self._positions[indices] = positions
        for row, letter in self.maze.crossings(np.broadcast_to(self.maze.start, positions.shape), positions):
            append_crossing(self._words[indices[row]], letter)

    def step(self, positions: FloatArray) -> None:
        """
        :param positions: where all bodies are now, having moved straight there, shape (n, 2)
        """
        for i, letter in self.maze.crossings(self._positions, positions):
            append_crossing(self._words[i], letter)
        self._positions[:] = positions

    def state_dict(self) -> dict[str, Any]:
        """
        :return: positions and words, for ``load_state_dict``
        """
        return {"positions": self._positions, "words": self._words}

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: what ``state_dict`` gave
        :raises ValueError: if it is of other bodies
        """
        known = convert(state, _TrackerState, "routes")
        positions = check_array(known.positions, np.float64, self._positions.shape, "routes.positions")
        letters = {case for cut in self.maze.cuts for case in (cut.letter, cut.letter.upper())}
        if len(known.words) != len(self._words) or not letters.issuperset(set().union(*known.words)):
            raise ValueError(f"routes: the words of {len(known.words)} bodies do not fit {len(self._words)} in this maze")
        self._positions, self._words = positions.copy(), known.words

    def word(self, i: int) -> str:
        """
        :param i: index of a body
        :return: reduced word of its route so far
        """
        return "".join(self._words[i])

    def label(self, i: int, goal_id: int) -> str:
        """
        :param i: index of a body that has reached a goal
        :param goal_id: index of the goal
        :return: the mode of its route, equal to :meth:`Maze.label` of its positions
        """
        word = list(self._words[i])
        for _, letter in self.maze.crossings(self._positions[i : i + 1], self.maze.goals[goal_id : goal_id + 1]):
            append_crossing(word, letter)
        return format_label(goal_id, "".join(word))
