"""A folder of recorded trainings, read."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from msgspec.structs import replace

from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.experiments.record import has_record, read_record, trial_of
from sb3_ddiffpg.experiments.trial import Trial

# What reports tell of every training
_RECORDED = ("machine", "versions", "git_commit")


@dataclass(frozen=True)
class Recorded:
    """
    A complete training.

    :param folder: Of its record
    :param trial: What was trained
    :param record: All of ``config.yml``
    :param curve: Its tests, one a row; empty for a union
    :param evaluation: Of the best model
    :param elsewhere: Of the same in further environments, by id
    :param last_success: Success without command of the last model, which need not be the best; NaN where that is not known
    """

    folder: Path
    trial: Trial
    record: dict[str, Any]
    curve: pd.DataFrame
    evaluation: ModeEvaluation
    elsewhere: dict[str, ModeEvaluation]
    last_success: float

    @property
    def result(self) -> dict[str, Any]:
        """What it took."""
        return self.record["result"]


def read_results(folder: Path) -> tuple[list[Recorded], list[Path]]:
    """
    :param folder: In which trainings have left their records, at whatever depth
    :return: The complete ones, unchanged algorithms first, and the folders of the others
    :raises ValueError: If there is none at all
    """
    complete, others = [], []
    for place, folders, _ in os.walk(folder):
        folders.sort()
        if not has_record(Path(place)):
            continue
        folders.clear()  # what lies below are members of a union, and logs
        record = _record(Path(place))
        recorded = None if record is None else _read(Path(place), record)
        if recorded is None:
            others.append(Path(place))
        else:
            complete.append(recorded)
    if not complete and not others:
        raise ValueError(f"results: {folder} given; accepted is a folder in which trainings have left their records")
    complete.sort(key=lambda run: run.trial.variant != run.trial.algo)
    return complete, others


def read_training(folder: Path) -> Recorded:
    """
    :param folder: Of a complete training
    :return: The training
    :raises ValueError: If it is no such folder
    """
    record = _record(folder)
    found = None if record is None else _read(folder, record)
    if found is None:
        raise ValueError(f"{folder} given; accepted is the folder of a complete training")
    return found


def _record(folder: Path) -> dict[str, Any] | None:
    """None if there is none, or it is damaged."""
    try:
        return read_record(folder)
    except ValueError:
        return None


def _read(folder: Path, record: dict[str, Any]) -> Recorded | None:
    if not (record.get("result") or {}).get("complete") or not (folder / "evaluation.json").is_file():
        return None
    curve = folder / "curve.csv"
    elsewhere = sorted(folder.glob("evaluation_*.json"))
    try:
        _check(record)
        return _of_files(folder, record, curve, elsewhere)
    except (ValueError, pd.errors.ParserError) as error:  # of an evaluation, or an empty table
        raise ValueError(f"{folder}: {error}") from None


def _check(record: dict[str, Any]) -> None:
    for part, of_part, names in (("", record, _RECORDED), ("result: ", record["result"], ("steps", "hours"))):
        if missing := [name for name in names if name not in of_part]:
            raise ValueError(f"its record has no {part}{', '.join(missing)}")


def _of_files(folder: Path, record: dict[str, Any], curve: Path, elsewhere: list[Path]) -> Recorded:
    best = ModeEvaluation.load(folder / "evaluation.json")
    return Recorded(
        folder,
        trial_of(record, folder),
        record,
        pd.read_csv(curve) if curve.is_file() else pd.DataFrame(),
        best,
        {path.stem.removeprefix("evaluation_"): ModeEvaluation.load(path) for path in elsewhere},
        _last_success(folder, record["result"], best),
    )


def _last_success(folder: Path, result: dict[str, Any], best: ModeEvaluation) -> float:
    path, last = folder / "logs" / "evaluation_final.json", None
    if result.get("best_step") == result["steps"]:
        last = best
    elif path.is_file():
        last = ModeEvaluation.load(path)
    return last.uncommanded.success_rate if last is not None and last.success_told else float("nan")


def check_alike(runs: Sequence[Recorded]) -> None:
    """
    :param runs: Trainings
    :raises ValueError: If two of one task and variant are not two seeds of the same
    """
    for task in by(task_of, runs).values():
        for own in by(variant_of, task).values():
            seeds: dict[int, Recorded] = {}
            for run in own:
                same = replace(run.trial, seed=own[0].trial.seed) == own[0].trial
                if not same or run.trial.seed in seeds:
                    other = seeds.get(run.trial.seed, own[0])
                    why = "have the same seed" if same else "differ in their settings"
                    raise ValueError(f"results: {other.folder} and {run.folder} {why}, and cannot be averaged")
                seeds[run.trial.seed] = run


def by(key: Callable[[Recorded], str], runs: Sequence[Recorded]) -> dict[str, list[Recorded]]:
    """
    :param key: What is to be alike
    :param runs: Trainings
    :return: Those that are alike, in the order in which they come first
    """
    found: dict[str, list[Recorded]] = {}
    for run in runs:
        found.setdefault(key(run), []).append(run)
    return found


def task_of(run: Recorded) -> str:
    """
    :param run: A training
    :return: Where
    """
    return run.trial.env


def variant_of(run: Recorded) -> str:
    """
    :param run: A training
    :return: Of what
    """
    return run.trial.variant
