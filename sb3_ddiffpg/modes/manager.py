"""The modes of a model: found, named, kept, frozen, forgotten."""

from collections.abc import Sequence
from typing import Any, Protocol

import msgspec
import numpy as np

from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.trajectory import NO_MODE, Trajectory
from sb3_ddiffpg.clustering.linkage import cluster
from sb3_ddiffpg.modes.discovery import find_modes, readmit_homeless, retired_modes, surpassed_modes
from sb3_ddiffpg.modes.history import ModeEvent, ModeHistory, succeed
from sb3_ddiffpg.modes.mode import (
    TRIED_EPISODES,
    Mode,
    ModeTable,
    Outcome,
    check_name,
    default_name,
    modes_from_state,
    modes_state,
    outclassed,
)
from sb3_ddiffpg.modes.settings import ModeSettings
from sb3_ddiffpg.serialization.safetensors_tree import Count, convert

#: A mode that succeeds this often, when it is commanded, needs no explorers any more
MASTERED_SUCCESS_RATE = 0.5


class Heir(Protocol):
    """What follows the modes: the critics and embeddings of a policy."""

    def inherit(self, parents: Sequence[int | None], kept: Sequence[bool], reset_output: bool = True) -> None:
        """
        :param parents: For every new mode, the old one from which it inherits, or None
        :param kept: Whether it also keeps that mode's embedding
        :param reset_output: Whether critics of a mode without parent start with a zeroed output layer
        """


class Followers(Protocol):
    """What follows the modes' indices: the scheduler of the episodes."""

    def follow(self, new_modes: list[int | None]) -> None:
        """
        :param new_modes: New index of every old mode, None if it is gone
        """


class _State(msgspec.Struct, forbid_unknown_fields=True):
    modes: Any
    history: Any
    next_number: Count
    success_is_told: bool = False
    n_judged: Count = 0


