"""Replay buffer that keeps whole trajectories: rows, running and finished episodes, eviction."""

from collections import deque
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ddiffpg.features import Observation
from sb3_ddiffpg.trajectories import NO_MODE, RowSet, SuccessRule, Trajectory


class TrajectoryReplayBuffer(ReplayBuffer):
    """
    Transitions live in rows; a finished trajectory owns its rows. When rows run out, the oldest retired trajectory is evicted,
    then the oldest of whichever group (mode and outcome) holds most rows, so that a rare mode is never crowded out.

    Storage is allocated at the first ``add``: a model that is loaded to act needs none.

    :param buffer_size: Capacity in transitions (over all environments)
    :param observation_space: Observation space
    :param action_space: Action space
    :param device: PyTorch device of the samples
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Not supported
    :param handle_timeout_termination: Whether time limits are bootstrapped through
    :param success_key: Key of ``info`` that marks a success; None reads ``is_success`` or ``success`` and, where neither
        exists, counts the trajectories whose return is in the top fifth of those seen lately
    :raises ValueError: If ``buffer_size`` is not positive or ``optimize_memory_usage`` is asked for
    """

    observations: Any
    next_observations: Any
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
        success_key: str | None = None,
    ) -> None:
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage=True is not supported: trajectories do not lie in one ring")
        if buffer_size < 1:
            raise ValueError(f"buffer_size must be at least 1, got {buffer_size}")
        # Not ReplayBuffer's constructor: it would allocate a ring per environment
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.success_key = success_key
        self.reset()

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
        #: Indices of modes whose successes are evicted last
        self.frozen_modes: set[int] = set()
        self._n_finished = 0
        self._last_rows = np.empty(0, dtype=np.int32)
        self._success_rule = SuccessRule(self.success_key)
        self.just_finished: list[tuple[int, Trajectory]] = []

    def _row_arrays(self) -> list[str]:
        return ["observations", "next_observations", "actions", "rewards", "dones", "timeouts", "next_row", "_all_position"]

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
        self.actions = np.zeros((self.buffer_size, self.action_dim), dtype=np.float32)
        self.rewards = np.zeros(self.buffer_size, dtype=np.float32)
        self.dones = np.zeros(self.buffer_size, dtype=bool)
        self.timeouts = np.zeros(self.buffer_size, dtype=bool)
        self.next_row = np.zeros(self.buffer_size, dtype=np.int32)
        self._all_position = np.zeros(self.buffer_size, dtype=np.int32)
        self._all = RowSet(self._all_position)
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

    def _evict(self) -> Trajectory:
        if self._retired:
            trajectory = self._retired.popleft()
        else:
            # The last success of a mode stays: without it the mode would have nothing to learn from
            spare = [key for key, group in self._groups.items() if len(group) > (key[0] != NO_MODE and key[1])]
            spare = [key for key in spare if not (key[0] in self.frozen_modes and key[1])] or spare
            if not spare:
                raise ValueError(
                    f"buffer_size={self.buffer_size} transitions is too small: the unfinished episodes of {self.n_envs} "
                    "environment(s) fill it. Give at least n_envs times the episode length"
                )
            largest = max(spare, key=lambda key: self._group_rows[key])
            trajectory = self._groups[largest].popleft()
            self._group_rows[largest] -= trajectory.length
        self._free_rows(trajectory.rows)
        return trajectory

    def _free_rows(self, rows: np.ndarray) -> None:
        self._all.remove(rows)
        needed = self._n_free + len(rows)
        if needed > len(self._free):
            self._free = np.concatenate((self._free[: self._n_free], np.empty(2 * needed, dtype=np.int32)))
        self._free[self._n_free : needed] = rows
        self._n_free = needed

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
            self.check_finite(name, value)
        rows = self._take_rows(self.n_envs)
        self._write_rows(rows, obs, next_obs, action, reward, done)
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

    def _write_rows(
        self, rows: np.ndarray, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray, done: np.ndarray
    ) -> None:
        self._write(self.observations, rows, obs)
        self._write(self.next_observations, rows, next_obs)
        self.actions[rows] = action
        self.rewards[rows] = reward
        self.dones[rows] = done
        self.timeouts[rows] = False
        self.next_row[rows] = -1

    @staticmethod
    def _write(array: Any, rows: np.ndarray, value: Any) -> None:
        if isinstance(array, dict):
            for key in array:
                array[key][rows] = np.asarray(value[key]).reshape(len(rows), *array[key].shape[1:])
        else:
            array[rows] = np.asarray(value).reshape(len(rows), *array.shape[1:])

    @staticmethod
    def check_finite(name: str, value: Any) -> None:
        """
        :param name: What the value is, for the message
        :param value: One row per environment, or a dict of such
        :raises ValueError: If a value is not finite, naming the environment
        """
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
            label=None if info.get("mode") is None else str(info["mode"]),
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

    def drop_unfinished_episodes(self) -> None:
        """Forget the transitions of running episodes: call it when the environments were reset outside."""
        for env in np.flatnonzero(self._running_length > 0):
            self._free_rows(self._running[env, : self._running_length[env]].copy())
        self._running_length[:] = 0
        self._running_return[:] = 0.0

    @property
    def has_success_signal(self) -> bool:
        """Whether the environment itself says what a success is."""
        return self._success_rule.has_signal

    def trajectories(self, success: bool) -> list[Trajectory]:
        """
        :param success: Goal-reached or failed ones (and those foreign to their mode)
        :return: Those in use by a mode or not yet clustered, in order of finishing
        """
        found = [t for key, group in self._groups.items() if key[1] == success for t in group]
        return sorted(found, key=lambda trajectory: trajectory.serial)

    def _read(self, array: Any, rows: np.ndarray) -> Any:
        # Not array[rows]: in a large buffer `take` is three times as fast
        return (
            {key: value.take(rows, axis=0) for key, value in array.items()}
            if isinstance(array, dict)
            else array.take(rows, axis=0)
        )

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
