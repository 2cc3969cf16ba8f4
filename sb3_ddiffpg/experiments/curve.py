"""A training's learning curve: tests along the way, and what had been reached by then."""

import csv
import os
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from sb3_ddiffpg.buffers.success import read_success
from sb3_ddiffpg.callbacks.evaluation import EvaluateModesCallback
from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.experiments.wall_clock import Stopwatch
from sb3_ddiffpg.serialization.safetensors_tree import convert
from sb3_ddiffpg.utils.vec_envs import labels_routes, route_label

#: Column of the goals reached in training by a route, before its label
REACHED = "reached "


class Clock:
    """
    Hours since a run began, without those between a kill and its resumption.

    :param hours: So many before
    :param cpu_hours: So many of all processors before
    """

    def __init__(self, hours: float = 0.0, cpu_hours: float = 0.0) -> None:
        self._began, self._cpu = time.perf_counter() - 3600 * hours, self._cpu_seconds() - 3600 * cpu_hours

    @property
    def hours(self) -> float:
        """Of the clock on the wall."""
        return (time.perf_counter() - self._began) / 3600

    @property
    def cpu_hours(self) -> float:
        """Of this process and of those that it began, such as a simulator's workers."""
        return (self._cpu_seconds() - self._cpu) / 3600

    @staticmethod
    def _cpu_seconds() -> float:
        seconds = sum(os.times()[:4])  # children are in it when they have ended
        for child in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):  # it has just ended
                seconds += sum(child.cpu_times()[:4])
        return seconds


class CurveCallback(EvaluateModesCallback):
    """
    Keeps the best model so far, and a line of ``curve.csv`` for each test of it.

    :param folder: Of the run
    :param kwargs: Of ``EvaluateModesCallback``
    """

    def __init__(self, folder: Path, **kwargs: Any) -> None:
        super().__init__(path=folder / "logs" / "evaluations.jsonl", best_model_path=folder / "model.zip", **kwargs)
        self.folder = folder
        #: Goals reached in training, by the environment's label of the route
        self.reached: Counter[str] = Counter()
        self.rows: list[dict[str, Any]] = []
        self.clock = Clock()
        self.stopwatch = Stopwatch()

    def _on_step(self) -> bool:
        for env, (done, info) in enumerate(zip(self.locals["dones"], self.locals["infos"], strict=True)):
            label = self._reached(env, info) if done else None
            if label is not None:
                self.reached[label] += 1
        return super()._on_step()

    def _reached(self, env: int, info: dict[str, Any]) -> str | None:
        """Route by which an episode has reached its goal, with the step that ends it, which is not stored yet."""
        said = read_success(info, getattr(self.model, "success_key", None))
        rule = getattr(self.model.replay_buffer, "success_rule", None)  # type: ignore[attr-defined]
        if rule is None:  # SB3's own buffers know the last step alone
            return route_label(info, labels_routes(self.training_env)) if said else None
        before = rule.so_far(env, info)
        return before.label if before.success or said else None

    def _on_training_end(self) -> None:
        if not self.evaluations or self.evaluations[-1][0] < self.num_timesteps:
            self._on_period()

    def _on_period(self) -> None:
        super()._on_period()
        step, found = self.evaluations[-1]
        row: dict[str, Any] = {
            "step": step,
            "hours": round(self.clock.hours, 4),
            "cpu_hours": round(self.clock.cpu_hours, 4),
            "updates": self.model._n_updates,
            "cells": len(visits) if (visits := getattr(self.model, "visits", None)) is not None else "",
            "modes": len(getattr(self.model, "modes", ())),
            "commanded_modes": round(found.commanded_modes, 3),
            "expected_modes": round(found.expected_modes(), 3),
            "robust_modes": found.robust_modes,
            "success_rate": round(found.uncommanded.success_rate, 3) if found.success_told else "",
            "mean_return": round(found.uncommanded.mean_return, 4),
        }
        for label in self._labels(found):
            shares = [each.labels.get(label, 0) / each.n_episodes for each in (*found.commanded, found.uncommanded)]
            row[label] = round(max(shares), 3)
            row[REACHED + label] = self.reached[label]
        self.rows.append(row)
        with (self.folder / "curve.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(row), restval="")
            writer.writeheader()
            writer.writerows(self.rows)

    def _labels(self, found: ModeEvaluation) -> list[str]:
        """Of the routes that are listed, and of those that a test has taken, this one or one before."""
        before = [name.removeprefix(REACHED) for name in (self.rows or [{}])[-1] if name.startswith(REACHED)]
        told = found.label_source == "environment"  # those of a clustering mean something else in each test
        taken = sorted({label for each in (*found.commanded, found.uncommanded) for label in each.labels}) if told else []
        return list(dict.fromkeys([*found.listed, *before, *taken]))

    def state_dict(self) -> dict[str, Any]:
        """
        :return: What a resumed run must know, for ``load_state_dict``
        """
        clock = [self.clock.hours, self.clock.cpu_hours]
        own = {"reached": dict(self.reached), "rows": self.rows, "clock": clock, "seconds": self.stopwatch.seconds}
        return {**super().state_dict(), **own}

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: What ``state_dict`` gave
        :raises ValueError: If it is something else
        """
        super().load_state_dict(state)
        self.reached = Counter(convert(state.get("reached"), dict[str, int], "callback.reached"))
        self.rows = convert(state.get("rows"), list[dict[str, Any]], "callback.rows")
        self.clock = Clock(*convert(state.get("clock"), tuple[float, float], "callback.clock"))
        self.stopwatch.seconds.update(convert(state.get("seconds"), dict[str, float], "callback.seconds"))
