"""What became of the modes in the course of a run."""

import itertools
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, astuple, dataclass
from typing import Any

import msgspec
import numpy as np

from sb3_ddiffpg.clustering.matching import ModeMatching
from sb3_ddiffpg.modes.mode import Mode, default_name
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert

#: What can happen to a mode; those of the second row by hand
BIRTHS = ("born", "split from")
EVENT_KINDS = (
    *(*BIRTHS, "merged into", "retired"),
    *("renamed to", "frozen", "released", "deleted"),
)


@dataclass(frozen=True)
class ModeEvent:
    """
    Something that happened to a mode. ``str(event)`` is a sentence.

    :param step: Environment steps at that time
    :param kind: One of ``EVENT_KINDS``
    :param number: The mode's number, which nothing changes
    :param name: Its name at that time
    :param other: Name of the mode from which it split or into which it was merged, or its new name
    """

    step: int
    kind: str
    number: int
    name: str
    other: str | None = None

    def __str__(self) -> str:
        return " ".join(part for part in (self.name, self.kind, self.other) if part is not None)


@dataclass(frozen=True)
class ModeState:
    """
    A mode at one re-clustering.

    :param step: Environment steps at that time
    :param number: The mode's number
    :param n_trajectories: Goal-reached trajectories that train it
    :param success_rate: Share of successes among its latest commanded training episodes, NaN if there are none
    """

    step: int
    number: int
    n_trajectories: int
    success_rate: float


#: Of ``ModeState``: how each field is kept, in memory and in a file
_COLUMNS = {"step": "q", "number": "q", "n_trajectories": "q", "success_rate": "d"}


class _Columns(msgspec.Struct, forbid_unknown_fields=True):
    step: np.ndarray
    number: np.ndarray
    n_trajectories: np.ndarray
    success_rate: np.ndarray


class _State(msgspec.Struct, forbid_unknown_fields=True):
    events: list[ModeEvent]
    states: list[ModeState] | _Columns  # a list in older files


class ModeHistory:
    """
    All events of a run, and every mode's state at each re-clustering. Iterate over the events, or print them.

    :param events: In order of time
    :param states: In order of time
    """

    def __init__(self, events: Iterable[ModeEvent] = (), states: Iterable[ModeState] = ()) -> None:
        self.events = list(events)
        # A long run has a hundred thousand states: a column of numbers for each field, a tenth of the objects' memory
        self._columns: list[array[Any]] = [array(kind) for kind in _COLUMNS.values()]
        self._append(states)

    def __setstate__(self, state: dict[str, Any]) -> None:
        if "states" in state:  # pickled when it was a list
            state = vars(ModeHistory(state["events"], state["states"]))
        self.__dict__.update(state)

    @property
    def states(self) -> list[ModeState]:
        """In order of time; made anew when asked for."""
        return [ModeState(*row) for row in zip(*self._columns, strict=True)]

    def _append(self, states: Iterable[ModeState]) -> None:
        for state in states:
            for column, value in zip(self._columns, astuple(state), strict=True):
                column.append(value)

    def note(self, step: int, modes: Sequence[Mode]) -> None:
        """
        :param step: Environment steps so far
        :param modes: The modes at a re-clustering
        """
        self._append(ModeState(step, mode.number, mode.n_trajectories, mode.success_rate) for mode in modes)

    def state_dict(self) -> dict[str, Any]:
        """
        :return: All of it, for ``from_state``
        """
        columns = {name: np.array(column) for name, column in zip(_COLUMNS, self._columns, strict=True)}
        return {"events": [asdict(event) for event in self.events], "states": columns}

    @classmethod
    def from_state(cls, state: Any) -> "ModeHistory":
        """
        :param state: What ``state_dict`` gave
        :return: The same history
        :raises ValueError: If it is something else
        """
        known = convert(state, _State, "history")
        unknown = {event.kind for event in known.events} - set(EVENT_KINDS)
        if unknown:
            raise ValueError(f"history: nothing that can happen to a mode is called {sorted(unknown)}")
        if isinstance(known.states, list):
            try:
                return cls(known.events, known.states)
            except OverflowError:
                raise ValueError("history: a number of a state is beyond 64 bits") from None
        n = known.states.step.size
        columns = [check_array(getattr(known.states, name), kind, [n], f"history.{name}") for name, kind in _COLUMNS.items()]
        return cls(known.events, (ModeState(*row) for row in zip(*(column.tolist() for column in columns), strict=True)))

    def share_kept(self, min_trajectories: int = 20, from_step: int = 0) -> float:
        """
        How steady the modes are.

        :param min_trajectories: A mode that trains on so many is established
        :param from_step: Earlier re-clusterings do not count
        :return: Share of the re-clusterings that kept every mode established before them; NaN if there was none to keep
        """
        by_step: dict[int, dict[int, int]] = {}
        for state in self.states:
            by_step.setdefault(state.step, {})[state.number] = state.n_trajectories
        steps = [step for step in by_step if step >= from_step]
        kept = []
        for before, after in itertools.pairwise(steps):
            established = {number for number, n in by_step[before].items() if n >= min_trajectories}
            if established:
                kept.append(established <= set(by_step[after]))
        return sum(kept) / len(kept) if kept else float("nan")

    def __iter__(self) -> Iterator[ModeEvent]:
        return iter(self.events)

    def __len__(self) -> int:
        return len(self.events)

    def __str__(self) -> str:
        return "\n".join(f"{event.step:>10}  {event}" for event in self.events) or "nothing has happened to a mode yet"


def succeed(
    old: Sequence[Mode], inheritance: ModeMatching, step: int, first_free_number: int
) -> tuple[list[Mode], list[ModeEvent]]:
    """
    The modes after a re-clustering: heirs keep number, name and record, newcomers get a number never used before.

    :param old: Modes before
    :param inheritance: Which new cluster follows which old mode
    :param step: Environment steps so far
    :param first_free_number: Number for the next new mode
    :return: The new modes, and what happened
    """
    modes: list[Mode] = []
    events: list[ModeEvent] = []
    number = first_free_number
    for parent, kept in zip(inheritance.parents, inheritance.kept, strict=True):
        if kept and parent is not None:
            modes.append(old[parent])
            continue
        name = default_name(number)
        modes.append(Mode(number, name, born_at=step))
        came = ("born", None) if parent is None else ("split from", old[parent].name)
        events.append(ModeEvent(step, came[0], number, name, came[1]))
        number += 1
    ended = {loser: ("merged into", modes[heir].name) for loser, heir in sorted(inheritance.merged.items())}
    for gone, (kind, other) in {**ended, **{gone: ("retired", None) for gone in sorted(inheritance.retired)}}.items():
        events.append(ModeEvent(step, kind, old[gone].number, old[gone].name, other))
    return modes, events
