"""Visits of all stored steps, counted again in other cells."""

import numpy as np
import torch as th

from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.exploration.cells import CellGrid
from sb3_ddiffpg.exploration.episode_cells import first_visits
from sb3_ddiffpg.exploration.novelty import VisitCounts
from sb3_ddiffpg.exploration.visit_map import VisitMap

#: Rows of which visits are counted, or taken back, at a time
AT_A_TIME = 50_000


def places_of(buffer: ModeReplayBuffer, rows: np.ndarray) -> np.ndarray:
    """
    :param buffer: Holds an episode
    :param rows: Its rows, at least one, shape [length]
    :return: Mode features where it started, and those that it reached, shape [length + 1, dim]
    """
    start = buffer.positions(buffer.steps, "observations", rows[:1])
    return np.concatenate((start, buffer.positions(buffer.nexts, "next_observations", rows)))


def count_again(
    buffer: ModeReplayBuffer, grid: CellGrid, counts: VisitCounts | None, visit_map: VisitMap | None, first: bool
) -> None:
    """
    :param buffer: Holds the steps
    :param grid: Cells that have a size
    :param counts: Empty, of novelty; None: novelty counts nothing
    :param visit_map: Empty, for pictures; None: it is not to be filled
    :param first: Whether to note anew which steps saw a cell first in their episode
    """
    rows = buffer.stored_rows.rows[: buffer.stored_rows.size]
    for some in np.array_split(rows, -(-len(rows) // AT_A_TIME)) if len(rows) else []:
        positions = buffer.positions(buffer.nexts, "next_observations", some)
        if counts is not None:
            counts.observe(th.as_tensor(positions[buffer.counted[some]], device=counts.counts.device))
        if visit_map is not None:
            visit_map.observe(positions)
    for episode in buffer.episodes() if first else []:
        buffer.first_visits[episode] = first_visits(places_of(buffer, episode), grid)[1:]
