"""Replay buffer that knows trajectories and modes, and stores a target action beside every action."""

from collections import deque
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from scipy.spatial.distance import cdist
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ddiffpg.dtw import erase_loops, resample_path
from sb3_ddiffpg.features import ModeFeatures, Observation
from sb3_ddiffpg.trajectories import NO_MODE, DistanceCache, RowSet, SuccessRule, Trajectory

EXPLORATORY = 0  # the first group of a batch


class ModeBatch(NamedTuple):
    """
    One batch, split evenly over G groups: the exploratory one first, then every mode. N = G * n rows, group by group.

    Observations are [N, ...] (or dicts of such), ``actions``, ``target_actions`` [G, n, action_dim], ``rewards`` and
    ``discounts`` [G, n]. ``active`` [G] is False for a mode without any transition, whose rows are a stand-in that must
    not train it. ``rows`` [G, n] and ``windows`` [G, n, n_steps] (-1 where a window ends early) say where in
    the buffer the transitions lie.
    """

    observations: Any
    actions: th.Tensor
    target_actions: th.Tensor
    next_observations: Any
    rewards: th.Tensor
    discounts: th.Tensor
    active: th.Tensor
    rows: np.ndarray
    windows: np.ndarray


class ModeReplayBuffer(ReplayBuffer):
    """
    Transitions live in rows; a finished trajectory owns its rows. When rows run out, the oldest trajectory that no mode
    needs is evicted, then the oldest of whichever group (mode and outcome) holds most rows, so that a rare mode is never
    crowded out. Each row has two target actions: one for the mode that owns its trajectory, one for the exploratory group.

    Storage is allocated at the first ``add``: a model that is loaded to act needs none.

    :param buffer_size: Capacity in transitions (over all environments)
    :param observation_space: Observation space
    :param action_space: Action space
    :param device: PyTorch device of the samples
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Not supported
    :param handle_timeout_termination: Whether time limits are bootstrapped through
    :param mode_features: See ``ModeFeatures``
    :param success_key: Key of ``info`` that marks a success; None reads ``is_success`` or ``success`` and, where neither
        exists, counts the trajectories whose return is in the top fifth of those seen lately
    :param max_successes_per_mode: Newest goal-reached trajectories that train a mode; older ones serve exploration only
    :param max_failures_per_mode: Newest failed trajectories that train a mode
    :param n_path_points: Points to which a trajectory's path is resampled for clustering
    :raises ValueError: If a size is not positive or ``optimize_memory_usage`` is asked for
    """

    observations: Any
    next_observations: Any
    target_actions: np.ndarray
    exploratory_target_actions: np.ndarray
    next_row: np.ndarray

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        mode_features: Any = None,
        success_key: str | None = None,
        max_successes_per_mode: int = 40,
        max_failures_per_mode: int = 20,
        max_length_ratio: float = 1.5,
        min_direct: int = 5,
        n_path_points: int = 48,
        loop_share: float = 0.05,
        route_share: float = 0.1,
    ) -> None:
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage=True is not supported: trajectories do not lie in one ring")
        for name, value in (
            ("buffer_size", buffer_size),
            ("max_successes_per_mode", max_successes_per_mode),
            ("max_failures_per_mode", max_failures_per_mode),
        ):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        if n_path_points < 2:
            raise ValueError(f"n_path_points must be at least 2, got {n_path_points}")
        # Not ReplayBuffer's constructor: it would allocate a ring per environment
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.features = ModeFeatures(observation_space, mode_features)
        self.success_key = success_key
        self.max_successes_per_mode = max_successes_per_mode
        self.max_failures_per_mode = max_failures_per_mode
        self.max_length_ratio = max_length_ratio
        self.min_direct = min_direct
        self.n_path_points = n_path_points
        self.loop_share = loop_share
        self.route_share = route_share
        self.reset()

    # ------------------------------------------------------------------ storage

    def reset(self) -> None:
        """Forget everything and release the storage."""
        super().reset()
        self._allocated = False
        self._free = np.empty(0, dtype=np.int32)  # stack of rows that were used and freed
        self._n_free = 0
        self._running = np.empty((self.n_envs, 64), dtype=np.int32)
        self._running_length = np.zeros(self.n_envs, dtype=np.int64)
        self._running_return = np.zeros(self.n_envs)
        self._groups: dict[tuple[int, bool], deque[Trajectory]] = {}
        self._group_rows: dict[tuple[int, bool], int] = {}
        self._retired: deque[Trajectory] = deque()
        self._n_finished = 0
        self._last_rows = np.empty(0, dtype=np.int32)
        self._success_rule = SuccessRule(self.success_key)
        self._feature_scale: np.ndarray | None = None
        self._distances = DistanceCache()
        self._mode_position = np.empty(0, dtype=np.int32)
        self.just_finished: list[tuple[int, Trajectory]] = []
        self.mode_rows: list[RowSet] = []

    def _row_arrays(self) -> list[str]:
        return [
            *("observations", "next_observations", "actions", "target_actions", "exploratory_target_actions"),
            *("rewards", "off_route", "dones", "timeouts", "next_row", "_all_position", "_mode_position"),
        ]

    def _allocate(self) -> None:
        """The operating system commits zeroed pages only when they are written, so an unfilled buffer stays small."""

        def zeros_like_space(space: spaces.Space) -> np.ndarray:
            shape = get_obs_shape(space)
            return np.zeros((self.buffer_size, *shape), dtype=self._maybe_cast_dtype(space.dtype))

        if isinstance(self.observation_space, spaces.Dict):
            self.observations = {key: zeros_like_space(space) for key, space in self.observation_space.items()}
            self.next_observations = {key: zeros_like_space(space) for key, space in self.observation_space.items()}
        else:
            self.observations = zeros_like_space(self.observation_space)
            self.next_observations = zeros_like_space(self.observation_space)
        for name in ("actions", "target_actions", "exploratory_target_actions"):
            setattr(self, name, np.zeros((self.buffer_size, self.action_dim), dtype=np.float32))
        self.rewards = np.zeros(self.buffer_size, dtype=np.float32)
        self.off_route = np.zeros(self.buffer_size, dtype=bool)
        self.dones = np.zeros(self.buffer_size, dtype=bool)
        self.timeouts = np.zeros(self.buffer_size, dtype=bool)
        self.next_row = np.zeros(self.buffer_size, dtype=np.int32)
        self._all_position = np.zeros(self.buffer_size, dtype=np.int32)
        self._mode_position = np.zeros(self.buffer_size, dtype=np.int32)
        self._all = RowSet(self._all_position)
        for row_set in self.mode_rows:
            row_set.position = self._mode_position
        self._allocated = True

    def __getstate__(self) -> dict[str, Any]:
        """Only used rows are pickled."""
        state = self.__dict__.copy()
        if self._allocated:
            for name in self._row_arrays():
                array = state[name]
                used = {k: v[: self.pos] for k, v in array.items()} if isinstance(array, dict) else array[: self.pos]
                state[name] = used
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if not self._allocated:
            return
        saved = {name: state[name] for name in self._row_arrays()}
        all_rows = self._all
        self._allocate()
        for name, array in saved.items():
            target = getattr(self, name)
            for full, used in zip(
                target.values() if isinstance(target, dict) else [target],
                array.values() if isinstance(array, dict) else [array],
                strict=True,
            ):
                full[: self.pos] = used
        self._all = all_rows
        self._all.position = self._all_position

    def size(self) -> int:
        """
        :return: Number of stored transitions
        """
        return self._all.size if self._allocated else 0

    def _take_rows(self, n: int) -> np.ndarray:
        """Rows for n transitions: unused ones first, then freed ones, then those of an evicted trajectory."""
        unused = min(n, self.buffer_size - self.pos)
        rows = np.arange(self.pos, self.pos + unused, dtype=np.int32)
        self.pos += unused
        if unused < n:
            self.full = True
            while self._n_free < n - unused:
                self._evict()
            self._n_free -= n - unused
            rows = np.concatenate((rows, self._free[self._n_free : self._n_free + n - unused]))
        return rows

    def _evict(self) -> None:
        if self._retired:
            trajectory = self._retired.popleft()
        else:
            # The last success of a mode stays: without it the mode would have nothing to learn from
            spare = [key for key, group in self._groups.items() if len(group) > (key[0] != NO_MODE and key[1])]
            if not spare:
                raise ValueError(
                    f"buffer_size={self.buffer_size} transitions is too small: the unfinished episodes of {self.n_envs} "
                    "environment(s) fill it. Give at least n_envs times the episode length"
                )
            largest = max(spare, key=lambda key: self._group_rows[key])
            trajectory = self._groups[largest].popleft()
            self._group_rows[largest] -= trajectory.length
        self._free_rows(trajectory.rows)
        if trajectory.trains:
            self.mode_rows[trajectory.mode].remove(trajectory.rows)

    def _free_rows(self, rows: np.ndarray) -> None:
        self._all.remove(rows)
        needed = self._n_free + len(rows)
        if needed > len(self._free):
            self._free = np.concatenate((self._free[: self._n_free], np.empty(2 * needed, dtype=np.int32)))
        self._free[self._n_free : needed] = rows
        self._n_free = needed

    # ------------------------------------------------------------------ adding

    def add(
        self,
        obs: Observation,
        next_obs: Observation,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition of every environment. Trajectories that end are listed in ``just_finished``.

        :param obs: Observations, [n_envs, ...] (or a dict of such)
        :param next_obs: Next observations, the terminal one where an episode ended
        :param action: Actions in [-1, 1], [n_envs, action_dim]
        :param reward: [n_envs]
        :param done: [n_envs]
        :param infos: One dict per environment
        :raises ValueError: If a value is not finite (nothing is stored then), or the buffer cannot hold one episode
        """
        if not self._allocated:
            self._allocate()
        action = np.asarray(action, dtype=np.float32).reshape(self.n_envs, self.action_dim)
        for name, value in (("observation", obs), ("next observation", next_obs), ("action", action), ("reward", reward)):
            self._check_finite(name, value)
        rows = self._take_rows(self.n_envs)
        self._write(self.observations, rows, obs)
        self._write(self.next_observations, rows, next_obs)
        self.actions[rows] = self.target_actions[rows] = self.exploratory_target_actions[rows] = action
        self.rewards[rows] = reward
        self.off_route[rows] = False
        self.dones[rows] = done
        self.timeouts[rows] = False
        self.next_row[rows] = -1
        self._all.add(rows)

        running = np.flatnonzero(self._running_length > 0)
        self.next_row[self._running[running, self._running_length[running] - 1]] = rows[running]
        longest = int(self._running_length.max(initial=0))
        if longest == self._running.shape[1]:
            self._running = np.concatenate((self._running, np.empty_like(self._running)), axis=1)
        self._running[np.arange(self.n_envs), self._running_length] = rows
        self._running_length += 1
        self._running_return += reward

        self._last_rows = rows
        self.just_finished = []
        for env in np.flatnonzero(done):
            if self.handle_timeout_termination:
                self.timeouts[rows[env]] = bool(infos[env].get("TimeLimit.truncated", False))
            self.just_finished.append((int(env), self._finish(int(env), infos[env])))

    @staticmethod
    def _write(array: Any, rows: np.ndarray, value: Any) -> None:
        if isinstance(array, dict):
            for key in array:
                array[key][rows] = np.asarray(value[key]).reshape(len(rows), *array[key].shape[1:])
        else:
            array[rows] = np.asarray(value).reshape(len(rows), *array.shape[1:])

    @staticmethod
    def _check_finite(name: str, value: Any) -> None:
        for array in value.values() if isinstance(value, dict) else [value]:
            array = np.asarray(array)
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                env = int(np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))[0])
                raise ValueError(
                    f"The {name} of environment {env} is not finite: {array[env]}. Nothing of this step was stored"
                )

    def _finish(self, env: int, info: dict[str, Any]) -> Trajectory:
        length = self._running_length[env]
        trajectory = Trajectory(
            rows=self._running[env, :length].copy(),
            success=self._success_rule(info, float(self._running_return[env])),
            episode_return=float(self._running_return[env]),
            serial=self._n_finished,
        )
        self._n_finished += 1
        self._running_length[env] = 0
        self._running_return[env] = 0.0
        self._insert(trajectory)
        return trajectory

    def _insert(self, trajectory: Trajectory) -> None:
        key = (trajectory.mode, trajectory.success and not trajectory.foreign)
        self._groups.setdefault(key, deque()).append(trajectory)
        self._group_rows[key] = self._group_rows.get(key, 0) + trajectory.length

    def last_positions(self) -> np.ndarray:
        """
        :return: Mode features of the states reached by the latest ``add``, shape [n_envs, dim]
        """
        return self.features(self._read(self.next_observations, self._last_rows))

    def drop_unfinished_episodes(self) -> None:
        """Forget the transitions of running episodes: call it when the environments were reset outside."""
        for env in np.flatnonzero(self._running_length > 0):
            self._free_rows(self._running[env, : self._running_length[env]].copy())
        self._running_length[:] = 0
        self._running_return[:] = 0.0

    # ------------------------------------------------------------------ modes

    @property
    def has_success_signal(self) -> bool:
        """Whether the environment itself says what a success is."""
        return self._success_rule.has_signal

    def expect_modes(self, n_modes: int) -> None:
        """
        Forget which mode owns what: until the next clustering, a model's modes have no trajectories here.

        :param n_modes: Number of modes of the model
        """
        successes, failures = self.trajectories(success=True), self.trajectories(success=False)
        nobody = np.full(len(successes), NO_MODE), np.full(len(failures), NO_MODE)
        self.assign_modes(successes, nobody[0], failures, nobody[1], [None] * n_modes)

    def trajectories(self, success: bool) -> list[Trajectory]:
        """
        :param success: Goal-reached or failed ones (and those foreign to their mode)
        :return: Those in use by a mode or not yet clustered, in order of finishing
        """
        found = [t for key, group in self._groups.items() if key[1] == success for t in group]
        return sorted(found, key=lambda trajectory: trajectory.serial)

    def path(self, trajectory: Trajectory) -> np.ndarray:
        """
        :param trajectory: A stored trajectory
        :return: Its mode features, terminal state included, resampled; shape [n_path_points, dim]
        """
        if trajectory.path is None:
            trajectory.path = self.resample(self.full_path(trajectory))
        return trajectory.path

    def resample(self, full_path: np.ndarray) -> np.ndarray:
        """
        :param full_path: Mode features along a trajectory, shape [L, dim]
        :return: What clustering compares, shape [n_path_points, dim]
        """
        if self._feature_scale is None:
            self._feature_scale = self._measure_scale()
        path = full_path / self._feature_scale
        path = erase_loops(path, self.loop_share * float(np.linalg.norm(np.ptp(path, axis=0))))
        return resample_path(path, self.n_path_points)

    def full_path(self, trajectory: Trajectory) -> np.ndarray:
        """
        :param trajectory: A stored trajectory
        :return: Its mode features, terminal state included, shape [length + 1, dim]
        """
        first = self.features(self._read(self.observations, trajectory.rows))
        last = self.features(self._read(self.next_observations, trajectory.rows[-1:]))
        return np.concatenate((first, last))

    def _measure_scale(self) -> np.ndarray:
        """Declared positions keep their unit; a whole observation is standardised once, or cached distances would age."""
        if not self.features.whole_observation:
            return np.ones(self.features.dim, dtype=np.float32)
        rows = self._all.rows[: min(self._all.size, 50_000)]
        deviation = self.features(self._read(self.observations, rows)).std(axis=0)
        return np.where(deviation > 1e-6, deviation, 1.0).astype(np.float32)

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
        """
        self._groups, self._group_rows = {}, {}
        self.mode_rows = [RowSet(self._mode_position) for _ in parents]
        stays: list[Trajectory] = []
        goes: list[Trajectory] = []
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
                for trajectory in members:
                    self._change_mode(trajectory, mode, parents)
                stays += kept
                goes += dropped
        for trajectory in sorted(stays, key=lambda t: t.serial):
            self._insert(trajectory)
            if trajectory.trains:
                self.mode_rows[trajectory.mode].add(trajectory.rows)
        for trajectory in sorted(goes, key=lambda t: t.serial):
            trajectory.mode, trajectory.path = NO_MODE, None
            self._retired.append(trajectory)

    def _split_detours(self, trajectories: list[Trajectory]) -> tuple[list[Trajectory], list[Trajectory]]:
        """
        A mode's trajectories, and apart from them the successes that are much longer than its shortest one. From detours a
        critic would piece together a better way than the mode's own route, and the modes would become one.
        """
        lengths = np.sort([t.length for t in trajectories if t.success and not t.foreign])
        if not len(lengths):
            return trajectories, []
        limit = max(self.max_length_ratio * lengths[0], lengths[: self.min_direct][-1])
        is_detour = [t.success and not t.foreign and t.length > limit for t in trajectories]
        direct = [t for t, detour in zip(trajectories, is_detour, strict=True) if not detour]
        return direct, [t for t, detour in zip(trajectories, is_detour, strict=True) if detour]

    def mark_off_route(self, trajectory: Trajectory, members: list[Trajectory]) -> None:
        """
        Mark the steps of a foreign trajectory that lead away from the route of the mode that it was told to follow.

        :param trajectory: The foreign trajectory
        :param members: Goal-reached trajectories of that mode
        """
        trajectory.foreign = True
        route = np.concatenate([self.path(member) for member in members])
        reached = self.full_path(trajectory)[1:] / self._feature_scale
        radius = self.route_share * float(np.linalg.norm(np.ptp(route, axis=0)))
        self.off_route[trajectory.rows] = cdist(reached, route).min(axis=1) > radius

    def _change_mode(self, trajectory: Trajectory, mode: int, parents: list[int | None]) -> None:
        """Target actions are inherited with the critics that made them, or start again from the action."""
        inherited = trajectory.mode == NO_MODE or (mode != NO_MODE and parents[mode] == trajectory.mode)
        if not inherited:
            self.target_actions[trajectory.rows] = self.actions[trajectory.rows]
        trajectory.mode = mode

    # ------------------------------------------------------------------ sampling

    def _read(self, array: Any, rows: np.ndarray) -> Any:
        return {key: value[rows] for key, value in array.items()} if isinstance(array, dict) else array[rows]

    def read_observations(self, rows: np.ndarray, env: VecNormalize | None = None) -> tuple[Any, Any]:
        """
        :param rows: Shape [N]
        :param env: Normalises the observations when given
        :return: Observations and next observations of the rows, unprocessed NumPy arrays or dicts of such
        """
        obs, next_obs = self._read(self.observations, rows), self._read(self.next_observations, rows)
        return self._normalize_obs(obs, env), self._normalize_obs(next_obs, env)

    def _tensors(self, obs: Any) -> Any:
        return {key: self.to_torch(value) for key, value in obs.items()} if isinstance(obs, dict) else self.to_torch(obs)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Draw transitions uniformly, whatever their mode.

        :param batch_size: Number of transitions
        :param env: Normalises observations and rewards when given
        :return: SB3's samples
        """
        rows = self._all.sample(batch_size)
        obs, next_obs = self.read_observations(rows, env)
        dones = (self.dones[rows] & ~self.timeouts[rows]).astype(np.float32)
        samples = DictReplayBufferSamples if isinstance(self.observation_space, spaces.Dict) else ReplayBufferSamples
        return samples(  # type: ignore[return-value]
            observations=self._tensors(obs),
            actions=self.to_torch(self.actions[rows]),
            next_observations=self._tensors(next_obs),
            dones=self.to_torch(dones[:, None]),
            rewards=self.to_torch(self._normalize_reward(self.rewards[rows, None], env)),
        )

    def sample_modes(
        self, batch_size: int, gamma: float, exploration_n_steps: int, mode_n_steps: int, env: VecNormalize | None = None
    ) -> ModeBatch:
        """
        Draw one multimodal batch: an equal part from all transitions (exploratory group) and from each mode's own.

        :param batch_size: Number of transitions B; each of the G groups gets B // G
        :param gamma: Discount factor
        :param exploration_n_steps: Length of the exploratory group's returns
        :param mode_n_steps: Length of the modes' returns
        :param env: Normalises observations and rewards when given
        :return: The batch
        """
        n_groups = len(self.mode_rows) + 1
        n = batch_size // n_groups
        active = np.array([True, *(row_set.size > 0 for row_set in self.mode_rows)])
        sets = [self._all, *(row_set if row_set.size else self._all for row_set in self.mode_rows)]
        rows = np.stack([row_set.sample(n) for row_set in sets])  # [G, n]
        windows = self._windows(rows, exploration_n_steps, mode_n_steps)
        present = windows >= 0
        powers = np.float32(gamma) ** np.arange(windows.shape[-1], dtype=np.float32)
        rewards = self._normalize_reward(self.rewards[windows.ravel()], env).reshape(windows.shape)
        # For its mode a step off the route ends the episode without reward, so that no way back is worth anything
        lost = np.logical_or.accumulate(self.off_route[windows] & present, axis=-1)
        lost[EXPLORATORY] = False
        rewards = (np.where(present & ~lost, rewards, 0.0) * powers).sum(axis=-1)  # [G, n]
        lengths = present.sum(axis=-1)
        last = np.take_along_axis(windows, lengths[..., None] - 1, axis=-1)[..., 0]
        continues = (~self.dones[last] | self.timeouts[last]) & ~lost.any(axis=-1)
        discounts = np.float32(gamma) ** lengths * continues
        obs = self._normalize_obs(self._read(self.observations, rows.ravel()), env)
        next_obs = self._normalize_obs(self._read(self.next_observations, last.ravel()), env)
        targets = np.concatenate((self.exploratory_target_actions[rows[:1]], self.target_actions[rows[1:]]))
        return ModeBatch(
            observations=self._tensors(obs),
            actions=self.to_torch(self.actions[rows]),
            target_actions=self.to_torch(targets),
            next_observations=self._tensors(next_obs),
            rewards=self.to_torch(rewards.astype(np.float32)),
            discounts=self.to_torch(discounts.astype(np.float32)),
            active=self.to_torch(active),
            rows=rows,
            windows=windows,
        )

    def _windows(self, rows: np.ndarray, exploration_n_steps: int, mode_n_steps: int) -> np.ndarray:
        """The rows that follow each row in its trajectory, itself first, [G, n, n_steps]; -1 beyond the end."""
        n_steps = max(exploration_n_steps, mode_n_steps if len(rows) > 1 else 1)
        windows = np.full((*rows.shape, n_steps), -1, dtype=np.int32)
        windows[..., 0] = rows
        for k in range(1, n_steps):
            previous = windows[..., k - 1]
            windows[..., k] = np.where(previous >= 0, self.next_row[previous], -1)
        windows[0, :, exploration_n_steps:] = -1
        windows[1:, :, mode_n_steps:] = -1
        return windows

    def store_target_actions(self, batch: ModeBatch, target_actions: th.Tensor) -> None:
        """
        Write improved target actions back.

        :param batch: As drawn by ``sample_modes``
        :param target_actions: Shape [G, n, action_dim]
        """
        improved = target_actions.cpu().numpy()
        self.exploratory_target_actions[batch.rows[0]] = improved[0]
        for mode, row_set in enumerate(self.mode_rows):
            if row_set.size:
                self.target_actions[batch.rows[mode + 1]] = improved[mode + 1]
