"""The cells that episodes have seen, and which of their steps saw one first."""

import numpy as np
import torch as th

from sb3_ddiffpg.buffers.trajectory import StepRecord
from sb3_ddiffpg.exploration.cells import CellGrid
from sb3_ddiffpg.exploration.novelty import cell_entries

# Of so many numbers two cells of one episode hardly share one
_NUMBERS = 2**31


def numbers_of_cells(positions: np.ndarray, grid: CellGrid) -> list[int]:
    """
    :param positions: Shape [N, dim]
    :param grid: Cells that have a size
    :return: The cell of each, as a number
    """
    assert grid.edges is not None
    edges = th.as_tensor(grid.edges, dtype=th.float32)
    return cell_entries(th.from_numpy(positions), edges, _NUMBERS).tolist() if len(positions) else []


def first_visits(positions: np.ndarray, grid: CellGrid) -> np.ndarray:
    """
    :param positions: Of a whole episode, from its start on, shape [N, dim]
    :param grid: Cells that have a size
    :return: Whether each is the first in its cell, shape [N]
    """
    first = np.zeros(len(positions), dtype=bool)
    first[np.unique(numbers_of_cells(positions, grid), return_index=True)[1]] = True
    return first


class EpisodeCells:
    """
    Follows the running episodes.

    :param n_envs: Number of environments
    """

    def __init__(self, n_envs: int) -> None:
        #: Cells that each running episode has seen
        self.seen: list[set[int]] = [set() for _ in range(n_envs)]

    def observe(self, record: StepRecord, grid: CellGrid) -> list[bool]:
        """
        :param record: Of a step of all environments
        :param grid: Cells that have a size
        :return: Whether each episode saw its place first
        """
        n_started = len(record.started)
        both = np.concatenate((record.start_positions, record.positions)) if n_started else record.positions
        cells = numbers_of_cells(both, grid)
        for env, cell in zip(record.started.tolist(), cells[:n_started], strict=True):
            self.seen[env].add(cell)
        cells = cells[n_started:]
        first = [cell not in seen for cell, seen in zip(cells, self.seen, strict=True)]
        for cell, seen in zip(cells, self.seen, strict=True):
            seen.add(cell)
        return first
