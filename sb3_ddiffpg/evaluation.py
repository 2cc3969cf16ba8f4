"""Counting modes honestly: what each command does, and which ways an uncommanded model takes, from one fixed start."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import binomtest
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.buffers import ModeReplayBuffer
from sb3_ddiffpg.clustering import cluster
from sb3_ddiffpg.dtw import comparable_path, dtw_distances
from sb3_ddiffpg.envs import is_ours, make_vec_env
from sb3_ddiffpg.episodes import EpisodeResult, run_episodes
from sb3_ddiffpg.rng import preserved_rng
from sb3_ddiffpg.safe_files import convert
from sb3_ddiffpg.trajectories import NO_MODE

#: Share of episodes from which on a way counts as one that the model robustly takes
ROBUST_SHARE = 0.05
_FORMAT = 1
_MOST_EPISODES = 2**31 - 1  # of a command, so that tables of them are counted in 64 bits
# Of a success that is like no other
_NO_WAY = ""


@dataclass(frozen=True)
class CommandResult:
    """
    What the episodes under one command came to.

    :param mode: The mode that was commanded, None: none
    :param n_episodes: Complete episodes
    :param n_successes: Those that reached the goal
    :param mean_length: Mean steps of the successes, NaN if there are none
    :param mean_return: Mean undiscounted return of all episodes
    :param labels: How many successes took which way
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
        interval = binomtest(self.n_successes, self.n_episodes).proportion_ci(method="wilson")
        return float(interval.low), float(interval.high)


