"""What an evaluation of modes found, and the numbers that follow from it: how many routes, how well commanded."""

import json
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from sb3_ddiffpg.evaluation import diversity
from sb3_ddiffpg.evaluation.rollout import EpisodeResult
from sb3_ddiffpg.serialization.safetensors_tree import convert

#: Share of episodes from which on a route counts as one that the model robustly takes
ROBUST_SHARE = 0.05
_FORMAT = 1
_MOST_EPISODES = 2**31 - 1  # of a command, so that tables of them are counted in 64 bits


@dataclass(frozen=True)
class CommandResult:
    """
    What the episodes under one command came to.

    :param mode: The mode that was commanded, None: none
    :param n_episodes: Complete episodes
    :param n_successes: Those that reached the goal
    :param mean_length: Mean steps of the successes, NaN if there are none
    :param mean_return: Mean undiscounted return of all episodes
    :param labels: How many successes took which route
    """

    mode: str | None
    n_episodes: int
    n_successes: int
    mean_length: float
    mean_return: float
    labels: dict[str, int]

    @property
    def success_rate(self) -> float:
        """Share of successes."""
        return self.n_successes / self.n_episodes

    @property
    def success_interval(self) -> tuple[float, float]:
        """Its 95 % Wilson interval."""
        from scipy.stats import binomtest  # slow to import

        interval = binomtest(self.n_successes, self.n_episodes).proportion_ci(method="wilson")
        return float(interval.low), float(interval.high)


@dataclass(frozen=True)
class RouteResult:
    """
    The successes that took one route, whatever was commanded.

    :param label: Of the route
    :param n_episodes: How many
    :param mean_length: Their mean steps
    :param path_ratio: Their mean path, in units of the mode features, as a multiple of the shortest among them
    """

    label: str
    n_episodes: int
    mean_length: float
    path_ratio: float


