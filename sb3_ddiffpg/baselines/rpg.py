"""Reparameterised policy gradient: a policy with a latent variable, improved through a model of the task."""

import contextlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from torch.nn import functional as F

from sb3_ddiffpg.baselines.baseline import FifoReplayBuffer, names_of
from sb3_ddiffpg.baselines.entropy_tuning import EntropyTuning
from sb3_ddiffpg.baselines.rpg_policy import CnnRPGPolicy, RPGPolicy
from sb3_ddiffpg.baselines.world_model import WorldModel
from sb3_ddiffpg.buffers.trajectory import StepRecord
from sb3_ddiffpg.common.actor_critic import CUT_VALUES, Metrics
from sb3_ddiffpg.exploration.settings import NoveltySettings
from sb3_ddiffpg.networks.policies import average_networks
from sb3_ddiffpg.networks.settings import CriticSettings
from sb3_ddiffpg.saving.records import saved_part
from sb3_ddiffpg.serialization.safetensors_tree import Count, check_array, convert
from sb3_ddiffpg.utils.settings import NOT_NEGATIVE, SHARE, Accepted, Settings, at_least, setting


class EpisodeLatents:
    """
    The latent variable of each environment's episode.

    :param n_envs: Number of environments
    :param latent_dim: Size Z of the variable
    """

    def __init__(self, n_envs: int, latent_dim: int) -> None:
        self.values = np.zeros((n_envs, latent_dim), dtype=np.float32)

    def draw(self, envs: Sequence[int], policy: RPGPolicy) -> None:
        """
        :param envs: Environments whose episodes begin
        :param policy: Draws the variables
        """
        self.values[list(envs)] = policy.draw_latents(len(envs)).cpu().numpy()

    def state_dict(self) -> dict[str, Any]:
        """
        :return: For ``load_state_dict``
        """
        return {"latents": self.values}

    def load_state_dict(self, tree: Any, n_envs: int) -> None:
        """
        :param tree: What ``state_dict`` gave
        :param n_envs: Number of environments
        :raises ValueError: If it is something else
        """
        latents = convert(tree.get("latents"), np.ndarray, "episodes.latents")
        self.values = check_array(latents, np.float32, [n_envs, self.values.shape[1]], "episodes.latents").copy()


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


@dataclass(frozen=True, kw_only=True)
class ScalarCriticSettings(CriticSettings):
    """``CriticSettings`` of values that are scalar: only one atom, and no Bellman target."""

    n_atoms: int = setting(1, Accepted("be 1, RPG's values are scalar", lambda value: value == 1), flat="n_atoms")


class RPG(EntropyTuning):
    """
    Reparameterised policy gradient (Huang et al., 2023, https://arxiv.org/abs/2307.10710): each episode draws a latent
    variable z, which the policy pi(a | s, z) sees. The policy climbs the lambda-return of its own rollouts in a learned model,
    plus the entropy of its actions and what they tell about z, so that different z act differently. Deviations are listed in
    ``docs/algorithm/baselines.md``.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"`` (images), ``"MultiInputPolicy"`` (dict observations) or a class
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
    :param tau: As in ``ActorCriticAlgorithm``
    :param kwargs: Of ``EntropyTuning`` and ``ActorCriticAlgorithm``; there is no Bellman target, so what is said of one has no
        effect
    :raises ValueError: If an argument is out of its range, naming it
    """

    default_replay_buffer_class = FifoReplayBuffer
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = names_of(RPGPolicy, CnnRPGPolicy)
    settings_groups: ClassVar[tuple[type[Settings], ...]] = (ScalarCriticSettings, NoveltySettings)
    accepted: ClassVar[dict[str, Accepted]] = {
        "gae_lambda": SHARE,
        **dict.fromkeys(("latent_dim", "target_update_interval"), at_least(1)),
        "latent_coef": NOT_NEGATIVE.or_schedule(),
        **dict.fromkeys(("reward_loss_coef", "value_loss_coef", "state_loss_coef"), NOT_NEGATIVE),
    }
    _counters: ClassVar[dict[str, Any]] = {"_n_model_updates": Count}
    episode_part = "episode_latents"
    _unsaved: ClassVar[dict[str, None]] = {"episode_latents": None}
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
        **kwargs: Any,
    ) -> None:
        self.gae_lambda = gae_lambda
        self.latent_dim = latent_dim
        self.latent_coef = latent_coef
        self.reward_loss_coef = reward_loss_coef
        self.value_loss_coef = value_loss_coef
        self.state_loss_coef = state_loss_coef
        self.target_update_interval = target_update_interval
        self._n_model_updates = 0
        super().__init__(
            policy,
            env,
            entropy_learning_rate=entropy_learning_rate,
            initial_entropy_coef=initial_entropy_coef,
            n_steps=n_steps,
            tau=tau,
            **kwargs,
        )

    # ------------------------------------------------------------------ set-up

    def _setup_parts(self) -> None:
        self.episode_latents = EpisodeLatents(self.n_envs, self.latent_dim)
        if (saved := saved_part(self, "episodes")) is not None:
            with contextlib.suppress(ValueError):  # of another number of environments: new episodes begin
                self.episode_latents.load_state_dict(saved, self.n_envs)

    def _policy_arguments(self) -> dict[str, Any]:
        critic = self.critic_settings
        return {"latent_dim": self.latent_dim, "n_critics": critic.n_critics, "support": critic.support}

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        :param gradient_steps: Number of updates
        :param batch_size: Segments per update
        """
        with self._updates(gradient_steps) as metrics:
            for _ in range(gradient_steps):
                segments = self._sample_segments(batch_size, metrics)
                self._update_model(segments, metrics)
                self._update_policy(segments, metrics)
                self._update_targets()

    def _sample_segments(self, batch_size: int, metrics: Metrics) -> Segments:
        buffer, env = self.replay_buffer, self._vec_normalize_env
        windows = buffer.sample_windows(batch_size, self.n_steps)  # [B, H]
        present = windows >= 0
        rows = np.where(present, windows, windows[:, :1]).ravel()
        steps = buffer.read(rows, env)
        shape = windows.shape
        intrinsic = self._intrinsic_rewards(buffer.visited(windows.reshape(1, -1, 1)), metrics)

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

    def _update_model(self, segments: Segments, metrics: Metrics) -> None:
        policy, model = self.policy, self.policy.model
        n, horizon = segments.rewards.shape
        latents = policy.draw_latents(n)
        with th.no_grad():
            next_states = policy.encode(segments.next_observations, target=True)
            returns = self._imagine(policy.model_target, next_states, latents.repeat_interleave(horizon, 0))[0]
            low, high = self.critic_settings.support
            metrics[CUT_VALUES].append((returns >= high).float().mean())
            returns = returns.clamp(low, high).view(n, horizon)
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

    def _update_policy(self, segments: Segments, metrics: Metrics) -> None:
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

    def _begin_episodes(self) -> None:
        self.episode_latents.draw(range(self.n_envs), self.policy)

    def _training_actions(self) -> np.ndarray:
        return self.policy.predict(self._last_obs, latents=self.episode_latents.values)[0]  # type: ignore[arg-type]

    def _on_episodes_end(self, record: StepRecord) -> None:
        super()._on_episodes_end(record)
        self.episode_latents.draw([env for env, _ in record.finished], self.policy)
