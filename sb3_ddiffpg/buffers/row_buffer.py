"""Replay buffer whose transitions lie in rows, wherever there is room: how they are written and read."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ddiffpg.buffers.features import ModeFeatures
from sb3_ddiffpg.buffers.storage import Fields, HostRows, RowSet, make_rows, storage_place
from sb3_ddiffpg.utils.settings import FLAG

# Rows are numbered in 32 bits
MOST_ROWS = 2**31 - 1


class RowReplayBuffer(ReplayBuffer):
    """
    Rows of transitions, without an order among them.

    Storage is allocated by ``allocate`` or the first ``add``: a model that is loaded to act needs none. What the networks see
    may live on an accelerator (``storage_device``); what decides which rows are read always stays in the main memory.

    :param buffer_size: Capacity in transitions (over all environments)
    :param observation_space: Observation space
    :param action_space: Action space
    :param device: PyTorch device of the samples
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Not supported
    :param handle_timeout_termination: Whether time limits are bootstrapped through
    :param storage_device: Where observations and actions live: ``"cpu"``, or ``"auto"``: where the samples go
    :param mode_features: See ``ModeFeatures``
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
    #: Value of each note that is the same at all steps of the buffer's algorithm: it is not stored
    constant_notes: ClassVar[dict[str, Any]] = {}
    #: For the exploration bonus, which writes them: places that an episode saw first, number of the known route that it had
    #: come along by then, and whether its visits count
    first_visits: np.ndarray
    followed: np.ndarray
    counted: np.ndarray

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        storage_device: th.device | str = "cpu",
        mode_features: Any = None,
    ) -> None:
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage=True is not supported: trajectories do not lie in one ring")
        if not 1 <= buffer_size <= MOST_ROWS:
            raise ValueError(f"buffer_size must be from 1 to {MOST_ROWS}, got {buffer_size}")
        # Not ReplayBuffer's constructor: it would allocate a ring per environment
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.optimize_memory_usage = False
        FLAG.check("handle_timeout_termination", handle_timeout_termination)
        self.handle_timeout_termination = handle_timeout_termination
        self.features = ModeFeatures(observation_space, mode_features)
        self.storage_device = storage_place(storage_device, self.device)
        self._settings = {*vars(self), "_settings"}
        self.reset()

    def reset(self) -> None:
        """Forget everything and release the storage."""
        super().reset()
        for name in set(vars(self)) - self._settings:
            delattr(self, name)
        self._allocated = False

    def settings(self) -> dict[str, Any]:
        """
        :return: What the buffer was made with, by attribute
        """
        return {name: value for name, value in vars(self).items() if name in self._settings}

    def size(self) -> int:
        """
        :return: Number of stored transitions
        """
        return self.stored_rows.size if self._allocated else 0

    def move_storage(self, device: th.device) -> None:
        """
        :param device: Where observations and actions live from now on
        """
        if device == self.storage_device:
            return
        self.storage_device = device
        if self._allocated:
            for part in ("steps", "nexts"):
                old = getattr(self, part)
                moved = make_rows(self.buffer_size, old.fields, device)
                moved.restore(old.dump(self.pos))
                setattr(self, part, moved)
            self._make_views()

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

    def note_fields(self) -> Fields:
        """
        :return: What is read at all rows of a window, also what ``constant_notes`` says
        """
        own: Fields = {"rewards": ((), np.float32), "next_row": ((), np.int32), "dones": ((), bool), "timeouts": ((), bool)}
        return {**own, "followed": ((), np.int32), "first_visits": ((), bool), "counted": ((), bool)}

    def part_fields(self) -> tuple[Fields, Fields, Fields]:
        """
        :return: Fields of the three parts of a row that are stored: step, next observation, notes
        """
        notes = {name: each for name, each in self.note_fields().items() if name not in self.constant_notes}
        return self._step_fields(), self._observation_fields("next_observations"), notes

    def read_notes(self, rows: np.ndarray) -> Any:
        """
        :param rows: Any shape
        :return: Their notes by name, each of the same shape: copies, but for ``constant_notes``
        """
        records = self.notes.take(rows)
        if not self.constant_notes:
            return records
        return {name: records[name] for name in self.notes.fields} | self._constant_notes(rows.shape)

    def _constant_notes(self, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
        """Of each one value that is read as an array of a shape; writing raises ValueError."""
        fields = self.note_fields()
        return {name: np.broadcast_to(fields[name][1](value), shape) for name, value in self.constant_notes.items()}

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
        self.steps = make_rows(self.buffer_size, steps, self.storage_device)
        self.nexts = make_rows(self.buffer_size, nexts, self.storage_device)
        self.notes = HostRows(self.buffer_size, notes)
        self.stored_rows = RowSet(np.zeros(self.buffer_size, dtype=np.int32))
        self._make_views()
        self._allocated = True

    def _make_views(self) -> None:
        self.observations = self._as_observation(self.steps, "observations")
        self.next_observations = self._as_observation(self.nexts, "next_observations")
        self.actions = self.steps["actions"]
        for name in self.notes.fields:
            setattr(self, name, self.notes[name])
        for name, constant in self._constant_notes((self.buffer_size,)).items():
            setattr(self, name, constant)

    def _as_observation(self, fields: Any, name: str) -> Any:
        """One array or tensor, or a dict of them."""
        if isinstance(self.observation_space, spaces.Dict):
            return {key: fields[f"{name}/{key}"] for key in self.observation_space.spaces}
        return fields[name]

    @property
    def storage_bytes(self) -> int:
        """Size of the storage."""
        return sum(part.nbytes for part in (*self.parts, self.stored_rows.position))

    @property
    def parts(self) -> tuple[Any, ...]:
        """What is stored of all rows: step, next observation, notes."""
        return self.steps, self.nexts, self.notes

    def _write_rows(
        self, rows: np.ndarray, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray, done: np.ndarray
    ) -> None:
        self._write_observations(self.steps, "observations", rows, obs)
        self._write_observations(self.nexts, "next_observations", rows, next_obs)
        self.steps.write("actions", rows, action)
        self.rewards[rows] = reward
        self.dones[rows] = done
        self.timeouts[rows] = False
        self.next_row[rows] = -1

    @staticmethod
    def _write_observations(part: Any, name: str, rows: np.ndarray, value: Any) -> None:
        values = {f"{name}/{key}": each for key, each in value.items()} if isinstance(value, dict) else {name: value}
        for field, each in values.items():
            part.write(field, rows, np.asarray(each).reshape(len(rows), *part[field].shape[1:]))

    def positions(self, part: Any, name: str, rows: np.ndarray) -> np.ndarray:
        """
        :param part: ``steps`` or ``nexts``
        :param name: ``"observations"`` or ``"next_observations"``
        :param rows: Shape [N]
        :return: Mode features there, shape [N, dim]
        """
        return self.features.of_tensors(self._as_observation(part.tensors(rows), name)).cpu().numpy()

    def read_observations(self, rows: np.ndarray) -> tuple[Any, Any]:
        """
        :param rows: Shape [N]
        :return: Observations and next observations of the rows, not normalised: tensors [N, ...] or dicts of such
        """
        return (
            self._as_observation(self._on_device(self.steps.tensors(rows)), "observations"),
            self._as_observation(self._on_device(self.nexts.tensors(rows)), "next_observations"),
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

    def read(self, rows: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        :param rows: Shape [N]
        :param env: Normalises observations and rewards when given
        :return: Their transitions, as SB3's samples
        """
        steps = self._on_device(self.steps.tensors(rows))
        nexts = self._on_device(self.nexts.tensors(rows))
        dones = (self.dones[rows] & ~self.timeouts[rows]).astype(np.float32)
        samples = DictReplayBufferSamples if isinstance(self.observation_space, spaces.Dict) else ReplayBufferSamples
        return samples(  # type: ignore[return-value]
            observations=self.normalized(self._as_observation(steps, "observations"), env),
            actions=steps["actions"],
            next_observations=self.normalized(self._as_observation(nexts, "next_observations"), env),
            dones=self.to_torch(dones[:, None]),
            rewards=self.to_torch(self._normalize_reward(self.rewards[rows, None], env)),
        )

    def training_rewards(self, rows: np.ndarray, env: VecNormalize | None = None) -> np.ndarray:
        """
        :param rows: Shape [N]
        :param env: Normalises rewards when given
        :return: What they train with, shape [N]
        """
        return self._normalize_reward(self.rewards[rows], env)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Draw transitions uniformly, whatever their mode.

        :param batch_size: Number of transitions
        :param env: Normalises observations and rewards when given
        :return: SB3's samples
        """
        return self.read(self.stored_rows.sample(batch_size), env)
