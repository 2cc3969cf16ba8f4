"""What a check of an environment found, as numbers and as a page in plain words."""

import math
from dataclasses import dataclass
from typing import Any

# Components of an observation of which the page tells the travel, at most
_MOST_NAMED = 8
_WIDTH = 16


@dataclass(frozen=True)
class SuccessSignal:
    """
    What the steps said of success.

    :param key: Of ``info`` by which it was told; None: no step said anything
    :param only_true: Whether it was told only where it is True
    :param n_steps: Steps that said something
    :param n_mid_episode: Steps at which it was True and the episode went on
    :param n_counted: Episodes that training would take for goal-reached ones
    :param stands_in: Whether these are the best of the returns, since nobody has told a success
    :param asked_for: The key that was given, if no step had it
    :param candidates: Other keys of ``info`` that were True or False
    """

    key: str | None
    only_true: bool
    n_steps: int
    n_mid_episode: int
    n_counted: int
    stands_in: bool
    asked_for: str | None
    candidates: tuple[str, ...]


@dataclass(frozen=True)
class ChosenFeatures:
    """
    In which part of the observation modes differ.

    :param source: ``"given"``, ``"declared"``, ``"achieved_goal"``, ``"found"`` or ``"whole"``
    :param selection: As for ``mode_features``; None: the whole observation
    :param names: Of its components
    :param travels: How far each goes, in its own steps
    :param others: Of the other components of a whole observation, how far each goes
    :param parting: Whether those were found along which goal-reached episodes part, not those that go farthest
    """

    source: str
    selection: Any
    names: tuple[str, ...]
    travels: tuple[float, ...]
    others: dict[str, float]
    parting: bool


@dataclass(frozen=True)
class Cells:
    """
    By which places are told apart.

    :param edges: Of a cell along each mode feature, in its unit, infinite where nothing moved; None: too little was seen
    :param n_seen: Cells in which the steps ended
    :param given: Whether the size was declared or given
    :param complaint: Why novelty would say nothing by them; None if it does
    """

    edges: tuple[float, ...] | None
    n_seen: int
    given: bool
    complaint: str | None


