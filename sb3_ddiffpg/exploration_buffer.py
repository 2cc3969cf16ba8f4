"""Replay buffer that notes what explorers are paid for: places that an episode sees first, and what lies past known ways."""

from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_ddiffpg.features import ModeFeatures
from sb3_ddiffpg.intrinsic import cell_entries
from sb3_ddiffpg.known_ways import NO_WAY, KnownWays, Way, come_along
from sb3_ddiffpg.row_storage import Fields
from sb3_ddiffpg.trajectories import Trajectory
from sb3_ddiffpg.trajectory_buffer import TrajectoryReplayBuffer


def positive_length(name: str, length: Any) -> float | None:
    """
    :param name: Of the argument
    :param length: Its value
    :return: As a float
    :raises ValueError: If it is neither None nor positive and finite
    """
    if length is None:
        return None
    if not isinstance(length, Real) or isinstance(length, bool) or not 0 < float(length) < np.inf:
        raise ValueError(f"{name} must be a positive and finite number, or None, got {length!r}")
    return float(length)


class ExplorationReplayBuffer(TrajectoryReplayBuffer):
    """
    A ``TrajectoryReplayBuffer`` that knows where its observations are.

    :param buffer_size: Capacity in transitions (over all environments)
    :param observation_space: Observation space
    :param action_space: Action space
    :param device: PyTorch device of the samples
    :param mode_features: See ``ModeFeatures``
    :param visit_cell_size: Edge of the cells of mode features by which places and ``first_visits`` are told; None: not at all
    :param kwargs: See ``TrajectoryReplayBuffer``
    :raises ValueError: If an argument is out of its range
    """

    first_visits: np.ndarray
    followed: np.ndarray
    counted: np.ndarray

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        device: th.device | str = "auto",
        mode_features: Any = None,
        visit_cell_size: float | None = None,
        **kwargs: Any,
    ) -> None:
        self.features = ModeFeatures(observation_space, mode_features)
        self.visit_cell_size = positive_length("visit_cell_size", visit_cell_size)
        super().__init__(buffer_size, observation_space, action_space, device, **kwargs)

    # ------------------------------------------------------------------ storage

    def reset(self) -> None:
        """Forget everything and release the storage."""
        super().reset()
        self._feature_scale: np.ndarray | None = None
        self._last_positions = np.empty((0, self.features.dim), dtype=np.float32)
        self._episode_places: list[set[int]] = [set() for _ in range(self.n_envs)]
        self._forget_ways()

    def _note_fields(self) -> Fields:
        return {**super()._note_fields(), "followed": ((), np.int32), "first_visits": ((), bool), "counted": ((), bool)}

    def _view_names(self) -> list[str]:
        return [*super()._view_names(), "first_visits", "followed", "counted"]

    def _allocate(self) -> None:
        super()._allocate()
        self.first_visits, self.followed = self._notes["first_visits"], self._notes["followed"]
        self.counted = self._notes["counted"]

    def _check_step(self, obs: Any, next_obs: Any, *args: Any) -> None:
        super()._check_step(obs, next_obs, *args)
        positions = self.features(next_obs)
        self.check_finite("mode features", positions)
        self._last_positions = positions

    def _write_rows(self, rows: np.ndarray, obs: Any, next_obs: Any, action: np.ndarray, *args: Any) -> None:
        super()._write_rows(rows, obs, next_obs, action, *args)
        if self.known_ways.ways:
            self.known_ways.observe(np.arange(self.n_envs), self._last_positions / self._measured_scale())
        self._last_followed = self.followed[rows] = self.known_ways.followed.copy()
        self.counted[rows] = self._last_followed == NO_WAY
        if self.visit_cell_size is None:
            self.first_visits[rows] = True
            return
        places = self._places(self._last_positions)
        self.first_visits[rows] = [place not in seen for place, seen in zip(places, self._episode_places, strict=True)]
        for place, seen in zip(places, self._episode_places, strict=True):
            seen.add(place)

    def _places(self, positions: np.ndarray) -> list[int]:
        """The cell of each position, as a number."""
        return cell_entries(th.from_numpy(positions), self.visit_cell_size or 1.0, 2**31).tolist()

    def _finish(self, env: int, info: dict[str, Any]) -> Trajectory:
        self._episode_places[env].clear()
        self.known_ways.forget(env)
        return super()._finish(env, info)

    def drop_unfinished_episodes(self) -> None:
        """Forget the transitions of running episodes: call it when the environments were reset outside."""
        super().drop_unfinished_episodes()
        for env, seen in enumerate(self._episode_places):
            seen.clear()
            self.known_ways.forget(env)

    def recall_places(self) -> None:
        """After loading: where the running episodes have been."""
        for env, (seen, length) in enumerate(zip(self._episode_places, self._running_length, strict=True)):
            seen.clear()
            if length and self.visit_cell_size is not None:
                rows = self._running[env, :length]
                seen.update(self._places(self._positions(self._nexts, "next_observations", rows)))
        self._recall_ways()

    # ------------------------------------------------------------------ positions

    def _positions(self, part: Any, name: str, rows: np.ndarray) -> np.ndarray:
        """Mode features at the rows, shape [N, dim]."""
        return self.features.of_tensors(self._as_observation(part.tensors(rows), name)).cpu().numpy()

    def _measured_scale(self) -> np.ndarray:
        if self._feature_scale is None:
            self._feature_scale = self._measure_scale()
        return self._feature_scale

    def _measure_scale(self) -> np.ndarray:
        """Declared positions keep their unit; a whole observation is standardised once, or cached distances would age."""
        if not self.features.whole_observation:
            return np.ones(self.features.dim, dtype=np.float32)
        rows = self._all.rows[: min(self._all.size, 50_000)]
        deviation = self._positions(self._steps, "observations", rows).std(axis=0)
        return np.where(deviation > 1e-6, deviation, 1.0).astype(np.float32)

    def last_positions(self) -> np.ndarray:
        """
        :return: Mode features of the states reached by the latest ``add``, shape [n_envs, dim]
        """
        return self._last_positions

    def counted_positions(self) -> np.ndarray:
        """
        :return: Those of ``last_positions`` whose visits count: not of an episode that came along a known way
        """
        return self._last_positions[self._last_followed == NO_WAY]

    # ------------------------------------------------------------------ known ways

    def past_known_ways(self, rows: np.ndarray) -> np.ndarray:
        """
        :param rows: Any shape
        :return: Which of them are of an episode that had come along a way that is known still, same shape
        """
        return self.known_ways.include(self.followed[rows])

    def _forget_ways(self) -> None:
        self.known_ways = KnownWays(self.n_envs)
        self._last_followed = self.known_ways.followed.copy()

    def _watch(self, ways: Sequence[Way], finished: Sequence[np.ndarray] = ()) -> np.ndarray:
        """
        Note from now on which steps are of episodes that have come along a way: ``followed``.

        :param ways: All that are known from now on
        :param finished: Rows of each finished episode that may have come along one of them unnoticed, as running ones may
        :return: Rows of these steps, where their visits were counted
        """
        unknown = [way for way in ways if way.number not in self.known_ways.numbers()]
        self.known_ways.replace(ways)
        noted = np.empty(0, dtype=np.int32)
        if unknown:
            running = [self._running[env, :length] for env, length in enumerate(self._running_length) if length]
            noted = np.concatenate([noted, *(self._note_followed(unknown, rows) for rows in (*finished, *running))])
        self._recall_ways()
        return noted

    def _note_followed(self, ways: Sequence[Way], rows: np.ndarray) -> np.ndarray:
        """Of one episode; the rows whose visits were counted, which from now on they are not."""
        followed = come_along(ways, self._reached(rows))
        came = (followed != NO_WAY) & ~self.past_known_ways(rows)
        self.followed[rows[came]] = followed[came]
        were_counted = rows[came & self.counted[rows]]
        self.counted[were_counted] = False
        return were_counted

    def _recall_ways(self) -> None:
        envs = np.repeat(np.arange(self.n_envs), self._running_length)
        if self.known_ways.ways and len(envs):
            rows = np.concatenate([self._running[env, :length] for env, length in enumerate(self._running_length)])
            self.known_ways.observe(envs, self._reached(rows))

    def _reached(self, rows: np.ndarray) -> np.ndarray:
        """Positions that ways are told by, [N, dim]."""
        return self._positions(self._nexts, "next_observations", rows) / self._measured_scale()
