"""
What the trainings of a suite come to: interquartile means over seeds with intervals by stratified bootstrap (Agarwal et al.,
2021, https://arxiv.org/abs/2108.13264; the library is theirs), beside the paper's numbers.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from rliable import library, metrics
from scipy.stats import bootstrap, trim_mean

from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.experiments.store import Recorded, by, task_of, variant_of
from sb3_ddiffpg.experiments.wall_clock import PARTS

N_BOOTSTRAP = 2000
# Too few for an interval
FEW = 5
PAPER = Path(__file__).with_name("paper.yml")

#: What the tables say of an evaluation, by column
MEASURES: dict[str, Callable[[ModeEvaluation], float]] = {
    "modes in 20": lambda found: found.expected_modes(),
    "robust modes": lambda found: found.robust_modes,
    "commanded modes": lambda found: found.commanded_modes,
    "coverage": lambda found: found.coverage,
    "behavior entropy": lambda found: found.behavior_entropy,
    "multi-goal score": lambda found: found.multi_goal_score,
    "success": lambda found: found.uncommanded.success_rate if found.success_told else float("nan"),
    "return": lambda found: found.uncommanded.mean_return,
    "length": lambda found: found.uncommanded.mean_length,
}


@cache
def paper_results() -> dict[str, dict[str, list[float | None]]]:
    """
    :return: Task -> algorithm -> modes in 20 episodes, success, length, as the paper has them
    """
    return yaml.safe_load(PAPER.read_text())


def interquartile_mean(values: Sequence[float]) -> tuple[float, float, float]:
    """
    :param values: Of one task's seeds
    :return: Their interquartile mean and its 95 % bootstrap interval; of fewer than five values the lowest and the highest,
        as a bootstrap of three holds the truth in 72 of 100 cases
    """
    mean = float(trim_mean(values, 0.25))
    if len(values) < FEW or len(set(values)) == 1:
        return mean, min(values), max(values)
    measure = partial(trim_mean, proportiontocut=0.25)
    # The generator is seeded so that a report that is made twice is the same
    found = bootstrap((values,), measure, n_resamples=N_BOOTSTRAP, method="percentile", rng=np.random.default_rng(0))
    return mean, float(found.confidence_interval.low), float(found.confidence_interval.high)


def _cell(values: Sequence[float], digits: int) -> str:
    known = [value for value in values if not np.isnan(value)]
    if not known:
        return "-"
    fewer = f" (of {len(known)})" if len(known) < len(values) else ""
    if len(known) == 1:
        return f"{known[0]:.{digits}f}{fewer}"
    mean, low, high = interquartile_mean(known)
    return f"{mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]{fewer}"


def task_table(runs: Sequence[Recorded]) -> pd.DataFrame:
    """
    :param runs: Of one task
    :return: A row for each variant
    """
    rows = []
    for variant, own in by(variant_of, runs).items():
        row: dict[str, str | None] = {"": variant, "seeds": str(len(own))}
        row |= {name: _cell([measure(run.evaluation) for run in own], _digits(name)) for name, measure in MEASURES.items()}
        row["success, last model"] = _cell([run.last_success for run in own], 2)
        short = max(run.result["hours"] for run in runs) < 1
        row["minutes" if short else "hours"] = _cell([run.result["hours"] * (60 if short else 1) for run in own], 1)
        steps = np.mean([run.result["steps"] for run in own])
        row["steps"] = f"{steps / 1000:,.0f} k" if steps >= 10_000 else f"{steps:.0f}"
        times = [1000 * time for run in own if (time := seconds_per_update(run)) is not None]
        row["learning, s per 1000 updates"] = _cell(times, 1)
        rows.append(row | _paper_cells(task_of(own[0]), own[0]))
    return pd.DataFrame(rows).dropna(axis=1, how="all").fillna("-")


def elsewhere_table(runs: Sequence[Recorded]) -> pd.DataFrame:
    """
    :param runs: Trainings, some evaluated in further environments
    :return: A row for each of these and each variant; empty if there is none
    """
    rows = []
    for env_id, task in dict.fromkeys((env_id, task_of(run)) for run in runs for env_id in run.elsewhere):
        for variant, own in by(variant_of, [run for run in runs if task_of(run) == task and env_id in run.elsewhere]).items():
            found = [run.elsewhere[env_id] for run in own]
            row: dict[str, str | None] = {"": variant, "trained in": task, "tested in": env_id, "seeds": str(len(own))}
            row |= {name: _cell([MEASURES[name](each) for each in found], _digits(name)) for name in ("success", "length")}
            rows.append(row | _paper_cells(env_id, own[0]))
    return pd.DataFrame(rows).dropna(axis=1, how="all").fillna("-")


def _digits(measure: str) -> int:
    return {"success": 2, "coverage": 2, "behavior entropy": 2, "multi-goal score": 2}.get(measure, 1)


def _paper_cells(task: str, run: Recorded) -> dict[str, str | None]:
    """The paper's own, for the algorithm itself, not for what was changed of it."""
    itself = run.trial.variant == run.trial.algo and run.trial.members == 1
    numbers = paper_results().get(task, {}).get(run.trial.algo) if itself else None
    names = "paper: modes", "paper: success", "paper: length"
    if numbers is None:
        return dict.fromkeys(names)
    return {name: None if number is None else f"{number:g}" for name, number in zip(names, numbers, strict=True)}


def seconds_per_update(run: Recorded) -> float | None:
    """
    :param run: A training
    :return: Seconds of learning for each update; None if not all of it was measured
    """
    seconds, updates = run.result.get("seconds"), run.result.get("updates")
    if not seconds or not updates or not set(PARTS) <= set(seconds):
        return None  # records of before have no part for the rest
    return sum(seconds[part] for part in PARTS if part != "collection") / updates


def over_tasks(runs: Sequence[Recorded], measure: str) -> dict[str, tuple[float, float, float]]:
    """
    :param runs: Trainings
    :param measure: One of ``MEASURES``
    :return: Variant -> interquartile mean over tasks and seeds and its interval, for the variants that have every task that
        has such a number; of each, as many seeds as the task with fewest has
    """
    runs = [
        run
        for task in by(task_of, runs).values()
        if not np.isnan([MEASURES[measure](run.evaluation) for run in task]).all()
        for run in task
    ]
    n_tasks, found = len(by(task_of, runs)), {}
    for variant, own in by(variant_of, runs).items():
        tasks = list(by(task_of, own).values())
        n_seeds = min(map(len, tasks))
        scores = np.array([[MEASURES[measure](run.evaluation) for run in task[:n_seeds]] for task in tasks]).T
        if len(tasks) == n_tasks and not np.isnan(scores).any():
            found[variant] = _stratified(scores)
    return found


def _stratified(scores: np.ndarray) -> tuple[float, float, float]:
    """Interquartile mean over all of [n, T] scores, resampled within each task, as rliable does."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of how it calls arch
        mean, interval = library.get_interval_estimates(
            {"": scores},
            lambda some: np.array([metrics.aggregate_iqm(some)]),
            reps=N_BOOTSTRAP,
            random_state=np.random.RandomState(0),
        )
    return float(mean[""][0]), float(interval[""][0, 0]), float(interval[""][1, 0])
