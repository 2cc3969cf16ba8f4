"""What runs in progress have written, as far as it can be read: a file may be missing, half-written or damaged at any time."""

import csv
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from sb3_ddiffpg.visualization.page import Shown
from sb3_ddiffpg.visualization.sketch import CURVE_POINTS, LIVE_FILE, Sketch, thin

#: What an experiment writes
CURVE_FILE = "curve.csv"
#: So many runs are shown, those first that wrote last
MOST_RUNS = 4
_MOST_BYTES = 50_000_000
_HEAD = ("trajectories", "success in training", "steps", "known since step")


def read_sketch(path: Path) -> Sketch | None:
    """
    :param path: Of a ``live.json``
    :return: What is in it; None if it cannot be read, or is something else
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            return None
        found = msgspec.json.decode(path.read_bytes(), type=Sketch)
    except (OSError, msgspec.DecodeError, RecursionError):
        return None
    return found if _is_sound(found) else None


def _is_sound(found: Sketch) -> bool:
    """Lists that belong together are as long as each other."""
    routes = all(len({len(column) for column in mode.route}) <= 1 for mode in found.modes)
    courses = all(len(each.step) == len(each.success) == len(each.n_trajectories) for each in found.courses)
    sizes = found.maze is None or (
        len(found.maze.extent) == 4
        and len(found.maze.start) == 2
        and all(len(wall) == 4 for wall in found.maze.walls)
        and all(len(goal) == 2 for goal in found.maze.goals)
    )
    return routes and courses and sizes and len(found.coverage[0]) == len(found.coverage[1])


def read_curve(path: Path) -> dict[str, list[float | None]]:
    """
    :param path: Of a ``curve.csv``
    :return: Its columns of numbers by name, None where there is none; of a line that is not whole nothing. Empty if it cannot
        be read
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.DictReader(file) if None not in row.values() and None not in row]
    except (OSError, UnicodeDecodeError, csv.Error):
        return {}
    rows = [row for row in rows if _number(row.get("step")) is not None]
    return {name: [_number(row[name]) for row in rows] for name in (rows[0] if rows else ())}


def _number(text: str | None) -> float | None:
    try:
        value = float(text or "nan")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def read_tests(path: Path) -> dict[str, list[float | None]]:
    """
    :param path: Of what ``EvaluateModesCallback`` appends to
    :return: As ``read_curve``: ``step``, ``success_rate``, ``commanded_modes``
    """
    found: dict[str, list[float | None]] = {"step": [], "success_rate": [], "commanded_modes": []}
    for line in _lines(path):
        try:
            told = json.loads(line)
            row = (told["step"], told["uncommanded"], told["summary"]["commanded_modes"])
            values = [float(row[0]), row[1]["n_successes"] / row[1]["n_episodes"], float(row[2])]
        except (ValueError, KeyError, TypeError, ZeroDivisionError, RecursionError):
            continue  # the last one may be half-written
        for column, value in zip(found.values(), values, strict=True):
            column.append(value if math.isfinite(value) else None)
    return found if found["step"] else {}


def _lines(path: Path) -> Iterator[str]:
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            yield from file
    except OSError:
        return


def _places(folder: Path) -> list[Path]:
    """Folders of runs below a folder, those first that wrote last. What vanishes meanwhile is passed over."""
    written: dict[Path, float] = {}
    for name in (CURVE_FILE, LIVE_FILE):
        for path in folder.rglob(name):
            # Of an experiment, live.json lies in the folder ``logs`` beside curve.csv
            place = path.parent.parent if name == LIVE_FILE and (path.parent.parent / CURVE_FILE).is_file() else path.parent
            place = place if place.is_relative_to(folder) else path.parent
            try:
                written[place] = max(written.get(place, 0.0), path.stat().st_mtime)
            except OSError:
                continue
    return sorted(written, key=lambda place: -written[place])[:MOST_RUNS]


def read_runs(folder: Path) -> list[Shown]:
    """
    :param folder: Of a run, or of several, at any depth
    :return: What the page shows of each of the latest ``MOST_RUNS``; empty while nothing can be read
    """
    shown = []
    for place in _places(folder):
        sketches = (read_sketch(path) for path in (place / LIVE_FILE, place / "logs" / LIVE_FILE))
        found = next((each for each in sketches if each is not None), None)
        curve = read_curve(place / CURVE_FILE)
        for path in (place / "evaluations.jsonl", place / "logs" / "evaluations.jsonl"):
            curve = curve or read_tests(path)
        if found is None and not curve:
            continue
        label = str(place.relative_to(folder)) if place != folder else folder.resolve().name
        shown.append(_shown(label, found or _of_curve(curve), curve))
    return shown


def _of_curve(curve: Mapping[str, list[float | None]]) -> Sketch:
    """Of a run that has written no sketch."""
    known = [(int(step), int(n)) for step, n in zip(curve["step"], curve.get("cells", []), strict=False) if step and n]
    coverage = [step for step, _ in known], [n for _, n in known]
    return Sketch("", int(curve["step"][-1] or 0), [], None, [], [], [], [], coverage)


def _shown(label: str, found: Sketch, curve: Mapping[str, list[Any]]) -> Shown:
    kept = thin(len(curve.get("step", ())), CURVE_POINTS).tolist()
    columns = {"step": "step", "success": "success_rate", "modes": "commanded_modes"}
    nothing = [None] * len(curve.get("step", ()))
    tests = {own: [curve.get(name, nothing)[index] for index in kept] for own, name in columns.items()}
    where = f" in {found.env}" if found.env else ""
    return Shown(
        label=label,
        subtitle=f"{len(found.modes)} modes{where} after {found.steps:,} environment steps",
        sketch=found,
        head=_HEAD,
        cells={
            mode.name: [
                f"{mode.n_trajectories:,}",
                "-" if mode.success_rate is None else f"{mode.success_rate:.0%}",
                "-" if mode.mean_length is None else f"{mode.mean_length:.0f}",
                f"{mode.born_at:,}",
            ]
            for mode in found.modes
        },
        tests=tests,
        history="\n".join(f"{step:>10}  {text}" for step, text in found.events),
    )
