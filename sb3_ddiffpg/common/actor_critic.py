"""What all actor-critic algorithms of this package share: distributional twin critics, novelty, and the loop around them."""

import uuid
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import islice
from typing import Any, ClassVar, Self

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate

from sb3_ddiffpg.buffers.batch import ModeBatch, VisitedSteps
from sb3_ddiffpg.buffers.features import declared_cell_size
from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.common.checks import check_each, check_model, take_number_of_critics
from sb3_ddiffpg.common.collection import CollectingAlgorithm
from sb3_ddiffpg.common.presets import preset
from sb3_ddiffpg.common.scales import features_of, review_scales
from sb3_ddiffpg.envs.description import describe_env
from sb3_ddiffpg.envs.snapshots import SoundNormalization
from sb3_ddiffpg.exploration.bonus import ExplorationBonus
from sb3_ddiffpg.exploration.bonus_factory import make_bonus
from sb3_ddiffpg.exploration.noise import noise_for
from sb3_ddiffpg.exploration.settings import NoveltySettings
from sb3_ddiffpg.networks.cuda_graphs import graphed
from sb3_ddiffpg.networks.policies import TwinCriticPolicy, average_networks
from sb3_ddiffpg.networks.settings import CriticSettings
from sb3_ddiffpg.networks.value_range import ValueRange
from sb3_ddiffpg.saving._legacy import parts_of_0_1
from sb3_ddiffpg.saving.model import built
from sb3_ddiffpg.saving.records import saved_part
from sb3_ddiffpg.utils.arguments import absorb_settings, grouped, take_settings
from sb3_ddiffpg.utils.divergence import EXPLODED, DivergenceWatch
from sb3_ddiffpg.utils.settings import Settings

#: Numbers of updates, by the names under which their means are logged
Metrics = dict[str, list[th.Tensor]]
# Metric: share of the first group's targets at the upper end of the support; and how much of it is a fault
CUT_VALUES, MOST_CUT_VALUES = "values_at_limit", 0.02


