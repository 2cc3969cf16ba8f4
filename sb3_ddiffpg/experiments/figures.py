"""The paper's figures, from recorded trainings."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_ddiffpg.common.actor_critic import ActorCriticAlgorithm
from sb3_ddiffpg.envs import is_ours, make_vec_env
from sb3_ddiffpg.experiments.ablations import register
from sb3_ddiffpg.experiments.store import Recorded, by, task_of, variant_of
from sb3_ddiffpg.experiments.summary import MEASURES, over_tasks, seconds_per_update
from sb3_ddiffpg.experiments.trial import setting_of
from sb3_ddiffpg.experiments.wall_clock import PARTS
from sb3_ddiffpg.utils.vec_envs import env_attribute
from sb3_ddiffpg.visualization import plots
from sb3_ddiffpg.zoo import ALGOS

# Places on the horizontal axis, to which every training's tests are interpolated
_N_PLACES = 60
# More lines than this in one panel cannot be told apart: each variant has a panel of its own then
_MOST_LINES = 12
_LABELS = {
    "success_rate": "success, uncommanded",
    "mean_return": "return, uncommanded",
    "expected_modes": "modes expected in 20 episodes",
    "commanded_modes": "modes that can be commanded",
    "cells": "known cells",
}


def palette(runs: Sequence[Recorded]) -> dict[str, Any]:
    """
    :param runs: Trainings
    :return: Variant -> its colour in all figures
    """
    names = list(by(variant_of, runs))
    return dict(zip(names, sns.color_palette("tab10" if len(names) <= 10 else "tab20", len(names)), strict=True))


def curves(runs: Sequence[Recorded], measure: str, against: str = "step") -> Figure:
    """
    A measure along training, for each task: the mean over seeds, between the lowest and the highest. Many variants have a
    panel each, with the others' means behind.

    :param runs: Trainings
    :param measure: Column of their curves, such as ``"success_rate"``
    :param against: ``"step"`` or ``"hours"``
    :return: The figure
    """
    known = [run for run in runs if measure in run.curve and run.curve[measure].notna().any()]
    colors = palette(runs)
    apart = len(colors) > _MOST_LINES
    shown: list[tuple[str, pd.DataFrame, list[pd.Series]]] = []
    for task, own in by(task_of, known).items():
        table = pd.concat([_interpolated(each, measure, against) for each in by(variant_of, own).values()], ignore_index=True)
        if apart:
            means = [data.groupby(against)[measure].mean() for _, data in table.groupby("variant")]
            shown += [(f"{variant}\n{task}", data, means) for variant, data in table.groupby("variant", sort=False)]
        else:
            shown.append((task, table, []))
    figure, panels = plots.panels(len(shown))
    for axes, (title, data, behind) in zip(panels, shown, strict=True):
        for line in behind:
            axes.plot(line.index, line, color="0.85", linewidth=0.8)
        hues = dict.fromkeys(colors, "C0") if apart else colors  # alone in its panel
        sns.lineplot(data, x=against, y=measure, hue="variant", palette=hues, ax=axes, errorbar=("pi", 100), legend=False)
        axes.set(title=title, xlabel={"step": "environment steps"}.get(against, against), ylabel=_LABELS.get(measure, measure))
        if measure != "mean_return":
            axes.set_ylim(0, 1.03 if measure == "success_rate" else None)
        if against == "step":
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    if not apart:
        drawn = {variant_of(run) for run in known}  # a union has no curve
        _one_legend(figure, panels, {variant: color for variant, color in colors.items() if variant in drawn})
    return figure


def _interpolated(runs: Sequence[Recorded], measure: str, against: str) -> pd.DataFrame:
    """Seeds need not have been tested at the same steps."""
    places = np.linspace(0, min(run.curve[against].max() for run in runs), _N_PLACES)
    parts = []
    for run in runs:
        known = run.curve[[against, measure]].dropna()
        # Before its first test nothing had been reached; what an untrained model is paid is not known
        first = known[measure].iloc[0] if measure == "mean_return" else 0
        xs, ys = np.append(0, known[against]), np.append(first, known[measure])
        parts.append(pd.DataFrame({against: places, measure: np.interp(places, xs, ys), "variant": variant_of(run)}))
    return pd.concat(parts, ignore_index=True)


def aggregate(runs: Sequence[Recorded], measures: Sequence[str] = ("success", "coverage")) -> Figure:
    """
    Interquartile means over all tasks and seeds.

    :param runs: Trainings
    :param measures: Of ``summary.MEASURES``
    :return: The figure
    """
    colors = palette(runs)
    figure = Figure(figsize=(4.5 * len(measures), 1 + 0.35 * len(colors)), layout="constrained")
    panels = figure.subplots(1, len(measures), sharey=True, squeeze=False)[0]
    for axes, measure in zip(panels, measures, strict=True):
        for variant, (mean, low, high) in reversed(over_tasks(runs, measure).items()):
            if high > low:
                axes.barh(variant, high - low, left=low, color=colors[variant], alpha=0.6, height=0.6)
            axes.plot([mean, mean], [variant, variant], marker="|", markersize=14, color="k")
        axes.set(title=f"{measure}: interquartile mean", xlim=(0, 1.02))
    return figure


def ablation(runs: Sequence[Recorded], setting: str) -> Figure:
    """
    What the models of the tables come to, over the values of a setting.

    :param runs: Trainings that differ in it
    :param setting: Its name
    :return: The figure
    """
    measures = ("success", "modes in 20")
    figure, panels = plots.panels(len(measures))
    for axes, measure in zip(panels, measures, strict=True):
        rows = [(setting_of(run.trial, setting), MEASURES[measure](run.evaluation), task_of(run)) for run in runs]
        data = pd.DataFrame(rows, columns=[setting, measure, "task"])
        sns.lineplot(data, x=setting, y=measure, hue="task", marker="o", ax=axes, errorbar=("pi", 100))
        values = sorted(data[setting].unique())
        axes.set(xscale="log" if values[0] > 0 else "linear", ylim=(0, None))
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.minorticks_off()
    return figure


def wall_clock(runs: Sequence[Recorded]) -> Figure:
    """
    Seconds for 1000 updates and the collection between them, by part.

    :param runs: Trainings
    :return: The figure
    """
    timed = [run for run in runs if seconds_per_update(run) is not None]
    rows = {
        variant: pd.DataFrame([run.result["seconds"] for run in own]).sum() / sum(run.result["updates"] for run in own) * 1000
        for variant, own in by(variant_of, timed).items()
    }
    figure = Figure(figsize=(8, 1.2 + 0.4 * len(rows)), layout="constrained")
    axes = figure.subplots()
    if rows:
        data = pd.DataFrame(rows).T[list(PARTS)].iloc[::-1]
        data.plot.barh(stacked=True, ax=axes, width=0.7, legend=False)
        figure.legend(loc="outside upper center", ncols=len(PARTS))
        axes.set_xlabel("seconds for 1000 updates")
    return figure


class Maps:
    """
    Where each variant's training went, and what its critics expect, in the maze of one task.

    :param runs: Trainings of one task, of which the first of each variant is shown
    """

    def __init__(self, runs: Sequence[Recorded]) -> None:
        self.maze: Any = None
        self.observation: Any = None
        self.models: dict[str, Any] = {}
        settings = runs[0].trial.hyperparams
        if not _is_ours_here(task_of(runs[0])) or settings.get("env_wrapper"):
            return
        env = make_vec_env(task_of(runs[0]), 1, seed=0, env_kwargs=settings.get("env_kwargs"))
        self.maze = env_attribute(env, "maze")
        self.observation = env.reset()
        env.close()
        register()
        for variant, own in by(variant_of, runs).items():
            algorithm = ALGOS[own[0].trial.algo]
            if (own[0].folder / "model.zip").is_file() and issubclass(algorithm, ActorCriticAlgorithm):
                self.models[variant] = algorithm.load(_final_model(own[0]))

    def exploration(self) -> Figure | None:
        """
        :return: Visits by cell; None where none were counted
        """
        visited = {variant: model.visits for variant, model in self.models.items() if getattr(model, "visits", None)}
        if self.maze is None or not visited:
            return None
        figure, panels = plots.panels(len(visited))
        most = max(plots.usual_visits(visits) for visits in visited.values())
        for axes, (variant, visits) in zip(panels, visited.items(), strict=True):
            image = plots.draw_visits(axes, visits, self.maze, most)
            axes.set_title(f"{variant}: {len(visits)} cells")
        figure.colorbar(image, ax=panels, label=f"visits (from {most:,.0f} on alike)", extend="max")
        return figure

    def values(self) -> Figure | None:
        """
        :return: ``state_values`` all over the maze, of DDiffPG those of the best mode; None where there is no maze
        """
        if self.maze is None or isinstance(self.observation, dict):
            return None
        shown = {
            variant: model
            for variant, model in self.models.items()
            if isinstance(model.replay_buffer.features.selection, np.ndarray) and not model.is_normalized
        }
        if not shown:
            return None
        figure, panels = plots.panels(len(shown))
        for axes, (variant, model) in zip(panels, shown.items(), strict=True):
            places = plots.grid_observations(model, self.observation[0], self.maze)
            image = plots.draw_values(axes, model.replay_buffer.features(places), model.state_values(places), self.maze)
            figure.colorbar(image, ax=axes)
            axes.set_title(variant)
        return figure


def _is_ours_here(env_id: str) -> bool:
    """A report is made without what the trainings needed."""
    try:
        return is_ours(env_id)
    except (gym.error.Error, ImportError):
        return False


def _final_model(run: Recorded) -> Any:
    """It has seen all of training; where it was not kept, the best one."""
    final = run.folder / "logs" / "final_model.zip"
    return final if final.is_file() else run.folder / "model.zip"


def _one_legend(figure: Figure, panels: Sequence[Any], colors: dict[str, Any]) -> None:
    if not panels:
        return
    handles = [panels[0].plot([], [], color=color)[0] for color in colors.values()]
    width, height = figure.get_size_inches()
    n_columns = max(1, min(len(colors), int(width / (0.9 + 0.09 * max(map(len, colors))))))
    figure.set_size_inches(width, height + 0.22 * -(-len(colors) // n_columns))
    figure.legend(handles, list(colors), loc="outside lower center", ncols=n_columns)
