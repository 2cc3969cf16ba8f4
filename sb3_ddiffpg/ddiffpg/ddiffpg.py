"""Deep Diffusion Policy Gradient: the algorithm."""

import contextlib
import io
import os
import pathlib
import time
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule, TensorDict

from sb3_ddiffpg.buffers.batch import ModeBatch
from sb3_ddiffpg.buffers.features import same_selection
from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.trajectory import NO_MODE, StepRecord
from sb3_ddiffpg.callbacks.clustering import ClusteringCallback, contains_clustering
from sb3_ddiffpg.common.actor_critic import ActorCriticAlgorithm, Metrics
from sb3_ddiffpg.common.scales import settle_features
from sb3_ddiffpg.ddiffpg.onnx_export import export_onnx
from sb3_ddiffpg.ddiffpg.policies import CnnDiffusionPolicy, DiffusionPolicy
from sb3_ddiffpg.exploration.episode_scheduler import EpisodeScheduler
from sb3_ddiffpg.exploration.settings import ExplorationSettings, NoveltySettings
from sb3_ddiffpg.modes.history import BIRTHS, ModeEvent, ModeHistory
from sb3_ddiffpg.modes.manager import ModeManager
from sb3_ddiffpg.modes.mode import Mode, ModeTable
from sb3_ddiffpg.modes.settings import ModeSettings
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.networks.cuda_graphs import graphed
from sb3_ddiffpg.networks.diffusion_actor import DiffusionActor
from sb3_ddiffpg.networks.settings import CriticSettings, TargetActionSettings
from sb3_ddiffpg.networks.target_actions import climb
from sb3_ddiffpg.networks.value_range import ValueRange
from sb3_ddiffpg.saving.algorithm import read_parameters
from sb3_ddiffpg.saving.records import saved_part
from sb3_ddiffpg.serialization.safetensors_tree import Count
from sb3_ddiffpg.utils.settings import Accepted, Settings, at_least
from sb3_ddiffpg.utils.signals import uninterrupted

# Updates of the critics for each of policy and target actions, where the policy is a flow: as in TD3
FLOW_DELAY = 2
# Of the exploratory group's batch, from trajectories that took a new route: among all transitions these are too few to be met
NEW_ROUTE_SHARE = 0.25


