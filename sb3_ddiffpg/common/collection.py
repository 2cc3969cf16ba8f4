"""How experience is collected: actions, transitions, and what begins and ends with a rollout."""

import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import MaybeCallback, RolloutReturn

from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.returns import discounted_returns
from sb3_ddiffpg.buffers.trajectory import StepRecord
from sb3_ddiffpg.common.scales import review_scales
from sb3_ddiffpg.envs.snapshots import SoundNormalization
from sb3_ddiffpg.exploration.bonus import ExplorationBonus
from sb3_ddiffpg.exploration.visit_map import VisitMap
from sb3_ddiffpg.networks.cuda_graphs import GraphedFunction
from sb3_ddiffpg.networks.settings import CriticSettings
from sb3_ddiffpg.networks.value_range import ValueRange
from sb3_ddiffpg.saving.algorithm import SavableAlgorithm
from sb3_ddiffpg.utils.divergence import check_finite
from sb3_ddiffpg.utils.settings import at_least

SelfCollecting = TypeVar("SelfCollecting", bound="CollectingAlgorithm")


class Recorder:
    """
    Takes the place of a replay buffer where SB3 stores a transition, and keeps what the buffer says of it.

    :param buffer: Where it is stored
    """

    record: StepRecord

    def __init__(self, buffer: ModeReplayBuffer) -> None:
        self.buffer = buffer

    def add(self, *args: Any) -> None:
        """
        :param args: Of the buffer's ``add``
        """
        self.record = self.buffer.add(*args)


