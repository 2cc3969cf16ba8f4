"""Who is who among the modes: numbers and names, statistics, and the table behind ``model.modes``."""

import re
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, field
from typing import Annotated, Any

import msgspec
import numpy as np

from sb3_ddiffpg.serialization.safetensors_tree import Count, check_array, convert

#: Latest commanded episodes by which modes are compared, and what makes one worse than the best: the share of the pairs of an
#: episode of each that it loses (ties count half), and how seldom that may be chance
COMPARED_EPISODES, OUTCLASSED, CHANCE = 30, 0.75, 0.01
#: Fewest commanded episodes that say something of a mode: two successes of five are plainly worse than 30 of 30
TRIED_EPISODES = 5
# A name stands in tables, legends, on command lines (where a number would be an index) and in tags of a log that cuts them
ACCEPTED_NAME = re.compile(r"(?!_)(?=.*[^\W\d])[\w .+-]{1,24}")


@dataclass(frozen=True)
class Outcome:
    """
    A training episode that was commanded to a mode.

    :param success: Whether it reached the goal, by whatever route
    :param episode_return: Sum of its rewards
    :param length: Number of steps
    """

    success: bool
    episode_return: float
    length: int


def default_name(number: int) -> str:
    """
    :param number: A mode's number
    :return: The name that it is born with
    """
    return f"mode_{number}"


def check_name(name: Any, number: int) -> None:
    """
    :param name: That a mode is to have
    :param number: The mode's
    :raises ValueError: If it is no name, or another mode may be born with it
    """
    if not isinstance(name, str) or not ACCEPTED_NAME.fullmatch(name) or name != name.strip():
        given = repr(name)[:100]
        raise ValueError(
            f"name={given} is no name of a mode: accepted are 1 to 24 letters, digits, spaces and _.+-, not digits alone"
        )
    if re.fullmatch(r"mode_\d+", name) and name != default_name(number):
        raise ValueError(f"name={name!r} is reserved for the mode that is born with it")


@dataclass(eq=False)
class Mode:
    """
    One discovered way to solve the task.

    :param number: Counted up from 0 in each run; a mode keeps it for life, through re-clusterings, saving and loading
    :param name: ``mode_<number>``, until ``DDiffPG.rename_mode`` gives it another
    :param born_at: Environment steps when it was discovered
    :param n_trajectories: Goal-reached trajectories that train it
    :param mean_length: Their mean length, in environment steps
    :param mean_return: Their mean undiscounted return
    :param representative: Mode features along the most central of them (the medoid), shape [length + 1, dim]
    :param frozen: Whether it is never merged, retired or crowded out, see ``DDiffPG.freeze_mode``
    :param outcomes: The latest training episodes that were commanded to this mode
    :param doubts: Re-clusterings in a row that found it within another mode's cluster
    :param misses: Training episodes in a row that were commanded to it and did not reach the goal by its route
    :param unjudged: Commanded training episodes since the last clustering, which has not told yet by which route they went
    :param embedding: The vector that commands it; filled in by ``model.modes``, owned by the policy
    """

    number: int
    name: str
    born_at: int
    n_trajectories: int = 0
    mean_length: float = float("nan")
    mean_return: float = float("nan")
    representative: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), dtype=np.float32), repr=False)
    frozen: bool = False
    outcomes: deque[Outcome] = field(default_factory=lambda: deque(maxlen=100), repr=False)
    doubts: int = field(default=0, repr=False)
    misses: int = field(default=0, repr=False)
    unjudged: int = field(default=0, repr=False)
    embedding: np.ndarray | None = field(default=None, repr=False)

    @property
    def success_rate(self) -> float:
        """Share of successes among the latest (at most 100) training episodes commanded to it, noise included; or NaN."""
        return self._mean("success")

    @property
    def expected_return(self) -> float:
        """Mean undiscounted return of these episodes, failures included; or NaN."""
        return self._mean("episode_return")

    @property
    def expected_length(self) -> float:
        """Mean number of steps of these episodes, failures included; or NaN."""
        return self._mean("length")

    def _mean(self, name: str) -> float:
        return float(np.mean([getattr(outcome, name) for outcome in self.outcomes])) if self.outcomes else float("nan")