@dataclass(frozen=True)
class ModeEvaluation:
    """
    What ``evaluate_modes`` found. Prints as a table.

    :param env_id: Of the environment, or what it is
    :param label_source: ``"environment"`` (``info["mode"]``, where it declares ``listed_modes``), or ``"clustering"`` of these
        episodes' paths, where it gives no labels: then modes are counted by the same rule by which they were found
    :param listed: Routes that the environment names as those to find; empty if it names none
    :param start_spread: Largest distance between two episodes' starts, in units of the mode features
    :param uncommanded: Episodes in which the model chose for itself
    :param commanded: Those under each command
    :param routes: The routes that were taken
    :param success_told: Whether the environment says what a success is; where it does not, every episode counts as one
    :param episodes: All episodes by command, ``"(none)"`` without; not saved
    """

    env_id: str
    label_source: str
    listed: tuple[str, ...]
    start_spread: float
    uncommanded: CommandResult
    commanded: tuple[CommandResult, ...]
    routes: tuple[RouteResult, ...]
    success_told: bool = True
    episodes: dict[str, list[EpisodeResult]] = field(default_factory=dict, compare=False, repr=False)

    def expected_modes(self, n_draws: int = 20) -> float:
        """
        Different routes that are expected in some of the uncommanded episodes, drawn without replacement: with 20 the paper's
        "modes in 20 episodes", without its luck.

        :param n_draws: How many; all, if there are fewer
        :return: sum over routes k of ``1 - C(n - c_k, n_draws) / C(n, n_draws)``
        """
        n = self.uncommanded.n_episodes
        draws = min(n_draws, n)
        return sum(1 - math.comb(n - count, draws) / math.comb(n, draws) for count in self.uncommanded.labels.values())

    @property
    def robust_modes(self) -> int:
        """Routes that at least 5 % of the uncommanded episodes take to the goal."""
        return len(self._robust())

    def _robust(self) -> list[str]:
        n = self.uncommanded.n_episodes
        return [label for label, count in self.uncommanded.labels.items() if count >= ROBUST_SHARE * n]

    @property
    def effective_modes(self) -> float:
        """exp of the entropy of the routes' shares among the uncommanded successes; 0 without successes."""
        counts = np.array(list(self.uncommanded.labels.values()), dtype=float)
        if not counts.size:
            return 0.0
        shares = counts / counts.sum()
        return float(np.exp(-(shares * np.log(shares)).sum()))

    @property
    def coverage(self) -> float:
        """Share of the listed routes that are robust; NaN if none is listed."""
        return len(set(self._robust()) & set(self.listed)) / len(self.listed) if self.listed else float("nan")

    def _listed_counts(self) -> list[int]:
        """Uncommanded successes by each listed route that was taken."""
        return [count for label, count in self.uncommanded.labels.items() if label in self.listed]

    @property
    def behavior_entropy(self) -> float:
        """D3IL's, of the uncommanded successes over the listed routes, in [0, 1]; NaN if fewer than two are listed."""
        return diversity.behavior_entropy(self._listed_counts(), len(self.listed))

    @property
    def reachable_modes(self) -> float:
        """DrAC's: listed routes that were taken at least once uncommanded; NaN if none is listed."""
        return len(self._listed_counts()) if self.listed else float("nan")

    @property
    def multi_goal_score(self) -> float:
        """DrAC's, of the uncommanded episodes, in [0, 1]; NaN if no route is listed."""
        if not self.listed:
            return float("nan")
        return diversity.multi_goal_score(self._listed_counts(), len(self.listed), self.uncommanded.n_episodes)

    def few_shot_robustness(self, n_removed: int, n_trials: int = 5) -> float:
        """
        Tell how likely a few uncommanded trials are to succeed if some listed routes are closed, as DrAC does with goals.

        :param n_removed: Number of listed routes that are closed
        :param n_trials: Number of trials
        :return: The probability; NaN if no route is listed
        :raises ValueError: If an argument is out of range
        """
        if not self.listed:
            return float("nan")
        if not 0 <= n_removed <= len(self.listed):
            raise ValueError(
                f"n_removed: {n_removed} given; accepted are 0 to {len(self.listed)}, the number of listed routes"
            )
        if n_trials < 1:
            raise ValueError(f"n_trials: {n_trials} given; accepted are numbers from 1 up")
        n_episodes = self.uncommanded.n_episodes
        return diversity.few_shot_robustness(self._listed_counts(), len(self.listed), n_episodes, n_removed, n_trials)

    def qd_archive(self, corrected: bool = True) -> dict[str, float]:
        """
        Take the listed routes as the cells of a quality-diversity archive (pyribs, QDax), commanded modes as its solutions,
        and returns as their objective.

        :param corrected: Whether a mode is where most of its episodes are, with their median return, or where the first one is
        :return: Return of the best mode in each route that has one
        :raises ValueError: If the episodes are not there, as in an evaluation from a file
        """
        runs = [self.episodes.get(str(each.mode)) for each in self.commanded]
        if any(run is None for run in runs):
            raise ValueError("The evaluation holds no single episodes: it is from a file. Evaluate the model again")
        solutions = [[(each.label if each.success else None, each.episode_return) for each in run or ()] for run in runs]
        return diversity.qd_archive(solutions, self.listed, corrected)

    def qd_score(self, offset: float = 0.0, corrected: bool = True) -> float:
        """
        Add up the returns of the best modes by listed route: the QD-score.

        :param offset: What is added to each return, so that none is negative
        :param corrected: See ``qd_archive``
        :return: The sum over the routes that have a mode
        :raises ValueError: See ``qd_archive``
        """
        return sum(each + offset for each in self.qd_archive(corrected).values())

    @property
    def commandable(self) -> list[str]:
        """Routes that some command takes in at least 95 % of its episodes."""
        return sorted({label for each in self.commanded for label, n in each.labels.items() if n >= 0.95 * each.n_episodes})

    @property
    def labels(self) -> list[str]:
        """The routes that were taken, the columns of :attr:`confusion`."""
        return [route.label for route in self.routes]

    @property
    def confusion(self) -> np.ndarray:
        """Commanded mode (row) by the route taken (column), failures last; shape [M, number of routes + 1]."""
        rows = [
            [*(each.labels.get(label, 0) for label in self.labels), each.n_episodes - each.n_successes]
            for each in self.commanded
        ]
        return np.array(rows, dtype=int).reshape(len(self.commanded), len(self.labels) + 1)

    @property
    def matching(self) -> dict[str, str]:
        """Each mode's own route: one to one, such that most commanded episodes took the route of their mode."""
        counts = self.confusion[:, :-1]
        pairs = zip(*linear_sum_assignment(counts, maximize=True), strict=True)
        return {str(self.commanded[row].mode): self.labels[column] for row, column in pairs if counts[row, column]}

    @property
    def commanded_modes(self) -> float:
        """How many routes can be commanded: the share of episodes that took their mode's own route, summed over the modes."""
        episodes = {str(each.mode): each for each in self.commanded}
        return sum(episodes[mode].labels[route] / episodes[mode].n_episodes for mode, route in self.matching.items())

    @property
    def control_accuracy(self) -> float:
        """Share of the commanded episodes that reached the goal by their mode's own route; NaN without modes."""
        n_right = sum(each.labels.get(self.matching.get(str(each.mode), ""), 0) for each in self.commanded)
        n = sum(each.n_episodes for each in self.commanded)
        return n_right / n if n else float("nan")

    def __str__(self) -> str:
        rows = [*self.commanded, self.uncommanded]
        names = [command_name(row.mode) for row in rows]
        width = max(9, *map(len, names))
        lines = [f"{'commanded':<{width}}  success      95 % interval   length   return  routes taken"]
        for name, row in zip(names, rows, strict=True):
            low, high = row.success_interval
            ways = ", ".join(f"{label} x{count}" for label, count in row.labels.items()) or "-"
            lines.append(
                f"{name:<{width}}  {row.n_successes:4d}/{row.n_episodes:<4d}  {low:6.1%} - {high:6.1%}"
                f"  {row.mean_length:7.1f}  {row.mean_return:7.2f}  {ways}"
            )
        accuracy, coverage = ("-" if np.isnan(x) else f"{x:.1%}" for x in (self.control_accuracy, self.coverage))
        lines += [
            "",
            f"uncommanded: {self.expected_modes():.2f} modes expected in 20 episodes, {self.robust_modes} robust,"
            f" {self.effective_modes:.2f} effective, coverage {coverage}; control accuracy {accuracy}",
        ]
        if self.label_source == "clustering":
            told = "The environment gives no labels: routes are clusters of these very episodes' paths"
            successes = sum(row.n_successes for row in rows)
            alone = successes - sum(sum(row.labels.values()) for row in rows)
            lines.append(told + (f", but for {alone} of {successes}, which are like too few others" if alone else ""))
        if self.start_spread > 1e-3:
            lines.append(f"Episodes start up to {self.start_spread:.3g} apart: the start may decide on the route")
        return "\n".join(lines)

    def save(self, path: str | Path) -> None:
        """
        :param path: Of the JSON file
        """
        Path(path).write_text(json.dumps(self.to_dict(), indent=2) + "\n")

    def to_dict(self) -> dict[str, Any]:
        """
        :return: What JSON can hold: what was counted, and a ``summary`` of what follows from it
        """
        summary = {
            "expected_modes_in_20": self.expected_modes(),
            "robust_modes": self.robust_modes,
            "effective_modes": self.effective_modes,
            "coverage": _number(self.coverage),
            "behavior_entropy": _number(self.behavior_entropy),
            "reachable_modes": _number(self.reachable_modes),
            "multi_goal_score": _number(self.multi_goal_score),
            "few_shot_robustness": [_number(self.few_shot_robustness(k)) for k in range(len(self.listed) + 1)],
            "commanded_modes": self.commanded_modes,
            "control_accuracy": _number(self.control_accuracy),
            "commandable": self.commandable,
            "matching": self.matching,
            "success_intervals": {
                command_name(each.mode): each.success_interval for each in [*self.commanded, self.uncommanded]
            },
        }
        counted = asdict(replace(self, episodes={}))
        del counted["episodes"]
        return {"format": _FORMAT, **_without_nan(counted), "summary": summary}

    @staticmethod
    def load(path: str | Path) -> "ModeEvaluation":
        """
        :param path: Of a file that :meth:`save` wrote
        :return: The evaluation
        :raises ValueError: If it is no such file
        """
        try:
            return ModeEvaluation.from_dict(json.loads(Path(path).read_text()))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path} is no evaluation of modes in format {_FORMAT}: {error!r}") from None

    @staticmethod
    def from_dict(data: Any) -> "ModeEvaluation":
        """
        :param data: What :meth:`to_dict` gave
        :return: The evaluation
        :raises ValueError: If it is of another format
        """
        if not isinstance(data, dict) or data.get("format") != _FORMAT:
            raise ValueError(f"it is not of format {_FORMAT}")

        def command(row: dict[str, Any]) -> dict[str, Any]:
            return {**row, "mean_length": _nan(row["mean_length"]), "mean_return": _nan(row["mean_return"])}

        counted = {name: value for name, value in data.items() if name not in ("format", "summary", "episodes")}
        if "ways" in counted:  # as version 0.1 called them
            counted["routes"] = counted.pop("ways")
        try:
            counted["uncommanded"] = command(data["uncommanded"])
            counted["commanded"] = [command(row) for row in data["commanded"]]
        except (KeyError, TypeError) as error:
            raise ValueError(f"evaluation: {error!r}") from None
        found = convert(counted, ModeEvaluation, "evaluation")
        for each in (found.uncommanded, *found.commanded):
            counts = each.labels.values()
            if not (each.n_episodes > 0 and all(count > 0 for count in counts) and sum(counts) <= each.n_successes):
                raise ValueError(f"{command_name(each.mode)}: the numbers of episodes contradict each other")
            if each.n_successes > each.n_episodes:
                raise ValueError(f"{command_name(each.mode)}: more successes than episodes")
            if each.n_episodes > _MOST_EPISODES:
                raise ValueError(f"{command_name(each.mode)}: {each.n_episodes} episodes; accepted are up to {_MOST_EPISODES}")
        return found


def command_name(mode: str | None) -> str:
    """
    :param mode: That is commanded, None: none
    :return: How tables and files call it
    """
    return "(none)" if mode is None else mode


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _nan(value: float | None) -> float:
    return float("nan") if value is None else value


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(each) for key, each in value.items()}
    return [_without_nan(each) for each in value] if isinstance(value, (list, tuple)) else _number(value)
