"""Replay buffer that keeps whole trajectories: rows, running and finished episodes, eviction."""

import warnings
from collections import deque
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ddiffpg.divergence import LARGEST
from sb3_ddiffpg.features import Observation
from sb3_ddiffpg.row_storage import Fields, HostRows, make_rows
from sb3_ddiffpg.trajectories import NO_MODE, RowSet, SuccessRule, Trajectory

# Rows are numbered in 32 bits
MOST_ROWS = 2**31 - 1


class TrajectoryReplayBuffer(ReplayBuffer):
    """
    Transitions live in rows; a finished trajectory owns its rows. When rows run out, the oldest retired trajectory is evicted,
    then the oldest of whichever group (mode and outcome) holds most rows, so that a rare mode is never crowded out.

    Storage is allocated by ``allocate`` or the first ``add``: a model that is loaded to act needs none. What the networks see
    may live on an accelerator (``storage_device``); what decides which rows are read always stays in the main memory.

    :param buffer_size: Capacity in transitions (over all environments)
    :param observation_space: Observation space
    :param action_space: Action space
    :param device: PyTorch device of the samples
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Not supported
    :param handle_timeout_termination: Whether time limits are bootstrapped through
    :param success_key: Key of ``info`` that marks a success; None reads ``is_success`` or ``success`` and, where neither
        exists, counts the trajectories whose return is in the top fifth of those seen lately
    :param storage_device: Where observations and actions live: ``"cpu"``, or ``"auto"``: where the samples go
    :raises ValueError: If ``buffer_size`` is out of its range or ``optimize_memory_usage`` is asked for
    """

    # Views of the storage: arrays (tensors where it is on an accelerator), or dicts of such
    observations: Any
    next_observations: Any
    actions: Any
    rewards: np.ndarray
    dones: np.ndarray
    timeouts: np.ndarray
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
        storage_device: th.device | str = "cpu",
    ) -> None:
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage=True is not supported: trajectories do not lie in one ring")
        if not 1 <= buffer_size <= MOST_ROWS:
            raise ValueError(f"buffer_size must be from 1 to {MOST_ROWS}, got {buffer_size}")
        # Not ReplayBuffer's constructor: it would allocate a ring per environment
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.success_key = success_key
        self._allocated = False
        self.storage_device = self._resolve_storage(storage_device)
        self.reset()

    def reset(self) -> None:
        """Forget everything and release the storage."""
        super().reset()
        if self._allocated:
            for name in ("_steps", "_nexts", "_notes", *self._view_names()):
                delattr(self, name)
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
        self._success_rule = SuccessRule(self.success_key)
        self.just_finished: list[tuple[int, Trajectory]] = []

    def _resolve_storage(self, asked: th.device | str) -> th.device:
        """Rows go straight to the networks or stay in the main memory: nowhere else."""
        if asked == "auto":
            return self.device
        if not isinstance(asked, (str, th.device)):
            raise ValueError(f"storage_device must be 'cpu', 'auto' or the samples' device, got {asked!r}")
        device = th.device(asked)
        if device.type != "cpu" and device.type != self.device.type:
            warnings.warn(f"storage_device={asked!r}: the samples go to {self.device}, so the rows stay in the main memory")
            return th.device("cpu")
        return device

    def move_storage(self, device: th.device) -> None:
        """
        :param device: Where observations and actions live from now on
        """
        moved = self._allocated and device != self.storage_device
        state = self.__getstate__() if moved else {}
        self.storage_device = device
        if moved:
            self._restore(state["saved_rows"], state["saved_positions"])

    def _observation_fields(self, name: str) -> Fields:
        space = self.observation_space
        parts = {f"{name}/{key}": each for key, each in space.items()} if isinstance(space, spaces.Dict) else {name: space}
        fields: Fields = {}
        for part, each in parts.items():
            shape: Any = get_obs_shape(each)
            fields[part] = shape, self._maybe_cast_dtype(each.dtype)
        return fields

    def _step_fields(self) -> Fields:
        """What is read at the row of a step."""
        return {**self._observation_fields("observations"), "actions": ((self.action_dim,), np.float32)}

    def _note_fields(self) -> Fields:
        """What is read at all rows of a window."""
        return {"rewards": ((), np.float32), "next_row": ((), np.int32), "dones": ((), bool), "timeouts": ((), bool)}

    def part_fields(self) -> tuple[Fields, Fields, Fields]:
        """
        :return: Fields of the three parts of a row: step, next observation, notes
        """
        return self._step_fields(), self._observation_fields("next_observations"), self._note_fields()

    def allocate(self) -> None:
        """
        Claim the memory, where that has not been done. The system grants most of it only when rows are written.

        :raises ValueError: If there is not that much
        """
        if self._allocated:
            return
        try:
            self._allocate()
        except (MemoryError, th.OutOfMemoryError) as error:
            raise ValueError(f"buffer_size={self.buffer_size}: there is not so much memory ({error})") from error

    def _allocate(self) -> None:
        steps, nexts, notes = self.part_fields()
        self._steps = make_rows(self.buffer_size, steps, self.storage_device)
        self._nexts = make_rows(self.buffer_size, nexts, self.storage_device)
        self._notes = HostRows(self.buffer_size, notes)
        self.observations = self._as_observation(self._steps, "observations")
        self.next_observations = self._as_observation(self._nexts, "next_observations")
        self.actions = self._steps["actions"]
        self.rewards, self.next_row = self._notes["rewards"], self._notes["next_row"]
        self.dones, self.timeouts = self._notes["dones"], self._notes["timeouts"]
        self._all_position = np.zeros(self.buffer_size, dtype=np.int32)
        self._all = RowSet(self._all_position)
        self._allocated = True

    def _as_observation(self, fields: Any, name: str) -> Any:
        """One array or tensor, or a dict of them."""
        if isinstance(self.observation_space, spaces.Dict):
            return {key: fields[f"{name}/{key}"] for key in self.observation_space.spaces}
        return fields[name]

    @property
    def storage_bytes(self) -> int:
        """Size of the storage."""
        return sum(part.nbytes for part in (self._steps, self._nexts, self._notes, *self._position_arrays()))

    def _position_arrays(self) -> list[np.ndarray]:
        return [self._all_position]

    def _stored(self) -> tuple[Any, ...]:
        return self._steps, self._nexts, self._notes

    def __getstate__(self) -> dict[str, Any]:
        """Only used rows are pickled."""
        state = self.__dict__.copy()
        if self._allocated:
            own = [*self._stored(), *self._position_arrays()]
            views = {*(id(value) for value in own), *(id(getattr(self, name)) for name in self._view_names())}
            state = {name: value for name, value in state.items() if id(value) not in views}
            state["saved_rows"] = [part.dump(self.pos) for part in self._stored()]
            state["saved_fields"] = [HostRows(0, fields).dtype.descr for fields in self.part_fields()]
            state["saved_positions"] = [array[: self.pos] for array in self._position_arrays()]
        return state

    def _view_names(self) -> list[str]:
        return ["observations", "next_observations", "actions", "rewards", "next_row", "dones", "timeouts"]

    def __setstate__(self, state: dict[str, Any]) -> None:
        saved_rows, saved_positions = state.pop("saved_rows", None), state.pop("saved_positions", None)
        saved_fields = state.pop("saved_fields", None)
        self.__dict__.update(state)
        self.storage_device = th.device("cpu")  # another machine may have no other
        if self._allocated:
            own = [HostRows(0, fields).dtype.descr for fields in self.part_fields()]
            if saved_fields != own:
                raise ValueError(f"The replay buffer is of another version: its rows hold {saved_fields}, here {own}")
            self._restore(saved_rows, saved_positions)

    def _restore(self, saved_rows: list[np.ndarray], saved_positions: list[np.ndarray]) -> None:
        all_rows = self._all
        self._allocate()
        for part, records in zip(self._stored(), saved_rows, strict=True):
            part.restore(records)
        for array, used in zip(self._position_arrays(), saved_positions, strict=True):
            array[: self.pos] = used
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
        self.allocate()
        action = np.asarray(action, dtype=np.float32).reshape(self.n_envs, self.action_dim)
        self._check_step(obs, next_obs, action, reward)
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

        self.just_finished = []
        for env in np.flatnonzero(done):
            if self.handle_timeout_termination:
                self.timeouts[rows[env]] = bool(infos[env].get("TimeLimit.truncated", False))
            self.just_finished.append((int(env), self._finish(int(env), infos[env])))

    def _check_step(self, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray) -> None:
        for name, value in (("observation", obs), ("next observation", next_obs), ("action", action), ("reward", reward)):
            self.check_finite(name, value)

    def _write_rows(
        self, rows: np.ndarray, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray, done: np.ndarray
    ) -> None:
        self._write_observations(self._steps, "observations", rows, obs)
        self._write_observations(self._nexts, "next_observations", rows, next_obs)
        self._steps.write("actions", rows, action)
        self.rewards[rows] = reward
        self.dones[rows] = done
        self.timeouts[rows] = False
        self.next_row[rows] = -1

    @staticmethod
    def _write_observations(part: Any, name: str, rows: np.ndarray, value: Any) -> None:
        values = {f"{name}/{key}": each for key, each in value.items()} if isinstance(value, dict) else {name: value}
        for field, each in values.items():
            part.write(field, rows, np.asarray(each).reshape(len(rows), *part[field].shape[1:]))

    @staticmethod
    def check_finite(name: str, value: Any) -> None:
        """
        :param name: What the value is, for the message
        :param value: One row per environment, or a dict of such
        :raises ValueError: If a value is not finite, or its square is not in 32 bits, naming the environment
        """
        for array in value.values() if isinstance(value, dict) else [value]:
            array = np.asarray(array)
            if array.dtype.kind == "f" and not (good := np.abs(array) < LARGEST).all():
                env = int(np.flatnonzero(~good.reshape(len(array), -1).all(axis=1))[0])
                what = "too large" if np.isfinite(array[env]).all() else "not finite"
                raise ValueError(f"The {name} of environment {env} is {what}: {array[env]}. Nothing of this step was stored")

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

    def read_observations(self, rows: np.ndarray) -> tuple[Any, Any]:
        """
        :param rows: Shape [N]
        :return: Observations and next observations of the rows, not normalised: tensors [N, ...] or dicts of such
        """
        return (
            self._as_observation(self._on_device(self._steps.tensors(rows)), "observations"),
            self._as_observation(self._on_device(self._nexts.tensors(rows)), "next_observations"),
        )

    def _on_device(self, fields: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
        # Back to the main memory a copy must be waited for
        wait = self.device.type == "cpu"
        return {name: value.to(self.device, non_blocking=not wait) for name, value in fields.items()}

    def _to_device(self, array: np.ndarray) -> th.Tensor:
        """The same values on the device of the samples; not waited for."""
        return th.from_numpy(array).to(self.device, non_blocking=True)

    def normalized(self, obs: Any, env: VecNormalize | None) -> Any:
        """
        :param obs: Tensors of observations, or a dict of such
        :param env: Normalises them, in the main memory, when given
        :return: What the networks see of them
        """
        if env is None:
            return obs
        host = {key: each.cpu().numpy() for key, each in obs.items()} if isinstance(obs, dict) else obs.cpu().numpy()
        normalized: Any = self._normalize_obs(host, env)
        if isinstance(normalized, dict):
            return {key: self.to_torch(value) for key, value in normalized.items()}
        return self.to_torch(normalized)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Draw transitions uniformly, whatever their mode.

        :param batch_size: Number of transitions
        :param env: Normalises observations and rewards when given
        :return: SB3's samples
        """
        return self.read(self._all.sample(batch_size), env)

    def read(self, rows: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        :param rows: Shape [N]
        :param env: Normalises observations and rewards when given
        :return: Their transitions, as SB3's samples
        """
        steps = self._on_device(self._steps.tensors(rows))
        nexts = self._on_device(self._nexts.tensors(rows))
        dones = (self.dones[rows] & ~self.timeouts[rows]).astype(np.float32)
        samples = DictReplayBufferSamples if isinstance(self.observation_space, spaces.Dict) else ReplayBufferSamples
        return samples(  # type: ignore[return-value]
            observations=self.normalized(self._as_observation(steps, "observations"), env),
            actions=steps["actions"],
            next_observations=self.normalized(self._as_observation(nexts, "next_observations"), env),
            dones=self.to_torch(dones[:, None]),
            rewards=self.to_torch(self._normalize_reward(self.rewards[rows, None], env)),
        )