@dataclass(frozen=True)
class EnvCheck:
    """
    What ``check_env`` found. Prints as a page.

    :param env: What was checked
    :param spaces: Of observations and actions
    :param policy: Name of the policy that they need
    :param is_image: Whether observations are images
    :param n_steps: Random steps that were taken
    :param lengths: Of the episodes that ended
    :param limit: Steps after which an episode is cut off; None: none was seen or declared
    :param declared_limit: Whether that is declared, not only seen
    :param success: What the steps said of success
    :param relabels: Whether transitions are given other goals, see ``Hindsight``; None: there are none
    :param features: In which part of the observation modes differ
    :param cells: By which places are told apart
    :param rewards: The smallest and the largest
    :param returns: Of the discounted returns from any step, the smallest and the largest
    :param gamma: By which they are discounted
    :param support: Range of values that the critics are held to; None: it follows the returns
    :param listed: Routes that the environment names
    :param labels: Episodes by the label of their route
    :param wrappers: Those that change observations, the innermost first
    :param warned: What the package and SB3's checker warned of
    :param code: Lines that train
    """

    env: str
    spaces: tuple[str, str]
    policy: str
    is_image: bool
    n_steps: int
    lengths: tuple[int, ...]
    limit: int | None
    declared_limit: bool
    success: SuccessSignal
    relabels: bool | None
    features: ChosenFeatures
    cells: Cells
    rewards: tuple[float, float]
    returns: tuple[float, float]
    gamma: float
    support: tuple[float, float] | None
    listed: tuple[str, ...]
    labels: dict[str, int]
    wrappers: tuple[str, ...]
    warned: tuple[str, ...]
    code: str

    def __str__(self) -> str:
        """The page."""
        parts = {
            "spaces": self._of_spaces(),
            "time limit": self._of_limit(),
            "success": [*self._of_success(), *self._of_goals()],
            "mode features": self._of_features(),
            "cells": self._of_cells(),
            "values": self._of_values(),
            "routes": self._of_routes(),
            "wrappers": [
                f"change what is observed: {', '.join(self.wrappers)}" if self.wrappers else "none changes observations"
            ],
            "warnings": list(self.warned) or ["none"],
        }
        n = len(self.lengths)
        mean = f", {sum(self.lengths) / n:.0f} steps long on average" if n else ""
        lines = [f"{self.env} can be trained on. {self.n_steps} random steps, {n} episodes ended{mean}.", ""]
        lines += [line for name, part in parts.items() for line in _entry(name, part)]
        lines += ["", "To have it otherwise, say so to DDiffPG (nothing of this needs to be set):"]
        lines += [f"  {argument:<46} {why}" for argument, why in self.arguments().items()]
        lines += ["", "To train:", "", *(f"    {line}".rstrip() for line in self.code.splitlines())]
        return "\n".join(lines)

    def arguments(self) -> dict[str, str]:
        """
        :return: What to give where one disagrees, with values that could be, and what each is for
        """
        features, cells, success = self.features, self.cells, self.success
        now, found = features.selection, {}
        if now is None:
            now = list(range(min(2, len(features.names))))
        elif not isinstance(now, str) and not callable(now):
            now = [int(each) for each in now]
        if not callable(now) and not self.is_image:  # of which no two numbers say where one is
            found[f"mode_features={now!r}"] = "where modes differ: indices, or a key, of the observation"
        key = success.key or next(iter(success.candidates), "reached")
        found[f"success_key={key!r}"] = "the key of info that tells a success"
        edge = max((each for each in cells.edges or () if math.isfinite(each)), default=0.5)
        cell_size = f'novelty={{"kwargs": {{"cell_size": {edge:.3g}}}}}'
        found[cell_size] = "edge of all cells, in the unit of the mode features"
        low, high = self.returns
        if success.n_counted and not success.stands_in and high > low:  # what a success is worth has been seen
            found[f'critic={{"v_min": {low:.4g}, "v_max": {high:.4g}}}'] = "smallest and largest return, held fixed"
        return found

    def _of_spaces(self) -> list[str]:
        return [f"observations {self.spaces[0]}", f"actions {self.spaces[1]}", f'policy "{self.policy}"']

    def _of_limit(self) -> list[str]:
        if self.limit is not None:
            return [f"{self.limit} steps, {'as declared' if self.declared_limit else 'as seen'}"]
        if self.lengths:
            return [
                "none was declared, and none was met: all episodes ended by themselves",
                "one that goes on is stored in parts; gymnasium.wrappers.TimeLimit(env, max_episode_steps=...) ends it",
            ]
        return [
            f"none, and no episode ended in {self.n_steps} steps; an episode without end never reaches a place by a new",
            "start: put gymnasium.wrappers.TimeLimit(env, max_episode_steps=...) around each environment",
        ]

    def _of_success(self) -> list[str]:
        signal, n = self.success, len(self.lengths)
        counted = f"{signal.n_counted} of {n} episodes"
        if signal.key is None:
            what = "until one does, the best fifth of the returns stands in for it"
            lines = [f"no step told it: {what if signal.stands_in else 'until one does, all have failed'} ({counted})"]
            if signal.asked_for is not None:
                lines[0] = f"no step told it by info[{signal.asked_for!r}], which was asked for: all have failed"
            if signal.candidates:
                lines.append(f"info also has {', '.join(signal.candidates)}: if one of these is meant, give it as success_key")
            return lines
        how = (
            "only where it is True"
            if signal.only_true
            else "at each step"
            if signal.n_steps == self.n_steps
            else "at some steps"
        )
        reached = f"0 of {n} episodes" if signal.stands_in else counted
        lines = [f'info["{signal.key}"], told {how}; {reached} counted']
        if signal.n_mid_episode:
            lines.append(f"it was True at {signal.n_mid_episode} steps after which the episode went on")
        if signal.stands_in or not signal.n_counted:
            lines.append("random actions have not reached it, which is usual: exploration goes on from here")
        if signal.stands_in and signal.n_counted:
            lines.append(f"until one does, the best fifth of the returns stands in for it ({counted})")
        return lines

    def _of_goals(self) -> list[str]:
        if self.relabels is None:
            return []
        also = "modes also learn from each episode as if the goal had been where it went"
        only = "no compute_reward for arrays of goals gives the rewards that were met, so each episode learns from its own"
        return [f"goals differ between episodes: {also if self.relabels else only}"]

    def _of_features(self) -> list[str]:
        features = self.features
        reached = "the best" if self.success.stands_in else "goal-reached"
        reason = {
            "given": "as given",
            "declared": "declared by the environment",
            "achieved_goal": "the achieved_goal of a goal environment",
            "whole": "the whole observation",
            "found": f"found: {reached} episodes part along them" if features.parting else "found: they go farthest",
        }[features.source]
        lines = [
            f"{_selected(features)}, {reason}",
            f"travel in steps of their own: {_travels(features.names, features.travels)}",
        ]
        if features.others:
            others = sorted(features.others.items(), key=lambda each: -each[1])
            lines.append(f"of the others: {_travels([name for name, _ in others], [far for _, far in others])}")
        return lines

    def _of_cells(self) -> list[str]:
        cells = self.cells
        if cells.edges is None:
            return ["too little was seen to tell places apart"]
        size = "given" if cells.given else "from where it has been; they grow with that"
        edges = ", ".join("not divided" if math.isinf(each) else f"{each:.3g}" for each in cells.edges[:_MOST_NAMED])
        more = ", ..." if len(cells.edges) > _MOST_NAMED else ""
        verdict = "neither almost every step nor almost none is new" if cells.complaint is None else "they say nothing"
        lines = [f"{self.n_steps} steps in {cells.n_seen} cells: {verdict}", f"edges {edges}{more} ({size})"]
        return lines if cells.complaint is None else [*lines, cells.complaint]

    def _of_values(self) -> list[str]:
        returns = f"discounted returns (gamma={self.gamma:g}) {_range(self.returns)}"
        lines = [f"rewards {_range(self.rewards)}, {returns}"]
        if self.limit is not None:
            lines.append("an episode that the time limit ends counts as if it went on")
        if self.support is None:
            return [*lines, "nothing need be set: the critics' range follows the returns"]
        return [*lines, f"the critics hold values within {_range(self.support)}, as given"]

    def _of_routes(self) -> list[str]:
        lines = [f"the environment names {', '.join(self.listed)}"] if self.listed else []
        if self.labels:
            met = ", ".join(f"{label} ({n})" for label, n in sorted(self.labels.items()))
            return [*lines, f'info["mode"] labelled episodes: {met}; only evaluations read it']
        if lines:
            return [*lines, 'no episode had a label in info["mode"] yet']
        return ["not labelled, which training does not need; evaluations tell routes apart by clustering"]


def _entry(name: str, lines: list[str]) -> list[str]:
    return [f"{name if not k else '':<{_WIDTH}}{line}" for k, line in enumerate(lines)]


def _range(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.4g} to {ends[1]:.4g}" if ends[0] != ends[1] else f"all {ends[0]:.4g}"


def _selected(features: ChosenFeatures) -> str:
    selection = features.selection
    if callable(selection):
        return f"{len(features.names)} numbers that a callable makes"
    if isinstance(selection, str):
        return f'the key "{selection}"'
    named = ", ".join(features.names[:_MOST_NAMED]) + (", ..." if len(features.names) > _MOST_NAMED else "")
    return f"components {named}" if len(features.names) > 1 else f"component {named}"


def _travels(names: Any, travels: Any) -> str:
    told = [f"{name} {far:.1f}" for name, far in zip(names, travels, strict=True)]
    return ", ".join(told[:_MOST_NAMED]) + (", ..." if len(told) > _MOST_NAMED else "")