class CollectingAlgorithm(SavableAlgorithm):
    """
    Steps environments: SB3's loop, in which each step's record goes on to the exploration bonus, and nothing that is not
    finite is stored.
    """

    replay_buffer: ModeReplayBuffer
    bonus: ExplorationBonus
    critic_settings: CriticSettings
    reward_scale: float
    graphs: dict[str, Callable[..., Any]]
    sound_normalization: SoundNormalization
    value_range: ValueRange
    next_review: int
    _warned_support: bool

    @property
    def visits(self) -> VisitMap | None:
        """Where the run has been; None where there are more than three mode features, and before learning has begun."""
        return self.bonus.visit_map

    def learn(
        self: SelfCollecting,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 100,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        horizon: int | None = None,
    ) -> SelfCollecting:
        """
        Train the model. See SB3's ``learn``; ``log_interval`` counts episodes of all environments, and TensorBoard's logs are
        called as the algorithm when no name is given. The first call after ``resume`` is given what the interrupted one was
        given, and does what was left of it.

        :param horizon: Steps of the whole run, of which this call is a piece: schedules follow the run then. It is remembered
        """
        if horizon is not None:
            at_least(1).check("horizon", horizon)
            self.horizon = int(horizon)
        # Denormal numbers in Adam's moments slow a small update down by half
        th.set_flush_denormal(True)
        try:
            name = tb_log_name or type(self).__name__
            return super().learn(total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar)
        finally:
            th.set_flush_denormal(False)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        assert self.env is not None, "You must set the environment before calling learn()"
        self.replay_buffer.claim(self.env)
        self.sound_normalization.note(self._vec_normalize_env)  # the environments may be reset now
        if self._vec_normalize_env is not None and self._vec_normalize_env.norm_reward:
            warnings.warn(
                "VecNormalize scales the rewards (norm_reward=True), and so the values, differently in the course of the run; "
                "norm_reward=False leaves them in reward units, and DDiffPG's critics follow these"
            )
        for graph in self.graphs.values():
            if isinstance(graph, GraphedFunction):
                graph.clear()  # settings may have changed since
        new_episodes = reset_num_timesteps or self._last_obs is None
        if new_episodes:
            self.replay_buffer.drop_unfinished_episodes()
            self.bonus.forget_episodes()
        steps = self.num_timesteps
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if self.num_timesteps < steps:  # counted anew
            self._steps_before += steps
        # What an earlier run left behind would end the exploration of this one's first episodes
        self._update_current_progress_remaining(self.num_timesteps, max(total_timesteps, 1))
        if new_episodes:
            self._begin_episodes()
        if self.interrupted is not None:
            self.interrupted.go_on(self, callback)
        return total_timesteps, callback

    def _begin_episodes(self) -> None:
        """All environments have been reset."""

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """
        See SB3. A callback that stops the training makes SB3 drop the last transition (its issue 2056), and so does an error
        or an interrupt: the next ``learn`` then resets the environments, or the running trajectories would have a gap.
        """
        self.interrupted = None  # callbacks may have refused to begin before
        complete = False
        try:
            rollout = super().collect_rollouts(*args, **kwargs)
            complete = rollout.continue_training
        except ValueError:
            # VecNormalize has taken in what was refused
            self.sound_normalization.restore(self._vec_normalize_env)
            raise
        finally:
            if not complete:
                self._last_obs = None
        self.sound_normalization.note(self._vec_normalize_env)
        return rollout

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        assert self._last_obs is not None, "self._last_obs was not set"
        # Before the environments are given an action that follows from NaN
        if self._vec_normalize_env is not None:  # the normalised ones are all NaN if one is
            check_finite("observation", self._last_original_obs)
        check_finite("observation", self._last_obs)
        shape = (n_envs, *self.action_space.shape)  # type: ignore[misc]
        if self.num_timesteps < learning_starts:
            scaled_action = np.random.uniform(-1.0, 1.0, size=shape).astype(np.float32)
        else:
            if not self.next_review and self.replay_buffer.size():  # before anything acts on raw numbers
                review_scales(self)
            scaled_action = self.policy.scale_action(self._training_actions())
            if action_noise is not None:
                scaled_action = np.clip(scaled_action + action_noise().reshape(shape), -1.0, 1.0)
            check_finite("policy's action (has training diverged?)", scaled_action)
        return self.policy.unscale_action(scaled_action), scaled_action

    def _training_actions(self) -> np.ndarray:
        """The policy's actions at the latest observations, before exploration noise."""
        return self.policy.predict(self._last_obs)[0]  # type: ignore[arg-type]

    def _store_transition(self, replay_buffer: ModeReplayBuffer, *args: Any, **kwargs: Any) -> None:  # type: ignore[override]
        if self._vec_normalize_env is not None:
            # By its statistics one broken environment breaks what the others' episodes ended with
            check_finite("next observation", self._vec_normalize_env.get_original_obs())
        recorder: Any = Recorder(replay_buffer)
        super()._store_transition(recorder, *args, **kwargs)
        # From environments to the record, from the record to the bonus
        self.bonus.observe(recorder.record, replay_buffer)
        self._on_episodes_end(recorder.record)

    def _on_episodes_end(self, record: StepRecord) -> None:
        """
        :param record: Of a step, with the episodes that it has ended, perhaps none, and parts of those that go on
        """
        for _, trajectory in (*record.parts, *record.finished):
            buffer, last = self.replay_buffer, trajectory.rows[-1]
            rewards = self.reward_scale * buffer.training_rewards(trajectory.rows, self._vec_normalize_env)
            goes_on = bool(buffer.timeouts[last] or not buffer.dones[last])
            at_goal = bool(buffer.goals[last]) and buffer.goals_are_told
            then = "ends" if not goes_on else "stays" if at_goal else "goes on"
            returns = discounted_returns(rewards, self.gamma, then)
            self.value_range.observe(returns)
            if self.value_range.adapts or self._warned_support:
                continue
            low, high = self.critic_settings.support
            if returns.max() > high + 1e-6 or returns.min() < low - 1e-6:
                self._warned_support = True
                # Once: values that the critics cannot represent make all actions look alike
                warnings.warn(
                    f"A discounted return between {returns.min():.4g} and {returns.max():.4g} leaves the critics' support "
                    f"[v_min={low}, v_max={high}] and is clipped: adapt critic.v_min, critic.v_max or reward_scale"
                )
