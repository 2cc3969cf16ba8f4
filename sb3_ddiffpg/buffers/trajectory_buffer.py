"""Replay buffer that keeps whole trajectories: steps, running and finished episodes, and where they went."""

import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.buffers.features import Observation
from sb3_ddiffpg.buffers.groups import TrajectoryGroups
from sb3_ddiffpg.buffers.row_buffer import RowReplayBuffer
from sb3_ddiffpg.buffers.running import RunningEpisodes
from sb3_ddiffpg.buffers.storage import FreeRows
from sb3_ddiffpg.buffers.success import SuccessRule
from sb3_ddiffpg.buffers.trajectory import PAST_GOAL, StepRecord, Trajectory
from sb3_ddiffpg.utils.divergence import check_finite
from sb3_ddiffpg.utils.vec_envs import env_attribute, labels_routes

# Steps of a stored part of an episode, at most: beyond the episodes of any common task
LONGEST_PART = 10_000


class TrajectoryReplayBuffer(RowReplayBuffer):
    """
    A ``RowReplayBuffer`` in which a finished trajectory owns its rows. When rows run out, ``TrajectoryGroups`` says which
    trajectory is evicted.

    :param args: Of ``RowReplayBuffer``
    :param success_key: Key of ``info`` that marks a success, at any step of an episode; None reads ``is_success`` or
        ``success`` and, until one is met, counts the trajectories whose return is in the top fifth of those seen lately
    :param kwargs: Of ``RowReplayBuffer``
    :raises ValueError: If an argument is out of its range or ``optimize_memory_usage`` is asked for
    """

    #: What positions are divided by where paths are compared, [dim]; None until they are
    feature_scale: np.ndarray | None
    #: Once for each filling of the buffer
    _warned_parts: bool = False

    def __init__(self, *args: Any, success_key: str | None = None, **kwargs: Any) -> None:
        self.success_key = success_key
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        """Forget everything and release the storage."""
        super().reset()
        self.free_rows = FreeRows()
        #: Steps after which a running episode is stored as a part; None: however long it is, while there is room
        self.part_length: int | None = None
        self._parts: list[tuple[int, Trajectory]] = []
        self.running = RunningEpisodes(self.n_envs)
        self.groups = TrajectoryGroups()
        self.n_finished = 0
        self.success_rule = SuccessRule(self.success_key, self.n_envs)

    def claim(self, env: VecEnv) -> None:
        """
        Claim the memory before training begins. The episodes in progress must fit: those of environments that declare no
        time limit are stored in parts, if they are long.

        :param env: The environments
        :raises ValueError: If the buffer is too small for them, was made for another number, or there is not that much memory
        """
        if self.n_envs != env.num_envs:
            raise ValueError(f"The replay buffer was made for {self.n_envs} environment(s), got {env.num_envs}")
        self.success_rule.labelled = labels_routes(env)
        limit = getattr(env_attribute(env, "spec"), "max_episode_steps", None)
        if limit is not None and self.buffer_size < limit * self.n_envs:
            raise ValueError(
                f"buffer_size={self.buffer_size} is smaller than one episode of every environment: "
                f"{self.n_envs} x {limit} steps"
            )
        self.part_length = self._longest_part() if limit is None else None
        self.allocate()

    def _longest_part(self) -> int:
        """So that running episodes fill half of the buffer at most."""
        return max(1, min(self.buffer_size // (2 * self.n_envs), LONGEST_PART))

    def _take_rows(self, n: int) -> np.ndarray:
        """Rows for n transitions: unused ones first, then freed ones, then those of an evicted trajectory."""
        unused = min(n, self.buffer_size - self.pos)
        rows = np.arange(self.pos, self.pos + unused, dtype=np.int32)
        self.pos += unused
        if unused < n:
            self.full = True
            while self.free_rows.size < n - unused:
                self._evict()
            rows = np.concatenate((rows, self.free_rows.take(n - unused)))
        return rows

    def _evict(self) -> Trajectory:
        trajectory = self.groups.pop_oldest()
        if trajectory is None and self.running.lengths.any():
            self.part_length = self._longest_part()  # whatever the environments have declared
            self._cut(int(self.running.lengths.argmax()))
            trajectory = self.groups.pop_oldest()
        if trajectory is None:
            raise ValueError(
                f"buffer_size={self.buffer_size} transitions is too small: the last successes of the modes and one step of "
                f"{self.n_envs} environment(s) fill it"
            )
        self._parts = [part for part in self._parts if part[1] is not trajectory]
        self._release(trajectory.rows)
        return trajectory

    def _release(self, rows: np.ndarray) -> None:
        self.stored_rows.remove(rows)
        self.free_rows.add(rows)

    def add(  # type: ignore[override]
        self,
        obs: Observation,
        next_obs: Observation,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> StepRecord:
        """
        Store one transition of every environment.

        :param obs: Observations, [n_envs, ...] (or a dict of such)
        :param next_obs: Next observations, the terminal one where an episode ended
        :param action: Actions in [-1, 1], [n_envs, action_dim]
        :param reward: [n_envs]
        :param done: [n_envs]
        :param infos: One dict per environment
        :return: What was stored where, and which trajectories ended
        :raises ValueError: If a value is not finite (nothing is stored then), or the buffer cannot hold one episode
        """
        self.allocate()
        said = self.success_rule.read(infos)
        action = np.asarray(action, dtype=np.float32).reshape(self.n_envs, self.action_dim)
        positions = self._check_step(obs, next_obs, action, reward)
        self._parts = []
        rows = self._take_rows(self.n_envs)
        self._write_rows(rows, obs, next_obs, action, reward, done)
        self.stored_rows.add(rows)
        goes_on, before = self.running.latest()
        self.next_row[before] = rows[goes_on]
        started = np.flatnonzero(self.success_rule.steps == 0)
        self.running.extend(rows, reward)
        had_goal = self.success_rule.has_goal
        self.success_rule.observe(infos, said)
        if self.success_rule.has_goal and not had_goal:
            self._take_back_successes()

        finished: list[tuple[int, Trajectory]] = []
        for env in np.flatnonzero(done):
            if self.handle_timeout_termination:
                self.timeouts[rows[env]] = bool(infos[env].get("TimeLimit.truncated", False))
            finished.append((int(env), self._finish(int(env), infos[env])))
        if self.part_length is not None:
            for env in np.flatnonzero(self.running.lengths >= self.part_length):
                self._cut(int(env))
        return StepRecord(
            rows=rows,
            positions=positions,
            scale=self.feature_scale,
            started=started,
            start_positions=self._start_positions(obs, started),
            finished=finished,
            parts=self._parts,
        )

    def _start_positions(self, obs: Observation, envs: np.ndarray) -> np.ndarray:
        if not len(envs):
            return np.empty((0, self.features.dim), dtype=np.float32)
        return self.features({key: each[envs] for key, each in obs.items()} if isinstance(obs, dict) else obs[envs])

    def _check_step(self, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray) -> np.ndarray:
        """The positions that were reached, [n_envs, dim]."""
        for name, value in (("observation", obs), ("next observation", next_obs), ("action", action), ("reward", reward)):
            check_finite(name, value)
        positions = self.features(next_obs)
        check_finite("mode features", positions)
        return positions

    def _finish(self, env: int, info: dict[str, Any]) -> Trajectory:
        """Store an episode that is over."""
        self.success_rule.check_key(info)
        trajectory = self._store(env, info)
        self.success_rule.end(env)
        return trajectory

    def _cut(self, env: int) -> None:
        """Store what an episode has done so far. It goes on: for the part's last step, as if it met a time limit."""
        if not self._warned_parts:
            self._warned_parts = True
            warnings.warn(
                f"An episode goes on after {self.running.lengths[env]} steps. Environments without a time limit are stored in "
                f"parts, of at most {self._longest_part()} steps with this buffer_size={self.buffer_size}, as if a time limit "
                "ended each: a goal must be reached within one. gymnasium.wrappers.TimeLimit gives them one"
            )
        self._parts.append((env, self._store(env, {})))

    def _store(self, env: int, info: dict[str, Any]) -> Trajectory:
        """Make a trajectory of a running episode up to its goal, and another one of what it did after that."""
        told = self.success_rule.so_far(env, info)
        before = int(self.success_rule.steps[env])  # in parts that are stored already
        rows, episode_return = self.running.end(env)
        before -= len(rows)
        reached = bool(told.success) and told.length > before
        to_goal = told.length - before if reached else 0 if told.success else len(rows)
        whole = self._stored(rows[:to_goal], episode_return, told.label) if to_goal else None
        if whole is not None:
            whole.success = reached or self._stands_in(episode_return)
            self._insert(whole)
        past = rows[to_goal:]
        if not len(past):
            return whole  # type: ignore[return-value]
        if whole is not None:
            # Windows end at the goal: what follows may leave the buffer before it
            self.next_row[whole.rows[-1]] = -1
        rest = self._stored(past, float(self.rewards[past].sum(dtype=np.float64)), None)
        rest.mode = PAST_GOAL
        self._insert(rest)
        return rest if whole is None else whole

    def _stands_in(self, episode_return: float) -> bool:
        """Whether an episode of this return counts as a success, of which nobody has told one yet."""
        return self.success_rule.among_best(episode_return)

    def _stored(self, rows: np.ndarray, episode_return: float, label: str | None) -> Trajectory:
        self.n_finished += 1
        return Trajectory(rows, success=False, episode_return=episode_return, serial=self.n_finished - 1, label=label)

    def _insert(self, trajectory: Trajectory) -> None:
        self.groups.insert(trajectory)

    def _take_back_successes(self) -> None:
        """
        Judge again what is stored. Until an environment told of a goal for the first time, the best returns stood in for
        successes; of those episodes none has reached a goal, or it would have been said.
        """
        self.groups.judge_again(lambda trajectory: False)

    def judge_by_returns(self) -> None:
        """
        While nobody has told a success: take those for it whose returns are the best by now. What was among the best
        at its time may be none any more, and the first were judged beside nothing.
        """
        least = self.success_rule.best_from()
        if least is not None:
            self.groups.judge_again(lambda trajectory: trajectory.episode_return >= least)

    def finished_trajectories(self) -> list[Trajectory]:
        """
        :return: All that are stored: in use, retired, and what episodes did after their goals
        """
        used = *self.trajectories(success=True), *self.trajectories(success=False)
        return [*used, *self.groups.retired, *self.groups.past_goals()]

    def drop_unfinished_episodes(self) -> None:
        """Forget the transitions of running episodes: call it when the environments were reset outside."""
        for env in range(self.n_envs):
            self.success_rule.end(env)
            if self.running.lengths[env]:
                self._release(self.running.end(env)[0])

    @property
    def has_success_signal(self) -> bool:
        """Whether the environment itself says what a success is, if only that there was none."""
        return self.success_rule.has_signal

    @property
    def goals_are_told(self) -> bool:
        """Whether the environment has told of a goal; before that the best returns stand in for it."""
        return self.success_rule.has_goal

    def trajectories(self, success: bool) -> list[Trajectory]:
        """
        :param success: Goal-reached or failed ones (and those foreign to their mode)
        :return: Those in use by a mode or not yet clustered, in order of finishing
        """
        return self.groups.of(success)
