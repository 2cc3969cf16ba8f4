"""Reparameterised policy gradient: a policy with a latent variable, improved through a model of the task."""

import copy
from collections import defaultdict
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    create_mlp,
    get_actor_critic_arch,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.nn import functional as F

from sb3_ddiffpg.actor_critic import CUT_VALUES
from sb3_ddiffpg.baselines.baseline import FifoReplayBuffer, names_of
from sb3_ddiffpg.baselines.entropy_tuning import EntropyTuning
from sb3_ddiffpg.baselines.sac_c51 import GaussianActor
from sb3_ddiffpg.baselines.world_model import WorldModel
from sb3_ddiffpg.policy_parts import SavablePolicy, average_networks
from sb3_ddiffpg.safe_files import Count, check_array, convert
from sb3_ddiffpg.twin_critic_policy import default_extractor


class LatentActor(GaussianActor):
    """
    Squashed Gaussian actor that sees a latent state and the episode's latent variable.

    :param observation_space: Observation space
    :param action_space: Action space
    :param features_extractor: Features of an observation; the actor itself does not look at them
    :param features_dim: Their number
    :param input_dim: Size of a latent state and the variable together
    :param net_arch: Hidden layers
    :param kwargs: Of ``GaussianActor``
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_extractor: nn.Module,
        features_dim: int,
        input_dim: int,
        net_arch: list[int],
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, input_dim, net_arch, features_extractor=features_extractor, **kwargs)
        self.features_dim = features_dim


class LatentInference(nn.Module):
    """
    Which latent variable an action in a state speaks of: a Gaussian q(z | s, a).

    :param input_dim: Size of a latent state and an action together
    :param latent_dim: Size Z of the variable
    :param net_arch: Hidden layers
    :param activation_fn: Their activation
    """

    def __init__(self, input_dim: int, latent_dim: int, net_arch: list[int], activation_fn: type[nn.Module]) -> None:
        super().__init__()
        self.net = nn.Sequential(*create_mlp(input_dim, 2 * latent_dim, net_arch, activation_fn))

    def log_ratio(self, states: th.Tensor, actions: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """
        :param states: Latent states, [N, L]
        :param actions: [N, A]
        :param latents: Values of the variable, [N, Z]
        :return: log q(z | s, a) - log p(z), [N]: what was learned about z
        """
        mean, log_std = self.net(th.cat((states, actions), dim=1)).chunk(2, dim=1)
        log_std = log_std.clamp(-5.0, 2.0)
        posterior = th.distributions.Normal(mean, log_std.exp(), validate_args=False)
        prior = th.distributions.Normal(th.zeros_like(mean), 1.0, validate_args=False)
        return (posterior.log_prob(latents) - prior.log_prob(latents)).sum(dim=1)


class RPGPolicy(SavablePolicy):
    """
    An actor pi(a | s, z), the model in which it is improved, and the inference of z.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate of the actor
    :param net_arch: Hidden layers, a list or ``dict(pi=[...], qf=[...])``; ``qf`` are the model's
    :param activation_fn: Activation of all networks
    :param features_extractor_class: Features extractor; when None, observations are flattened, and those of a dict combined
    :param features_extractor_kwargs: Its keyword arguments
    :param normalize_images: Whether images are divided by 255
    :param optimizer_class: Optimiser of all networks
    :param optimizer_kwargs: Its keyword arguments, without the learning rate
    :param state_dim: Size L of a latent state
    :param latent_dim: Size Z of the latent variable
    :param n_critics: Values for each state
    :param support: Lower and upper end of the values
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ELU,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        state_dim: int = 100,
        latent_dim: int = 12,
        n_critics: int = 2,
        support: tuple[float, float] = (0.0, 5.0),
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class or default_extractor(observation_space),
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            normalize_images=normalize_images,
        )
        self._constructor = dict(
            net_arch=net_arch,
            activation_fn=activation_fn,
            state_dim=state_dim,
            latent_dim=latent_dim,
            n_critics=n_critics,
            support=support,
        )
        self.latent_dim = latent_dim
        actor_arch, model_arch = get_actor_critic_arch([128, 128] if net_arch is None else net_arch)
        action_dim = int(np.prod(action_space.shape))
        extractor = self.make_features_extractor()
        self.model = WorldModel(
            extractor,
            extractor.features_dim,
            action_dim,
            latent_dim,
            model_arch,
            state_dim,
            activation_fn,
            n_critics,
            support,
        )
        self.model_target = copy.deepcopy(self.model)
        self.model_target.train(False)
        self.model_target.requires_grad_(False)
        self.actor = LatentActor(
            observation_space,
            action_space,
            self.make_features_extractor(),
            extractor.features_dim,
            state_dim + latent_dim,
            actor_arch,
            activation_fn=activation_fn,
            normalize_images=normalize_images,
        )
        self.inference = LatentInference(state_dim + action_dim, latent_dim, model_arch, activation_fn)
        # Tuned by the algorithm
        self.log_entropy_coef = nn.Parameter(th.zeros(()))
        learnt = [*self.actor.latent.parameters(), *self.inference.parameters()]
        self.actor.optimizer = self.make_optimizer(learnt, lr_schedule(1))
        self.critics.optimizer = self.make_optimizer(self.model.parameters(), lr_schedule(1))
        self._latents_in_use: th.Tensor | None = None

    @property
    def critics(self) -> Any:
        """The model's values; their optimiser is that of the whole model."""
        return self.model.critics

    def encode(self, obs: PyTorchObs, target: bool = False) -> th.Tensor:
        """
        :param obs: Observations, [N, ...]
        :param target: By the target model
        :return: Latent states, [N, L]
        """
        model = self.model_target if target else self.model
        return model.encoder(self.extract_features(obs, model.features_extractor))

    def draw_latents(self, n: int) -> th.Tensor:
        """
        :param n: How many
        :return: Latent variables from their prior, [n, Z]
        """
        return th.randn(n, self.latent_dim, device=self.device)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        states = self.encode(observation)
        latents = self._latents_in_use
        if latents is None:
            latents = states.new_zeros(len(states), self.latent_dim) if deterministic else self.draw_latents(len(states))
        return self.actor.sample_from(th.cat((states, latents), dim=1), deterministic)[0]

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        latents: np.ndarray | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        :param observation: The observation(s)
        :param state: What the previous call returned: the latent variable of every environment's episode
        :param episode_start: Which environments begin an episode and so draw a new one
        :param deterministic: The mean action; without ``state`` and ``episode_start`` also the latent variable's mean
        :param latents: The latent variables to follow, [Z] or [N, Z]; they are drawn when None
        :return: The actions and the state for the next call
        """
        if latents is not None:
            latents = np.atleast_2d(np.asarray(latents, dtype=np.float32))
        elif state is not None or episode_start is not None:
            latents = self.draw_latents(len(state[0] if episode_start is None else np.atleast_1d(episode_start))).cpu().numpy()  # type: ignore[index]
            if state is not None:
                starts = False if episode_start is None else np.atleast_1d(episode_start).astype(bool)[:, None]
                latents = np.where(starts, latents, state[0])
        if latents is not None:
            n_obs = self.obs_to_tensor(observation)[0]
            n_rows = len(next(iter(n_obs.values())) if isinstance(n_obs, dict) else n_obs)
            if latents.shape not in ((1, self.latent_dim), (n_rows, self.latent_dim)):
                raise ValueError(f"latents must be of shape [{n_rows}, {self.latent_dim}], got {list(latents.shape)}")
            latents = np.broadcast_to(latents, (n_rows, self.latent_dim)).copy()
            state = (latents,)
            self._latents_in_use = th.from_numpy(latents).to(self.device)
        try:
            return super().predict(observation, state, episode_start, deterministic)
        finally:
            self._latents_in_use = None

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: True for training, False for evaluation (dropout, batch norm of the extractors)
        """
        self.actor.set_training_mode(mode)
        self.model.train(mode)
        self.inference.train(mode)
        self.training = mode


