"""Replay buffer whose trajectories belong to modes: which learn from which."""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.buffers.hindsight import Hindsight
from sb3_ddiffpg.buffers.path_buffer import PathReplayBuffer
from sb3_ddiffpg.buffers.routes import off_route, split_detours
from sb3_ddiffpg.buffers.storage import Fields, RowSet
from sb3_ddiffpg.buffers.trajectory import NO_MODE, Trajectory
from sb3_ddiffpg.utils.settings import Accepted, at_least, is_number

_RATIO = Accepted("be at least 1", lambda value: is_number(value) and value >= 1)


class AssignedReplayBuffer(PathReplayBuffer):
    """
    A ``PathReplayBuffer`` whose trajectories belong to modes. Each row has two target actions: one for the mode that
    owns its trajectory, one for the exploratory group.

    :param args: Of ``PathReplayBuffer``
    :param max_successes_per_mode: Newest goal-reached trajectories that train a mode; older ones serve exploration only
    :param max_failures_per_mode: Newest failed trajectories that train a mode
    :param max_length_ratio: An uncommanded success longer than this times the mode's shortest is a detour: it is remembered
        for the next clustering, but trains no mode
    :param min_direct: The mode's shortest successes, so many, are never detours
    :param kwargs: Of ``PathReplayBuffer``
    :raises ValueError: If an argument is out of its range or ``optimize_memory_usage`` is asked for
    """

    #: Stored beside each action, for algorithms that improve them: of the mode that owns it, and of the exploratory group
    target_action_fields: tuple[str, ...] = ("target_actions", "exploratory_target_actions")
    target_actions: Any
    exploratory_target_actions: Any
    off_mode_success: np.ndarray
    off_route: np.ndarray
    route_novelty: np.ndarray
    goals: np.ndarray

    def __init__(
        self,
        *args: Any,
        max_successes_per_mode: int = 40,
        max_failures_per_mode: int = 20,
        max_length_ratio: float = 1.5,
        min_direct: int = 5,
        **kwargs: Any,
    ) -> None:
        for name, accepted, value in (
            ("max_successes_per_mode", at_least(1), max_successes_per_mode),
            ("max_failures_per_mode", at_least(1), max_failures_per_mode),
            ("max_length_ratio", _RATIO, max_length_ratio),
            ("min_direct", at_least(1), min_direct),
        ):
            accepted.check(name, value)
        self.max_successes_per_mode = max_successes_per_mode
        self.max_failures_per_mode = max_failures_per_mode
        self.max_length_ratio = max_length_ratio
        self.min_direct = min_direct
        super().__init__(*args, **kwargs)

    # ------------------------------------------------------------------ storage

    def reset(self) -> None:
        """Forget everything and release the storage."""
        super().reset()
        self.owner: tuple[str, list[int]] = ("", [])  # run and numbers of its modes, noted when it is saved
        self._mode_position = np.empty(0, dtype=np.int32)
        self.mode_rows: list[RowSet] = []
        #: Of trajectories that reached a goal by a route of which a mode has not its fill
        self.new_route_rows = np.empty(0, dtype=np.int32)
        #: Indices of modes that came of successes which were taken back; they end when others are found, and not they
        self.unfounded_modes: set[int] = set()
        #: Other goals than the given ones; None: there are none
        self.hindsight: Hindsight | None = None

    def claim(self, env: VecEnv) -> None:
        """
        See ``TrajectoryReplayBuffer``.

        :param env: The environments
        """
        super().claim(env)
        self.hindsight = Hindsight.of(env) if self.has_modes else None
        if self.hindsight is not None:
            self.hindsight.judge(self)

    @property
    def has_modes(self) -> bool:
        """Whether the algorithm has modes; only then are their notes stored, and trajectories told of other goals."""
        return not self.constant_notes

    @property
    def has_hindsight(self) -> bool:
        """Whether a mode learns from goals that were reached in place of others."""
        return self.hindsight is not None and self.hindsight.in_use

    @property
    def has_outliers(self) -> bool:
        """Whether a success may be of no mode: where it has been told what one is, but not where all reach something."""
        return self.goals_are_told and not self.has_hindsight

    @property
    def learns_from_all(self) -> bool:
        """Whether a mode learns from all its episodes: where it is told at each step how well it does, or afterwards."""
        return not self.has_outliers or bool(self.unfounded_modes)

    def training_trajectories(self) -> list[Trajectory]:
        """
        :return: All that train a mode
        """
        return [each for each in self.finished_trajectories() if each.trains]

    def _step_fields(self) -> Fields:
        action = ((self.action_dim,), np.float32)
        return {**super()._step_fields(), **dict.fromkeys(self.target_action_fields, action)}

    def note_fields(self) -> Fields:
        """See ``RowReplayBuffer``."""
        own: Fields = {"off_mode_success": ((), bool), "off_route": ((), bool), "route_novelty": ((), np.float32)}
        return {**super().note_fields(), **own, "goals": ((), bool)}

    @property
    def storage_bytes(self) -> int:
        """Size of the storage."""
        return super().storage_bytes + self._mode_position.nbytes

    def _allocate(self) -> None:
        super()._allocate()
        self._mode_position = np.zeros(self.buffer_size if self.has_modes else 0, dtype=np.int32)
        for row_set in self.mode_rows:
            row_set.position = self._mode_position

    def make_row_set(self) -> RowSet:
        """
        :return: An empty set of rows of a mode
        """
        return RowSet(self._mode_position)

    def _make_views(self) -> None:
        super()._make_views()
        for name in self.target_action_fields:
            setattr(self, name, self.steps[name])

    def _write_rows(self, rows: np.ndarray, obs: Any, next_obs: Any, action: np.ndarray, *args: Any) -> None:
        super()._write_rows(rows, obs, next_obs, action, *args)
        for name in self.target_action_fields:
            self.steps.write(name, rows, action)
        self.goals[rows] = False
        if self.has_modes:
            self.off_mode_success[rows] = self.off_route[rows] = False
            self.route_novelty[rows] = 0.0

    def _store(self, env: int, info: dict[str, Any]) -> Trajectory:
        trajectory = super()._store(env, info)
        self.goals[trajectory.rows[-1]] = trajectory.success
        return trajectory

    def _stands_in(self, episode_return: float) -> bool:
        # Where other goals than the given ones are learned from, no success is needed to begin with
        return not self.has_hindsight and super()._stands_in(episode_return)

    def judge_by_returns(self) -> None:
        """See ``TrajectoryReplayBuffer``."""
        if self.has_hindsight:  # the first episodes came before that was known
            self.groups.judge_again(lambda trajectory: False)
        else:
            super().judge_by_returns()

    def _take_back_successes(self) -> None:
        taken = self.trajectories(success=True)
        self.unfounded_modes.update(each.mode for each in taken if each.mode != NO_MODE)
        super()._take_back_successes()
        self.goals[:] = False
        if self.has_modes:
            self.route_novelty[:] = 0.0
        self.new_route_rows = self.new_route_rows[:0]

    def _evict(self) -> Trajectory:
        trajectory = super()._evict()
        if trajectory.trains:
            self.mode_rows[trajectory.mode].remove(trajectory.rows)
        if self.route_novelty[trajectory.rows[-1]] > 0:
            self.new_route_rows = np.setdiff1d(self.new_route_rows, trajectory.rows)
        return trajectory

    # ------------------------------------------------------------------ modes

    def expect_modes(self, n_modes: int) -> None:
        """
        Forget which mode owns what: until the next clustering, a model's modes have no trajectories here.

        :param n_modes: Number of modes of the model
        """
        successes, failures = self.trajectories(success=True), self.trajectories(success=False)
        if self.size():
            self.counted[:] = False  # by the model that is left, not by this one
        nobody = np.full(len(successes), NO_MODE), np.full(len(failures), NO_MODE)
        self.assign_modes(successes, nobody[0], failures, nobody[1], [None] * n_modes)

    def follow_modes(self, new_modes: list[int], numbers: list[int]) -> None:
        """
        Follow a model whose modes have other indices. Commands to modes that it does not have are forgotten.

        :param new_modes: New index of every mode so far, ``NO_MODE`` if the model does not have it
        :param numbers: Numbers of the model's modes
        """
        stored = self.trajectories(success=True) + self.trajectories(success=False)
        for trajectory in stored:
            if trajectory.off_mode_success and trajectory.assigned_mode not in numbers:
                self.readmit(trajectory)
            elif trajectory.assigned_mode not in numbers:
                trajectory.assigned_mode = None
        stored.sort(key=lambda trajectory: trajectory.serial)
        parts = [[t for t in stored if (t.success and not t.off_mode_success) == success] for success in (True, False)]
        table = np.array([*new_modes, NO_MODE])  # the last one for NO_MODE itself
        successes, failures = (table[np.array([t.mode for t in part], dtype=int)] for part in parts)
        parents = [new_modes.index(mode) if mode in new_modes else None for mode in range(len(numbers))]
        self.assign_modes(parts[0], successes, parts[1], failures, parents)

    def assign_modes(
        self,
        successes: list[Trajectory],
        success_modes: np.ndarray,
        failures: list[Trajectory],
        failure_modes: np.ndarray,
        parents: list[int | None],
        abandoned: Sequence[Trajectory] = (),
    ) -> None:
        """
        Hand the trajectories to their new modes and rebuild the modes' rows. Each mode learns from its newest direct successes
        and its newest failures, and remembers as many detours for the next clustering; the rest retires to exploration.
        Where it ``learns_from_all``, a long one is no detour, and a mode goes on learning from what has retired.

        :param successes: In order of finishing
        :param success_modes: New mode of each, ``NO_MODE`` for outliers
        :param failures: In order of finishing; off-mode successes count as failures of their mode
        :param failure_modes: New mode of each
        :param parents: For every new mode, the old mode from which it inherits. A trajectory that comes from another lineage
            starts again with its action as target action
        :param abandoned: Further goal-reached trajectories, which retire to exploration
        """
        self.groups.clear()
        if self.hindsight is not None:
            self.hindsight.judge(self)
            self.hindsight.forget()
        self.unfounded_modes = {new for new, old in enumerate(parents) if old in self.unfounded_modes}
        self.mode_rows = [self.make_row_set() for _ in parents]
        stays: list[Trajectory] = []
        goes: list[Trajectory] = list(abandoned)
        for trajectories, modes, limit in (
            (successes, success_modes, self.max_successes_per_mode),
            (failures, failure_modes, self.max_failures_per_mode),
        ):
            for mode in range(NO_MODE, len(parents)):
                members = [trajectories[i] for i in np.flatnonzero(np.asarray(modes) == mode)]
                direct, detours = self._split(members, mode)
                for trajectory in members:
                    trajectory.trains = False
                for trajectory in direct[-limit:]:
                    trajectory.trains = True
                kept = [*direct[-limit:], *detours[-limit:]]
                dropped = [*direct[:-limit], *detours[:-limit]]
                # How far the mode is from having its fill; what is in no mode is all new
                novelty = 1.0 if mode == NO_MODE else 1.0 - min(len(direct) / limit, 1.0)
                for trajectory in members:
                    self._change_mode(trajectory, mode, parents)
                    self.route_novelty[trajectory.rows[-1]] = novelty * (
                        trajectory.success and not trajectory.off_mode_success
                    )
                stays += kept
                goes += dropped
        for trajectory in sorted(stays, key=lambda t: t.serial):
            self._insert(trajectory)
            if trajectory.trains:
                self.mode_rows[trajectory.mode].add(trajectory.rows)
        for trajectory in [*self._still_training(parents), *sorted(goes, key=lambda t: t.serial)]:
            self.groups.retire(trajectory, trains=self.learns_from_all)
            if trajectory.trains:
                self.mode_rows[trajectory.mode].add(trajectory.rows)
            self.route_novelty[trajectory.rows[-1]] = 0.0
        new_routes = [trajectory.rows for trajectory in stays if self.route_novelty[trajectory.rows[-1]] > 0]
        self.new_route_rows = np.concatenate([self.new_route_rows[:0], *new_routes])

    def _split(self, members: list[Trajectory], mode: int) -> tuple[list[Trajectory], list[Trajectory]]:
        """Those of a mode's trajectories that may train it, and those that are only remembered."""
        if mode == NO_MODE:
            return [], members
        if self.learns_from_all:
            return members, []
        return split_detours(members, self.max_length_ratio, self.min_direct)

    def _still_training(self, parents: list[int | None]) -> list[Trajectory]:
        """Retired trajectories that train a mode, taken from the others, with the heirs of their modes."""
        heirs = {old: new for new, old in reversed(list(enumerate(parents)))}  # the largest part, where there are several
        training = self.groups.take_training()
        for trajectory in training:
            self._change_mode(trajectory, heirs.get(trajectory.mode, NO_MODE), parents)
        return training

    def training_successes(self, modes: Collection[int]) -> dict[int, list[Trajectory]]:
        """
        :param modes: Indices of modes
        :return: Of each the goal-reached trajectories that train it by its own route
        """
        members: dict[int, list[Trajectory]] = {mode: [] for mode in modes}
        for each in self.trajectories(success=True) if members else []:
            if each.trains and each.mode in members:
                members[each.mode].append(each)
        return members

    def settled_trajectories(self) -> list[Trajectory]:
        """
        :return: Finished ones but those that took a new route to a goal
        """
        return [each for each in self.finished_trajectories() if self.route_novelty[each.rows[-1]] == 0]

    def mark_off_route(self, trajectory: Trajectory, members: list[Trajectory]) -> None:
        """
        Mark the steps of an off-mode success that lead away from the route of the mode that it was told to follow, or to
        another goal close by.

        :param trajectory: The off-mode success
        :param members: Goal-reached trajectories of that mode
        """
        trajectory.off_mode_success = True
        self.off_mode_success[trajectory.rows] = True
        path = self.full_path(trajectory) / self.measured_scale()
        routes = [self.path(member) for member in members]
        self.off_route[trajectory.rows] = off_route(path, routes, self.loop_share, self.compared_length)

    def readmit(self, trajectory: Trajectory) -> None:
        """
        :param trajectory: An off-mode success whose mode has ended: it is a success like any other again
        """
        self.off_mode_success[trajectory.rows] = self.off_route[trajectory.rows] = False
        self.groups.remove(trajectory)
        trajectory.off_mode_success, trajectory.assigned_mode, trajectory.mode = False, None, NO_MODE
        self.groups.insert(trajectory)

    def _change_mode(self, trajectory: Trajectory, mode: int, parents: list[int | None]) -> None:
        """Target actions are inherited with the critics that made them, or start again from the action."""
        inherited = trajectory.mode == NO_MODE or (mode != NO_MODE and parents[mode] == trajectory.mode)
        if not inherited:
            self.steps.write("target_actions", trajectory.rows, self.steps.tensors(trajectory.rows)["actions"])
        trajectory.mode = mode
