"""How an exploration bonus is made of settings, and of what an environment declares."""

from collections.abc import Callable

from torch import nn

from sb3_ddiffpg.exploration.bonus import ExplorationBonus
from sb3_ddiffpg.exploration.cells import CellGrid
from sb3_ddiffpg.exploration.novelty import NOVELTY_MEASURES
from sb3_ddiffpg.exploration.settings import ExplorationSettings, NoveltySettings


def make_bonus(
    build: Callable[..., nn.Module],
    settings: NoveltySettings,
    exploration: ExplorationSettings | None,
    dims: tuple[int, int],
    n_envs: int,
    counted_cell: float | None,
    seen_cell: float | None,
) -> ExplorationBonus:
    """
    :param build: Makes the measure of its class, its dimensions and its keyword arguments
    :param settings: What is new, and what it is worth
    :param exploration: See ``ExplorationBonus``
    :param dims: Number of mode features, and of features of an observation
    :param n_envs: Number of environments
    :param counted_cell: Edge of the cells by which places are told apart, unless the settings say it; None: it follows from
        what is seen
    :param seen_cell: Of those in the map of visits, and of places where nothing is counted; None: as well
    :return: The bonus
    :raises ValueError: If a cell has no size
    """
    arguments, measure = dict(settings.kwargs or {}), settings.measure
    # The environment says how far apart places are, unless the user does
    grid = CellGrid(dims[0], arguments.get("cell_size", counted_cell) if measure == "counts" else seen_cell)
    kind = NOVELTY_MEASURES[measure] if isinstance(measure, str) else measure

    def rebuild(dim: int) -> nn.Module:
        return build(kind, dim, dims[1], **arguments)

    return ExplorationBonus(rebuild(dims[0]), dims[0], settings, exploration, n_envs, grid, seen_cell, rebuild)