@dataclass(frozen=True)
class WayResult:
    """
    The successes that took one way, whatever was commanded.

    :param label: Of the way
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
    What :func:`evaluate_modes` found. Prints as a table.

    :param env_id: Of the environment, or what it is
    :param label_source: ``"environment"`` (``info["mode"]``), or ``"clustering"`` of these episodes' paths, where it gives no
        labels: then modes are counted by the same rule by which they were found
    :param listed: Ways that the environment names as those to find; empty if it names none
    :param start_spread: Largest distance between two episodes' starts, in units of the mode features
    :param uncommanded: Episodes in which the model chose for itself
    :param commanded: Those under each command
    :param ways: The ways that were taken
    :param episodes: All episodes by command, ``"(none)"`` without; not saved
    """

    env_id: str
    label_source: str
    listed: tuple[str, ...]
    start_spread: float
    uncommanded: CommandResult
    commanded: tuple[CommandResult, ...]
    ways: tuple[WayResult, ...]
    episodes: dict[str, list[EpisodeResult]] = field(default_factory=dict, compare=False, repr=False)

    def expected_modes(self, n_draws: int = 20) -> float:
        """
        Different ways that are expected in some of the uncommanded episodes, drawn without replacement: with 20 the paper's
        "modes in 20 episodes", without its luck.

        :param n_draws: How many; all, if there are fewer
        :return: sum over ways k of ``1 - C(n - c_k, n_draws) / C(n, n_draws)``
        """
        n = self.uncommanded.n_episodes
        draws = min(n_draws, n)
        return sum(1 - math.comb(n - count, draws) / math.comb(n, draws) for count in self.uncommanded.labels.values())

    @property
    def robust_modes(self) -> int:
        """Ways that at least 5 % of the uncommanded episodes take to the goal."""
        return len(self._robust())

    def _robust(self) -> list[str]:
        n = self.uncommanded.n_episodes
        return [label for label, count in self.uncommanded.labels.items() if count >= ROBUST_SHARE * n]

    @property
    def effective_modes(self) -> float:
        """exp of the entropy of the ways' shares among the uncommanded successes; 0 without successes."""
        counts = np.array(list(self.uncommanded.labels.values()), dtype=float)
        if not counts.size:
            return 0.0
        shares = counts / counts.sum()
        return float(np.exp(-(shares * np.log(shares)).sum()))

    @property
    def coverage(self) -> float:
        """Share of the listed ways that are robust; NaN if none is listed."""
        return len(set(self._robust()) & set(self.listed)) / len(self.listed) if self.listed else float("nan")

    @property
    def commandable(self) -> list[str]:
        """Ways that some command takes in at least 95 % of its episodes."""
        return sorted({label for each in self.commanded for label, n in each.labels.items() if n >= 0.95 * each.n_episodes})

    @property
    def labels(self) -> list[str]:
        """The ways that were taken, the columns of :attr:`confusion`."""
        return [way.label for way in self.ways]

    @property
    def confusion(self) -> np.ndarray:
        """Commanded mode (row) by the way taken (column), failures last; shape [M, number of ways + 1]."""
        rows = [
            [*(each.labels.get(label, 0) for label in self.labels), each.n_episodes - each.n_successes]
            for each in self.commanded
        ]
        return np.array(rows, dtype=int).reshape(len(self.commanded), len(self.labels) + 1)

    @property
    def matching(self) -> dict[str, str]:
        """Each mode's own way: one to one, such that most commanded episodes took the way of their mode."""
        counts = self.confusion[:, :-1]
        pairs = zip(*linear_sum_assignment(counts, maximize=True), strict=True)
        return {str(self.commanded[row].mode): self.labels[column] for row, column in pairs if counts[row, column]}

    @property
    def commanded_modes(self) -> float:
        """How many ways can be commanded: the share of episodes that took their mode's own way, summed over the modes."""
        episodes = {str(each.mode): each for each in self.commanded}
        return sum(episodes[mode].labels[way] / episodes[mode].n_episodes for mode, way in self.matching.items())

    @property
    def control_accuracy(self) -> float:
        """Share of the commanded episodes that reached the goal by their mode's own way; NaN without modes."""
        n_right = sum(each.labels.get(self.matching.get(str(each.mode), ""), 0) for each in self.commanded)
        n = sum(each.n_episodes for each in self.commanded)
        return n_right / n if n else float("nan")

    def __str__(self) -> str:
        rows = [*self.commanded, self.uncommanded]
        names = [_command_name(row.mode) for row in rows]
        width = max(9, *map(len, names))
        lines = [f"{'commanded':<{width}}  success      95 % interval   length   return  ways taken"]
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
            lines.append("The environment gives no labels: ways are clusters of these very episodes' paths")
        if self.start_spread > 1e-3:
            lines.append(f"Episodes start up to {self.start_spread:.3g} apart: the start may decide on the way")
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
            "commanded_modes": self.commanded_modes,
            "control_accuracy": _number(self.control_accuracy),
            "commandable": self.commandable,
            "matching": self.matching,
            "success_intervals": {
                _command_name(each.mode): each.success_interval for each in [*self.commanded, self.uncommanded]
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
        except ValueError as error:
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
        try:
            counted["uncommanded"] = command(data["uncommanded"])
            counted["commanded"] = [command(row) for row in data["commanded"]]
        except (KeyError, TypeError) as error:
            raise ValueError(f"evaluation: {error!r}") from None
        found = convert(counted, ModeEvaluation, "evaluation")
        for each in (found.uncommanded, *found.commanded):
            counts = each.labels.values()
            if not (each.n_episodes > 0 and all(count > 0 for count in counts) and sum(counts) <= each.n_successes):
                raise ValueError(f"{_command_name(each.mode)}: the numbers of episodes contradict each other")
            if each.n_successes > each.n_episodes:
                raise ValueError(f"{_command_name(each.mode)}: more successes than episodes")
            if each.n_episodes > _MOST_EPISODES:
                raise ValueError(
                    f"{_command_name(each.mode)}: {each.n_episodes} episodes; accepted are up to {_MOST_EPISODES}"
                )
        return found


def _command_name(mode: str | None) -> str:
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


def evaluate_modes(
    model: Any,
    env: VecEnv | str,
    n_episodes: int = 100,
    n_uncommanded: int | None = None,
    modes: Sequence[str] | None = None,
    listed: Sequence[str] | None = None,
    deterministic: bool = False,
    seed: int | None = None,
    **env_kwargs: Any,
) -> ModeEvaluation:
    """
    Run complete episodes under each command and without any, and count which ways they took.

    All should begin at one fixed start, or the start decides on the way. Given an id, the tasks of this package are made
    without start noise; of other environments the result says how far apart their episodes started.

    :param model: Any SB3 model. What has no modes, such as a TD3, is run without commands
    :param env: The environments, or the id of one
    :param n_episodes: Episodes for each command
    :param n_uncommanded: Episodes without command; twice ``n_episodes`` when None
    :param modes: Names of the modes to command; all when None
    :param listed: Labels of the ways to find; what the environment says in ``listed_modes`` when None
    :param deterministic: Passed to ``predict``
    :param seed: Seeds environments and actions
    :param env_kwargs: Arguments of ``gym.make``, if ``env`` is an id
    :return: The evaluation
    :raises ValueError: If an argument cannot work, naming it
    """
    known = [mode.name for mode in getattr(model, "modes", ())]
    n_uncommanded = 2 * n_episodes if n_uncommanded is None else n_uncommanded
    for argument, number in (("n_episodes", n_episodes), ("n_uncommanded", n_uncommanded)):
        if not isinstance(number, (int, np.integer)) or number < 1:
            raise ValueError(f"{argument} must be an integer of at least 1, got {number!r}")
    if isinstance(modes, str):
        raise ValueError(f"modes: {modes!r} given; accepted is a list of names")
    for name in modes or ():
        if name not in known:
            raise ValueError(f"modes: {name!r} given; the model's modes are {known}")
    if isinstance(env, str):
        if is_ours(env):
            env_kwargs = {"start_noise": 0.0, **env_kwargs}
        made = make_vec_env(env, min(n_episodes, 25), seed=seed, **env_kwargs)
        try:
            return evaluate_modes(model, made, n_episodes, n_uncommanded, modes, listed, deterministic, seed)
        finally:
            made.close()
    if env_kwargs:
        raise ValueError(f"{sorted(env_kwargs)} given; accepted beside an env that is made already are none")
    if seed is not None:
        with preserved_rng():
            set_random_seed(seed)
            if hasattr(env, "seed"):
                env.seed(seed)
            return evaluate_modes(model, env, n_episodes, n_uncommanded, modes, listed, deterministic)
    commands: list[str | None] = [*(known if modes is None else modes), None]
    runs = [
        run_episodes(model, env, n, mode=command, deterministic=deterministic)
        for command in commands
        for n in [n_uncommanded if command is None else n_episodes]
    ]
    if listed is None:
        listed = env.get_attr("listed_modes", indices=0)[0] if env.has_attr("listed_modes") else ()
    labels, source = _labels(model, runs)
    spec = env.get_attr("spec", indices=0)[0] if env.has_attr("spec") else None
    results = [_count(command, run, names) for command, run, names in zip(commands, runs, labels, strict=True)]
    starts = np.array([episode.path[0] for run in runs for episode in run])
    return ModeEvaluation(
        env_id=type(env).__name__ if spec is None else spec.id,
        label_source=source,
        listed=tuple(map(str, listed)),
        start_spread=float(np.linalg.norm(np.ptp(starts, axis=0))),
        uncommanded=results[-1],
        commanded=tuple(results[:-1]),
        ways=_ways(runs, labels),
        episodes={_command_name(command): run for command, run in zip(commands, runs, strict=True)},
    )


def clustering_agreement(model: Any) -> float:
    """
    How well the modes of the stored trajectories agree with the environment's own labels. The clustering never saw those.

    :param model: A DDiffPG with its replay buffer
    :return: Adjusted Rand index over the goal-reached trajectories that have a mode and a label (1: the same partition, 0: as
        by chance); NaN if there are none
    """
    from sklearn.metrics import adjusted_rand_score  # of the extra "plots"

    known = [t for t in model.replay_buffer.trajectories(True) if t.mode != NO_MODE and t.label is not None]
    if not known:
        return float("nan")
    return float(adjusted_rand_score([t.label for t in known], [t.mode for t in known]))


def _labels(model: Any, runs: list[list[EpisodeResult]]) -> tuple[list[list[str | None]], str]:
    """The way of every success, None for failures, and who says so."""
    successes = [episode for run in runs for episode in run if _reached(episode)]
    if not successes or any(episode.label is not None for episode in successes):
        return [[str(episode.label) if _reached(episode) else None for episode in run] for run in runs], "environment"
    # As the model finds them, where it does
    buffer = getattr(model, "replay_buffer", None)
    if isinstance(buffer, ModeReplayBuffer) and (buffer.size() or not buffer.features.whole_observation):
        paths = [buffer.resample(episode.path) for episode in successes]
        normalize, linkage = buffer.normalize_distances, getattr(model, "linkage", "average")
    else:
        full = [episode.path for episode in successes]
        if full[0].shape[1] > 3:  # a whole observation, whose components have scales of their own
            scale = np.maximum(np.concatenate(full).std(axis=0), 1e-6)
            full = [path / scale for path in full]
        compared_length = getattr(buffer, "compared_length", None)
        paths, normalize, linkage = [comparable_path(path, arc_length=compared_length) for path in full], True, "average"
    threshold, min_size = getattr(model, "distance_threshold", None), 1 if len(paths) < 3 else 3
    numbers = iter(cluster(dtw_distances(paths, normalize=normalize), threshold, linkage, min_size=min_size))
    names = [[_cluster_name(next(numbers)) if _reached(episode) else None for episode in run] for run in runs]
    return names, "clustering"


def _reached(episode: EpisodeResult) -> bool:
    """Where nobody says what a success is, every complete episode counts."""
    return episode.success is not False


def _cluster_name(number: int) -> str:
    return f"cluster {number}" if number >= 0 else _NO_WAY


def _count(command: str | None, run: list[EpisodeResult], labels: list[str | None]) -> CommandResult:
    lengths = [episode.length for episode, label in zip(run, labels, strict=True) if label is not None]
    return CommandResult(
        mode=command,
        n_episodes=len(run),
        n_successes=len(lengths),
        mean_length=float(np.mean(lengths)) if lengths else float("nan"),
        mean_return=float(np.mean([episode.episode_return for episode in run])),
        labels=dict(Counter(label for label in labels if label).most_common()),
    )


def _ways(runs: list[list[EpisodeResult]], labels: list[list[str | None]]) -> tuple[WayResult, ...]:
    """Most frequent first."""
    by_label: dict[str, list[EpisodeResult]] = {}
    for run, names in zip(runs, labels, strict=True):
        for episode, name in zip(run, names, strict=True):
            if name:
                by_label.setdefault(name, []).append(episode)
    ways = []
    for label, episodes in sorted(by_label.items(), key=lambda item: -len(item[1])):
        paths = [float(np.linalg.norm(np.diff(episode.path, axis=0), axis=1).sum()) for episode in episodes]
        shortest = min(paths)
        ratio = float(np.mean(paths)) / shortest if shortest > 0 else 1.0
        ways.append(WayResult(label, len(episodes), float(np.mean([episode.length for episode in episodes])), ratio))
    return tuple(ways)