class DDiffPG(ActorCriticAlgorithm):
    """
    Deep Diffusion Policy Gradient (DDiffPG): learns several ways to solve one task.

    Paper: https://arxiv.org/abs/2406.00681 (Li et al., NeurIPS 2024). How this implementation differs from it is listed in
    ``docs/algorithm/deviations.md``. The defaults suit a laptop; the paper's own numbers are in
    ``zoo_hyperparams/ddiffpg.yml``, from which ``from_preset`` takes them.

    :param policy: ``"DiffusionPolicy"``, ``"MlpPolicy"`` (the same), ``"CnnPolicy"`` (images), ``"MultiInputPolicy"`` (dict
        observations) or a class
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: Learning rate of the diffusion policy, a float or a function of the remaining progress (from 1 to 0)
    :param buffer_size: Capacity of the replay buffer in transitions, over all environments
    :param learning_starts: Steps of random actions before learning starts
    :param batch_size: Transitions per update, split evenly over the exploratory group and the modes
    :param tau: Soft update coefficient of the target critics
    :param gamma: Discount factor. A goal L steps away is worth ``gamma ** L`` of itself: much less than 0.1 at the start of a
        mode's first trajectories, and its critics do not see it there
    :param train_freq: Update the model every ``train_freq`` steps (of all environments), or a tuple with the unit
    :param gradient_steps: Updates after each rollout; -1: as many as transitions were collected
    :param action_noise: Exploration noise; None: Gaussian, its standard deviation drawn per episode from [.05, .6]
    :param replay_buffer_class: ``ModeReplayBuffer`` or a subclass of it
    :param replay_buffer_kwargs: Further keyword arguments of the replay buffer
    :param optimize_memory_usage: Not supported
    :param n_steps: Length of the multi-step returns (uncorrected), where ``modes`` and ``exploration`` do not say theirs;
        None: 5 for the modes' critics, 1 for the exploratory ones
    :param qf_learning_rate: Learning rate of the critics, like ``learning_rate``; the same as it when None
    :param n_diffusion_steps: Steps T of the diffusion policy. None: a flow of two steps along straight lines, which learns at
        every second update of the critics, as TD3 does: two thirds of the time for as many updates, but some thousand more of
        them until it acts as surely
    :param recluster_freq: Rollouts between two re-clusterings
    :param reward_scale: Factor on the environment's reward
    :param max_grad_norm: Largest gradient norm of the policy, of each mode's critics and of their features extractor
    :param mode_features: In which part of the observation modes differ: indices, a key, or a callable on batches of
        observations. None: what the environment declares as ``mode_features``, ``achieved_goal`` of a dict observation,
        else the whole observation, standardised
    :param success_key: Key of ``info`` that marks a success, see ``ModeReplayBuffer``
    :param critic: How values are learned: a dict of some of ``CriticSettings``, or these
    :param modes: How modes are found, kept and trained: of ``ModeSettings``
    :param exploration: Who explores, and what explorers learn from: of ``ExplorationSettings``
    :param novelty: What is new and what it is worth: of ``NoveltySettings``, or the name of a measure
    :param target_action: How target actions climb the critics: of ``TargetActionSettings``
    :param stats_window_size: Window size for the rollout logging
    :param tensorboard_log: The log location for tensorboard (if None, no logging)
    :param policy_kwargs: Additional arguments of the policy, see ``DiffusionPolicy``
    :param verbose: 0: no output, 1: info messages and what became of the modes, 2: debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device on which the code should run; "auto" uses the GPU if possible
    :param _init_setup_model: Whether to build the networks at the creation of the instance
    :param flat: Settings of the groups as arguments of their own, as in version 0.1
    :raises ValueError: If an argument is out of its range, naming it
    :raises TypeError: If there is no such argument
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "DiffusionPolicy": DiffusionPolicy,
        "MlpPolicy": DiffusionPolicy,
        "MultiInputPolicy": DiffusionPolicy,
        "CnnPolicy": CnnDiffusionPolicy,
    }
    settings_groups: ClassVar[tuple[type[Settings], ...]] = (
        *(CriticSettings, NoveltySettings, ExplorationSettings, ModeSettings, TargetActionSettings),
    )
    accepted: ClassVar[dict[str, Accepted]] = {
        "recluster_freq": at_least(1),
        **dict.fromkeys(("n_diffusion_steps", "n_steps"), at_least(1).or_none()),
    }
    manager_class: ClassVar[type[ModeManager]] = ModeManager
    policy: DiffusionPolicy
    actor: DiffusionActor
    replay_buffer: ModeReplayBuffer
    exploration_settings: ExplorationSettings
    mode_settings: ModeSettings
    target_action_settings: TargetActionSettings
    mode_manager: ModeManager
    scheduler: EpisodeScheduler
    _first_group = ("exploratory critics", "exploration.v_max", "novelty.coef")
    _counters: ClassVar[dict[str, Any]] = {"n_rollouts": Count}
    _parts: ClassVar[dict[str, str]] = {"modes": "mode_manager", "values": "value_range"}
    episode_part = "scheduler"
    _unsaved: ClassVar[dict[str, None]] = dict.fromkeys(("mode_manager", "scheduler", "mode_history"))
    _only_to_train: ClassVar[dict[str, None]] = {"bonus.known_cells": None}

    def __init__(
        self,
        policy: str | type[DiffusionPolicy],
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
        n_steps: int | None = None,
        qf_learning_rate: float | Schedule | None = None,
        n_diffusion_steps: int | None = 5,
        recluster_freq: int = 25,
        reward_scale: float = 1.0,
        max_grad_norm: float = 1.0,
        mode_features: Any = None,
        success_key: str | None = None,
        critic: CriticSettings | dict[str, Any] | None = None,
        modes: ModeSettings | dict[str, Any] | None = None,
        exploration: ExplorationSettings | dict[str, Any] | None = None,
        novelty: NoveltySettings | dict[str, Any] | str | type | None = None,
        target_action: TargetActionSettings | dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        **flat: Any,
    ) -> None:
        groups = {"modes": modes, "exploration": exploration, "target_action": target_action}
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
            n_steps=n_steps,
            qf_learning_rate=qf_learning_rate,
            reward_scale=reward_scale,
            max_grad_norm=max_grad_norm,
            mode_features=mode_features,
            success_key=success_key,
            critic=critic,
            novelty=novelty,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
            **groups,
            **flat,
        )
        self.n_diffusion_steps = n_diffusion_steps
        self.recluster_freq = recluster_freq
        self.n_rollouts = 0

        if _init_setup_model:
            self._setup_model()

    # ------------------------------------------------------------------ set-up

    def _setup_parts(self) -> None:
        n_groups = self.mode_settings.max_modes + 1
        if self.batch_size < n_groups:
            raise ValueError(
                f"batch_size={self.batch_size} is smaller than the number of groups it may be split over: "
                f"modes.max_modes + 1 = {n_groups}"
            )
        self.mode_manager = self.manager_class(self.mode_settings, self.resolved_features)
        self.scheduler = EpisodeScheduler(self.exploration_settings, self.mode_manager)
        if (saved := saved_part(self, "modes")) is not None:
            self.mode_manager.load_state_dict(saved)
        if (saved := saved_part(self, "episodes")) is not None:
            with contextlib.suppress(ValueError):  # of another number of environments: new episodes begin
                self.scheduler.load_state_dict(saved, self.n_envs)
        novelty_range = self.exploration_settings.novelty_range(self.novelty_settings, self.gamma)
        self.value_range = ValueRange(self.critic_settings.adapts, *novelty_range)
        if (saved := saved_part(self, "values")) is not None:
            self.value_range.load_state_dict(saved)
        #: What became of the modes in the course of the run
        self.mode_history: ModeHistory = self.mode_manager.history

    def _policy_arguments(self) -> dict[str, Any]:
        critic = self.critic_settings
        most = self.exploration_settings.v_max_beside(self.novelty_settings, critic.support[1], self.gamma)
        return {
            **super()._policy_arguments(),
            "n_modes": len(self.mode_manager),
            "n_diffusion_steps": self.n_diffusion_steps,
            "mode_embedding_dim": self.mode_settings.embedding_dim,
            "support": (0.0, 1.0) if critic.adapts else critic.support,
            "exploration_support": (0.0, 1.0) if critic.adapts else (0.0, most),
        }

    def _buffer_arguments(self) -> dict[str, Any]:
        arguments, given = super()._buffer_arguments(), self.mode_features is not None
        # Distances that are given are in the unit of the features
        measured = self.mode_settings.distance_threshold is not None or "compared_length" in self.replay_buffer_kwargs
        standardize = arguments["standardize"] and not (given and measured)
        return {
            **arguments,
            "standardize": standardize,
            "action_chunk": self.policy_kwargs.get("action_chunk", 1),
            "max_successes_per_mode": self.mode_settings.max_successes,
            "max_failures_per_mode": self.mode_settings.max_failures,
            "explore_beyond_goals": self.exploration_settings.beyond_goals,
            "new_route_share": NEW_ROUTE_SHARE if self.exploration_settings.new_route_coef else 0.0,
        }

    def _setup_model(self) -> None:
        super()._setup_model()
        found_in = self.mode_manager.mode_features
        if len(self.mode_manager) and not same_selection(found_in, self.resolved_features):
            raise ValueError(
                f"mode_features={self.resolved_features}: the modes of this model were found in {found_in}. Load it so, "
                "and then change them by use_features"
            )
        dim = self.replay_buffer.features.dim
        if any(mode.representative.shape[1] not in (0, dim) for mode in self.mode_manager.modes):  # of a file
            raise ValueError(f"modes.representative: accepted are positions of {dim} components")
        self.replay_buffer.expect_modes(len(self.mode_manager))
        if self.mode_manager.success_is_told:  # so the best returns are no longer a stand-in, in a new buffer either
            rule = self.replay_buffer.success_rule
            rule.has_signal = rule.has_goal = True

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.graphs["ascent"] = graphed(lambda batch: climb(self.policy, batch, self.target_action_settings), self.policy)
        self.graphs["policy"] = graphed(self._policy_gradients, self.policy, self.actor.optimizer)

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        Algorithm 1 of the paper, lines 9 to 21.

        :param gradient_steps: Number of updates
        :param batch_size: Transitions per update, over all groups
        """
        names = ["exploratory critics", *(f"critics of {mode.name!r}" for mode in self.mode_manager.modes)]
        with self._updates(gradient_steps) as metrics:
            for n_before in range(self._n_updates, self._n_updates + gradient_steps):
                # Sample one batch per mode, and one for the exploratory group
                batch = self.replay_buffer.sample_modes(
                    batch_size,
                    self.gamma,
                    self.exploration_settings.n_steps_beside(self.n_steps),
                    self.mode_settings.n_steps_beside(self.n_steps),
                    env=self._vec_normalize_env,
                    exploration_gamma=self.exploration_settings.gamma,
                    visits_of_modes=self.mode_settings.novelty_coef != 0.0,
                    lost_value=self.value_range.worst / self.reward_scale,
                )
                # Novelty is what explorers are paid, the environment's reward what the modes are
                batch = self.bonus.end_past_routes(batch)
                rewards = self._rewards(batch, metrics)
                # Update each critic with the Bellman equation on its own batch
                self._update_critics(batch, rewards, metrics, names)
                if self.n_diffusion_steps is not None or (n_before + 1) % FLOW_DELAY == 0:
                    # Gradient ascent on the target actions, which return to the buffer
                    target_actions = self._improve_target_actions(batch)
                    metrics["target_action_shift"].append((target_actions - batch.target_actions).abs().mean())
                    # Concatenate all batches and update the diffusion policy
                    metrics["actor_loss"].append(self._update_policy(batch, target_actions))
                self._update_targets()

    def _rewards(self, batch: ModeBatch, metrics: Metrics) -> th.Tensor:
        """Intrinsic reward for the exploratory group, the environment's (and some intrinsic) for the modes, [G, n]."""
        intrinsic = self._intrinsic_rewards(batch.visited, metrics, self.exploration_settings.gamma)
        rewards = self.reward_scale * batch.rewards
        if self.mode_settings.novelty_coef != 0.0:
            rewards = rewards + self.mode_settings.novelty_coef * self.value_range.unit * intrinsic
        # What a goal is worth beside novelty must not depend on the unit of the reward
        worth = self.exploration_settings.new_route_coef * self.reward_scale / self.value_range.unit
        of_new_routes = worth * batch.new_routes
        rewards[EXPLORATORY_GROUP] = intrinsic[EXPLORATORY_GROUP] + of_new_routes
        return rewards

    def _next_actions(self, batch: ModeBatch) -> tuple[th.Tensor, th.Tensor | float]:
        masked = self.mode_settings.backup_embedding == "masked"
        embeddings = self.policy.row_embeddings(batch.rewards.shape[1], self.mode_settings.mask_prob if masked else None)
        return self.actor(batch.next_observations, embeddings=embeddings), 0.0

    def _update_policy(self, batch: ModeBatch, target_actions: th.Tensor) -> th.Tensor:
        loss, norm = self.graphs["policy"](batch, target_actions)
        self.divergence_watch.step(["actor"], self.actor.optimizer, loss, norm)
        return loss

    def _policy_gradients(self, batch: ModeBatch, target_actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The denoising loss and the norm of its gradient, which is left, clipped, at the actor."""
        embeddings = self.policy.row_embeddings(batch.rewards.shape[1], self.mode_settings.mask_prob)
        condition = self.actor.condition(batch.observations, embeddings)
        weights = batch.imitated.flatten().float()
        if batch.executed is not None:
            weights = weights[:, None] * batch.executed.flatten(0, 1)
        loss = self.actor.diffusion.loss(target_actions.flatten(0, 1), condition, weights=weights)
        self.actor.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = th.nn.utils.clip_grad_norm_(self.actor.parameters(), self.max_grad_norm)
        return loss.detach(), norm

    # ------------------------------------------------------------------ modes

    @property
    def modes(self) -> ModeTable:
        """The modes discovered so far: iterate, index by name or number, or print."""
        embeddings = self.policy.mode_embeddings[1:].cpu().numpy().copy()
        for mode, embedding in zip(self.mode_manager.modes, embeddings, strict=True):
            mode.embedding = embedding
        return self.mode_manager.table

    def recluster(self) -> list[ModeEvent]:
        """
        Algorithm 2 of the paper: cluster the goal-reached trajectories, let the new modes inherit from the old ones, and
        assign the failed trajectories.

        :return: What happened: births, splits, merges and retirements
        """
        started, manager = time.perf_counter(), self.mode_manager
        settle_features(self)
        with uninterrupted():
            events = manager.recluster(
                self.replay_buffer, self.policy, self.scheduler, self.lifetime_steps, births=self._exploration_share() > 0
            )
            if self.visits is not None:
                self.visits.note(self.lifetime_steps)
            self.bonus.on_modes_changed(self.replay_buffer, manager.mastered())
            born = any(event.kind in BIRTHS for event in events)
            self.scheduler.note_news(self.lifetime_steps, self.bonus.n_cells, born)
        self.logger.record("modes/n_modes", len(manager))
        for mode in manager.modes:
            self.logger.record(f"modes/{mode.name}/n_trajectories", mode.n_trajectories)
            self.logger.record(f"modes/{mode.name}/success_rate", mode.success_rate)
        self.logger.record("time/recluster", time.perf_counter() - started)
        return events

    def rename_mode(self, mode: str | int | Mode, name: str) -> None:
        """
        Give a mode a name that says what it does. It keeps it through re-clusterings, saving and resuming.

        :param mode: Name, index or record of the mode
        :param name: Letters, digits, spaces and ``_.+-``, up to 24 of them, not digits alone and without ``_`` in front
        :raises ValueError: If there is no such mode, or another has that name or may be born with it
        """
        self.mode_manager.rename(mode, name, self.lifetime_steps)

    def freeze_mode(self, mode: str | int | Mode, frozen: bool = True) -> None:
        """
        Keep a mode whatever a re-clustering finds: it is not merged, retired or crowded out, and its goal-reached
        trajectories are the last to leave the buffer. It goes on learning.

        :param mode: Name, index or record of the mode
        :param frozen: False takes it back
        :raises ValueError: If there is no such mode
        """
        self.mode_manager.freeze(mode, frozen, self.lifetime_steps, self.replay_buffer)

    def delete_mode(self, mode: str | int | Mode) -> None:
        """
        Forget a mode, with its critics and its embedding. Its trajectories serve exploration from now on. While training
        explores, the same route may be discovered again, as another mode.

        :param mode: Name, index or record of the mode
        :raises ValueError: If there is no such mode
        """
        with uninterrupted():
            self.mode_manager.delete(mode, self.lifetime_steps, self.replay_buffer, self.policy, self.scheduler)
            self.bonus.on_modes_changed(self.replay_buffer, self.mode_manager.mastered())

    def mode_values(self, observation: np.ndarray | dict[str, np.ndarray], n_actions: int = 8) -> np.ndarray:
        """
        What each mode's critics expect from here: the discounted, scaled return of following the mode, as the mean over
        actions drawn from the policy of the smaller of the twins' values.

        :param observation: One observation or a batch of N, normalised if the model was trained so
        :param n_actions: Actions drawn for each mode
        :return: Shape [M] or [N, M], in the order of ``modes``
        :raises ValueError: If there is no mode yet, or ``n_actions`` is less than 1
        """
        if not len(self.mode_manager):
            raise ValueError("There is no mode yet whose value could be told")
        if n_actions < 1:
            raise ValueError(f"n_actions must be at least 1, got {n_actions}")
        self.policy.set_training_mode(False)
        tensors, is_batch = self.policy.obs_to_tensor(observation)
        values = self.policy.group_values(tensors, n_actions)[1:].T.cpu().numpy()  # row 0 of the groups explores
        values = self.value_range.values(values)
        return values if is_batch else values[0]

    def best_mode(self, observation: np.ndarray | dict[str, np.ndarray], n_actions: int = 8) -> Any:
        """
        The mode from which its critics expect most here, see :meth:`mode_values`. Exploration is none.

        :param observation: One observation or a batch of N
        :param n_actions: Actions drawn for each mode
        :return: Its name, or a list of N names
        :raises ValueError: If there is no mode yet
        """
        values = self.mode_values(observation, n_actions)
        names = self.mode_manager.table.names
        best = values.argmax(axis=-1)
        return names[int(best)] if best.ndim == 0 else [names[index] for index in best]

    # ------------------------------------------------------------------ acting

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        mode: str | int | list[str | int] | np.ndarray | None = None,
        n_samples: int | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Actions for one observation or a batch of them.

        :param observation: The observation(s)
        :param state: What the previous call returned: the mode that every environment follows
        :param episode_start: Which environments begin an episode
        :param deterministic: Without chance: the same call returns the same action
        :param mode: Name or index of the mode to follow, or one for each observation. None: a mode is drawn for each episode,
            of those that are not plainly worse than the best, and kept through it by ``state`` and ``episode_start``; without
            those, the zero embedding, which leaves the choice to the policy at every step
        :param n_samples: Of so many actions for each observation take that which the mode's critics like best (without a mode,
            those of any). One of them has no noise, and where ``deterministic`` the others always have the same. None: 4 where
            ``deterministic``, else 1
        :return: The actions and the state for the next call
        :raises ValueError: If there is no such mode, or ``n_samples`` is less than 1
        """
        indices: int | np.ndarray | None = None
        if mode is not None:
            table = self.mode_manager.table
            single = np.ndim(mode) == 0
            if not single and len(mode) == 0:  # type: ignore[arg-type]
                raise ValueError(f"mode={mode!r} is unknown: it names no mode")
            indices = table.index(mode) if single else np.array([table.index(each) for each in mode])  # type: ignore[arg-type, union-attr]
        begins = episode_start is not None and (state is None or np.any(episode_start))
        among = self.mode_manager.trusted() if begins and mode is None else None
        return self.policy.predict(
            observation, state, episode_start, deterministic, mode=indices, n_samples=n_samples, among=among
        )

    def _training_actions(self) -> np.ndarray:
        length = self.mode_manager.mean_length()
        if length is not None:
            # On average after the time that a mode needs for all of its route
            self.scheduler.hand_over(1 / length)
        groups, plans = self.scheduler.groups, self.scheduler.plans
        followed = None if plans is None else (groups, *plans)
        actions, state = self.policy.predict(self._last_obs, followed, group=groups)  # type: ignore[arg-type]
        self.scheduler.plans = None if state is None else state[1:]
        return actions

    def _exploration_share(self) -> float:
        if self.num_timesteps < self.learning_starts:
            return 1.0  # random actions are no mode's doing
        return self.scheduler.exploration_share(self._current_progress_remaining, self.lifetime_steps)

    def _on_episodes_end(self, record: StepRecord) -> None:
        super()._on_episodes_end(record)
        for env, trajectory in (*record.parts, *record.finished):
            assigned = self.scheduler.assigned_mode(env)
            trajectory.assigned_mode = None if assigned is None else self.mode_manager.numbers[assigned]
        for env, trajectory in record.finished:
            commanded = self.scheduler.commanded_mode(env)
            if commanded is not None:
                stands_in = self.replay_buffer.has_success_signal and not self.replay_buffer.goals_are_told
                self.mode_manager.note_outcome(commanded, trajectory, stands_in)
            self.scheduler.begin(env, self._exploration_share())
        for env, _ in record.parts:
            if env not in dict(record.finished):
                # Whoever drives the next part has not done so from the episode's beginning
                self.scheduler.begin(env, self._exploration_share())
                self.scheduler.handed_over[env] = True

    # ------------------------------------------------------------------ a run's beginning

    def _begin_episodes(self) -> None:
        self.scheduler.begin_all(self.n_envs, self._exploration_share())

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        callbacks = callback if isinstance(callback, list) else [callback]
        callbacks = [each if isinstance(each, BaseCallback) else ConvertCallback(each) for each in callbacks]
        if not any(contains_clustering(each) for each in callbacks):
            # First, so that the others see fresh modes
            callbacks.insert(0, ClusteringCallback())
        return super()._init_callback(callbacks, progress_bar)

    # ------------------------------------------------------------------ saving

    def set_parameters(
        self, load_path_or_dict: str | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        See ``SavableAlgorithm``. The number of modes follows; if it changes, nobody knows which modes these are: they get new
        names and wait.
        """
        parameters = read_parameters(self, load_path_or_dict, device)
        policy = parameters.get("policy") or {}
        n_modes = len(policy["mode_embeddings"]) - 1 if "mode_embeddings" in policy else len(self.mode_manager)
        # What does not fit is refused by SB3; it must not cost the modes before that
        complete = not exact_match or set(parameters) == set(self._get_torch_save_params()[0])
        if n_modes != len(self.mode_manager) and complete and self.policy.fits_but_for_modes(policy):
            self.policy.resize(n_modes)
            self.mode_manager.expect_unknown(n_modes, self.lifetime_steps, self.replay_buffer, self.scheduler)
            self.bonus.on_modes_changed(self.replay_buffer, {})
        super().set_parameters(parameters, exact_match, device)

    def export_onnx(self, path: str | os.PathLike, mode: str | int | Mode | None = None) -> None:
        """
        Save the policy as one ONNX file, which acts without torch and this package, see ``docs/guides/deployment.md``.

        Its inputs are ``observation`` (of a dict one for each key, ``observation.KEY``) as the environment gives it, [N, ...];
        ``mode``, the index of each row's mode or -1 for none, int64, [N]; and ``noise``, float32, [N, K, T, action_dim], of
        which K actions are made: that which the mode's critics like best is the output, ``action``, [N, ...], in the
        environment's units; where the policy has an ``action_chunk`` [N, action_chunk, ...], those of the next steps, and
        ``action_dim`` above is that of all of them. Noise is standard normal, or what the file says, to act as
        ``predict(deterministic=True)``. What
        ``VecNormalize`` does to observations is inside, if the model has its environments. Images are as the model sees them,
        channels first. The file is tried with onnxruntime before it is written.

        :param path: Path to the file
        :param mode: Name or index of the only mode, which is then no input; None: all
        :raises ValueError: If there is no such mode
        :raises ImportError: If the extra ``onnx`` is not installed
        :raises RuntimeError: If onnxruntime does not compute what torch does; nothing is written then
        """
        export_onnx(self, path, None if mode is None else self.mode_manager.table.index(mode))

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer with its trajectories, clusters, target actions and distances.

        :param path: Path to the file
        """
        self.replay_buffer.owner = self.run_id, self.mode_manager.numbers
        super().save_replay_buffer(path)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load a replay buffer of this model's run, saved with it or at another time: trajectories follow their modes. What
        trains a mode, and what of a path is compared, stays as the model was made; number of points and unit of distances are
        those of the file.

        :param path: Path to the pickled replay buffer
        :param truncate_last_traj: Whether the next ``learn`` resets the environments and drops the episodes in progress
        :raises ValueError: If it is no ``ModeReplayBuffer``, was filled with other mode features, or is of another run and the
            model has modes
        """
        previous = self.replay_buffer
        with contextlib.suppress(AssertionError):  # SB3's, for anything but a replay buffer
            super().load_replay_buffer(path, truncate_last_traj)
        loaded: Any = self.replay_buffer
        problem = None
        if not isinstance(loaded, ModeReplayBuffer):
            problem = f"is a {type(loaded).__name__}, not a ModeReplayBuffer"
        elif len(self.mode_manager) and loaded.owner[0] != self.run_id:
            problem = "was not saved by this model: its modes are others"
        elif previous is not None and not same_selection(loaded.features.selection, previous.features.selection):
            problem = f"was filled with mode_features={loaded.features.selection}, not {previous.features.selection}"
        if problem is not None:
            self.replay_buffer = previous
            raise ValueError(f"The replay buffer {path} {problem}")
        manager = self.mode_manager
        if previous is not None and loaded.adopt_settings(previous):
            self.bonus.forget_routes()
        numbers = manager.numbers
        if loaded.owner != (self.run_id, numbers):
            loaded.follow_modes([numbers.index(each) if each in numbers else NO_MODE for each in loaded.owner[1]], numbers)
            # A mode that the file knows must not lend its number to another one
            manager.next_number = max([manager.next_number, *(number + 1 for number in loaded.owner[1])])
        manager.hold(manager.modes, loaded, self.scheduler)
        self.bonus.recall_episodes(loaded)
        if truncate_last_traj:
            self._last_obs = None
