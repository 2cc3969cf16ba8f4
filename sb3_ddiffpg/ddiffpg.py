"""Deep Diffusion Policy Gradient: the algorithm."""

import contextlib
import io
import pathlib
from collections import defaultdict
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_ddiffpg.actor_critic import NoveltyActorCritic
from sb3_ddiffpg.behavior import EXPLORATORY_GROUP, Behavior
from sb3_ddiffpg.buffers import ModeBatch, ModeReplayBuffer
from sb3_ddiffpg.callbacks import ClusteringCallback, contains_clustering
from sb3_ddiffpg.cuda_graphs import GraphedFunction
from sb3_ddiffpg.features import same_selection
from sb3_ddiffpg.history import ModeEvent, ModeHistory
from sb3_ddiffpg.intrinsic import KnownPlaces
from sb3_ddiffpg.mode_control import ModeControl
from sb3_ddiffpg.modes import Mode, ModeTable, Outcome, default_name, modes_from_state, modes_state
from sb3_ddiffpg.policies import DiffusionActor, DiffusionPolicy
from sb3_ddiffpg.safe_files import Count
from sb3_ddiffpg.target_actions import ascend
from sb3_ddiffpg.trajectories import NO_MODE
from sb3_ddiffpg.validation import check_mode_arguments

SelfDDiffPG = TypeVar("SelfDDiffPG", bound="DDiffPG")


# Of the exploratory group's batch, from trajectories that took a new way: among all transitions these are too few to be met
NEW_WAY_SHARE = 0.25
# A mode that succeeds this often, when it is commanded, needs no explorers any more
ABLE = 0.5