@dataclass
class Segments:
    """
    Consecutive steps of B episodes, at most H each.

    :param observations: Where they begin, [B, ...]
    :param actions: Shape [B, H, A]
    :param next_observations: Shape [B * H, ...]
    :param rewards: Scaled, and what was new, [B, H]
    :param ended: Whether the episode ended there, [B, H]
    :param present: 0 beyond a segment's end, [B, H]
    """

    observations: Any
    actions: th.Tensor
    next_observations: Any
    rewards: th.Tensor
    ended: th.Tensor
    present: th.Tensor


class RPG(EntropyTuning):
    """
    Reparameterised policy gradient (Huang et al., 2023, https://arxiv.org/abs/2307.10710): each episode draws a latent
    variable z, which the policy pi(a | s, z) sees. The policy climbs the lambda-return of its own rollouts in a learned model,
    plus the entropy of its actions and what they tell about z, so that different z act differently. Deviations are listed in
    ``docs/baselines.md``.

    :param policy: ``"MlpPolicy"``, ``"MultiInputPolicy"`` (dict observations) or a class
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param n_steps: Steps H of rollouts in the model, and of the segments from which it learns
    :param gae_lambda: Weight lambda of longer returns
    :param latent_dim: Size of the latent variable
    :param latent_coef: Factor of log q(z | s, a) - log p(z) in the reward, a float or a function of the remaining progress
    :param reward_loss_coef: Factor of the reward's squared error in the model's loss
    :param value_loss_coef: Factor of the values' squared error
    :param state_loss_coef: Factor of the latent states' squared error
    :param target_update_interval: Updates between two steps of the target model
    :param entropy_learning_rate: As in ``EntropyTuning``
    :param initial_entropy_coef: As there
    :param tau: As in ``NoveltyActorCritic``
    :param n_atoms: Values are scalar: only 1
    :param kwargs: Of ``EntropyTuning`` and ``NoveltyActorCritic``; there is no Bellman target, so what is said of one has no
        effect
    :raises ValueError: If an argument is out of its range, naming it
    """

    default_replay_buffer_class = FifoReplayBuffer
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = names_of(RPGPolicy)
    _counters: ClassVar[dict[str, Any]] = {"_n_model_updates": Count}
    target_networks: ClassVar[dict[str, str]] = {"model_target": "model"}
    policy: RPGPolicy  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: Any,
        *,
        n_steps: int = 3,
        gae_lambda: float = 0.97,
        latent_dim: int = 12,
        latent_coef: float | Schedule = 0.005,
        reward_loss_coef: float = 10.0,
        value_loss_coef: float = 1.0,
        state_loss_coef: float = 100.0,
        target_update_interval: int = 2,
        entropy_learning_rate: float = 3e-4,
        initial_entropy_coef: float = 0.01,
        tau: float = 0.01,
        n_atoms: int = 1,
        **kwargs: Any,
    ) -> None:
        if n_atoms != 1:
            raise ValueError(f"n_atoms must be 1, RPG's values are scalar, got {n_atoms!r}")
        self.gae_lambda = gae_lambda
        self.latent_dim = latent_dim
        self.latent_coef = latent_coef
        self.reward_loss_coef = reward_loss_coef
        self.value_loss_coef = value_loss_coef
        self.state_loss_coef = state_loss_coef
        self.target_update_interval = target_update_interval
        self._n_model_updates = 0
        self._episode_latents = np.empty((0, 0), dtype=np.float32)
        super().__init__(
            policy,
            env,
            entropy_learning_rate=entropy_learning_rate,
            initial_entropy_coef=initial_entropy_coef,
            n_steps=n_steps,
            tau=tau,
            n_atoms=n_atoms,
            **kwargs,
        )

    # ------------------------------------------------------------------ set-up

    def _policy_arguments(self) -> dict[str, Any]:
        return {"latent_dim": self.latent_dim, "n_critics": self.n_critics, "support": (self.v_min, self.v_max)}

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        :param gradient_steps: Number of updates
        :param batch_size: Segments per update
        """
        self._begin_updates()
        metrics: dict[str, list[th.Tensor]] = defaultdict(list)
        for _ in range(gradient_steps):
            segments = self._sample_segments(batch_size, metrics)
            self._update_model(segments, metrics)
            self._update_policy(segments, metrics)
            self._update_targets()
        self._end_updates(gradient_steps, metrics)

    def _sample_segments(self, batch_size: int, metrics: dict[str, list[th.Tensor]]) -> Segments:
        buffer, env = self.replay_buffer, self._vec_normalize_env
        windows = buffer.sample_modes(batch_size, self.gamma, self.n_steps, 1, env=env).windows[0]  # [B, H]
        present = windows >= 0
        rows = np.where(present, windows, windows[:, :1]).ravel()
        steps = buffer.read(rows, env)
        shape = windows.shape
        intrinsic = self._intrinsic_rewards(windows.reshape(1, -1, 1), metrics)

        def first(part: th.Tensor) -> th.Tensor:
            return part.unflatten(0, shape)[:, 0]

        obs: Any = steps.observations
        return Segments(
            observations={key: first(part) for key, part in obs.items()} if isinstance(obs, dict) else first(obs),
            actions=steps.actions.view(*shape, -1),
            next_observations=steps.next_observations,
            rewards=(self.reward_scale * steps.rewards[:, 0] + intrinsic[0]).view(shape),
            ended=steps.dones.view(shape),
            present=th.from_numpy(present.astype(np.float32)).to(self.device),
        )

    def _imagine(self, model: WorldModel, states: th.Tensor, latents: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Follow the policy through the model.

        :param model: The model, its weights constant
        :param states: Latent states, [N, L]
        :param latents: The latent variables, [N, Z]
        :return: Lambda-returns [N] with the entropy and what is told about z, the actions' log probabilities [N * H], and
            log q(z | s, a) - log p(z) with a gradient for q alone [N * H]
        """
        given = self.latent_coef
        latent_coef = float(given(self._current_progress_remaining) if callable(given) else given)
        rewards, discounts, values, log_probabilities, ratios = [], [], [], [], []
        for _ in range(self.n_steps):
            actions, log_probability = self.actor.sample_from(th.cat((states, latents), dim=1))
            told = self.policy.inference.log_ratio(states, actions, latents)
            ratios.append(self.policy.inference.log_ratio(states.detach(), actions.detach(), latents))
            states, reward, end = model.step(states, actions)
            rewards.append(reward - self.entropy_coef * log_probability + latent_coef * told)
            discounts.append(self.gamma * th.sigmoid(-end))
            values.append(model.values(states, latents).min(dim=0).values)
            log_probabilities.append(log_probability)
        returns = values[-1]
        for reward, discount, value in zip(reversed(rewards), reversed(discounts), reversed(values), strict=True):
            returns = reward + discount * ((1 - self.gae_lambda) * value + self.gae_lambda * returns)
        return returns, th.cat(log_probabilities), th.cat(ratios)

    def _update_model(self, segments: Segments, metrics: dict[str, list[th.Tensor]]) -> None:
        policy, model = self.policy, self.policy.model
        n, horizon = segments.rewards.shape
        latents = policy.draw_latents(n)
        with th.no_grad():
            next_states = policy.encode(segments.next_observations, target=True)
            returns = self._imagine(policy.model_target, next_states, latents.repeat_interleave(horizon, 0))[0]
            metrics[CUT_VALUES].append((returns >= self.v_max).float().mean())
            returns = returns.clamp(self.v_min, self.v_max).view(n, horizon)
            next_states = next_states.view(n, horizon, -1)
        states = policy.encode(segments.observations)
        errors: dict[str, list[th.Tensor]] = defaultdict(list)
        for t in range(horizon):
            states, rewards, ends = model.step(states, segments.actions[:, t])
            goes_on = 1.0 - segments.ended[:, t]
            errors["reward"].append((rewards - segments.rewards[:, t]).pow(2))
            errors["end"].append(F.binary_cross_entropy_with_logits(ends, segments.ended[:, t], reduction="none"))
            errors["state"].append((states - next_states[:, t]).pow(2).mean(dim=1))
            errors["value"].append((model.values(states, latents) - returns[:, t]).pow(2).sum(dim=0) * goes_on)
        means = {
            name: (th.stack(parts, dim=1) * segments.present).sum() / segments.present.sum() for name, parts in errors.items()
        }
        factors = {"reward": self.reward_loss_coef, "state": self.state_loss_coef, "value": self.value_loss_coef, "end": 1.0}
        loss = th.stack([factors[name] * mean for name, mean in means.items()]).sum()
        policy.critics.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = th.nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
        # Rewards that it predicts need not lie within the values' support
        self.divergence_watch.step(["model"], policy.critics.optimizer, loss, norm, bounded=False)
        for name, mean in means.items():
            metrics[f"{name}_loss"].append(mean.detach())

    def _update_policy(self, segments: Segments, metrics: dict[str, list[th.Tensor]]) -> None:
        """Actor, inference of z and the entropy's factor, by rollouts of the policy in the model."""
        policy, model = self.policy, self.policy.model
        with th.no_grad():
            states = policy.encode(segments.observations)
        model.requires_grad_(False)
        returns, log_probabilities, ratios = self._imagine(model, states, policy.draw_latents(len(states)))
        model.requires_grad_(True)
        loss = -returns.mean() - ratios.mean()
        self.actor.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        parts = self.actor, policy.inference
        norms = th.stack([th.nn.utils.clip_grad_norm_(part.parameters(), self.max_grad_norm) for part in parts])
        self.divergence_watch.step(["actor"], self.actor.optimizer, loss, norms.sum(), bounded=False)
        self._tune_entropy(log_probabilities, metrics)
        metrics["actor_loss"].append(-returns.mean().detach())
        metrics["latent_information"].append(ratios.mean().detach())

    def _update_targets(self) -> None:
        self._n_model_updates += 1
        if self._n_model_updates % self.target_update_interval == 0:
            average_networks([self.policy.model], [self.policy.model_target], self.tau)

    # ------------------------------------------------------------------ acting

    def _values_of_drawn_actions(self, obs: Any) -> th.Tensor:
        states = self.policy.encode(obs)  # its values know no action, but a latent variable
        return self.policy.model.values(states, self.policy.draw_latents(len(states))).amin(dim=0)

    def _begin_episodes(self) -> None:
        self._episode_latents = self.policy.draw_latents(self.n_envs).cpu().numpy()

    def _training_actions(self) -> np.ndarray:
        return self.policy.predict(self._last_obs, latents=self._episode_latents)[0]  # type: ignore[arg-type]

    def _store_transition(self, replay_buffer: Any, *args: Any, **kwargs: Any) -> None:
        super()._store_transition(replay_buffer, *args, **kwargs)
        ended = [env for env, _ in replay_buffer.just_finished]
        self._episode_latents[ended] = self.policy.draw_latents(len(ended)).cpu().numpy()

    # ------------------------------------------------------------------ saving

    def episodes_tree(self) -> dict[str, Any]:
        """
        :return: The latent variable of each environment's episode
        """
        return {"latents": self._episode_latents}

    def load_episodes_tree(self, tree: dict[str, Any]) -> None:
        """
        :param tree: What ``episodes_tree`` gave
        :raises ValueError: If it is something else
        """
        latents = convert(tree.get("latents"), np.ndarray, "episodes.latents")
        self._episode_latents = check_array(latents, np.float32, [self.n_envs, self.latent_dim], "episodes.latents").copy()
