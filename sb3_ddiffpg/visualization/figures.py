"""All pictures of a model at once: which of them there are depends on what is known."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sb3_ddiffpg.evaluation.rollout import EpisodeResult
from sb3_ddiffpg.visualization import plots

#: What each picture shows
CAPTIONS = {
    "routes": "The routes that each mode takes when it is commanded. Dashed: the goal was not reached.",
    "success": "Success of each mode in training, exploration noise included. Grey: modes that have ended.",
    "timeline": "When modes were born, split off, merged and ended. Grey: modes that have ended.",
    "values": "What each mode's critics expect from where, and the mode's central route.",
    "exploration": "Where training went, and how much of the space it knew when.",
    "dendrogram": "How alike the goal-reached trajectories are, and to which mode each belongs.",
}


def draw_all(
    model: Any,
    maze: Any = None,
    observation: np.ndarray | None = None,
    episodes: Mapping[str, Sequence[EpisodeResult]] | None = None,
    normalizer: Any = None,
) -> dict[str, Figure]:
    """
    :param model: A DDiffPG
    :param maze: The ``envs.Maze`` of its environment, None if it is none
    :param observation: One observation, not normalised, whose components that are no position stand for all places of a maze
    :param episodes: Episodes by commanded mode
    :param normalizer: See ``plots.plot_values``
    :return: Figures by name, see ``CAPTIONS``
    """
    modes = list(model.modes)
    names = {mode.number: mode.name for mode in modes}
    figures = {}
    if episodes:
        figures["routes"] = plots.plot_routes(episodes, maze, plots.colors_of(modes), plots.markers_of(modes))
    figures["success"] = plots.plot_success(model.mode_history, names)
    figures["timeline"] = plots.plot_timeline(model.mode_history, model.lifetime_steps)
    places = _places(model, maze, observation)
    if modes and places is not None:
        figures["values"] = plots.plot_values(model, places, maze, normalizer)
    if model.visits is not None:
        figures["exploration"] = plots.plot_exploration(model.visits, maze)
    if model.replay_buffer is not None and model.replay_buffer.size():
        figures["dendrogram"] = plots.plot_dendrogram(model)
    return figures


def _places(model: Any, maze: Any, observation: np.ndarray | None) -> np.ndarray | None:
    """Observations all over a maze, else visited ones; None where neither can be had."""
    buffer = model.replay_buffer
    if isinstance(model.observation_space.sample(), dict):
        return None
    if maze is not None and observation is not None and isinstance(buffer.features.selection, np.ndarray):
        return plots.grid_observations(model, observation, maze)
    if not buffer.size():
        return None
    rows = np.random.default_rng(0).choice(buffer.stored_rows.rows[: buffer.size()], size=2000)
    return buffer.read_observations(rows)[0].cpu().numpy()
