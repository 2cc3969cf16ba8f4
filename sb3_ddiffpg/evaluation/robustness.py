"""How each mode copes with a world that is changed more and more, and how far the best of them does."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.results import CommandResult, ModeEvaluation

_FORMAT = 1
# Of a curve that is read from a file
_MOST_VALUES = 100_000


@dataclass(frozen=True)
class RobustnessCurve:
    """
    What ``robustness_curve`` found. Prints as a table.

    The best mode is chosen by the very episodes that are counted: of several equally good modes, the luckiest. With few
    episodes for each its success is too good; evaluate it once more before you report it.

    :param values: Values of the change, numbers or words
    :param evaluations: One for each value
    """

    values: tuple[float | str, ...]
    evaluations: tuple[ModeEvaluation, ...]

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the modes that were commanded."""
        return tuple(str(each.mode) for each in self.evaluations[0].commanded)

    @property
    def success(self) -> dict[str, tuple[float, ...]]:
        """Share of successes of each mode, by value."""
        rows = zip(*(evaluation.commanded for evaluation in self.evaluations), strict=True)
        return {name: tuple(each.success_rate for each in row) for name, row in zip(self.modes, rows, strict=True)}

    @property
    def uncommanded_success(self) -> tuple[float, ...]:
        """Share of successes without command, by value."""
        return tuple(each.uncommanded.success_rate for each in self.evaluations)

    @property
    def best_modes(self) -> tuple[str | None, ...]:
        """Mode with the largest share of successes, by value: of several the first, None without modes."""
        return tuple(None if best is None else best.mode for best in map(_best, self.evaluations))

    @property
    def best_success(self) -> tuple[float, ...]:
        """Share of successes of the best mode, by value; NaN without modes."""
        return tuple(float("nan") if best is None else best.success_rate for best in map(_best, self.evaluations))

    @property
    def best_median(self) -> tuple[float, ...]:
        """
        Median of the best mode's episodes, by value, a success counting 1 and a failure 0: 1 where more than half of them
        succeed, 0.5 where exactly half do. NaN without modes.
        """
        return tuple(float("nan") if best is None else _median(best) for best in map(_best, self.evaluations))

    def __str__(self) -> str:
        names = [*self.modes, "(none)"]
        columns = [*self.success.values(), self.uncommanded_success]
        values = [f"{value:g}" if not isinstance(value, str) else value for value in self.values]
        first, *widths = (max(6, *map(len, column)) for column in (["changed to", *values], *([name] for name in names)))
        lines = ["  ".join([f"{'changed to':<{first}}", *(f"{n:>{w}}" for n, w in zip(names, widths, strict=True)), "best"])]
        for number, value in enumerate(values):
            shares = (f"{column[number]:>{width}.1%}" for column, width in zip(columns, widths, strict=True))
            lines.append("  ".join([f"{value:<{first}}", *shares, self.best_modes[number] or "-"]))
        return "\n".join(lines)

    def save(self, path: str | Path) -> None:
        """
        :param path: Of the JSON file
        """
        Path(path).write_text(json.dumps(self.to_dict(), indent=2) + "\n")

    def to_dict(self) -> dict[str, Any]:
        """
        :return: What JSON can hold: values and evaluations, and a ``summary`` of what follows from them
        """
        summary = {
            "success": self.success,
            "uncommanded_success": self.uncommanded_success,
            "best_modes": self.best_modes,
            "best_success": [None if math.isnan(each) else each for each in self.best_success],
            "best_median": [None if math.isnan(each) else each for each in self.best_median],
        }
        evaluations = [each.to_dict() for each in self.evaluations]
        return {"format": _FORMAT, "values": list(self.values), "evaluations": evaluations, "summary": summary}

    @staticmethod
    def load(path: str | Path) -> "RobustnessCurve":
        """
        :param path: Of a file that :meth:`save` wrote
        :return: The curve
        :raises ValueError: If it is no such file
        """
        try:
            return RobustnessCurve.from_dict(json.loads(Path(path).read_text()))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path} is no robustness curve in format {_FORMAT}: {error!r}") from None

    @staticmethod
    def from_dict(data: Any) -> "RobustnessCurve":
        """
        :param data: What :meth:`to_dict` gave
        :return: The curve
        :raises ValueError: If it is of another format
        """
        if not isinstance(data, dict) or data.get("format") != _FORMAT:
            raise ValueError(f"it is not of format {_FORMAT}")
        values, evaluations = data.get("values"), data.get("evaluations")
        if not (isinstance(values, list) and isinstance(evaluations, list) and len(values) == len(evaluations)):
            raise ValueError("values and evaluations are not as many")
        curve = RobustnessCurve(_checked(values), tuple(map(ModeEvaluation.from_dict, evaluations)))
        if any([each.mode for each in evaluation.commanded] != list(curve.modes) for evaluation in curve.evaluations):
            raise ValueError("the evaluations are of different modes")
        return curve


def robustness_curve(
    model: Any,
    make_env: Callable[[Any], gym.Env | VecEnv],
    values: Sequence[float | str],
    n_episodes: int = 100,
    **kwargs: Any,
) -> RobustnessCurve:
    """
    Evaluate each mode, and the model without command, under each value of a change of the world, as QDAC (Grillotti et al.,
    2024) and SMERL (Kumar et al., 2020) do with the skills of one policy. Nothing is trained.

    :param model: Any SB3 model. What has no modes is run without commands
    :param make_env: Function of a value that makes the changed environments, which are closed after use. All episodes should
        begin at one fixed start, see ``evaluate_modes``
    :param values: Values of the change, numbers or words, each other one
    :param n_episodes: Number of episodes for each mode and value
    :param kwargs: Further arguments of ``evaluate_modes``, such as ``seed``, ``n_uncommanded`` and ``modes``
    :return: The curve
    :raises ValueError: If an argument cannot work, naming it
    """
    known = _checked(values)
    evaluations = []
    for value in known:
        env = make_env(value)
        if not isinstance(env, (gym.Env, VecEnv)):
            raise ValueError(f"make_env: {env!r} made of {value!r}; accepted is a function that makes environments")
        try:
            evaluations.append(evaluate_modes(model, env, n_episodes, **kwargs))
        finally:
            env.close()
    return RobustnessCurve(known, tuple(evaluations))


def _checked(values: Any) -> tuple[float | str, ...]:
    if isinstance(values, str) or not 1 <= len(values) <= _MOST_VALUES:
        raise ValueError(f"values: {values!r:.100} given; accepted is a list of at least one number or word")
    found = tuple(value.item() if isinstance(value, np.generic) else value for value in values)
    for value in found:
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if not (is_number or isinstance(value, str)):
            raise ValueError(f"values: {value!r} given; accepted are finite numbers and words")
    if len(set(found)) < len(found):
        raise ValueError(f"values: {list(found)} given; accepted are different ones")
    return found


def _best(evaluation: ModeEvaluation) -> CommandResult | None:
    return max(evaluation.commanded, key=lambda each: each.success_rate, default=None)


def _median(result: CommandResult) -> float:
    doubled = 2 * result.n_successes
    return 0.5 if doubled == result.n_episodes else float(doubled > result.n_episodes)
