"""``config.yml`` in a training's folder: what was asked for, how to do it again, where it ran and what it took."""

import shlex
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import yaml

from sb3_ddiffpg.experiments.machine import git_commit, machine
from sb3_ddiffpg.experiments.trial import Trial
from sb3_ddiffpg.utils.disk import written_whole
from sb3_ddiffpg.utils.versions import versions

_FILE = "config.yml"


def has_record(folder: Path) -> bool:
    """
    :param folder: Any
    :return: Whether a training has left its record there, however damaged
    """
    return (folder / _FILE).is_file()


def read_record(folder: Path) -> dict[str, Any]:
    """
    :param folder: Of a training
    :return: All of its record
    :raises ValueError: If there is none, or it is damaged
    """
    path = folder / _FILE
    if not path.is_file():
        raise ValueError(f"{folder} given; accepted is the folder of a recorded training, with a config.yml")
    try:
        record = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not the record of a training: {error}") from None
    # The zoo's files have the same name
    if not isinstance(record, dict) or (missing := {"algo", "env", "seed", "hyperparams"} - set(record)):
        what = "it is no table" if not isinstance(record, dict) else f"it has no {', '.join(sorted(missing))}"
        raise ValueError(f"{path} is not the record of a training: {what}")
    if not isinstance(record.get("result") or {}, dict):
        raise ValueError(f"{path} is not the record of a training: its result is no table")
    return record


def recorded_trial(folder: Path) -> Trial:
    """
    :param folder: Of a recorded training
    :return: What was trained
    :raises ValueError: If it is no such folder
    """
    return trial_of(read_record(folder), folder)


def trial_of(record: dict[str, Any], folder: Path) -> Trial:
    """
    :param record: Of a training
    :param folder: Where it lies
    :return: What was trained
    :raises ValueError: If that is no trial
    """
    known = {name: record[name] for name in Trial.__struct_fields__ if name in record}
    try:
        return msgspec.convert({"variant": record["algo"], **known}, Trial)
    except msgspec.ValidationError as error:
        raise ValueError(f"{folder / _FILE} is not the record of a training: {error}") from None


def check_folder(trial: Trial, folder: Path) -> None:
    """
    :param trial: What is to be trained
    :param folder: Where its record is to go
    :raises ValueError: If another training's is there
    """
    if has_record(folder) and (other := recorded_trial(folder)) != trial:
        differences = "; ".join(_differences(other, trial))
        raise ValueError(
            f"out: {folder} holds another training ({differences}); accepted is a folder without one, or with this one"
        )


def _differences(there: Trial, asked: Trial) -> Iterator[str]:
    before, now = (msgspec.to_builtins(each) for each in (there, asked))
    for part, whole in (("hyperparams", "settings"), ("tests", "tests"), (None, "")):
        old, new = (before, now) if part is None else (before.pop(part), now.pop(part))
        for name in sorted(old.keys() | new.keys()):
            if old.get(name) != new.get(name):
                yield f"{whole} {name}: {old.get(name)!r} there, {new.get(name)!r} asked for".strip()


def is_complete(folder: Path) -> bool:
    """
    :param folder: Of a training
    :return: Whether there is nothing left to do
    :raises ValueError: If its record is damaged
    """
    if not has_record(folder) or not (folder / "evaluation.json").is_file():
        return False
    return bool((read_record(folder).get("result") or {}).get("complete"))


def command_line(trial: Trial, folder: Path) -> list[str]:
    """
    :param trial: What
    :param folder: Where its record goes
    :return: Arguments of ``python -m sb3_ddiffpg.experiments`` that do it, whatever files there are
    """
    words = ["trial", "--algo", trial.algo, "--env", trial.env, "--variant", trial.variant, "--seed", str(trial.seed)]
    words += ["--members", str(trial.members)] if trial.members > 1 else []
    for option, value in (("--settings", trial.hyperparams), ("--tests", msgspec.to_builtins(trial.tests))):
        words += [option, yaml.safe_dump(value, default_flow_style=True, width=10**6).strip()]
    return [*words, "--out", str(folder)]


def new_record(trial: Trial, folder: Path) -> dict[str, Any]:
    """
    :param trial: What is to be trained
    :param folder: Where its record goes
    :return: The record as it begins; where it goes on, what it was begun with, and by what it is ``resumed``
    """
    now: dict[str, Any] = {
        **msgspec.to_builtins(trial),
        "command": shlex.join(["python", "-m", "sb3_ddiffpg.experiments", *command_line(trial, folder)]),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "git_commit": git_commit(),
        "machine": machine(),
        "versions": versions(),
    }
    if not has_record(folder):
        return now
    begun = {name: value for name, value in read_record(folder).items() if name != "result"}
    changed = {name: now[name] for name in ("started", "git_commit", "machine", "versions") if now[name] != begun.get(name)}
    return {**begun, "resumed": [*begun.get("resumed", []), changed]}


def write_record(record: dict[str, Any], folder: Path) -> None:
    """
    Whole, or the one before.

    :param record: Of a training
    :param folder: Where it goes
    """
    with written_whole(folder / _FILE) as unfinished:
        unfinished.write_text(yaml.safe_dump(record, sort_keys=False))
