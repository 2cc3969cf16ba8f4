"""Pictures of modes. Needs matplotlib, which the extra ``plots`` installs."""

from collections.abc import Mapping, Sequence
from typing import Any

from sb3_ddiffpg.episodes import EpisodeResult


def plot_routes(episodes: Mapping[str, Sequence[EpisodeResult]], maze: Any = None) -> Any:
    """
    The routes of some episodes in the plane, one colour for each name. Failed episodes are dashed.

    :param episodes: Episodes by name, usually the mode that was commanded; of their paths the first two features are drawn
    :param maze: An ``envs.Maze`` whose walls, start and goals are drawn below
    :return: A matplotlib figure
    """
    from matplotlib.figure import Figure  # not needed to train, and slow to import
    from matplotlib.patches import Circle

    figure = Figure(figsize=(7, 6), layout="constrained")
    axes = figure.subplots()
    if maze is not None:
        axes.imshow(maze.walls, extent=maze.extent, cmap="Greys", vmin=0, vmax=1.6, zorder=0)
        axes.plot(*maze.start, marker="s", color="tab:gray", markersize=9, zorder=3, label="start")
        for goal in maze.goals:
            axes.add_patch(Circle(tuple(goal), 1.0, color="gold", ec="k", zorder=1))
            axes.annotate("goal", goal, ha="center", va="center", fontsize=8)
    for number, (name, runs) in enumerate(episodes.items()):
        color = f"C{number % 10}"
        for i, run in enumerate(runs):
            style = "--" if run.success is False else "-"
            axes.plot(run.path[:, 0], run.path[:, 1], style, color=color, alpha=0.35, lw=1, label=None if i else name)
    legend = figure.legend(loc="outside right upper")
    handles: list[Any] = [handle for handle in legend.legend_handles if handle is not None]
    for handle in handles:
        handle.set_alpha(1.0)
        if hasattr(handle, "set_linestyle") and handle.get_linestyle() == "--":
            handle.set_linestyle("-")  # the name's first episode failed, which says nothing of the name
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    return figure
