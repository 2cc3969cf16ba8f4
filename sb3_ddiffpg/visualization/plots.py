"""Pictures of modes. Needs matplotlib, which the extra ``plots`` installs."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import EngFormatter
from scipy.cluster import hierarchy
from scipy.spatial.distance import squareform

from sb3_ddiffpg.buffers.trajectory import NO_MODE
from sb3_ddiffpg.evaluation.robustness import RobustnessCurve
from sb3_ddiffpg.evaluation.rollout import EpisodeResult
from sb3_ddiffpg.exploration.visit_map import VisitMap
from sb3_ddiffpg.modes.history import ModeHistory
from sb3_ddiffpg.modes.mode import Mode
from sb3_ddiffpg.visualization.palette import GREY, styles
from sb3_ddiffpg.visualization.sketch import lives

# Share of the cells whose visits have a colour of their own; the rest, near the start, would outshine them
_TOLD_APART = 0.95
# Axes have one scale unless one of them is so many times as long
MOST_STRETCHED = 5.0
# Words stay legible over whatever colour
_OUTLINE = [withStroke(linewidth=2, foreground="w")]


def colors_of(modes: Sequence[Mode]) -> dict[str, str]:
    """
    :param modes: The modes of a model
    :return: Colour by name
    """
    looks = styles(mode.number for mode in modes)
    return {mode.name: looks[mode.number].color for mode in modes}


def markers_of(modes: Sequence[Mode]) -> dict[str, str]:
    """
    :param modes: The modes of a model
    :return: Marker by name
    """
    looks = styles(mode.number for mode in modes)
    return {mode.name: looks[mode.number].marker for mode in modes}


def _new(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout="constrained")


def panels(n: int) -> tuple[Figure, list[Any]]:
    """
    :param n: How many
    :return: A figure of rows of up to four, and the axes of each
    """
    n_rows = -(-max(n, 1) // 4)
    n_columns = -(-max(n, 1) // n_rows)
    figure = _new(4.4 * n_columns, 3.6 * n_rows)
    grid = figure.subplots(n_rows, n_columns, squeeze=False).ravel().tolist()
    for axes in grid[n:]:
        axes.axis("off")
    return figure, grid[:n]


def _count_steps(axes: Any) -> None:
    axes.set_xlabel("environment steps")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _empty(text: str) -> Figure:
    figure = _new(6, 2)
    axes = figure.subplots()
    axes.axis("off")
    axes.text(0.5, 0.5, text, ha="center", va="center")
    return figure


def _draw_maze(axes: Any, maze: Any) -> None:
    axes.imshow(maze.walls, extent=maze.extent, cmap="Greys", vmin=0, vmax=1.6, zorder=0)
    axes.plot(*maze.start, marker="s", color="tab:gray", markersize=9, zorder=3)
    words: dict[str, Any] = dict(textcoords="offset points", ha="center", fontsize=8, zorder=4, path_effects=_OUTLINE)
    axes.annotate("start", maze.start, xytext=(0, -14), **words)
    for goal in maze.goals:
        axes.add_patch(Circle(tuple(goal), 1.0, fc="gold", ec="k", zorder=1))
        axes.annotate("goal", goal, xytext=(0, -3), **words)


def _in_plane(positions: np.ndarray) -> np.ndarray:
    """The first two coordinates; of one, the second is zero. [N, dim] -> [N, 2]"""
    return positions[:, :2] if positions.shape[1] > 1 else np.concatenate((positions, np.zeros_like(positions)), axis=1)


def _label_axes(axes: Any, maze: Any, components: Sequence[int] = (0, 1)) -> None:
    """Of what is drawn: metres in a maze; elsewhere nobody has said which unit, nor whether it is the same on both axes."""
    spans = axes.dataLim.size
    alike = maze is not None or spans.max() <= MOST_STRETCHED * spans.min()
    axes.set_aspect("equal" if alike else "auto")
    names = ("x [m]", "y [m]") if maze is not None else _names(components)
    axes.set(**dict(zip(("xlabel", "ylabel"), names, strict=False)))  # a single one has no second


def _names(components: Sequence[int]) -> list[str]:
    return [f"mode feature {component}" for component in components]


def plot_routes(
    episodes: Mapping[str, Sequence[EpisodeResult]],
    maze: Any = None,
    colors: Mapping[str, str] | None = None,
    markers: Mapping[str, str] | None = None,
) -> Figure:
    """
    The routes of some episodes, one colour for each name and a marker at their ends: in the plane, or, where the mode features
    have three components (an arm), in space and seen from above and from the side. Failed episodes are dashed.

    :param episodes: Episodes by name, usually the mode that was commanded
    :param maze: An ``envs.Maze`` whose walls, start and goals are drawn below
    :param colors: Colours by name
    :param markers: Markers by name
    :return: The figure
    """
    if not any(len(runs) for runs in episodes.values()):
        return _empty("no episode")
    dim = next(run.path.shape[1] for runs in episodes.values() for run in runs)
    in_space = dim == 3 and maze is None
    figure = _new(13, 4.4) if in_space else _new(7, 6)
    if in_space:
        views = [figure.add_subplot(1, 3, 1, projection="3d"), figure.add_subplot(1, 3, 2), figure.add_subplot(1, 3, 3)]
        components = [[0, 1, 2], [0, 1], [0, 2]]
        views[0].set(**dict(zip(("xlabel", "ylabel", "zlabel"), _names(components[0]), strict=True)))
    else:
        views, components = [figure.subplots()], [[0, min(1, dim - 1)]]
    for axes, parts in zip(views, components, strict=True):
        draw_routes(axes, episodes, maze, colors, parts, markers)
        if len(parts) == 2:
            _label_axes(axes, maze, parts)
    figure.legend(*views[-1].get_legend_handles_labels(), loc="outside right upper")
    return figure


def draw_routes(
    axes: Any,
    episodes: Mapping[str, Sequence[EpisodeResult]],
    maze: Any = None,
    colors: Mapping[str, str] | None = None,
    components: Sequence[int] = (0, 1),
    markers: Mapping[str, str] | None = None,
) -> None:
    """
    The routes of some episodes, one colour, marker and label for each name. Failed episodes are dashed.

    :param axes: Where
    :param episodes: Episodes by name
    :param maze: An ``envs.Maze`` that is drawn below
    :param colors: Colours by name
    :param components: Of the mode features that are drawn
    :param markers: Of the ends of the paths, by name
    """
    if maze is not None:
        _draw_maze(axes, maze)
    looks = styles(range(len(episodes)))
    for number, (name, runs) in enumerate(episodes.items()):
        color = (colors or {}).get(name, looks[number].color)
        marker = (markers or {}).get(name, looks[number].marker)
        for run in runs:
            style = "--" if run.success is False else "-"
            path, end = run.path[:, list(components)].T, {"marker": marker, "markevery": [-1], "ms": 5}
            axes.plot(*path, style, color=color, alpha=0.35, lw=1, **end)
        axes.plot([], [], color=color, marker=marker, label=name)


def plot_dendrogram(model: Any) -> Figure:
    """
    The tree of the goal-reached trajectories in the replay buffer, coloured by the mode that each belongs to, and the height
    at which it was cut. The automatic rule looks into each branch by itself: its cut is where a coloured branch begins.

    :param model: A DDiffPG with its replay buffer
    :return: The figure
    """
    successes = [t for t in model.replay_buffer.trajectories(True) if t.mode != NO_MODE]
    if len(successes) < 2:
        return _empty("fewer than two goal-reached trajectories")
    distances = model.replay_buffer.success_distances(successes)
    tree = hierarchy.linkage(squareform(distances, checks=False), model.mode_settings.linkage)
    modes = list(model.modes)
    owners: list[int] = [t.mode for t in successes]
    for left, right, *_ in tree:  # a branch has a mode's colour if all of it is the mode's
        first, second = owners[int(left)], owners[int(right)]
        owners.append(first if first == second else NO_MODE)
    figure = _new(9, 4)
    axes = figure.subplots()
    looks = styles(mode.number for mode in modes)
    colors = ["0.6" if owner == NO_MODE else looks[modes[owner].number].color for owner in owners]
    hierarchy.dendrogram(tree, ax=axes, no_labels=True, link_color_func=lambda node: colors[node])
    if (threshold := model.mode_settings.distance_threshold) is not None:
        axes.axhline(threshold, color="k", ls=":", label=f"cut at {threshold:g}")
    for index, mode in enumerate(modes):
        n_members = owners[: len(successes)].count(index)
        own = looks[mode.number]
        axes.plot([], [], color=own.color, marker=own.marker, label=f"{mode.name} ({n_members})")
    axes.set(ylabel="DTW distance", xlabel=f"{len(successes)} goal-reached trajectories")
    figure.legend(loc="outside right upper")
    return figure


def usual_visits(visits: VisitMap) -> float:
    """
    :param visits: At least one
    :return: Visits which 95 of 100 known cells do not exceed
    """
    return max(2.0, float(np.quantile(visits.cells()[1], _TOLD_APART)))


def draw_visits(axes: Any, visits: VisitMap, maze: Any = None, most: float | None = None) -> Any:
    """
    Visits by cell; of three coordinates the first two.

    :param axes: Where
    :param visits: At least one
    :param maze: An ``envs.Maze`` that is drawn below
    :param most: Visits from which on all are shown alike; ``usual_visits`` if None
    :return: The image, for a colour bar
    """
    most = usual_visits(visits) if most is None else most
    centres, counts = visits.cells()
    cell = _in_plane(visits.cell_size[None])[0]
    cell = np.where((cell > 0) & np.isfinite(cell), cell, 1.0)
    columns = np.floor(_in_plane(centres) / cell).astype(int)
    coarse = int(np.ptp(columns, axis=0).max()) // 1000 + 1  # a stray far away must not make a picture of a million cells
    columns //= coarse
    edge = coarse * cell
    low = columns.min(axis=0)
    density = np.zeros(columns.max(axis=0) - low + 1)
    np.add.at(density, tuple((columns - low).T), counts)
    shown = np.where(density > 0, np.minimum(density, most), np.nan)
    if maze is not None:
        _draw_maze(axes, maze)
    edges = low * edge, (columns.max(axis=0) + 1) * edge
    extent = (edges[0][0], edges[1][0], edges[0][1], edges[1][1])
    image = axes.imshow(shown.T, origin="lower", extent=extent, norm=LogNorm(1, most), cmap="viridis", alpha=0.85, zorder=0.5)
    if maze is not None:
        axes.set(xlim=maze.extent[:2], ylim=maze.extent[2:])
    _label_axes(axes, maze, range(centres.shape[1])[:2])
    return image


def plot_exploration(visits: VisitMap | None, maze: Any = None) -> Figure:
    """
    Where training went (visits by cell; of three coordinates the first two), and how many cells it knew when.

    :param visits: ``model.visits``
    :param maze: An ``envs.Maze`` that is drawn below
    :return: The figure
    """
    if visits is None or not len(visits):
        return _empty("no visit was counted")
    figure = _new(11, 4.6)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    image = draw_visits(left, visits, maze)
    figure.colorbar(image, ax=left, label=f"visits (from {usual_visits(visits):,.0f} on alike)", extend="max")
    right.plot(*np.array(visits.coverage or [(0, 0)]).T)
    _count_steps(right)
    edges = " x ".join(f"{edge:.3g}" for edge in visits.cell_size if np.isfinite(edge))
    right.set(ylabel=f"known cells of {edges}", ylim=(0, None))
    return figure


def draw_values(
    axes: Any, positions: np.ndarray, values: np.ndarray, maze: Any = None, limits: tuple[float, float] | None = None
) -> Any:
    """
    Values of places.

    :param axes: Where
    :param positions: Shape [N, position_dim]
    :param values: Shape [N]
    :param maze: An ``envs.Maze`` that is drawn below
    :param limits: Of the colours; those of the values when None
    :return: The image, for a colour bar
    """
    if maze is not None:
        _draw_maze(axes, maze)
    low, high = (values.min(), values.max()) if limits is None else limits
    size = 30_000 / max(len(positions), 1) if maze is not None else 12
    image = axes.scatter(*_in_plane(positions).T, c=values, s=size, marker="s", vmin=low, vmax=high, zorder=0.5)
    _label_axes(axes, maze, range(positions.shape[1])[:2])
    return image


def plot_values(model: Any, observations: np.ndarray, maze: Any = None, normalizer: Any = None) -> Figure:
    """
    What each mode's critics expect from where: :meth:`DDiffPG.mode_values` at the given observations, over the first two mode
    features. The mode's own route (its medoid) is drawn on top.

    :param model: A DDiffPG with modes
    :param observations: Not normalised, shape ``[N, *observation shape]``, such as :func:`grid_observations` makes
    :param maze: An ``envs.Maze`` that is drawn below
    :param normalizer: The ``VecNormalize`` with which the model was trained; that of its environment when None
    :return: The figure
    """
    modes = list(model.modes)
    if not modes:
        return _empty("no mode yet")
    parts = np.array_split(observations, max(1, len(observations) // 500))
    normalizer = model.get_vec_normalize_env() if normalizer is None else normalizer
    shown = parts if normalizer is None else [normalizer.normalize_obs(part) for part in parts]
    values = np.concatenate([model.mode_values(part) for part in shown])
    positions = _in_plane(model.replay_buffer.features(observations))
    figure, grid = panels(len(modes))
    limits = float(values.min()), float(values.max())
    image: Any = None
    colors = colors_of(modes)
    for axes, mode, expected in zip(grid, modes, values.T, strict=True):
        image = draw_values(axes, positions, expected, maze, limits)
        if len(mode.representative):
            route = _in_plane(mode.representative)
            axes.plot(*route.T, color="w", lw=2.5, zorder=2)
            axes.plot(*route.T, color=colors[mode.name], lw=1.5, zorder=2)
        axes.set_title(mode.name)
    figure.colorbar(image, ax=grid, label="value of the mode (discounted, scaled reward)")
    return figure


def grid_observations(model: Any, observation: np.ndarray, maze: Any, spacing: float = 1.0) -> np.ndarray:
    """
    An observation as it would be at each free place of a maze.

    :param model: A model whose mode features are indices of a flat observation
    :param observation: One observation, for the components that are no position
    :param maze: An ``envs.Maze``
    :param spacing: Of the places, in metres
    :return: Shape ``[N, *observation shape]``
    """
    x_low, x_high, y_low, y_high = maze.extent
    xs, ys = np.arange(x_low + spacing / 2, x_high, spacing), np.arange(y_low + spacing / 2, y_high, spacing)
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    places = places[~maze.blocked(*places.T, half_size=0.49 * spacing)]
    observations = np.repeat(np.asarray(observation)[None], len(places), axis=0)
    observations[:, np.asarray(model.replay_buffer.features.selection)[:2]] = places
    return observations


def plot_timeline(history: ModeHistory, end: int | None = None) -> Figure:
    """
    When modes were born, split off, merged and ended. Those that have ended are grey.

    :param history: ``model.mode_history``
    :param end: Environment steps at the right edge; the latest event or state when None
    :return: The figure
    """
    if not len(history):
        return _empty("nothing has happened to a mode yet")
    last = max([event.step for event in history] + [state.step for state in history.states])
    right_edge = last if end is None else end
    known = {life.number: life for life in lives(history)}
    rows = {number: row for row, number in enumerate(known)}
    looks = styles(number for number, life in known.items() if life.end is None)
    colors = {number: looks[number].color if number in looks else GREY for number in known}
    row_of_name = {life.name: rows[number] for number, life in known.items()}
    figure = _new(9, 1.2 + 0.28 * len(rows))
    axes = figure.subplots()
    for number, life in known.items():
        ends_at = right_edge if life.end is None else life.end
        axes.plot([life.begin, ends_at], [rows[number]] * 2, color=colors[number], lw=4, solid_capstyle="butt")
    for event in history:
        if event.number not in rows:
            continue
        row = rows[event.number]
        other = row_of_name.get(event.other or "", row)
        if event.kind in ("split from", "merged into") and other != row:
            arrow = {"arrowstyle": "->", "color": "0.4"}
            first, second = (other, row) if event.kind == "split from" else (row, other)
            axes.annotate("", (event.step, second), (event.step, first), arrowprops=arrow)
        marker = {"born": "o", "split from": "o", "merged into": "X", "retired": "X", "deleted": "X", "frozen": "*"}
        if event.kind in marker:
            axes.plot(event.step, row, marker[event.kind], color=colors[event.number], mec="k", ms=7, zorder=3)
    axes.set_yticks(list(rows.values()), [life.name for life in known.values()])
    axes.invert_yaxis()
    _count_steps(axes)
    axes.set(title="o born or split   x ended   * frozen")
    return figure


def plot_success(history: ModeHistory, names: Mapping[int, str] | None = None) -> Figure:
    """
    Each mode's success in training, over the latest (at most 100) episodes that were commanded to it, noise included.

    :param history: ``model.mode_history``
    :param names: Names by number
    :return: The figure
    """
    states = history.states
    if not states:
        return _empty("no re-clustering yet")
    figure = _new(9, 3.6)
    axes = figure.subplots()
    numbers = sorted({state.number for state in states})
    looks = styles(numbers if names is None else names)
    for number in numbers:
        own = [state for state in states if state.number == number]
        known = names is None or number in names
        axes.plot(
            [state.step for state in own],
            [state.success_rate for state in own],
            color=looks[number].color if known else "0.8",
            lw=1.6 if known else 0.8,
            marker=looks[number].marker if known else None,
            markevery=max(1, len(own) // 8),
            ms=6,
            zorder=2 if known else 1,
            label=(names or {}).get(number, f"mode_{number}") if known else None,
        )
    _count_steps(axes)
    axes.set(ylabel="success of commanded episodes", ylim=(-0.03, 1.03))
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside right upper")
    return figure


def plot_robustness(curve: RobustnessCurve, change: str = "changed to") -> Figure:
    """
    Draw each mode's success, and that without command, over the values of a change of the world.

    :param curve: What ``robustness_curve`` found
    :param change: What is changed, the name of the axis
    :return: The figure
    """
    figure = _new(7, 3.6)
    axes = figure.subplots()
    numbers = all(not isinstance(value, str) for value in curve.values)
    values: Any = curve.values if numbers else list(map(str, curve.values))
    looks = styles(range(len(curve.modes)))
    for number, (name, success) in enumerate(curve.success.items()):
        axes.plot(values, success, color=looks[number].color, marker=looks[number].marker, lw=1.6, ms=6, label=name)
    axes.plot(values, curve.uncommanded_success, color=GREY, ls="--", label="no command")
    axes.set(xlabel=change, ylabel="success", ylim=(-0.03, 1.03))
    figure.legend(loc="outside right upper")
    return figure
