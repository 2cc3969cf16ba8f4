"""Replay buffer that knows modes, and stores target actions beside every action."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from scipy.spatial.distance import cdist
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ddiffpg.behavior import EXPLORATORY_GROUP
from sb3_ddiffpg.dtw import LOOP_SHARE, N_PATH_POINTS, comparable_path
from sb3_ddiffpg.exploration_buffer import ExplorationReplayBuffer, positive_length
from sb3_ddiffpg.known_ways import NO_WAY, Way
from sb3_ddiffpg.returns import group_returns
from sb3_ddiffpg.row_storage import Fields
from sb3_ddiffpg.trajectories import NO_MODE, DistanceCache, RowSet, Trajectory


class ModeBatch(NamedTuple):
    """
    One batch, split evenly over G groups: the exploratory one first, then every mode. N = G * n rows, group by group.

    Observations are [N, ...] (or dicts of such), ``actions``, ``target_actions`` [G, n, action_dim], ``rewards`` and
    ``discounts`` [G, n]. ``active`` [G] is False for a mode without any transition, whose rows are a stand-in that must
    not train it. ``imitated`` [G, n] is False for these and for steps of foreign trajectories, which the policy must not
    learn. ``new_ways`` [n] are the exploratory group's returns from goals reached by ways of which a mode has not its fill.
    ``rows`` [G, n] and ``windows`` [G, n, n_steps] (-1 where a window ends early, or beyond the mode's route) say where
    in the buffer the transitions lie.
    """

    observations: Any
    actions: th.Tensor
    target_actions: th.Tensor
    next_observations: Any
    rewards: th.Tensor
    discounts: th.Tensor
    active: th.Tensor
    imitated: th.Tensor
    new_ways: th.Tensor
    rows: np.ndarray
    windows: np.ndarray


# What may be changed when a run goes on; n_path_points may not: stored paths have so many
_MODE_SETTINGS = (
    *("max_successes_per_mode", "max_failures_per_mode", "max_length_ratio", "min_direct"),
    *("compared_length", "loop_share", "route_share"),
    *("new_way_share", "explore_beyond_goals", "visit_cell_size"),
)


def _extent(positions: np.ndarray) -> float:
    """Diagonal of the box round positions of shape [..., dim]."""
    return float(np.linalg.norm(np.ptp(positions.reshape(-1, positions.shape[-1]), axis=0)))


class ModeReplayBuffer(ExplorationReplayBuffer):
    """
    An ``ExplorationReplayBuffer`` whose trajectories belong to modes. Each row has two target actions: one for the mode that
    owns its trajectory, one for the exploratory group.

    :param buffer_size: Capacity in transitions (over all environments)
    :param observation_space: Observation space
    :param action_space: Action space
    :param device: PyTorch device of the samples
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Not supported
    :param handle_timeout_termination: Whether time limits are bootstrapped through
    :param success_key: See ``TrajectoryReplayBuffer``
    :param storage_device: See ``TrajectoryReplayBuffer``
    :param mode_features: See ``ModeFeatures``
    :param max_successes_per_mode: Newest goal-reached trajectories that train a mode; older ones serve exploration only
    :param max_failures_per_mode: Newest failed trajectories that train a mode
    :param max_length_ratio: An uncommanded success longer than this times the mode's shortest is a detour: it is remembered
        for the next clustering, but trains no mode
    :param min_direct: The mode's shortest successes, so many, are never detours
    :param n_path_points: Points to which a trajectory's path is resampled for clustering
    :param normalize_distances: Whether DTW distances are divided by the square root of the path's length, which makes them
        about the mean distance along the way; False for the root of the summed squares, to which the paper's thresholds refer
    :param compared_length: Arc length of a path's end, without its loops, that alone is compared; None: all of it. What an
        explorer did before it took a way says nothing about the way. In the unit of the mode features, of a whole observation
        in standard deviations
    :param loop_share: Radius within which a path that comes back has made a loop, as a share of the path's extent
    :param route_share: Distance beyond which a step is off a mode's route, as a share of the route's extent
    :param new_way_share: Share of the exploratory group's rows that are drawn from trajectories which reached a goal by a way
        of which a mode has not its fill
    :param explore_beyond_goals: Whether a goal does not end the exploratory group's returns
    :param visit_cell_size: Edge of the cells of mode features by which places and ``first_visits`` are told; None: not at all
    :raises ValueError: If a size is not positive and finite or ``optimize_memory_usage`` is asked for
    """

    target_actions: Any
    exploratory_target_actions: Any
    foreign: np.ndarray
    off_route: np.ndarray
    way_novelty: np.ndarray
    goals: np.ndarray

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        success_key: str | None = None,
        storage_device: th.device | str = "cpu",
        mode_features: Any = None,
        max_successes_per_mode: int = 40,
        max_failures_per_mode: int = 20,
        max_length_ratio: float = 1.5,
        min_direct: int = 5,
        n_path_points: int = N_PATH_POINTS,
        normalize_distances: bool = True,
        compared_length: float | None = None,
        loop_share: float = LOOP_SHARE,
        route_share: float = 0.1,
        new_way_share: float = 0.0,
        explore_beyond_goals: bool = False,
        visit_cell_size: float | None = None,
    ) -> None:
        for name, value, least in (
            ("max_successes_per_mode", max_successes_per_mode, 1),
            ("max_failures_per_mode", max_failures_per_mode, 1),
            ("max_length_ratio", max_length_ratio, 1),
            ("min_direct", min_direct, 1),
            ("n_path_points", n_path_points, 2),
            ("loop_share", loop_share, 0),
            ("route_share", route_share, 0),
            ("new_way_share", new_way_share, 0),
        ):
            if value < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        self.max_successes_per_mode = max_successes_per_mode
        self.max_failures_per_mode = max_failures_per_mode
        self.max_length_ratio = max_length_ratio
        self.min_direct = min_direct
        self.n_path_points = n_path_points
        self.normalize_distances = normalize_distances
        self.compared_length = positive_length("compared_length", compared_length)
        self.loop_share = loop_share
        self.route_share = route_share
        self.new_way_share = new_way_share
        self.explore_beyond_goals = explore_beyond_goals
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device,
            n_envs=n_envs,
            optimize_memory_usage=optimize_memory_usage,
            handle_timeout_termination=handle_timeout_termination,
            success_key=success_key,
            storage_device=storage_device,
            mode_features=mode_features,
            visit_cell_size=visit_cell_size,
        )

    # ------------------------------------------------------------------ storage

    def reset(self) -> None:
        """Forget everything and release the storage."""
        super().reset()
        self.owner: tuple[str, list[int]] = ("", [])  # run and numbers of its modes, noted when it is saved
        self._distances = DistanceCache(self.normalize_distances)
        self._mode_position = np.empty(0, dtype=np.int32)
        self.mode_rows: list[RowSet] = []
        self._new_way_rows = np.empty(0, dtype=np.int32)

    def _step_fields(self) -> Fields:
        action = ((self.action_dim,), np.float32)
        return {**super()._step_fields(), "target_actions": action, "exploratory_target_actions": action}

    def _note_fields(self) -> Fields:
        own: Fields = {"foreign": ((), bool), "off_route": ((), bool), "way_novelty": ((), np.float32), "goals": ((), bool)}
        return {**super()._note_fields(), **own}

    def _view_names(self) -> list[str]:
        own = ["target_actions", "exploratory_target_actions", "foreign", "off_route", "way_novelty", "goals"]
        return [*super()._view_names(), *own]

    def _position_arrays(self) -> list[np.ndarray]:
        return [*super()._position_arrays(), self._mode_position]

    def _allocate(self) -> None:
        super()._allocate()
        self.target_actions = self._steps["target_actions"]
        self.exploratory_target_actions = self._steps["exploratory_target_actions"]
        self.foreign, self.off_route = self._notes["foreign"], self._notes["off_route"]
        self.way_novelty, self.goals = self._notes["way_novelty"], self._notes["goals"]
        self._mode_position = np.zeros(self.buffer_size, dtype=np.int32)
        for row_set in self.mode_rows:
            row_set.position = self._mode_position

    def _write_rows(self, rows: np.ndarray, obs: Any, next_obs: Any, action: np.ndarray, *args: Any) -> None:
        super()._write_rows(rows, obs, next_obs, action, *args)
        for name in ("target_actions", "exploratory_target_actions"):
            self._steps.write(name, rows, action)
        self.foreign[rows] = self.off_route[rows] = self.goals[rows] = False
        self.way_novelty[rows] = 0.0

    def _finish(self, env: int, info: dict[str, Any]) -> Trajectory:
        trajectory = super()._finish(env, info)
        self.goals[trajectory.rows[-1]] = trajectory.success
        return trajectory

    def _evict(self) -> Trajectory:
        trajectory = super()._evict()
        if trajectory.trains:
            self.mode_rows[trajectory.mode].remove(trajectory.rows)
        if self.way_novelty[trajectory.rows[-1]] > 0:
            self._new_way_rows = np.setdiff1d(self._new_way_rows, trajectory.rows)
        return trajectory

    # ------------------------------------------------------------------ modes

    def expect_modes(self, n_modes: int) -> None:
        """
        Forget which mode owns what: until the next clustering, a model's modes have no trajectories here.

        :param n_modes: Number of modes of the model
        """
        successes, failures = self.trajectories(success=True), self.trajectories(success=False)
        self._forget_ways()
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
        self._watch([way for way in self.known_ways.ways if way.number in numbers])
        stored = self.trajectories(success=True) + self.trajectories(success=False)
        for trajectory in stored:
            if trajectory.foreign and trajectory.commanded not in numbers:
                self.readmit(trajectory)
            elif trajectory.commanded not in numbers:
                trajectory.commanded = None
        stored.sort(key=lambda trajectory: trajectory.serial)
        parts = [[t for t in stored if (t.success and not t.foreign) == success] for success in (True, False)]
        table = np.array([*new_modes, NO_MODE])  # the last one for NO_MODE itself
        successes, failures = (table[np.array([t.mode for t in part], dtype=int)] for part in parts)
        parents = [new_modes.index(mode) if mode in new_modes else None for mode in range(len(numbers))]
        self.assign_modes(parts[0], successes, parts[1], failures, parents)

    def adopt_settings(self, other: "ModeReplayBuffer") -> None:
        """
        :param other: The buffer that this one, loaded from a file, takes the place of
        """
        if (self.compared_length, self.loop_share) != (other.compared_length, other.loop_share):
            self._forget_paths()
        for name in ("success_key", *_MODE_SETTINGS):
            setattr(self, name, getattr(other, name))
        self.move_storage(other.storage_device)
        self._success_rule.success_key = other.success_key

    def path(self, trajectory: Trajectory) -> np.ndarray:
        """
        :param trajectory: A stored trajectory
        :return: What clustering compares of it: mode features, terminal state included, resampled; shape [n_path_points, dim]
        """
        if trajectory.path is None:
            trajectory.path = self.resample(self.full_path(trajectory))
        return trajectory.path

    def resample(self, full_path: np.ndarray) -> np.ndarray:
        """
        :param full_path: Mode features along a trajectory, shape [L, dim]
        :return: What clustering compares, shape [n_path_points, dim]
        """
        path = full_path / self._measured_scale()
        return comparable_path(path, self.n_path_points, self.loop_share, self.compared_length)

    def _forget_paths(self) -> None:
        """What is compared has changed."""
        self._forget_ways()
        self._distances = DistanceCache(self.normalize_distances)
        for success in (True, False):
            for trajectory in self.trajectories(success):
                trajectory.path = None

    def full_path(self, trajectory: Trajectory) -> np.ndarray:
        """
        :param trajectory: A stored trajectory
        :return: Its mode features, terminal state included, shape [length + 1, dim]
        """
        first = self._positions(self._steps, "observations", trajectory.rows)
        last = self._positions(self._nexts, "next_observations", trajectory.rows[-1:])
        return np.concatenate((first, last))

    def success_distances(self, successes: list[Trajectory]) -> np.ndarray:
        """
        Pairwise DTW distances. Only pairs with a trajectory that was not there the last time are computed.

        :param successes: The trajectories to compare, in order of finishing
        :return: Shape [N, N]
        """
        serials = np.array([trajectory.serial for trajectory in successes], dtype=np.int64)
        return self._distances(serials, [self.path(trajectory) for trajectory in successes])

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

        :param successes: In order of finishing
        :param success_modes: New mode of each, ``NO_MODE`` for outliers
        :param failures: In order of finishing; foreign ones count as failures of their mode
        :param failure_modes: New mode of each
        :param parents: For every new mode, the old mode from which it inherits. A trajectory that comes from another lineage
            starts again with its action as target action
        :param abandoned: Further goal-reached trajectories, which retire to exploration
        """
        self._groups, self._group_rows = {}, {}
        self.mode_rows = [RowSet(self._mode_position) for _ in parents]
        stays: list[Trajectory] = []
        goes: list[Trajectory] = list(abandoned)
        for trajectories, modes, limit in (
            (successes, success_modes, self.max_successes_per_mode),
            (failures, failure_modes, self.max_failures_per_mode),
        ):
            for mode in range(NO_MODE, len(parents)):
                members = [trajectories[i] for i in np.flatnonzero(np.asarray(modes) == mode)]
                direct, detours = ([], members) if mode == NO_MODE else self._split_detours(members)
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
                    self.way_novelty[trajectory.rows[-1]] = novelty * (trajectory.success and not trajectory.foreign)
                stays += kept
                goes += dropped
        for trajectory in sorted(stays, key=lambda t: t.serial):
            self._insert(trajectory)
            if trajectory.trains:
                self.mode_rows[trajectory.mode].add(trajectory.rows)
        for trajectory in sorted(goes, key=lambda t: t.serial):
            trajectory.mode, trajectory.trains, trajectory.path = NO_MODE, False, None
            self.way_novelty[trajectory.rows[-1]] = 0.0
            self._retired.append(trajectory)
        new_ways = [trajectory.rows for trajectory in stays if self.way_novelty[trajectory.rows[-1]] > 0]
        for rows in new_ways:  # along a known way for long, but on to a new one
            self.followed[rows] = NO_WAY
        self._new_way_rows = np.concatenate([self._new_way_rows[:0], *new_ways])

    def _training(self, modes: Collection[int]) -> dict[int, list[Trajectory]]:
        """Goal-reached trajectories that train each of these modes by its own way."""
        members: dict[int, list[Trajectory]] = {mode: [] for mode in modes}
        for each in self.trajectories(success=True) if members else []:
            if each.trains and each.mode in members:
                members[each.mode].append(each)
        return members

    def places_of(self, modes: Collection[int]) -> th.Tensor:
        """
        :param modes: Indices of modes
        :return: Where the goal-reached trajectories go that train one of these by its own way, [N, features.dim]
        """
        rows = [each.rows for members in self._training(modes).values() for each in members]
        if not rows:
            return th.empty(0, self.features.dim)
        return self.features.of_tensors(self.read_observations(np.concatenate(rows))[1])

    def watch_ways(self, modes: Mapping[int, int]) -> np.ndarray:
        """
        Note from now on which steps are of episodes that have come along the way of one of these modes: ``followed``. The
        episodes that are here already came along it unnoticed, and are noted too.

        :param modes: Numbers of modes by their indices
        :return: Rows of the latter, of steps whose visits were counted
        """
        ways = []
        for mode, members in self._training(modes).items():
            if members:
                paths = np.stack([self.path(each) for each in members])
                ways.append(Way(modes[mode], paths, self.route_share * _extent(paths)))
        if not ways:
            return self._watch([])
        # One that is a new way to a goal keeps its worth, however it began
        finished = [*self.trajectories(success=True), *self.trajectories(success=False), *self._retired]
        return self._watch(ways, [each.rows for each in finished if self.way_novelty[each.rows[-1]] == 0])

    def _split_detours(self, trajectories: list[Trajectory]) -> tuple[list[Trajectory], list[Trajectory]]:
        """
        A mode's trajectories, and apart from them the detours: successes that nobody told to follow the mode and that are
        much longer than its shortest one. From detours a critic would piece together a better way than the mode's own route,
        and the modes would become one. What the mode itself did slowly it must see, or it would never get better there.
        """
        lengths = np.sort([t.length for t in trajectories if t.success and not t.foreign])
        if not len(lengths):
            return trajectories, []
        limit = max(self.max_length_ratio * lengths[0], lengths[: self.min_direct][-1])
        is_detour = [t.success and t.commanded is None and t.length > limit for t in trajectories]
        direct = [t for t, detour in zip(trajectories, is_detour, strict=True) if not detour]
        return direct, [t for t, detour in zip(trajectories, is_detour, strict=True) if detour]

    def mark_off_route(self, trajectory: Trajectory, members: list[Trajectory]) -> None:
        """
        Mark the steps of a foreign trajectory that lead away from the route of the mode that it was told to follow, or to
        another goal close by.

        :param trajectory: The foreign trajectory
        :param members: Goal-reached trajectories of that mode
        """
        trajectory.foreign = True
        self.foreign[trajectory.rows] = True
        route = np.concatenate([self.path(member) for member in members])
        full_path = self.full_path(trajectory) / self._feature_scale
        reached = full_path[1:]
        extent = _extent(route)
        off_route = cdist(reached, route).min(axis=1) > self.route_share * extent
        if self.compared_length is not None:  # the members' routes before that are not known
            steps = np.linalg.norm(np.diff(full_path, axis=0), axis=1)
            off_route &= steps.sum() - steps.cumsum() <= self.compared_length
        ends = np.stack([self.path(member)[-1] for member in members])
        off_route[-1] |= cdist(reached[-1:], ends).min() > self.loop_share * extent
        self.off_route[trajectory.rows] = off_route

    def readmit(self, trajectory: Trajectory) -> None:
        """
        :param trajectory: A foreign trajectory whose mode has ended: it is a success like any other again
        """
        self.foreign[trajectory.rows] = self.off_route[trajectory.rows] = False
        trajectory.foreign, trajectory.commanded, trajectory.mode = False, None, NO_MODE

    def _change_mode(self, trajectory: Trajectory, mode: int, parents: list[int | None]) -> None:
        """Target actions are inherited with the critics that made them, or start again from the action."""
        inherited = trajectory.mode == NO_MODE or (mode != NO_MODE and parents[mode] == trajectory.mode)
        if not inherited:
            self._steps.write("target_actions", trajectory.rows, self._steps.tensors(trajectory.rows)["actions"])
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
    ) -> ModeBatch:
        """
        Draw one multimodal batch: an equal part from all transitions (exploratory group) and from each mode's own.

        :param batch_size: Number of transitions B; each of the G groups gets B // G
        :param gamma: Discount factor
        :param exploration_n_steps: Length of the exploratory group's returns
        :param mode_n_steps: Length of the modes' returns
        :param env: Normalises observations and rewards when given
        :param exploration_gamma: The exploratory group's discount factor; None: gamma
        :return: The batch
        """
        n_groups = len(self.mode_rows) + 1
        n = batch_size // n_groups
        if n == 0:
            raise ValueError(f"batch_size={batch_size} is smaller than the number of groups, {n_groups}")
        active = np.array([True, *(row_set.size > 0 for row_set in self.mode_rows)])
        sets = [self._all, *(row_set if row_set.size else self._all for row_set in self.mode_rows)]
        rows = np.stack([row_set.sample(n) for row_set in sets])  # [G, n]
        if len(self._new_way_rows) and self.new_way_share:
            n_new = round(self.new_way_share * n)
            rows[EXPLORATORY_GROUP, :n_new] = np.random.choice(self._new_way_rows, n_new)
        windows, notes = self._windows(rows, exploration_n_steps, mode_n_steps)
        gammas = np.full(n_groups, gamma, dtype=np.float32)
        if exploration_gamma is not None:
            gammas[EXPLORATORY_GROUP] = exploration_gamma
        returns = group_returns(
            windows,
            notes,
            self._normalize_reward(notes["rewards"].ravel(), env).reshape(windows.shape),
            gammas,
            past_known_ways=self.known_ways.include(notes["followed"][EXPLORATORY_GROUP]),
            explore_beyond_goals=self.explore_beyond_goals,
            new_ways_pay=self.new_way_share > 0,
        )
        # What led away from the route is for the critic to judge, not for the policy to follow
        imitated = active[:, None] & ~notes["foreign"][..., 0]
        imitated[EXPLORATORY_GROUP] = True
        steps = self._on_device(self._steps.tensors(rows.ravel()))
        nexts = self._on_device(self._nexts.tensors(returns.last.ravel()))
        actions, exploratory, targets = (
            steps[name].view(*rows.shape, self.action_dim)
            for name in ("actions", "exploratory_target_actions", "target_actions")
        )
        return ModeBatch(
            observations=self.normalized(self._as_observation(steps, "observations"), env),
            actions=actions,
            target_actions=th.cat((exploratory[:1], targets[1:])),
            next_observations=self.normalized(self._as_observation(nexts, "next_observations"), env),
            rewards=self._to_device(returns.rewards.astype(np.float32)),
            discounts=self._to_device(returns.discounts.astype(np.float32)),
            active=self._to_device(active),
            imitated=self._to_device(imitated),
            new_ways=self._to_device(returns.new_ways.astype(np.float32)),
            rows=rows,
            windows=np.where(returns.lost, -1, windows),
        )

    def _windows(self, rows: np.ndarray, exploration_n_steps: int, mode_n_steps: int) -> tuple[np.ndarray, np.ndarray]:
        """The rows that follow each row in its trajectory, itself first, -1 beyond its end; their notes. [G, n, n_steps]"""
        n_steps = max(exploration_n_steps, mode_n_steps if len(rows) > 1 else 1)
        windows = np.empty((*rows.shape, n_steps), dtype=np.int32)
        windows[..., 0], following = rows, rows
        for k in range(1, n_steps):
            following = windows[..., k] = np.where(following >= 0, self.next_row[following], -1)
        windows[0, :, exploration_n_steps:] = -1
        windows[1:, :, mode_n_steps:] = -1
        return windows, self._notes.take(windows)

    def store_target_actions(self, batch: ModeBatch, target_actions: th.Tensor) -> None:
        """
        Write improved target actions back.

        :param batch: As drawn by ``sample_modes``
        :param target_actions: Shape [G, n, action_dim]
        """
        if self.storage_device.type == "cpu":
            target_actions = target_actions.cpu()
        self._steps.write("exploratory_target_actions", batch.rows[0], target_actions[0])
        groups = [mode + 1 for mode, row_set in enumerate(self.mode_rows) if row_set.size]
        if groups:
            improved = th.cat([target_actions[group] for group in groups])
            self._steps.write("target_actions", batch.rows[groups].ravel(), improved)
