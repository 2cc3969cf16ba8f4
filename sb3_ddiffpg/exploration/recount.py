"""Visits of all stored steps, counted again in other cells."""

import numpy as np
import torch as th

from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.exploration.cells import CellGrid
from sb3_ddiffpg.exploration.episode_cells import first_visits
from sb3_ddiffpg.exploration.novelty import VisitCounts
from sb3_ddiffpg.exploration.visit_map import VisitMap

# Rows that are read at a time
_AT_A_TIME = 50_000


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
    for some in np.array_split(rows, -(-len(rows) // _AT_A_TIME)) if len(rows) else []:
        positions = buffer.positions(buffer.nexts, "next_observations", some)
        if counts is not None:
            counts.observe(th.as_tensor(positions[buffer.counted[some]], device=counts.counts.device))
        if visit_map is not None:
            visit_map.observe(positions)
    for episode in buffer.episodes() if first else []:
        start = buffer.positions(buffer.steps, "observations", episode[:1])
        reached = buffer.positions(buffer.nexts, "next_observations", episode)
        buffer.first_visits[episode] = first_visits(np.concatenate((start, reached)), grid)[1:]
