"""The tables of a report: what an evaluation and a model have to say of themselves."""

import inspect
from typing import Any

import numpy as np

from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.utils.arguments import groups_of, settings_attribute

#: Of the table of modes
HEAD = ("route taken", "success", "95 % interval", "steps", "return", "value at the start", "known since step")


def best_mode(found: ModeEvaluation) -> str | None:
    """
    :param found: An evaluation
    :return: The mode to command first: among those whose success is within the best one's interval, the one of the highest
        return, of equals the shortest; None if none succeeds
    """
    top = max((each.success_rate for each in found.commanded), default=0.0)
    least = min((each.success_interval[0] for each in found.commanded if each.success_rate == top), default=0.0)
    good = [each for each in found.commanded if each.n_successes and each.success_rate >= least]
    return min(good, key=lambda each: (-round(each.mean_return, 1), each.mean_length)).mode if good else None


def cells(model: Any, found: ModeEvaluation, values: np.ndarray) -> dict[str, list[str]]:
    """
    :param model: A model with modes
    :param found: Its evaluation
    :param values: What each mode's critics expect from the start, shape [M]
    :return: A row below ``HEAD`` for each mode, by name
    """
    by_name = {each.mode: each for each in found.commanded}
    rows = {}
    for mode, value in zip(model.modes, values, strict=True):
        result = by_name[mode.name]
        low, high = result.success_interval
        rows[mode.name] = [
            ", ".join(f"{label} ({count})" for label, count in result.labels.items()) or "none",
            f"{result.success_rate:.0%}",
            f"{low:.0%} to {high:.0%}",
            "-" if np.isnan(result.mean_length) else f"{result.mean_length:.0f}",
            f"{result.mean_return:.2f}",
            f"{value:.2f}",
            f"{mode.born_at:,}",
        ]
    return rows


def ways_note(found: ModeEvaluation) -> str:
    """
    :param found: An evaluation
    :return: Who says which route was taken
    """
    if found.label_source == "clustering":
        return "The environment does not say which route was taken: routes are clusters of these episodes' own paths."
    return "Routes are told apart by the environment, not by the clustering that found the modes."


def summary(found: ModeEvaluation) -> list[tuple[str, str]]:
    """
    :param found: An evaluation
    :return: What follows from it, by name
    """

    def percent(value: float) -> str:
        return "-" if np.isnan(value) else f"{value:.1%}"

    low, high = found.uncommanded.success_interval
    return [
        ("success without command", f"{found.uncommanded.success_rate:.1%} (95 %: {low:.1%} to {high:.1%})"),
        ("routes expected in 20 episodes without command", f"{found.expected_modes():.2f}"),
        ("routes taken in at least 5 % of them", str(found.robust_modes)),
        ("effective number of routes", f"{found.effective_modes:.2f}"),
        ("share of the task's listed routes", percent(found.coverage)),
        ("commanded episodes that took their mode's own route", percent(found.control_accuracy)),
        ("episodes start apart by at most", f"{found.start_spread:.3g}"),
    ]


def settings(model: Any) -> list[tuple[str, str]]:
    """
    :param model: A trained model
    :return: Constructor arguments, and settings of groups, that differ from their defaults
    """
    different, groups = [], groups_of(type(model))
    for name, parameter in inspect.signature(type(model).__init__).parameters.items():
        if name in groups:
            chosen, usual = getattr(model, settings_attribute(name)).to_dict(), groups[name]().to_dict()
            different += [(f"{name}.{key}", repr(value)) for key, value in chosen.items() if value != usual[key]]
            continue
        value = getattr(model, name, None)
        if name in ("self", "policy", "env", "device", "verbose", "tensorboard_log", "_init_setup_model", "action_noise"):
            continue
        if callable(value) or value is None or repr(value) == repr(parameter.default):
            continue
        shown = f"{value.frequency} {value.unit.value}" if name == "train_freq" else repr(value)
        if name != "train_freq" or value.frequency != 1:
            different.append((name, shown))
    return different