class DDiffPG(ModeControl, NoveltyActorCritic):
    """
    Deep Diffusion Policy Gradient (DDiffPG): learns several ways to solve one task.

    Paper: https://arxiv.org/abs/2406.00681 (Li et al., NeurIPS 2024). How this implementation differs from it is listed in
    ``docs/ddiffpg.md``. The defaults suit a laptop; the paper's own numbers are in ``zoo_hyperparams/ddiffpg.yml``.

    :param policy: ``"DiffusionPolicy"``, ``"MlpPolicy"`` (the same), ``"MultiInputPolicy"`` (dict observations) or a class
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
    :param n_steps: Not supported: see ``mode_n_steps`` and ``exploration_n_steps``
    :param qf_learning_rate: Learning rate of the critics, like ``learning_rate``; the same as it when None
    :param n_diffusion_steps: Number of diffusion steps T
    :param action_lr: Step size eta of the ascent on target actions
    :param n_action_gradient_steps: Number of ascent steps K per update
    :param action_optimizer: ``"adam"``, ``"normalized"`` or ``"sgd"`` (the paper's equation), see ``target_actions.ascend``
    :param n_critics: Critics per mode, the minimum over them is used
    :param n_atoms: Atoms of the critics' value distribution (C51); 1 for scalar critics
    :param twin_target: ``"lower_mean"``: the twins learn from the distribution of the one with the lower mean;
        ``"elementwise"``: from the minimum of their distributions, atom by atom, as in the authors' code
    :param v_min: Lower end of the values' support
    :param v_max: Upper end of the support of the modes' critics
    :param exploration_v_max: Upper end of the support of the exploratory critics (the lower end is 0); None: what novelty can
        be worth at most, ``intrinsic_clip * intrinsic_coef / (1 - exploration_gamma)``, or ``v_max`` if that is more
    :param reward_scale: Factor on the environment's reward
    :param mode_n_steps: Length of the multi-step returns of the modes' critics (uncorrected)
    :param exploration_n_steps: The same for the exploratory critics
    :param exploration_gamma: Discount factor of the exploratory critics; None: ``gamma``
    :param target_policy_noise: Standard deviation of the noise on the actions in the Bellman target
    :param target_noise_clip: Limit of that noise
    :param backup_embedding: What the policy in a mode's Bellman target is conditioned on: ``"mode"``, its own embedding, or
        ``"masked"``, the same embedding masked as in the policy's training
    :param recluster_freq: Rollouts between two re-clusterings
    :param distance_threshold: Distance (in units of the mode features) above which two groups of trajectories are
        different modes; None: an automatic rule
    :param linkage: Linkage of the hierarchical clustering, as in ``scipy.cluster.hierarchy.linkage``
    :param max_modes: Most modes at a time; 1 turns clustering off
    :param min_mode_size: Fewest goal-reached trajectories that make a mode
    :param mode_patience: Re-clusterings in a row that must find a mode within another before it is merged
    :param mode_trials: Commanded training episodes in a row that must miss a mode's route before it is retired
    :param min_return_ratio: Least mean return of a mode's goal-reached trajectories, as a share of the best mode's
    :param max_successes_per_mode: Newest goal-reached trajectories that train a mode
    :param max_failures_per_mode: Newest failed trajectories that train a mode
    :param mode_embedding_dim: Size of a mode embedding
    :param mode_mask_prob: Probability p with which a mode's embedding is masked when the policy is trained
    :param mode_features: In which part of the observation modes differ: indices, a key, or a callable on batches of
        observations. None: what the environment declares as ``mode_features``, ``achieved_goal`` of a dict observation,
        else the whole observation, standardised
    :param success_key: Key of ``info`` that marks a success, see ``ModeReplayBuffer``
    :param exploration_share: Share of episodes that explore, a float or a function of the remaining progress. None:
        ``1 / (M + 1)`` until ``exploration_fraction`` of the training, then 0; always 1 while there is no mode. While it is
        0, no further mode is born
    :param exploration_fraction: Part of the training that explores, when ``exploration_share`` is None
    :param explore_then_exploit: Share of the exploring episodes that hand over to a mode or the zero embedding after a random
        time (on average the modes' mean length), so that they come to a goal by a way that no mode would have taken
    :param switch_modes: Share of the episodes that follow a mode and go on with another one after such a time, so that a mode
        learns to come back from where others lead, which a ``Replanner`` asks of it
    :param explore_beyond_goals: Whether a goal does not end the exploratory critics' returns: novelty is not episodic
        (Burda et al., 2018, section 2.3), and explorers would keep away from where it ends
    :param novelty: ``"rnd"``, ``"counts"``, or a class with the methods of ``RandomNetworkDistillation``
    :param novelty_kwargs: Further keyword arguments of the novelty measure; the ``cell_size`` of ``"counts"`` is what the
        environment declares as ``novelty_cell_size``, else 0.5, if none is given
    :param novelty_scale: The factor alpha of NovelD
    :param intrinsic_coef: Factor c on the intrinsic reward
    :param mode_intrinsic_coef: Factor on the intrinsic reward that is added to the modes' rewards
    :param new_way_coef: Factor on the environment's reward that the exploratory critics get for goals reached by ways that are
        in no mode, or in one that has not its fill of trajectories yet: a second way is worth finding where the first pays
    :param normalize_intrinsic: Whether the intrinsic reward is divided by its running standard deviation
    :param intrinsic_clip: What one place is worth at most, in these deviations: a low limit hides a rare place behind others
    :param episodic_novelty: Whether a place pays only when it is reached for the first time in an episode (Zhang et al., 2021,
        section 3): otherwise explorers stand where fewest have been
    :param explore_off_modes: Whether explorers are paid nothing for places where the trajectories of the modes go that reach
        the goal in half of their episodes, so that another way pays where it leaves the known ones, not only where it ends
    :param explore_past_modes: Whether what lies past such a mode's way is worth anything to an explorer that came along it. If
        not, its visits there do not count either (nor earlier ones, with ``"counts"``): what is new by another way stays new.
        That hinders ways that go on from the end of a known one
    :param reset_new_critics: Whether the critics of a mode without parent start with a zeroed output layer, or are plain
        copies of the exploratory ones
    :param max_grad_norm: Largest gradient norm of the policy and of each mode's critics
    :param control: For comparison only, one of ``CONTROLS``: ``"shuffled_embeddings"`` (each row of a mode is learnt with a
        mode's embedding, but anyone's), ``"random_clusters"`` (as many clusters of the same sizes, but of any trajectories)
    :param stats_window_size: Window size for the rollout logging
    :param tensorboard_log: The log location for tensorboard (if None, no logging)
    :param policy_kwargs: Additional arguments of the policy, see ``DiffusionPolicy``
    :param verbose: 0: no output, 1: info messages and what became of the modes, 2: debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device on which the code should run; "auto" uses the GPU if possible
    :param _init_setup_model: Whether to build the networks at the creation of the instance
    :raises ValueError: If an argument is out of its range, naming it
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "DiffusionPolicy": DiffusionPolicy,
        "MlpPolicy": DiffusionPolicy,
        "MultiInputPolicy": DiffusionPolicy,
    }
    policy: DiffusionPolicy
    actor: DiffusionActor
    replay_buffer: ModeReplayBuffer
    _first_group = ("exploratory critics", "exploration_v_max", "intrinsic_coef")
    _counters: ClassVar[dict[str, Any]] = {"n_rollouts": Count, "_next_mode_number": Count}

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
        n_steps: int = 1,
        qf_learning_rate: float | Schedule | None = None,
        n_diffusion_steps: int = 5,
        action_lr: float = 0.3,
        n_action_gradient_steps: int = 1,
        action_optimizer: str = "adam",
        n_critics: int = 2,
        n_atoms: int = 51,
        twin_target: str = "lower_mean",
        v_min: float = 0.0,
        v_max: float = 5.0,
        exploration_v_max: float | None = None,
        reward_scale: float = 1.0,
        mode_n_steps: int = 5,
        exploration_n_steps: int = 1,
        exploration_gamma: float | None = None,
        target_policy_noise: float = 0.8,
        target_noise_clip: float = 0.2,
        backup_embedding: str = "mode",
        recluster_freq: int = 25,
        distance_threshold: float | None = None,
        linkage: str = "average",
        max_modes: int = 10,
        min_mode_size: int = 5,
        mode_patience: int = 10,
        mode_trials: int = 200,
        min_return_ratio: float = 0.0,
        max_successes_per_mode: int = 40,
        max_failures_per_mode: int = 20,
        mode_embedding_dim: int = 5,
        mode_mask_prob: float = 0.5,
        mode_features: Any = None,
        success_key: str | None = None,
        exploration_share: float | Schedule | None = None,
        exploration_fraction: float = 0.7,
        explore_then_exploit: float = 0.5,
        switch_modes: float = 0.0,
        explore_beyond_goals: bool = True,
        novelty: str | type = "counts",
        novelty_kwargs: dict[str, Any] | None = None,
        novelty_scale: float = 0.5,
        intrinsic_coef: float = 0.05,
        mode_intrinsic_coef: float = 0.0,
        new_way_coef: float = 0.0,
        normalize_intrinsic: bool = True,
        intrinsic_clip: float = 10.0,
        episodic_novelty: bool = True,
        explore_off_modes: bool = True,
        explore_past_modes: bool = True,
        reset_new_critics: bool = True,
        max_grad_norm: float = 1.0,
        control: str | None = None,
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
            n_steps=n_steps,
            qf_learning_rate=qf_learning_rate,
            n_critics=n_critics,
            n_atoms=n_atoms,
            twin_target=twin_target,
            v_min=v_min,
            v_max=v_max,
            reward_scale=reward_scale,
            target_policy_noise=target_policy_noise,
            target_noise_clip=target_noise_clip,
            mode_features=mode_features,
            success_key=success_key,
            novelty=novelty,
            novelty_kwargs=novelty_kwargs,
            novelty_scale=novelty_scale,
            intrinsic_coef=intrinsic_coef,
            normalize_intrinsic=normalize_intrinsic,
            intrinsic_clip=intrinsic_clip,
            episodic_novelty=episodic_novelty,
            max_grad_norm=max_grad_norm,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.n_diffusion_steps = n_diffusion_steps
        self.action_lr = action_lr
        self.n_action_gradient_steps = n_action_gradient_steps
        self.action_optimizer = action_optimizer
        self.exploration_v_max = exploration_v_max
        self.mode_n_steps = mode_n_steps
        self.exploration_n_steps = exploration_n_steps
        self.exploration_gamma = exploration_gamma
        self.backup_embedding = backup_embedding
        self.recluster_freq = recluster_freq
        self.distance_threshold = distance_threshold
        self.linkage = linkage
        self.max_modes = max_modes
        self.min_mode_size = min_mode_size
        self.mode_patience = mode_patience
        self.mode_trials = mode_trials
        self.min_return_ratio = min_return_ratio
        self.max_successes_per_mode = max_successes_per_mode
        self.max_failures_per_mode = max_failures_per_mode
        self.mode_embedding_dim = mode_embedding_dim
        self.mode_mask_prob = mode_mask_prob
        self.exploration_share = exploration_share
        self.exploration_fraction = exploration_fraction
        self.explore_then_exploit = explore_then_exploit
        self.switch_modes = switch_modes
        self.explore_beyond_goals = explore_beyond_goals
        self.explore_off_modes = explore_off_modes
        self.explore_past_modes = explore_past_modes
        self.mode_intrinsic_coef = mode_intrinsic_coef
        self.new_way_coef = new_way_coef
        self.reset_new_critics = reset_new_critics
        self.control = control

        # What a run remembers beside its networks; all of it is saved
        self.n_rollouts = 0
        self._modes: list[Mode] = []
        self._next_mode_number = 0
        self.mode_history = ModeHistory()
        self._behavior = Behavior(0)

        if _init_setup_model:
            self._setup_model()

    # ------------------------------------------------------------------ set-up

    def _policy_arguments(self) -> dict[str, Any]:
        return {
            **super()._policy_arguments(),
            "n_modes": len(self._modes),
            "n_diffusion_steps": self.n_diffusion_steps,
            "mode_embedding_dim": self.mode_embedding_dim,
            "exploration_support": (0.0, self._exploration_v_max()),
        }

    def _exploration_v_max(self) -> float:
        if self.exploration_v_max is not None:
            return self.exploration_v_max
        return max(self.v_max, self.intrinsic_clip * self.intrinsic_coef / max(1 - self._exploration_gamma(), 1e-4))

    def _exploration_gamma(self) -> float:
        return self.gamma if self.exploration_gamma is None else self.exploration_gamma

    def _buffer_arguments(self) -> dict[str, Any]:
        return {
            **super()._buffer_arguments(),
            "max_successes_per_mode": self.max_successes_per_mode,
            "max_failures_per_mode": self.max_failures_per_mode,
            "explore_beyond_goals": self.explore_beyond_goals,
            "new_way_share": NEW_WAY_SHARE if self.new_way_coef else 0.0,
        }

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_mode_arguments(self)

    def _setup_model(self) -> None:
        super()._setup_model()
        self.known_places = KnownPlaces(self._visit_cell_size()).to(self.device)
        dim = self.replay_buffer.features.dim
        if any(mode.representative.shape[1] not in (0, dim) for mode in self._modes):  # of a file
            raise ValueError(f"modes.representative: accepted are positions of {dim} components")
        self.replay_buffer.expect_modes(len(self._modes))

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.graphs["ascent"] = GraphedFunction(self._ascend, self.policy)
        self.graphs["policy"] = GraphedFunction(self._policy_gradients, self.policy, self.actor.optimizer)

    def _resolve_mode_features(self) -> None:
        before = self._resolved_features
        super()._resolve_mode_features()
        if self._modes and not same_selection(before, self._resolved_features):
            raise ValueError(f"mode_features={self._resolved_features}: the modes of this model were found in {before}")

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        Algorithm 1 of the paper, lines 9 to 21.

        :param gradient_steps: Number of updates
        :param batch_size: Transitions per update, over all groups
        """
        self._begin_updates()
        metrics: dict[str, list[th.Tensor]] = defaultdict(list)
        for _ in range(gradient_steps):
            # Sample one batch per mode, and one for the exploratory group
            batch = self._sample_modes(batch_size)
            rewards = self._rewards(batch, metrics)
            # Update each critic with the Bellman equation on its own batch
            self._update_critics(batch, rewards, metrics)
            # Gradient ascent on the target actions, which return to the buffer
            target_actions = self._improve_target_actions(batch)
            metrics["target_action_shift"].append((target_actions - batch.target_actions).abs().mean())
            # Concatenate all batches and update the diffusion policy
            metrics["actor_loss"].append(self._update_policy(batch, target_actions))
            self._update_targets()
        self._end_updates(gradient_steps, metrics)

    def _sample_modes(self, batch_size: int) -> ModeBatch:
        return self.replay_buffer.sample_modes(
            batch_size,
            self.gamma,
            self.exploration_n_steps,
            self.mode_n_steps,
            env=self._vec_normalize_env,
            exploration_gamma=self.exploration_gamma,
        )

    def _critic_names(self) -> list[str]:
        return ["exploratory critics", *(f"critics of {mode.name!r}" for mode in self._modes)]

    def _rewards(self, batch: ModeBatch, metrics: dict[str, list[th.Tensor]]) -> th.Tensor:
        """Intrinsic reward for the exploratory group, the environment's (and some intrinsic) for the modes, [G, n]."""
        everywhere = self.mode_intrinsic_coef != 0.0
        windows = batch.windows if everywhere else batch.windows[:1, :, : self.exploration_n_steps]
        intrinsic = self._intrinsic_rewards(windows, metrics)
        rewards = self.reward_scale * batch.rewards
        if everywhere:
            rewards = rewards + self.mode_intrinsic_coef * intrinsic
        rewards[EXPLORATORY_GROUP] = intrinsic[EXPLORATORY_GROUP] + self.new_way_coef * self.reward_scale * batch.new_ways
        return rewards

    def _pays(self, windows: np.ndarray, present: np.ndarray, positions: th.Tensor) -> th.Tensor:
        pays = super()._pays(windows, present, positions)
        if not self._modes:
            return pays
        explores = np.nonzero(present)[0] == EXPLORATORY_GROUP
        if self.replay_buffer.known_ways.ways:
            past = th.from_numpy(explores & self.replay_buffer.past_known_ways(windows[present]))
            pays = pays & ~past.to(self.device, non_blocking=True)
        if self.explore_off_modes:
            # What a mode knows is not new, or explorers would follow it to what lies beyond
            there = th.from_numpy(explores).to(self.device, non_blocking=True)
            pays = pays & ~(there & self.known_places.contain(positions))
        return pays

    def recluster(self) -> list[ModeEvent]:
        """
        See ``ModeControl``. From now on the places are known where the trajectories of those modes go that know their way.

        :return: What happened: births, splits, merges and retirements
        """
        events = super().recluster()
        # What a young mode cannot do yet, explorers must go on with
        able = [index for index, mode in enumerate(self._modes) if mode.success_rate >= ABLE]
        if self.explore_off_modes:
            self.known_places.replace(self.replay_buffer.places_of(able))
        watched = [] if self.explore_past_modes else able
        uncounted = self.replay_buffer.watch_ways({index: self._modes[index].number for index in watched})
        if len(uncounted) and hasattr(self.novelty_model, "forget"):
            for rows in np.array_split(uncounted, -(-len(uncounted) // 50_000)):
                reached = self.replay_buffer.read_observations(rows)[1]
                self.novelty_model.forget(self.replay_buffer.features.of_tensors(reached))
        return events

    def _row_embeddings(self, batch: ModeBatch, masked: bool) -> th.Tensor:
        """Embedding of every row's group, [G * n, mode_embedding_dim]; masked with probability p, exploration never."""
        n_groups, n = batch.rows.shape
        embeddings = self.policy.mode_embeddings[:, None].expand(-1, n, -1)
        if self.control == "shuffled_embeddings":
            owners = th.randperm((n_groups - 1) * n, device=self.device)
            embeddings = th.cat((embeddings[:1], embeddings[1:].flatten(0, 1)[owners].view_as(embeddings[1:])))
        if masked:
            keep = (th.rand(n_groups, n, 1, device=self.device) >= self.mode_mask_prob).to(embeddings.dtype)
            keep[EXPLORATORY_GROUP] = 1.0
            embeddings = embeddings * keep
        return embeddings.reshape(n_groups * n, -1)

    def _next_actions(self, batch: ModeBatch) -> tuple[th.Tensor, th.Tensor | float]:
        embeddings = self._row_embeddings(batch, masked=self.backup_embedding == "masked")
        return self.actor(batch.next_observations, embeddings=embeddings), 0.0

    def _ascend(self, batch: ModeBatch) -> th.Tensor:
        with th.no_grad():
            features = self.policy.critic_features(batch.observations)
        return ascend(
            self.policy.critics.action_gradient(features),
            batch.target_actions,
            learning_rate=self.action_lr,
            n_steps=self.n_action_gradient_steps,
            optimizer=self.action_optimizer,
        )

    def _update_policy(self, batch: ModeBatch, target_actions: th.Tensor) -> th.Tensor:
        loss, norm = self.graphs["policy"](batch, target_actions)
        self.divergence_watch.step(["actor"], self.actor.optimizer, loss, norm)
        return loss

    def _policy_gradients(self, batch: ModeBatch, target_actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The denoising loss and the norm of its gradient, which is left, clipped, at the actor."""
        condition = self.actor.condition(batch.observations, self._row_embeddings(batch, masked=True))
        weights = batch.imitated.flatten().float()
        loss = self.actor.diffusion.loss(target_actions.flatten(0, 1), condition, weights=weights)
        self.actor.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = th.nn.utils.clip_grad_norm_(self.actor.parameters(), self.max_grad_norm)
        return loss.detach(), norm

    # ------------------------------------------------------------------ acting

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        mode: str | int | list[str | int] | np.ndarray | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Actions for one observation or a batch of them.

        :param observation: The observation(s)
        :param state: What the previous call returned: the mode that every environment follows
        :param episode_start: Which environments begin an episode
        :param deterministic: Zero initial latent and no sampling noise: the same call returns the same action
        :param mode: Name or index of the mode to follow, or one for each observation. None: a mode is drawn for each episode
            and kept through it by ``state`` and ``episode_start``; without those, the zero embedding, which leaves the
            choice to the policy at every step
        :return: The actions and the state for the next call
        :raises ValueError: If there is no such mode
        """
        indices: int | np.ndarray | None = None
        if mode is not None:
            table = ModeTable(self._modes)
            single = np.ndim(mode) == 0
            if not single and len(mode) == 0:  # type: ignore[arg-type]
                raise ValueError(f"mode={mode!r} is unknown: it names no mode")
            indices = table.index(mode) if single else np.array([table.index(each) for each in mode])  # type: ignore[arg-type, union-attr]
        return self.policy.predict(observation, state, episode_start, deterministic, mode=indices)

    def state_values(self, observation: np.ndarray | dict[str, np.ndarray], n_actions: int = 8) -> np.ndarray:
        """
        See ``NoveltyActorCritic``: what the best mode expects; where there is none yet, what exploration does.

        :param observation: A batch of N observations
        :param n_actions: Actions drawn for each mode
        :return: Shape [N]
        """
        self.policy.set_training_mode(False)
        values = self.policy.group_values(self.policy.obs_to_tensor(observation)[0], n_actions)
        return (values[1:].amax(dim=0) if len(self.modes) else values[EXPLORATORY_GROUP]).cpu().numpy()

    def _training_actions(self) -> np.ndarray:
        lengths = [mode.mean_length for mode in self._modes if mode.n_trajectories]
        if lengths:
            # On average after the time that a mode needs for all of its way
            self._behavior.hand_over(len(self._modes), 1 / float(np.mean(lengths)))
        return self.policy.predict(self._last_obs, group=self._behavior.groups)[0]  # type: ignore[arg-type]

    def _exploration_share(self) -> float:
        if self.num_timesteps < self.learning_starts:
            return 1.0  # random actions are no mode's doing
        progress_remaining = self._current_progress_remaining
        if self.exploration_share is None:
            return 1 / (len(self._modes) + 1) if 1 - progress_remaining < self.exploration_fraction else 0.0
        return float(FloatSchedule(self.exploration_share)(progress_remaining))

    def _shares(self) -> tuple[float, float, float]:
        """Of episodes that explore, that hand over when they do, and that change their mode."""
        return self._exploration_share(), self.explore_then_exploit, self.switch_modes

    def _store_transition(self, replay_buffer: ModeReplayBuffer, *args: Any, **kwargs: Any) -> None:  # type: ignore[override]
        super()._store_transition(replay_buffer, *args, **kwargs)
        for env, trajectory in replay_buffer.just_finished:
            told = self._behavior.told_mode(env)
            trajectory.commanded = None if told is None else self._modes[told].number
            mode = self._behavior.commanded_mode(env)
            if mode is not None:
                self._modes[mode].outcomes.append(Outcome(trajectory.success, trajectory.episode_return, trajectory.length))
                self._modes[mode].unjudged += 1
            self._behavior.begin(env, len(self._modes), *self._shares())

    # ------------------------------------------------------------------ a run's beginning

    def _begin_episodes(self) -> None:
        self._behavior.begin_all(self.n_envs, len(self._modes), *self._shares())

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        callbacks = callback if isinstance(callback, list) else [callback]
        callbacks = [each if isinstance(each, BaseCallback) else ConvertCallback(each) for each in callbacks]
        if not any(contains_clustering(each) for each in callbacks):
            # First, so that the others see fresh modes
            callbacks.insert(0, ClusteringCallback())
        return super()._init_callback(callbacks, progress_bar)

    # ------------------------------------------------------------------ saving

    def _only_to_train(self) -> list[str]:
        return [*super()._only_to_train(), "known_places"]

    def state_tree(self) -> dict[str, Any]:
        """
        :return: See ``NoveltyActorCritic``; and the modes
        """
        modes = {"modes": modes_state(self._modes), "history": self.mode_history.state_dict()}
        return {**super().state_tree(), **modes}

    def load_state_tree(self, tree: Any) -> None:
        """
        :param tree: What ``state_tree`` gave
        :raises ValueError: If it is something else
        """
        super().load_state_tree(tree)
        self._modes = modes_from_state(tree.get("modes"))
        self.mode_history = ModeHistory.from_state(tree.get("history"))
        if any(mode.number >= self._next_mode_number for mode in self._modes):
            raise ValueError(f"model.state: a mode has a number that is not below {self._next_mode_number}, the next one's")

    def episodes_tree(self) -> dict[str, Any]:
        """
        :return: Which group drives which environment
        """
        return self._behavior.state_dict()

    def load_episodes_tree(self, tree: dict[str, Any]) -> None:
        """
        :param tree: What ``episodes_tree`` gave
        :raises ValueError: If it is something else
        """
        self._behavior.load_state_dict(tree, self.n_envs, len(self._modes))

    def _set_parameters(self, parameters: Any, exact_match: bool, device: th.device | str) -> None:
        """The number of modes follows; if it changes, nobody knows which modes these are: they get new names and wait."""
        policy = parameters.get("policy", {})
        n_modes = len(policy["mode_embeddings"]) - 1 if "mode_embeddings" in policy else len(self._modes)
        # What does not fit is refused by SB3; it must not cost the modes before that
        complete = not exact_match or set(parameters) == set(self._get_torch_save_params()[0])
        if n_modes != len(self._modes) and complete and self.policy.fits_but_for_modes(policy):
            self._expect_unknown_modes(n_modes)
        super()._set_parameters(parameters, exact_match, device)

    def _expect_unknown_modes(self, n_modes: int) -> None:
        self.policy.resize(n_modes)
        numbers = range(self._next_mode_number, self._next_mode_number + n_modes)
        self._hold([Mode(number, default_name(number), born_at=self.lifetime_steps) for number in numbers])
        self.replay_buffer.expect_modes(n_modes)

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer with its trajectories, clusters, target actions and distances.

        :param path: Path to the file
        """
        self.replay_buffer.owner = self.run_id, [mode.number for mode in self._modes]
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
        elif self._modes and loaded.owner[0] != self.run_id:
            problem = "was not saved by this model: its modes are others"
        elif previous is not None and not same_selection(loaded.features.selection, previous.features.selection):
            problem = f"was filled with mode_features={loaded.features.selection}, not {previous.features.selection}"
        if problem is not None:
            self.replay_buffer = previous
            raise ValueError(f"The replay buffer {path} {problem}")
        if previous is not None:
            loaded.adopt_settings(previous)
        numbers = [mode.number for mode in self._modes]
        if loaded.owner != (self.run_id, numbers):
            loaded.follow_modes([numbers.index(each) if each in numbers else NO_MODE for each in loaded.owner[1]], numbers)
            # A mode that the file knows must not lend its number to another one
            self._next_mode_number = max([self._next_mode_number, *(number + 1 for number in loaded.owner[1])])
        self._hold(self._modes)
        if truncate_last_traj:
            self._last_obs = None
