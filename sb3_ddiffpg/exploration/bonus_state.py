"""What an exploration bonus knows, in plain values and arrays."""

from typing import Any

import msgspec
import numpy as np

from sb3_ddiffpg.exploration.known_regions import NO_ROUTE
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert


class SavedRoute(msgspec.Struct, forbid_unknown_fields=True):
    """Where the trajectories of a mode go."""

    number: int
    paths: np.ndarray
    radius: float


class SavedCells(msgspec.Struct, forbid_unknown_fields=True):
    """Entries of the cells where a mode goes."""

    number: int
    entries: np.ndarray


class SavedEpisode(msgspec.Struct, forbid_unknown_fields=True):
    """Of a running episode in parts: what no stored step says."""

    env: int
    seen: np.ndarray
    been: np.ndarray
    followed: int


class BonusState(msgspec.Struct, forbid_unknown_fields=True):
    """What an ``ExplorationBonus`` knows beside parameters."""

    routes: list[SavedRoute]
    cells: list[SavedCells]
    visits: Any
    episodes: list[SavedEpisode] | None = None
    edges: np.ndarray | None = None  # of cells that follow what is seen


def bonus_state(tree: Any, dim: int, n_entries: int) -> BonusState:
    """
    :param tree: What ``ExplorationBonus.state_dict`` gave
    :param dim: Number of mode features
    :param n_entries: Of its table of known cells
    :return: The same, checked
    :raises ValueError: If it is something else
    """
    state = convert(tree, BonusState, "bonus")
    for each in state.routes:
        check_array(each.paths, np.float32, [None, None, dim], "bonus.routes")
        if not (0 <= each.number < 2**31 and each.paths.size and np.isfinite(each.paths).all() and 0 <= each.radius < np.inf):
            raise ValueError("bonus.routes: there is a route that cannot be")
    for cells in state.cells:
        check_array(cells.entries, np.int64, [None], "bonus.cells")
        if ((cells.entries < 0) | (cells.entries >= n_entries)).any():
            raise ValueError("bonus.cells: there is a cell that cannot be")
    for episode in state.episodes or ():
        check_array(episode.seen, np.int64, [None], "bonus.episodes.seen")
        check_array(episode.been, np.int64, [len(state.routes)], "bonus.episodes.been")
        if not (0 <= episode.env < 2**31 and NO_ROUTE <= episode.followed < 2**31):
            raise ValueError("bonus.episodes: there is one that cannot be")
    if state.edges is not None:
        check_array(state.edges, np.float64, [None], "bonus.edges")
        if not (state.edges > 0).all():
            raise ValueError("bonus.edges: there is a cell that cannot be")
    return state
