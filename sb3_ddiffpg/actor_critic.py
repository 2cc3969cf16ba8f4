"""What all actor-critic algorithms of this package share: distributional twin critics, novelty, and the loop around them."""

import uuid
import warnings
from collections import defaultdict
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from scipy.signal import lfilter
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, Schedule
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.buffers import ModeBatch, ModeReplayBuffer
from sb3_ddiffpg.critics import ModeCritics
from sb3_ddiffpg.cuda_graphs import GraphedFunction
from sb3_ddiffpg.divergence import EXPLODED, DivergenceWatch
from sb3_ddiffpg.envs.snapshots import normalization, restore_normalization
from sb3_ddiffpg.features import declared_cell_size, declared_mode_features, describe_env
from sb3_ddiffpg.intrinsic import NOVELTY_MEASURES, RunningMoments, VisitCounts, noveld_reward
from sb3_ddiffpg.noise import SpreadNormalActionNoise
from sb3_ddiffpg.persistence import SavableAlgorithm
from sb3_ddiffpg.policy_parts import average_networks
from sb3_ddiffpg.trajectories import Trajectory
from sb3_ddiffpg.twin_critic_policy import TwinCriticPolicy
from sb3_ddiffpg.validation import check_arguments
from sb3_ddiffpg.visits import VisitMap

SelfActorCritic = TypeVar("SelfActorCritic", bound="NoveltyActorCritic")

# Metric: share of the first group's targets at the upper end of the support; and how much of it is a fault
CUT_VALUES, MOST_CUT_VALUES = "values_at_limit", 0.02