class ModeManager:
    """
    Holds the modes and their history. Re-clustering finds them in the replay buffer and hands their critics, target actions
    and embeddings down.

    :param settings: How modes are found and kept
    :param mode_features: In which part of the observation those of a file were found
    """

    def __init__(self, settings: ModeSettings, mode_features: Any = None) -> None:
        self.settings, self.mode_features = settings, mode_features
        self.modes: list[Mode] = []
        self.history = ModeHistory()
        self.next_number = 0
        #: Whether the environment itself has told of a success
        self.success_is_told = False
        #: Trajectories that had been stored by the latest re-clustering
        self.n_judged = 0

    def __len__(self) -> int:
        return len(self.modes)

    @property
    def table(self) -> ModeTable:
        """The modes: iterate, index by name or number, or print."""
        return ModeTable(self.modes)

    @property
    def numbers(self) -> list[int]:
        """Numbers of the modes, by their indices."""
        return [mode.number for mode in self.modes]

    def mastered(self) -> dict[int, int]:
        """
        :return: Numbers of the modes that know their route, by their indices. What a young one cannot do yet, explorers must
            go on with
        """
        return {index: mode.number for index, mode in enumerate(self.modes) if mode.success_rate >= MASTERED_SUCCESS_RATE}

    def trusted(self) -> list[int]:
        """
        :return: Indices of the modes that a policy without command may follow: all that are not plainly worse than the best
            and, if any was tried, that were tried
        """
        worse = outclassed(self.modes, self.success_is_told)
        tried = [len(mode.outcomes) >= TRIED_EPISODES for mode in self.modes]
        return [index for index in range(len(self)) if index not in worse and (tried[index] or not any(tried))]

    # ------------------------------------------------------------------ finding

    def recluster(
        self, buffer: ModeReplayBuffer, heir: Heir, followers: Followers, step: int, births: bool = True
    ) -> list[ModeEvent]:
        """
        Algorithm 2 of the paper: cluster the goal-reached trajectories, let the new modes inherit from the old ones, and
        assign the failed trajectories.

        :param buffer: Holds the trajectories
        :param heir: Whose critics and embeddings follow
        :param followers: Whose indices of modes follow
        :param step: Environment steps so far
        :param births: Whether modes may be born; the first always may
        :return: What happened: births, splits, merges and retirements
        """
        self.success_is_told, self.n_judged = buffer.goals_are_told, buffer.n_finished
        if self.success_is_told:
            retired = retired_modes(self.modes, self.settings.trials)
        else:
            buffer.judge_by_returns()
            retired = surpassed_modes(self.modes, self.settings.min_size, buffer)
        readmit_homeless(buffer, {mode.number for index, mode in enumerate(self.modes) if index not in retired})
        found = find_modes(buffer, self.modes, self._cluster, self.settings, births, retired)
        if buffer.unfounded_modes and len(found.successes) >= self.settings.min_size and len(founded := found.continued()):
            # Now successes make modes: one of what was none ends if none of these is its own, unless the user keeps it
            ended = {index for index in buffer.unfounded_modes if index not in founded and not self.modes[index].frozen}
            buffer.unfounded_modes = set()
            found = find_modes(buffer, self.modes, self._cluster, self.settings, births, sorted({*retired, *ended}))
        # What was found is carried out: counters, off-mode successes, trajectories, networks, records
        for mode, counters in zip(self.modes, found.counters, strict=True):
            mode.doubts, mode.misses, mode.unjudged = counters.doubts, counters.misses, 0
        for trajectory, members in found.off_mode:
            buffer.mark_off_route(trajectory, members)
        parents, kept = found.matching.parents, found.matching.kept
        buffer.assign_modes(found.successes, found.labels, found.failures, found.failure_labels, parents, found.abandoned)
        heir.inherit(parents, kept, self.settings.reset_new_critics)
        modes, events = succeed(self.modes, found.matching, step, self.next_number)
        self.hold(modes, buffer, followers)
        self.history.events += events
        found.describe(self.modes, buffer)
        self.history.note(step, self.modes)
        return events

    def _cluster(self, distances: np.ndarray) -> np.ndarray:
        """Labels [N] of trajectories of such distances [N, N]."""
        settings = self.settings
        if settings.max_modes == 1:
            return np.zeros(len(distances), dtype=int)  # clustering off: whatever reaches the goal is the one mode
        return cluster(distances, settings.distance_threshold, settings.linkage, settings.max_modes, settings.min_size)

    def hold(self, modes: list[Mode], buffer: ModeReplayBuffer, followers: Followers) -> None:
        """
        :param modes: These are the modes now
        :param buffer: Evicts the successes of frozen ones last
        :param followers: Whose indices of modes follow
        """
        indices = {mode.number: index for index, mode in enumerate(modes)}
        followers.follow([indices.get(mode.number) for mode in self.modes])
        self.modes = modes
        self.next_number = max([self.next_number, *(number + 1 for number in indices)])
        self._keep_frozen(buffer)

    def _keep_frozen(self, buffer: ModeReplayBuffer) -> None:
        buffer.groups.frozen_modes = {index for index, mode in enumerate(self.modes) if mode.frozen}

    def expect_unknown(self, n_modes: int, step: int, buffer: ModeReplayBuffer, followers: Followers) -> None:
        """
        Nobody knows which modes these are: they get new names and wait for trajectories.

        :param n_modes: Number of modes
        :param step: Environment steps so far
        :param buffer: Forgets whose trajectories it holds
        :param followers: Whose indices of modes follow
        """
        numbers = range(self.next_number, self.next_number + n_modes)
        self.hold([Mode(number, default_name(number), born_at=step) for number in numbers], buffer, followers)
        buffer.expect_modes(n_modes)

    def use_features(self, selection: Any, dim: int) -> None:
        """
        Modes differ in other features from now on. They stay who they are, by the trajectories that they have.

        :param selection: See ``ModeFeatures``
        :param dim: Number of components
        """
        self.mode_features = selection
        for mode in self.modes:
            mode.representative = np.empty((0, dim), dtype=np.float32)

    # ------------------------------------------------------------------ keeping

    def rename(self, mode: str | int | Mode, name: str, step: int) -> None:
        """
        :param mode: Name, index or record of the mode
        :param name: Its new name, see ``DDiffPG.rename_mode``
        :param step: Environment steps so far
        :raises ValueError: If there is no such mode, or another has that name or may be born with it
        """
        record = self.modes[self.table.index(mode)]
        if any(name == other.name for other in self.modes if other is not record):
            raise ValueError(f"name={name!r} is another mode's; the modes are {self.table.names}")
        check_name(name, record.number)
        if name != record.name:
            self._note(step, "renamed to", record, name)
            record.name = name

    def freeze(self, mode: str | int | Mode, frozen: bool, step: int, buffer: ModeReplayBuffer) -> None:
        """
        :param mode: Name, index or record of the mode
        :param frozen: Whether it is to be kept whatever a re-clustering finds
        :param step: Environment steps so far
        :param buffer: Evicts its successes last
        :raises ValueError: If there is no such mode
        """
        record = self.modes[self.table.index(mode)]
        if record.frozen != frozen:
            record.frozen = frozen
            self._note(step, "frozen" if frozen else "released", record)
            self._keep_frozen(buffer)

    def delete(self, mode: str | int | Mode, step: int, buffer: ModeReplayBuffer, heir: Heir, followers: Followers) -> None:
        """
        :param mode: Name, index or record of the mode
        :param step: Environment steps so far
        :param buffer: Whose trajectories of it serve exploration from now on
        :param heir: Whose critics and embedding of it go
        :param followers: Whose indices of modes follow
        :raises ValueError: If there is no such mode
        """
        index = self.table.index(mode)
        stay = [each for each in range(len(self)) if each != index]
        new_index = np.array([stay.index(each) if each in stay else NO_MODE for each in range(len(self))] + [NO_MODE])
        successes, failures = (buffer.trajectories(success) for success in (True, False))
        abandoned = [trajectory for trajectory in successes if trajectory.mode == index]
        successes = [trajectory for trajectory in successes if trajectory.mode != index]
        labels = [new_index[np.array([t.mode for t in part], dtype=int)] for part in (successes, failures)]
        buffer.assign_modes(successes, labels[0], failures, labels[1], list(stay), abandoned)
        heir.inherit(stay, [True] * len(stay))
        self._note(step, "deleted", self.modes[index])
        self.hold([self.modes[each] for each in stay], buffer, followers)

    def _note(self, step: int, kind: str, mode: Mode, other: str | None = None) -> None:
        self.history.events.append(ModeEvent(step, kind, mode.number, mode.name, other))

    # ------------------------------------------------------------------ training episodes

    def note_outcome(self, index: int, trajectory: Trajectory, stands_in: bool = False) -> None:
        """
        :param index: Of the mode that has driven an episode from its beginning
        :param trajectory: The episode
        :param stands_in: Whether it can be but one of the best returns, for the environment says that no goal was reached
        """
        mode = self.modes[index]
        mode.outcomes.append(Outcome(trajectory.success and not stands_in, trajectory.episode_return, trajectory.length))
        mode.unjudged += 1

    def mean_length(self) -> float | None:
        """
        :return: Environment steps that a mode needs for its route, on average over those with trajectories; None: none has any
        """
        lengths = [mode.mean_length for mode in self.modes if mode.n_trajectories]
        return float(np.mean(lengths)) if lengths else None

    # ------------------------------------------------------------------ saving

    def state_dict(self) -> dict[str, Any]:
        """
        :return: All that is known of the modes, in plain values and arrays, for ``load_state_dict``
        """
        return {
            "modes": modes_state(self.modes),
            "history": self.history.state_dict(),
            "next_number": self.next_number,
            "success_is_told": self.success_is_told,
            "n_judged": self.n_judged,
        }

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: What ``state_dict`` gave
        :raises ValueError: If it is something else
        """
        known = convert(state, _State, "modes")
        self.modes = modes_from_state(known.modes)
        self.history = ModeHistory.from_state(known.history)
        self.next_number, self.success_is_told = known.next_number, known.success_is_told
        self.n_judged = known.n_judged
        if any(mode.number >= self.next_number for mode in self.modes):
            raise ValueError(f"modes: one has a number that is not below {self.next_number}, the next one's")
