"""Replay buffer that knows modes, and stores target actions beside every action."""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ddiffpg.buffers._pickle_of_0_1 import state_of_pickle
from sb3_ddiffpg.buffers.batch import ModeBatch
from sb3_ddiffpg.buffers.path_buffer import PathReplayBuffer
from sb3_ddiffpg.buffers.returns import group_returns
from sb3_ddiffpg.buffers.routes import off_route, split_detours
from sb3_ddiffpg.buffers.state import buffer_state, restore_buffer
from sb3_ddiffpg.buffers.storage import Fields, RowSet
from sb3_ddiffpg.buffers.trajectory import NO_MODE, Trajectory
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.serialization.codec import registered
from sb3_ddiffpg.utils.settings import FLAG, SHARE, Accepted, at_least, is_number

# What may be changed when a run goes on; n_path_points may not: stored paths have so many
_MODE_SETTINGS = (
    *("max_successes_per_mode", "max_failures_per_mode", "max_length_ratio", "min_direct"),
    *("compared_length", "loop_share"),
    *("new_route_share", "explore_beyond_goals"),
)
_RATIO = Accepted("be at least 1", lambda value: is_number(value) and value >= 1)


@registered("sb3_ddiffpg.buffers.ModeReplayBuffer")
class ModeReplayBuffer(PathReplayBuffer):
    """
    A ``PathReplayBuffer`` whose trajectories belong to modes. Each row has two target actions: one for the mode that
    owns its trajectory, one for the exploratory group.

    :param args: Of ``PathReplayBuffer``
    :param max_successes_per_mode: Newest goal-reached trajectories that train a mode; older ones serve exploration only
    :param max_failures_per_mode: Newest failed trajectories that train a mode
    :param max_length_ratio: An uncommanded success longer than this times the mode's shortest is a detour: it is remembered
        for the next clustering, but trains no mode
    :param min_direct: The mode's shortest successes, so many, are never detours
    :param new_route_share: Share of the exploratory group's rows that are drawn from trajectories which reached a goal by a
        route of which a mode has not its fill
    :param explore_beyond_goals: Whether a goal does not end the exploratory group's returns
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
        new_route_share: float = 0.0,
        explore_beyond_goals: bool = False,
        **kwargs: Any,
    ) -> None:
        for gone in ("visit_cell_size", "route_share"):  # of version 0.1: the bonus's, and a constant
            kwargs.pop(gone, None)
        new_route_share = kwargs.pop("new_way_share", new_route_share)
        for name, accepted, value in (
            ("max_successes_per_mode", at_least(1), max_successes_per_mode),
            ("max_failures_per_mode", at_least(1), max_failures_per_mode),
            ("max_length_ratio", _RATIO, max_length_ratio),
            ("min_direct", at_least(1), min_direct),
            ("new_route_share", SHARE, new_route_share),
            ("explore_beyond_goals", FLAG, explore_beyond_goals),
        ):
            accepted.check(name, value)
        self.max_successes_per_mode = max_successes_per_mode
        self.max_failures_per_mode = max_failures_per_mode
        self.max_length_ratio = max_length_ratio
        self.min_direct = min_direct
        self.new_route_share = new_route_share
        self.explore_beyond_goals = explore_beyond_goals
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
        #: Indices of modes that came of successes which were taken back; they end with the next clustering
        self.unfounded_modes: set[int] = set()

    def _step_fields(self) -> Fields:
        action = ((self.action_dim,), np.float32)
        return {**super()._step_fields(), **dict.fromkeys(self.target_action_fields, action)}

    def _note_fields(self) -> Fields:
        own: Fields = {"off_mode_success": ((), bool), "off_route": ((), bool), "route_novelty": ((), np.float32)}
        return {**super()._note_fields(), **own, "goals": ((), bool)}

    @property
    def storage_bytes(self) -> int:
        """Size of the storage."""
        return super().storage_bytes + self._mode_position.nbytes

    def _allocate(self) -> None:
        super()._allocate()
        self._mode_position = np.zeros(self.buffer_size, dtype=np.int32)
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
        self.off_mode_success[rows] = self.off_route[rows] = self.goals[rows] = False
        self.route_novelty[rows] = 0.0

    def state_dict(self) -> dict[str, Any] | None:
        """
        :return: All that it holds, in plain values and arrays, for ``load_state_dict``; None while that is nothing
        """
        return buffer_state(self)

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: What ``state_dict`` gave, of a buffer for the same spaces and number of environments
        :raises ValueError: If it is something else; the buffer is as before then
        """
        restore_buffer(self, state)

    def __getstate__(self) -> dict[str, Any]:
        """Only used rows are pickled."""
        return {**self.settings(), "n_modes": len(self.mode_rows), "owner": self.owner, "state": self.state_dict()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        settings, n_modes, tree = state_of_pickle(state, self.target_action_fields)
        self.__dict__.update(settings)
        self.storage_device = th.device("cpu")  # another machine may have no other
        self._settings = {*vars(self), "_settings"}
        self.reset()
        self.expect_modes(n_modes)
        self.load_state_dict(tree)
        self.owner = state["owner"]

    def _store(self, env: int, info: dict[str, Any]) -> Trajectory:
        trajectory = super()._store(env, info)
        self.goals[trajectory.rows[-1]] = trajectory.success
        return trajectory

    def _take_back_successes(self) -> None:
        taken = self.trajectories(success=True)
        self.unfounded_modes.update(each.mode for each in taken if each.mode != NO_MODE)
        super()._take_back_successes()
        self.goals[:] = False
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

    def adopt_settings(self, other: "ModeReplayBuffer") -> bool:
        """
        :param other: The buffer that this one, loaded from a file, takes the place of
        :return: Whether paths are compared in another way now
        """
        changed = (self.compared_length, self.loop_share) != (other.compared_length, other.loop_share)
        if changed:
            self.forget_paths()
        for name in ("success_key", *_MODE_SETTINGS):
            setattr(self, name, getattr(other, name))
        self.move_storage(other.storage_device)
        if self.success_rule.success_key != other.success_key:
            self.success_rule.success_key, self.success_rule.has_key = other.success_key, False
        return changed

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
        While nobody has said what a success is, a long one is no detour, and a mode goes on learning from what has retired.

        :param successes: In order of finishing
        :param success_modes: New mode of each, ``NO_MODE`` for outliers
        :param failures: In order of finishing; off-mode successes count as failures of their mode
        :param failure_modes: New mode of each
        :param parents: For every new mode, the old mode from which it inherits. A trajectory that comes from another lineage
            starts again with its action as target action
        :param abandoned: Further goal-reached trajectories, which retire to exploration
        """
        self.groups.clear()
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
            self.groups.retire(trajectory, trains=not self.has_success_signal)
            if trajectory.trains:
                self.mode_rows[trajectory.mode].add(trajectory.rows)
            self.route_novelty[trajectory.rows[-1]] = 0.0
        new_routes = [trajectory.rows for trajectory in stays if self.route_novelty[trajectory.rows[-1]] > 0]
        self.new_route_rows = np.concatenate([self.new_route_rows[:0], *new_routes])

    def _split(self, members: list[Trajectory], mode: int) -> tuple[list[Trajectory], list[Trajectory]]:
        """Those of a mode's trajectories that may train it, and those that are only remembered."""
        if mode == NO_MODE:
            return [], members
        told = self.has_success_signal
        return split_detours(members, self.max_length_ratio, self.min_direct) if told else (members, [])

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
        used = *self.trajectories(success=True), *self.trajectories(success=False)
        finished = [*used, *self.groups.retired, *self.groups.past_goals()]
        return [each for each in finished if self.route_novelty[each.rows[-1]] == 0]

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

    # ------------------------------------------------------------------ sampling

    def sample_modes(
        self,
        batch_size: int,
        gamma: float,
        exploration_n_steps: int,
        mode_n_steps: int,
        env: VecNormalize | None = None,
        exploration_gamma: float | None = None,
        visits_of_modes: bool = False,
    ) -> ModeBatch:
        """
        Draw one multimodal batch: an equal part from all transitions (exploratory group) and from each mode's own.

        :param batch_size: Number of transitions B; each of the G groups gets B // G
        :param gamma: Discount factor
        :param exploration_n_steps: Length of the exploratory group's returns
        :param mode_n_steps: Length of the modes' returns
        :param env: Normalises observations and rewards when given
        :param exploration_gamma: The exploratory group's discount factor; None: gamma
        :param visits_of_modes: Whether ``visited`` is of all groups, or of the exploratory one alone
        :return: The batch
        """
        n_groups = len(self.mode_rows) + 1
        n = batch_size // n_groups
        if n == 0:
            raise ValueError(f"batch_size={batch_size} is smaller than the number of groups, {n_groups}")
        active = np.array([True, *(row_set.size > 0 for row_set in self.mode_rows)])
        sets = [self.stored_rows, *(row_set if row_set.size else self.stored_rows for row_set in self.mode_rows)]
        rows = np.stack([row_set.sample(n) for row_set in sets])  # [G, n]
        if len(self.new_route_rows) and self.new_route_share:
            n_new = round(self.new_route_share * n)
            rows[EXPLORATORY_GROUP, :n_new] = np.random.choice(self.new_route_rows, n_new)
        windows = self._windows(rows, exploration_n_steps, mode_n_steps)
        notes = self.notes.take(windows)
        gammas = np.full(n_groups, gamma, dtype=np.float32)
        if exploration_gamma is not None:
            gammas[EXPLORATORY_GROUP] = exploration_gamma
        returns = group_returns(
            windows,
            notes,
            self._normalize_reward(notes["rewards"].ravel(), env).reshape(windows.shape),
            gammas,
            explore_beyond_goals=self.explore_beyond_goals,
            new_routes_pay=self.new_route_share > 0,
            goals_are_told=self.has_success_signal,
        )
        # What led away from the route is for the critic to judge, not for the policy to follow
        imitated = active[:, None] & ~notes["off_mode_success"][..., 0]
        imitated[EXPLORATORY_GROUP] = True
        steps = self._on_device(self.steps.tensors(rows.ravel()))
        nexts = self._on_device(self.nexts.tensors(returns.last.ravel()))
        actions = steps["actions"].view(*rows.shape, self.action_dim)
        on_route = np.where(returns.lost, -1, windows)
        return ModeBatch(
            observations=self.normalized(self._as_observation(steps, "observations"), env),
            actions=actions,
            target_actions=self._target_actions(steps, actions),
            next_observations=self.normalized(self._as_observation(nexts, "next_observations"), env),
            rewards=self._to_device(returns.rewards.astype(np.float32)),
            discounts=self._to_device(returns.discounts.astype(np.float32)),
            active=self._to_device(active),
            imitated=self._to_device(imitated),
            new_routes=self._to_device(returns.new_routes.astype(np.float32)),
            rows=rows,
            dormant=np.flatnonzero(~active).tolist(),
            visited=self.visited(on_route if visits_of_modes else on_route[:1, :, :exploration_n_steps]),
        )

    def _target_actions(self, steps: dict[str, th.Tensor], actions: th.Tensor) -> th.Tensor:
        """Of the exploratory group, and of each mode its own, [G, n, action_dim]; the actions where none are stored."""
        stored = [steps[name].view(actions.shape) for name in self.target_action_fields]
        return th.cat((stored[-1][:1], stored[0][1:])) if stored else actions

    def store_target_actions(self, batch: ModeBatch, target_actions: th.Tensor) -> None:
        """
        Write improved target actions back.

        :param batch: As drawn by ``sample_modes``
        :param target_actions: Shape [G, n, action_dim]
        """
        if self.storage_device.type == "cpu":
            target_actions = target_actions.cpu()
        self.steps.write("exploratory_target_actions", batch.rows[0], target_actions[0])
        groups = [mode + 1 for mode, row_set in enumerate(self.mode_rows) if row_set.size]
        if groups:
            improved = th.cat([target_actions[group] for group in groups])
            self.steps.write("target_actions", batch.rows[groups].ravel(), improved)