class NoveltyActorCritic(SavableAlgorithm):
    """
    Off-policy actor-critic with distributional twin critics, whose reward is the environment's and NovelD's
    (Zhang et al., 2021). A subclass says in ``_update_actor`` how its actor learns.

    :param policy: See the subclass
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: Learning rate of the actor, a float or a function of the remaining progress (from 1 to 0)
    :param buffer_size: Capacity of the replay buffer in transitions, over all environments
    :param learning_starts: Steps of random actions before learning starts
    :param batch_size: Transitions per update
    :param tau: Soft update coefficient of the target critics
    :param gamma: Discount factor
    :param train_freq: Update the model every ``train_freq`` steps (of all environments), or a tuple with the unit
    :param gradient_steps: Updates after each rollout; -1: as many as transitions were collected
    :param action_noise: Exploration noise; None: Gaussian, its standard deviation drawn per episode from [.05, .6]
    :param replay_buffer_class: ``ModeReplayBuffer`` or a subclass of it
    :param replay_buffer_kwargs: Further keyword arguments of the replay buffer
    :param optimize_memory_usage: Not supported
    :param n_steps: Length of the multi-step returns (uncorrected)
    :param qf_learning_rate: Learning rate of the critics, like ``learning_rate``; the same as it when None
    :param n_critics: Critics, the minimum over them is used
    :param n_atoms: Atoms of the critics' value distribution (C51); 1 for scalar critics
    :param twin_target: See ``ModeCritics``
    :param v_min: Lower end of the values' support
    :param v_max: Upper end of the support
    :param reward_scale: Factor on the environment's reward
    :param target_policy_noise: Standard deviation of the noise on the actions in the Bellman target
    :param target_noise_clip: Limit of that noise
    :param mode_features: See ``DDiffPG``; here novelty is measured in them
    :param success_key: Key of ``info`` that marks a success, see ``ModeReplayBuffer``
    :param novelty: ``"rnd"``, ``"counts"``, or a class with the methods of ``RandomNetworkDistillation``
    :param novelty_kwargs: Further keyword arguments of the novelty measure; the ``cell_size`` of ``"counts"`` is what the
        environment declares as ``novelty_cell_size``, else 0.5, if none is given
    :param novelty_scale: The factor alpha of NovelD
    :param intrinsic_coef: Factor c on the intrinsic reward
    :param normalize_intrinsic: Whether the intrinsic reward is divided by its running standard deviation
    :param intrinsic_clip: What one place is worth at most, in these deviations: a low limit hides a rare place behind others
    :param episodic_novelty: Whether a place pays only when it is reached for the first time in an episode (Zhang et al., 2021,
        section 3): otherwise explorers stand where fewest have been
    :param max_grad_norm: Largest gradient norm of the actor and of each group's critics
    :param stats_window_size: Window size for the rollout logging
    :param tensorboard_log: The log location for tensorboard (if None, no logging)
    :param policy_kwargs: Additional arguments of the policy
    :param verbose: 0: no output, 1: info messages, 2: debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device on which the code should run; "auto" uses the GPU if possible
    :param _init_setup_model: Whether to build the networks at the creation of the instance
    :raises ValueError: If an argument is out of its range, naming it
    """

    default_replay_buffer_class: ClassVar[type[ModeReplayBuffer]] = ModeReplayBuffer
    target_networks: ClassVar[dict[str, str]] = {
        "critics_target": "critics",
        "critic_features_extractor_target": "critic_features_extractor",
    }
    policy: TwinCriticPolicy
    actor: Any
    replay_buffer: ModeReplayBuffer
    # Of the first group: what an error calls its critics, the argument that limits their values, and those that scale them
    _first_group: ClassVar[tuple[str, str, str]] = ("critics", "v_max", "reward_scale or intrinsic_coef")

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 500_000,
        learning_starts: int = 1_000,
        batch_size: int = 256,
        tau: float = 0.05,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ModeReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        qf_learning_rate: float | Schedule | None = None,
        n_critics: int = 2,
        n_atoms: int = 51,
        twin_target: str = "lower_mean",
        v_min: float = 0.0,
        v_max: float = 5.0,
        reward_scale: float = 1.0,
        target_policy_noise: float = 0.8,
        target_noise_clip: float = 0.2,
        mode_features: Any = None,
        success_key: str | None = None,
        novelty: str | type = "counts",
        novelty_kwargs: dict[str, Any] | None = None,
        novelty_scale: float = 0.5,
        intrinsic_coef: float = 0.05,
        normalize_intrinsic: bool = True,
        intrinsic_clip: float = 10.0,
        episodic_novelty: bool = True,
        max_grad_norm: float = 1.0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            supported_action_spaces=(spaces.Box,),
            support_multi_env=True,
        )
        # Not handed on: SB3 would make a buffer of its own for it
        self.n_steps = n_steps
        self.qf_learning_rate = qf_learning_rate
        self.n_critics = n_critics
        self.n_atoms = n_atoms
        self.twin_target = twin_target
        self.v_min = v_min
        self.v_max = v_max
        self.reward_scale = reward_scale
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        self.mode_features = mode_features
        self.success_key = success_key
        self.novelty = novelty
        self.novelty_kwargs = novelty_kwargs
        self.novelty_scale = novelty_scale
        self.intrinsic_coef = intrinsic_coef
        self.normalize_intrinsic = normalize_intrinsic
        self.intrinsic_clip = intrinsic_clip
        self.episodic_novelty = episodic_novelty
        self.max_grad_norm = max_grad_norm

        self.run_id = uuid.uuid4().hex  # whose checkpoints, and modes, are meant: every run has a "mode_0"
        self.is_normalized = False
        self.visits: VisitMap | None = None
        self.env_spec: str | None = None
        self._resolved_features: Any = None
        #: What the environment declared when the model was made; the counts are in these cells
        self._novelty_cell_size: float | None = None
        self._warned_support = self._warned_cut_values = False

        if _init_setup_model:
            self._setup_model()

    # ------------------------------------------------------------------ set-up

    def _policy_arguments(self) -> dict[str, Any]:
        """What the algorithm's own arguments say about the policy."""
        support = (self.v_min, self.v_max)
        return {
            "n_critics": self.n_critics,
            "n_atoms": self.n_atoms,
            "twin_target": self.twin_target,
            "support": support,
            "exploration_support": support,
        }

    def _buffer_arguments(self) -> dict[str, Any]:
        """What they say about the replay buffer."""
        arguments = {"mode_features": self._resolved_features, "success_key": self.success_key}
        return {**arguments, **({"visit_cell_size": self._visit_cell_size()} if self.episodic_novelty else {})}

    def _visit_cell_size(self) -> float:
        """Edge of the cells by which places are told apart."""
        if self.novelty == "counts":
            cell_size = self._novelty_arguments()["cell_size"]
            if not cell_size > 0:
                raise ValueError(f"novelty_kwargs['cell_size'] must be positive, got {cell_size}")
            return float(cell_size)
        return declared_cell_size(self.env)

    def _novelty_arguments(self) -> dict[str, Any]:
        """Of the novelty measure: the environment says how far apart places are, unless the user does."""
        declared = {"cell_size": self._novelty_cell_size or VisitCounts.default_cell_size} if self.novelty == "counts" else {}
        return {**declared, **(self.novelty_kwargs or {})}

    def _check_arguments(self) -> None:
        check_arguments(self, self._policy_arguments)
        space: Any = self.action_space
        if (flat := np.flatnonzero(space.low >= space.high)).size:
            raise ValueError(f"action_space: low is not below high in components {flat.tolist()}; accepted are ranges")

    def _setup_model(self) -> None:
        self._check_arguments()
        for name in ("learning_rate", "qf_learning_rate"):
            if isinstance(rate := getattr(self, name), np.number):
                setattr(self, name, float(rate))  # SB3 wants Python's
        if self.replay_buffer_class is None:
            self.replay_buffer_class = self.default_replay_buffer_class
        self._resolve_mode_features()
        if self._novelty_cell_size is None and self.mode_features is None:
            self._novelty_cell_size = declared_cell_size(self.env, "novelty_cell_size")
        given = self.policy_class, self.policy_kwargs, self.replay_buffer_kwargs, self.n_steps
        # Not stored in the model: what the user gave is what ``load`` compares and ``save`` keeps
        self.policy_class = partial(self._built, "policy", self.policy_class)  # type: ignore[assignment]
        self.policy_kwargs = {**self._policy_arguments(), **self.policy_kwargs}
        self.replay_buffer_kwargs = {**self._buffer_arguments(), **self.replay_buffer_kwargs}
        self.n_steps = 1  # for more, SB3 would want a buffer of its own
        try:
            super()._setup_model()
        finally:
            self.policy_class, self.policy_kwargs, self.replay_buffer_kwargs, self.n_steps = given
        noise = self.action_noise
        if noise is None or (isinstance(noise, SpreadNormalActionNoise) and noise.shape[0] != self.n_envs):
            # None given, or loaded with another number of environments
            deviations = {} if noise is None else {"low": noise.low, "high": noise.high}
            action_dim = int(np.prod(self.action_space.shape or (1,)))
            self.action_noise = SpreadNormalActionNoise(self.n_envs, action_dim, **deviations)
        elif type(noise) is VectorizedActionNoise and noise.n_envs != self.n_envs:
            self.action_noise = VectorizedActionNoise(noise.base_noise, self.n_envs)
        dim = self.replay_buffer.features.dim
        if self.visits is None or self.visits.dim != dim:
            self.visits = VisitMap(dim, declared_cell_size(self.env)) if dim <= 3 else None
        if self.env is not None:
            self.env_spec = describe_env(self.env)
            self.is_normalized = self._vec_normalize_env is not None
        measure = NOVELTY_MEASURES[self.novelty] if isinstance(self.novelty, str) else self.novelty
        dims = self.replay_buffer.features.dim, self.policy.actor.features_dim
        self.novelty_model: Any = self._built("novelty_model", measure, *dims, **self._novelty_arguments()).to(self.device)
        self.intrinsic_moments = RunningMoments(1, max_count=100_000).to(self.device)
        self._qf_schedule = self.lr_schedule if self.qf_learning_rate is None else FloatSchedule(self.qf_learning_rate)
        self._create_aliases()

    def _resolve_mode_features(self) -> None:
        if self.mode_features is not None:
            self._resolved_features = self.mode_features
        elif self.env is not None:
            self._resolved_features = declared_mode_features(self.env)

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.graphs = {"critics": GraphedFunction(self._critic_gradients, self.policy, self.policy.critics.optimizer)}
        span = (self.critics.upper - self.critics.lower).max().item()
        self.divergence_watch = DivergenceWatch(self.device, EXPLODED * max(1.0, span**2))
        self._sound_normalization: dict[str, Any] | None = None

    @property
    def critics(self) -> ModeCritics:
        """The critics of all groups, see ``critics.ModeCritics``."""
        return self.policy.critics

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        :param gradient_steps: Number of updates
        :param batch_size: Transitions per update
        """
        self._begin_updates()
        metrics: dict[str, list[th.Tensor]] = defaultdict(list)
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample_modes(batch_size, self.gamma, self.n_steps, 1, env=self._vec_normalize_env)
            intrinsic = self._intrinsic_rewards(batch.windows[..., : self.n_steps], metrics)
            rewards = self.reward_scale * batch.rewards + intrinsic
            self._update_critics(batch, rewards, metrics)
            self._update_actor(batch, metrics)
            self._update_targets()
        self._end_updates(gradient_steps, metrics)

    def _begin_updates(self) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rates()

    def _end_updates(self, gradient_steps: int, metrics: dict[str, list[th.Tensor]]) -> None:
        self.divergence_watch.report()
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        means = {name: th.stack(values).mean().item() for name, values in metrics.items()}
        for name, mean in means.items():
            self.logger.record(f"train/{name}", mean)
        if means.get(CUT_VALUES, 0.0) > MOST_CUT_VALUES and not self._warned_cut_values:
            self._warned_cut_values = True
            (critics, limit, scales), value = self._first_group, self.critics.upper[0].item()
            warnings.warn(
                f"{means[CUT_VALUES]:.0%} of the {critics}' targets are cut off at {limit}={value:g}, "
                f"where one place is as good as another and exploration stops: raise {limit} or lower {scales}"
            )

    def _update_actor(self, batch: ModeBatch, metrics: dict[str, list[th.Tensor]]) -> None:
        """
        One step of the actor.

        :param batch: A batch of one group
        :param metrics: Where to note its loss
        """
        raise NotImplementedError

    def _next_actions(self, batch: ModeBatch) -> tuple[th.Tensor, th.Tensor | float]:
        """
        :param batch: The batch
        :return: The policy's actions at the next observations, [N, action_dim], and what it adds to the value there, such as
            entropy, [G, n]
        """
        return self.actor(batch.next_observations), 0.0

    def _intrinsic_rewards(self, windows: np.ndarray, metrics: dict[str, list[th.Tensor]]) -> th.Tensor:
        """
        Discounted NovelD rewards over windows of consecutive rows, followed by one step of the novelty measure.

        :param windows: Rows, [G, n, n_steps], -1 beyond a window's end
        :param metrics: Where to note the mean and the loss
        :return: [G, n]
        """
        present = windows >= 0
        inputs = [self._novelty_inputs(obs) for obs in self.replay_buffer.read_observations(windows[present])]
        now, then = (self.novelty_model.novelty(*each) for each in inputs)
        reward = self.divergence_watch.finite("the novelty", noveld_reward(now, then, self.novelty_scale), 0.0)
        reward = reward * self._pays(windows, present, inputs[1][0])
        metrics["intrinsic_reward"].append(reward.mean())
        if self.normalize_intrinsic:
            self.intrinsic_moments.update(reward[:, None])
            # Not centred: where nothing is new, a negative reward would make it worth while to end the episode at a goal.
            # Limited: one surprising state would dominate the values for long
            scale = self.intrinsic_moments.var.sqrt() + 1e-8
            reward = (reward / scale).clamp(max=self.intrinsic_clip)
        if self.novelty_model.optimizer is not None:
            metrics["novelty_loss"].append(self.novelty_model.update(*inputs[1]))
        places = th.from_numpy(np.flatnonzero(present)).to(self.device, non_blocking=True)
        rewards = reward.new_zeros(windows.size).index_copy(0, places, reward).view(windows.shape)
        if self.normalize_intrinsic and len(windows) > 1:
            # For a mode an ordinary place is worth nothing: staying there for ever would be worth as much as a distant goal
            ordinary = (self.intrinsic_moments.mean / scale).clamp(max=self.intrinsic_clip)
            modes_present = th.from_numpy(present[1:]).to(self.device, non_blocking=True)
            rewards[1:] -= ordinary * modes_present
        steps = th.arange(windows.shape[-1], device=self.device)
        rewards[:1] *= self._exploration_gamma() ** steps
        rewards[1:] *= self.gamma**steps
        return self.intrinsic_coef * rewards.sum(dim=-1).float()

    def _exploration_gamma(self) -> float:
        return self.gamma

    def _pays(self, windows: np.ndarray, present: np.ndarray, positions: th.Tensor) -> th.Tensor:
        """
        Where novelty is paid.

        :param windows: Rows, [G, n, n_steps]
        :param present: Which of them there are, same shape
        :param positions: Reached by each that is present, [N, position_dim]
        :return: Shape [N]
        """
        # All of them in a buffer that does not tell
        first = self.replay_buffer.first_visits[windows[present]]
        return th.from_numpy(first).to(self.device, non_blocking=True)

    def _novelty_inputs(self, obs: Any) -> tuple[th.Tensor, th.Tensor]:
        """Positions [N, position_dim] and features [N, features_dim] of observations, not normalised, on the device."""
        positions = self.replay_buffer.features.of_tensors(obs)
        if not getattr(self.novelty_model, "with_observation", False):
            return positions, positions
        obs = self.replay_buffer.normalized(obs, self._vec_normalize_env)
        with th.no_grad():
            return positions, self.actor.features(obs)

    def _update_critics(self, batch: ModeBatch, rewards: th.Tensor, metrics: dict[str, list[th.Tensor]]) -> None:
        losses, norms, at_top = self.graphs["critics"](batch, rewards)
        self.divergence_watch.step(self._critic_names(), self.policy.critics.optimizer, losses, norms)
        metrics["critic_loss"].append(losses.mean())
        metrics[CUT_VALUES].append(at_top[0])

    def _critic_names(self) -> list[str]:
        """How an error calls the critics of each group."""
        return ["critics"]

    def _critic_gradients(self, batch: ModeBatch, rewards: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        :param batch: The batch
        :param rewards: What its transitions are worth, [G, n]
        :return: Loss of every group, norm of its gradient, and share of its targets at the upper end of its values, [G] each;
            the gradients, clipped, are left at the critics
        """
        policy, shape = self.policy, batch.actions.shape
        with th.no_grad():
            next_actions, bonus = self._next_actions(batch)
            noise = (th.randn_like(next_actions) * self.target_policy_noise).clamp(
                -self.target_noise_clip, self.target_noise_clip
            )
            next_actions = (next_actions + noise).clamp(-1.0, 1.0).view(shape)
            next_features = policy.critic_features(batch.next_observations, target=True)
            rewards = rewards + batch.discounts * bonus
            targets = policy.critics_target.bellman_target(next_features, next_actions, rewards, batch.discounts)
        losses = policy.critics.loss(policy.critic_features(batch.observations), batch.actions, targets)
        policy.critics.optimizer.zero_grad(set_to_none=True)
        (losses * batch.active).sum().backward()
        norms = policy.critics.clip_gradients(self.max_grad_norm)
        return losses.detach(), norms, policy.critics.share_at_top(targets)

    def _improve_target_actions(self, batch: ModeBatch) -> th.Tensor:
        """
        ``a_target <- a_target + eta * grad_a Q_i(s, a_target)``, K times, written back to the buffer, of algorithms that have
        an ``"ascent"`` among their graphs. [G, n, action_dim]
        """
        improved = self.graphs["ascent"](batch)
        improved = self.divergence_watch.finite("a target action", improved, batch.target_actions)
        self.replay_buffer.store_target_actions(batch, improved)
        return improved

    def _update_targets(self) -> None:
        policy = self.policy
        online = policy.critics, policy.critic_features_extractor
        average_networks(online, (policy.critics_target, policy.critic_features_extractor_target), self.tau)

    def _update_learning_rates(self) -> None:
        progress = self._current_progress_remaining
        for name, optimizer, schedule in (
            ("learning_rate", self.actor.optimizer, self.lr_schedule),
            ("qf_learning_rate", self.policy.critics.optimizer, self._qf_schedule),
        ):
            self.logger.record(f"train/{name}", schedule(progress))
            update_learning_rate(optimizer, schedule(progress))

    # ------------------------------------------------------------------ acting

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        assert self._last_obs is not None, "self._last_obs was not set"
        # Before the environments are given an action that follows from NaN
        if self._vec_normalize_env is not None:  # the normalised ones are all NaN if one is
            self.replay_buffer.check_finite("observation", self._last_original_obs)
        self.replay_buffer.check_finite("observation", self._last_obs)
        shape = (n_envs, *self.action_space.shape)  # type: ignore[misc]
        if self.num_timesteps < learning_starts:
            scaled_action = np.random.uniform(-1.0, 1.0, size=shape).astype(np.float32)
        else:
            scaled_action = self.policy.scale_action(self._training_actions())
            if action_noise is not None:
                scaled_action = np.clip(scaled_action + action_noise().reshape(shape), -1.0, 1.0)
            self.replay_buffer.check_finite("policy's action (has training diverged?)", scaled_action)
        return self.policy.unscale_action(scaled_action), scaled_action

    def _training_actions(self) -> np.ndarray:
        """The policy's actions at the latest observations, before exploration noise."""
        return self.policy.predict(self._last_obs)[0]  # type: ignore[arg-type]

    def _store_transition(self, replay_buffer: ModeReplayBuffer, *args: Any, **kwargs: Any) -> None:  # type: ignore[override]
        if self._vec_normalize_env is not None:
            # By its statistics one broken environment breaks what the others' episodes ended with
            replay_buffer.check_finite("next observation", self._vec_normalize_env.get_original_obs())
        super()._store_transition(replay_buffer, *args, **kwargs)
        if len(counted := replay_buffer.counted_positions()):
            self.novelty_model.observe(th.as_tensor(counted, device=self.device))
        if self.visits is not None:
            self.visits.observe(replay_buffer.last_positions())
        for _, trajectory in replay_buffer.just_finished:
            self._warn_outside_support(trajectory)

    def _warn_outside_support(self, trajectory: Trajectory) -> None:
        """Once: values that the critics cannot represent make all actions look alike."""
        if self._warned_support:
            return
        rewards = self.reward_scale * self.replay_buffer.rewards[trajectory.rows]
        returns = lfilter([1.0], [1.0, -self.gamma], rewards[::-1])
        if returns.max() > self.v_max + 1e-6 or returns.min() < self.v_min - 1e-6:
            self._warned_support = True
            warnings.warn(
                f"A discounted return between {returns.min():.4g} and {returns.max():.4g} leaves the critics' support "
                f"[v_min={self.v_min}, v_max={self.v_max}] and is clipped: adapt v_min, v_max or reward_scale"
            )

    def state_values(self, observation: np.ndarray | dict[str, np.ndarray], n_actions: int = 8) -> np.ndarray:
        """
        What the critics expect from here: the discounted, scaled return, as the mean over actions drawn from the policy of the
        smaller of the twins' values.

        :param observation: A batch of N observations, normalised if the model was trained so
        :param n_actions: Actions drawn for each
        :return: Shape [N]
        """
        self.policy.set_training_mode(False)
        tensors, _ = self.policy.obs_to_tensor(observation)
        with th.no_grad():
            drawn = [self._values_of_drawn_actions(tensors) for _ in range(n_actions)]
        return th.stack(drawn).mean(dim=0).cpu().numpy()

    def _values_of_drawn_actions(self, obs: Any) -> th.Tensor:
        """The smaller of the twins' values, [N]."""
        features, actions = self.policy.critic_features(obs), self.policy(obs)
        return self.policy.critics.values(self.policy.critics(features, actions[None])).amin(dim=1)[0]

    # ------------------------------------------------------------------ a run's beginning and end

    def learn(
        self: SelfActorCritic,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 100,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfActorCritic:
        """
        Train the model. See SB3's ``learn``; ``log_interval`` counts episodes of all environments. The first call after
        ``resume`` is given what the interrupted one was given, and does what was left of it.
        """
        # Denormal numbers in Adam's moments slow a small update down by half
        th.set_flush_denormal(True)
        try:
            return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
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
        self._check_buffer(self.env)
        self._note_normalization()  # the environments may be reset now
        if self._vec_normalize_env is not None and self._vec_normalize_env.norm_reward:
            warnings.warn(
                "VecNormalize scales the rewards (norm_reward=True), and so the values, which the critics' support "
                f"[v_min={self.v_min}, v_max={self.v_max}] must cover; norm_reward=False leaves them in reward units"
            )
        for graph in self.graphs.values():
            graph.clear()  # settings may have changed since
        new_episodes = reset_num_timesteps or self._last_obs is None
        if new_episodes:
            self.replay_buffer.drop_unfinished_episodes()
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
        if self._interrupted is not None:
            self._interrupted.go_on(self, callback)
        return total_timesteps, callback

    def _begin_episodes(self) -> None:
        """All environments have been reset."""

    def _check_buffer(self, env: VecEnv) -> None:
        """Claim its memory. The episodes in progress must fit, or hours later there would be nothing to evict."""
        if self.replay_buffer.n_envs != self.n_envs:
            raise ValueError(f"The replay buffer was made for {self.replay_buffer.n_envs} environment(s), got {self.n_envs}")
        try:
            limit = getattr(env.get_attr("spec", indices=0)[0], "max_episode_steps", None)
        except AttributeError:
            limit = None
        if limit is not None and self.replay_buffer.buffer_size < limit * self.n_envs:
            raise ValueError(
                f"buffer_size={self.replay_buffer.buffer_size} is smaller than one episode of every environment: "
                f"{self.n_envs} x {limit} steps"
            )
        self.replay_buffer.allocate()

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """
        See SB3. A callback that stops the training makes SB3 drop the last transition (its issue 2056), and so does an error
        or an interrupt: the next ``learn`` then resets the environments, or the running trajectories would have a gap.
        """
        self._interrupted = None  # callbacks may have refused to begin before
        complete = False
        try:
            rollout = super().collect_rollouts(*args, **kwargs)
            complete = rollout.continue_training
        except ValueError:
            # VecNormalize has taken in what was refused
            if self._vec_normalize_env is not None and self._sound_normalization is not None:
                restore_normalization(self._vec_normalize_env, self._sound_normalization)
            raise
        finally:
            if not complete:
                self._last_obs = None
        self._note_normalization()
        return rollout

    def _note_normalization(self) -> None:
        if self._vec_normalize_env is not None:
            self._sound_normalization = normalization(self._vec_normalize_env)

    # ------------------------------------------------------------------ saving

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor", "graphs", "divergence_watch", "_sound_normalization"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "policy.critics.optimizer", *self._only_to_train()], []

    def _only_to_train(self) -> list[str]:
        names = ["novelty_model", "intrinsic_moments"]
        return names if self.novelty_model.optimizer is None else [*names, "novelty_model.optimizer"]