class ActorCriticAlgorithm(CollectingAlgorithm):
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
    :param reward_scale: Factor on the environment's reward
    :param max_grad_norm: Largest gradient norm of the actor, of each group's critics and of their features extractor
    :param mode_features: See ``DDiffPG``; here novelty is measured in them
    :param success_key: Key of ``info`` that marks a success, see ``ModeReplayBuffer``
    :param critic: How values are learned, see ``CriticSettings``
    :param novelty: What is new and what it is worth, see ``NoveltySettings``
    :param stats_window_size: Window size for the rollout logging
    :param tensorboard_log: The log location for tensorboard (if None, no logging)
    :param policy_kwargs: Additional arguments of the policy, SB3's ``n_critics`` among them
    :param verbose: 0: no output, 1: info messages, 2: debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device on which the code should run; "auto" uses the GPU if possible
    :param _init_setup_model: Whether to build the networks at the creation of the instance
    :param flat: Settings of the groups as arguments of their own, as in version 0.1
    :raises ValueError: If an argument is out of its range, naming it
    :raises TypeError: If there is no such argument
    """

    default_replay_buffer_class: ClassVar[type[ModeReplayBuffer]] = ModeReplayBuffer
    #: Groups of settings that the constructor takes
    settings_groups: ClassVar[tuple[type[Settings], ...]] = (CriticSettings, NoveltySettings)
    target_networks: ClassVar[dict[str, str]] = {
        "critics_target": "critics",
        "critic_features_extractor_target": "critic_features_extractor",
    }
    policy: TwinCriticPolicy
    actor: Any
    replay_buffer: ModeReplayBuffer
    critic_settings: CriticSettings
    novelty_settings: NoveltySettings
    bonus: ExplorationBonus
    _parts: ClassVar[dict[str, str]] = {"bonus": "bonus"}
    _unsaved: ClassVar[dict[str, None]] = dict.fromkeys(
        ("actor", "critics", "bonus", "graphs", "divergence_watch", "sound_normalization", "value_range")
    )
    _only_to_train: ClassVar[dict[str, None]] = dict.fromkeys(
        ("bonus.novelty_model", "bonus.moments", "bonus.novelty_model.optimizer")
    )
    # Of the first group: what an error calls its critics, the argument that limits their values, and those that scale them
    _first_group: ClassVar[tuple[str, str, str]] = ("critics", "critic.v_max", "reward_scale or novelty.coef")

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
        n_steps: int | None = 1,
        qf_learning_rate: float | Schedule | None = None,
        reward_scale: float = 1.0,
        max_grad_norm: float = 1.0,
        mode_features: Any = None,
        success_key: str | None = None,
        critic: CriticSettings | dict[str, Any] | None = None,
        novelty: NoveltySettings | dict[str, Any] | str | type | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        **flat: Any,
    ) -> None:
        take_settings(self, {"critic": critic, "novelty": novelty, **flat})
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
        self.n_steps = n_steps  # type: ignore[assignment]
        self.qf_learning_rate = qf_learning_rate
        self.reward_scale = reward_scale
        self.max_grad_norm = max_grad_norm
        self.mode_features = mode_features
        self.success_key = success_key

        self.run_id = uuid.uuid4().hex  # whose checkpoints, and modes, are meant: every run has a "mode_0"
        self.is_normalized = False
        self.env_spec: str | None = None
        self.resolved_features: Any = None
        #: What the environment declared when the model was made; the counts are in these cells
        self.novelty_cell_size: float | None = None
        self._warned_support = self._warned_cut_values = False
        # When scales are measured again; whether mode features were chosen from what was seen, and from episodes that reached
        # the goal, see ``common.scales``
        self.next_review, self.features_found, self.features_settled = 0, False, False
        #: The unit of the values that the critics learn
        self.value_range = ValueRange(adapts=False, notes=False)

        if _init_setup_model:
            self._setup_model()

    @classmethod
    def from_preset(cls, name: str, env: GymEnv | str, **changes: Any) -> Self:
        """
        A model with settings that are known to work.

        :param name: One of ``common.presets.PRESETS``, or a YAML file and an entry, such as ``"ddiffpg-cpu:AntMazeV2-v0"``
        :param env: The environment to learn from; what the preset says of environments is for the zoo
        :param changes: Arguments that are to be different; of a group of settings only what is given
        :return: The model
        :raises ValueError: If there is no such preset, or an argument is out of its range
        """
        arguments = grouped(cls, preset(name), changes)
        return cls(arguments.pop("policy", "MlpPolicy"), env, **arguments)

    # ------------------------------------------------------------------ set-up

    def _policy_arguments(self) -> dict[str, Any]:
        """What the algorithm's own arguments say about the policy."""
        critic = self.critic_settings
        support = critic.support
        return {
            "n_critics": critic.n_critics,
            "n_atoms": critic.n_atoms,
            "twin_target": critic.twin_target,
            "support": support,
            "exploration_support": support,
        }

    def _buffer_arguments(self) -> dict[str, Any]:
        """What they say about the replay buffer."""
        given, chosen = self.mode_features is not None, self.features_found
        return {
            "mode_features": self.resolved_features,
            "success_key": self.success_key,
            # What an environment declares, and a part of an observation, has one unit
            "standardize": self.resolved_features is None or chosen or (given and not isinstance(self.mode_features, str)),
        }

    def _setup_model(self) -> None:
        if (parts := parts_of_0_1(vars(self))) is not None:
            self.saved_parts = parts
        absorb_settings(self)
        check_each(self)
        take_number_of_critics(self)
        self._setup_parts()
        check_model(self, self._policy_arguments())
        for name in ("learning_rate", "qf_learning_rate"):
            if isinstance(rate := getattr(self, name), np.number):
                setattr(self, name, float(rate))  # SB3 wants Python's
        if self.replay_buffer_class is None:
            self.replay_buffer_class = self.default_replay_buffer_class
        self.resolved_features = features_of(self)
        if self.novelty_cell_size is None and self.mode_features is None:
            self.novelty_cell_size = declared_cell_size(self.env, "novelty_cell_size")
        given = self.policy_class, self.policy_kwargs, self.replay_buffer_kwargs, self.n_steps
        # Not stored in the model: what the user gave is what ``load`` compares and ``save`` keeps
        self.policy_class = partial(built, self, "policy", self.policy_class)  # type: ignore[assignment]
        self.policy_kwargs = {**self._policy_arguments(), **self.policy_kwargs}
        self.replay_buffer_kwargs = {**self._buffer_arguments(), **self.replay_buffer_kwargs}
        self.n_steps = 1  # for more, SB3 would want a buffer of its own
        try:
            super()._setup_model()
        finally:
            self.policy_class, self.policy_kwargs, self.replay_buffer_kwargs, self.n_steps = given
        self.action_noise = noise_for(self.action_noise, self.n_envs, int(np.prod(self.action_space.shape or (1,))))
        self.bonus = make_bonus(
            partial(built, self, "bonus.novelty_model"),
            self.novelty_settings,
            getattr(self, "exploration_settings", None),
            (self.replay_buffer.features.dim, self.policy.actor.features_dim),
            self.n_envs,
            counted_cell=self.novelty_cell_size,
            seen_cell=declared_cell_size(self.env) if self.mode_features is None else None,
        ).to(self.device)
        if self.env is not None:
            self.env_spec = describe_env(self.env)
            self.is_normalized = self._vec_normalize_env is not None
        self._qf_schedule = self.lr_schedule if self.qf_learning_rate is None else FloatSchedule(self.qf_learning_rate)
        self._create_aliases()
        if (saved := saved_part(self, "bonus")) is not None:
            self.bonus.load_state_dict(saved)
        self.saved_parts = None

    def _setup_parts(self) -> None:
        """Make what networks and buffer depend on."""

    def _create_aliases(self) -> None:
        self.actor, self.critics = self.policy.actor, self.policy.critics
        self.graphs = {"critics": graphed(self._critic_gradients, self.policy, self.policy.critics.optimizer)}
        span = (self.critics.upper - self.critics.lower).max().item()
        self.divergence_watch = DivergenceWatch(self.device, EXPLODED * max(1.0, span**2))
        self.sound_normalization = SoundNormalization()

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        :param gradient_steps: Number of updates
        :param batch_size: Transitions per update
        """
        with self._updates(gradient_steps) as metrics:
            for _ in range(gradient_steps):
                batch = self.replay_buffer.sample_modes(batch_size, self.gamma, self.n_steps, 1, env=self._vec_normalize_env)
                rewards = self.reward_scale * batch.rewards + self._intrinsic_rewards(batch.visited, metrics)
                self._update_critics(batch, rewards, metrics)
                self._update_actor(batch, metrics)
                self._update_targets()

    @contextmanager
    def _updates(self, gradient_steps: int) -> Iterator[Metrics]:
        """
        What comes before and after some updates.

        :param gradient_steps: How many there will be
        :return: Where to note their numbers, of which the means are logged
        """
        review_scales(self)
        metrics: Metrics = defaultdict(list)
        self.policy.set_training_mode(True)
        progress = self._current_progress_remaining
        for name, optimizer, schedule in (
            ("learning_rate", self.actor.optimizer, self.lr_schedule),
            ("qf_learning_rate", self.policy.critics.optimizer, self._qf_schedule),
        ):
            self.logger.record(f"train/{name}", schedule(progress))
            update_learning_rate(optimizer, schedule(progress))

        yield metrics
        self.divergence_watch.report()
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        # All of them at once: an accelerator is waited for, and a processor called, but once
        numbers = iter(th.stack([each for values in metrics.values() for each in values]).tolist() if metrics else ())
        means = {name: sum(islice(numbers, len(values))) / len(values) for name, values in metrics.items()}
        for name, mean in means.items():
            self.logger.record(f"train/{name}", mean)
        cut, values = means.get(CUT_VALUES, 0.0), self.value_range
        values.observe_targets(cut, gradient_steps)
        if cut > MOST_CUT_VALUES and not values.grows and not self._warned_cut_values:
            self._warned_cut_values = True
            (critics, limit, scales), value = self._first_group, self.policy.critics.upper[0].item()
            value *= values.novelty_unit if values.adapts else 1.0
            warnings.warn(
                f"{cut:.0%} of the {critics}' targets are cut off at {limit}={value:g}, "
                f"where one place is as good as another and exploration stops: raise {limit} or lower {scales}"
            )

    def _update_actor(self, batch: ModeBatch, metrics: Metrics) -> None:
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

    def _intrinsic_rewards(self, visited: VisitedSteps, metrics: Metrics, exploration_gamma: float | None = None) -> th.Tensor:
        """What the windows of a batch are worth for their novelty, [G, n], after which the measure learns from them."""
        gamma = self.gamma if exploration_gamma is None else exploration_gamma
        normalized = partial(self.replay_buffer.normalized, env=self._vec_normalize_env)
        rewards, found = self.bonus.reward(
            visited, gamma, self.gamma, self.divergence_watch, lambda obs: self.actor.features(normalized(obs))
        )
        for name, value in found.items():
            metrics[name].append(value)
        return rewards

    def _update_critics(
        self, batch: ModeBatch, rewards: th.Tensor, metrics: Metrics, names: Sequence[str] = ("critics",)
    ) -> None:
        """One step of the critics of all groups, which errors call by these names."""
        losses, norms, at_top = self.graphs["critics"](batch, self.value_range.scaled(rewards, batch.discounts))
        others = ["critics' features extractor"] if len(norms) > len(losses) else []
        with self.critics.at_rest(batch.dormant):
            self.divergence_watch.step(names, self.critics.optimizer, losses, norms, others=others)
        metrics["critic_loss"].append(losses.mean())
        metrics[CUT_VALUES].append(at_top[0])

    def _critic_gradients(self, batch: ModeBatch, rewards: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        :param batch: The batch
        :param rewards: What its transitions are worth, [G, n]
        :return: Loss of every group, [G], norm of its gradient, and of that of the critics' features extractor if it learns,
            [G] or [G + 1], and share of each group's targets at the upper end of its values, [G]; the gradients, clipped, are
            left at critics and extractor
        """
        policy, settings = self.policy, self.critic_settings
        with th.no_grad():
            # The policy's actions at the next observations, smoothed as in TD3
            next_actions, bonus = self._next_actions(batch)
            noise = (th.randn_like(next_actions) * settings.target_policy_noise).clamp(
                -settings.target_noise_clip, settings.target_noise_clip
            )
            next_actions = (next_actions + noise).clamp(-1.0, 1.0).view(batch.actions.shape)
            # What the target critics expect of them
            next_features = policy.critic_features(batch.next_observations, target=True)
            rewards = rewards + batch.discounts * bonus
            targets = policy.critics_target.bellman_target(next_features, next_actions, rewards, batch.discounts)
        losses = policy.critics.loss(policy.critic_features(batch.observations), batch.actions, targets)
        policy.critics.optimizer.zero_grad(set_to_none=True)
        (losses * batch.active).sum().backward()
        norms = policy.critics.clip_gradients(self.max_grad_norm)
        if learned := list(policy.critic_features_extractor.parameters()):
            norms = th.cat((norms, th.nn.utils.clip_grad_norm_(learned, self.max_grad_norm).reshape(1)))
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

    def state_values(self, observation: np.ndarray | dict[str, np.ndarray], n_actions: int = 8) -> np.ndarray:
        """
        What the critics expect from here: the discounted, scaled return, as the mean over actions drawn from the policy of the
        smaller of the twins' values. With modes what the best one expects; where there is none yet, what exploration does.

        :param observation: A batch of N observations, normalised if the model was trained so
        :param n_actions: Actions drawn for each (and each mode)
        :return: Shape [N]
        """
        self.policy.set_training_mode(False)
        values = self.policy.state_values(self.policy.obs_to_tensor(observation)[0], n_actions).cpu().numpy()
        return self.value_range.values(values)