def outclassed(modes: Sequence[Mode], by_success: bool) -> set[int]:
    """
    Modes that are plainly worse than the best one, by a Mann-Whitney test of their latest commanded training episodes.

    :param modes: Of a model
    :param by_success: Whether episodes are compared by whether they succeeded, else by their returns
    :return: Indices; without evidence none
    """
    kinds = "success" if by_success else "episode_return"
    scores = [np.array([getattr(each, kinds) for each in mode.outcomes][-COMPARED_EPISODES:], dtype=float) for mode in modes]
    best = max((each for each in scores if len(each)), key=np.mean, default=np.zeros(0))

    def is_worse(own: np.ndarray) -> bool:
        wins = np.sign(best[:, None] - own).mean() / 2 + 0.5 if len(own) else 0.5
        if wins <= OUTCLASSED:
            return False
        from scipy.stats import mannwhitneyu  # slow to import, and seldom asked

        return mannwhitneyu(best, own, alternative="greater", method="asymptotic").pvalue < CHANCE

    return {index for index, own in enumerate(scores) if is_worse(own)}


class _State(msgspec.Struct, forbid_unknown_fields=True):
    number: Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
    name: str
    born_at: Count
    n_trajectories: Count
    mean_length: float
    mean_return: float
    representative: np.ndarray
    frozen: bool
    outcomes: list[tuple[bool, float, Count]]
    doubts: Count
    misses: Count
    unjudged: Count


def modes_state(modes: Sequence[Mode]) -> list[dict[str, Any]]:
    """
    :param modes: Of a model
    :return: All that is known of them, in plain values and arrays
    """
    plain = [name for name in _State.__struct_fields__ if name != "outcomes"]
    return [
        {**{name: getattr(mode, name) for name in plain}, "outcomes": [astuple(each) for each in mode.outcomes]}
        for mode in modes
    ]


def modes_from_state(state: Any) -> list[Mode]:
    """
    :param state: What ``modes_state`` gave
    :return: The modes
    :raises ValueError: If it is something else
    """
    modes = []
    for known in convert(state, list[_State], "modes"):
        check_array(known.representative, np.float32, [None, None], "modes.representative")
        if not np.isfinite(known.representative).all():
            raise ValueError("modes.representative: there are numbers that are not finite")
        check_name(known.name, known.number)
        values = {name: getattr(known, name) for name in known.__struct_fields__ if name != "outcomes"}
        modes.append(Mode(**values))
        modes[-1].outcomes.extend(Outcome(*each) for each in known.outcomes)
    for what in ("number", "name"):
        if len({getattr(mode, what) for mode in modes}) < len(modes):
            raise ValueError(f"modes: two have the same {what}")
    return modes


class ModeTable(Sequence[Mode]):
    """
    The modes that a model holds. Iterate over it, index it by number or name, or print it.

    :param modes: In the order of their indices
    """

    def __init__(self, modes: Sequence[Mode] = ()) -> None:
        self._modes = list(modes)

    @property
    def names(self) -> list[str]:
        """Names in the order of the indices."""
        return [mode.name for mode in self._modes]

    def __len__(self) -> int:
        return len(self._modes)

    def __iter__(self) -> Iterator[Mode]:
        return iter(self._modes)

    def __getitem__(self, key):
        """
        :param key: Index, slice or name
        """
        return self._modes[self.index(key) if isinstance(key, str) else key]

    def __contains__(self, mode: object) -> bool:
        """
        :param mode: A name or a record
        """
        return mode in self.names if isinstance(mode, str) else any(mode is each for each in self._modes)

    def index(self, mode: "str | int | Mode", *args) -> int:
        """
        :param mode: Name, index or record of a mode
        :return: Its index
        :raises ValueError: If there is no such mode
        """
        if isinstance(mode, Mode):
            mode = mode.name
        if isinstance(mode, str) and mode in self.names:
            return self.names.index(mode)
        if isinstance(mode, (int, np.integer)) and not isinstance(mode, bool) and 0 <= mode < len(self):
            return int(mode)
        accepted = f"the modes are {self.names} (or an index below {len(self)})" if self._modes else "there is no mode yet"
        raise ValueError(f"mode={mode!r} is unknown; {accepted}")

    def __str__(self) -> str:
        if not self._modes:
            return "no mode yet (no goal-reached trajectories have been clustered)"
        width = max(4, *(len(mode.name) for mode in self._modes))
        lines = [f"{'mode':<{width}}  trajectories  success  length   return"]
        for mode in self._modes:
            success = "    -" if np.isnan(mode.success_rate) else f"{mode.success_rate:5.2f}"
            lines.append(
                f"{mode.name:<{width}}  {mode.n_trajectories:12d}    {success}"
                f"  {mode.mean_length:6.1f}  {mode.mean_return:7.2f}"
            )
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"ModeTable({self.names})"
