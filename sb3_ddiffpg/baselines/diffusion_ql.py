"""Diffusion-QL, online: the critic's gradient goes back through all denoising steps."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_ddiffpg.baselines.baseline import Baseline, names_of
from sb3_ddiffpg.baselines.dipo import CnnDiffusionActorPolicy, DiffusionActorPolicy
from sb3_ddiffpg.buffers.batch import ModeBatch
from sb3_ddiffpg.common.actor_critic import Metrics
from sb3_ddiffpg.serialization.safetensors_tree import Count
from sb3_ddiffpg.utils.observations import repeated
from sb3_ddiffpg.utils.settings import NOT_NEGATIVE, Accepted, at_least


class DiffusionQL(Baseline):
    """
    Diffusion policies as an expressive policy class (Wang et al., 2023, https://arxiv.org/abs/2208.06193), here online: the
    actor maximises ``Q_i(s, a) / mean |Q_j|``, with a sampled through all T denoising steps and (i, j) by a coin, plus
    ``bc_coef`` times the denoising loss of the buffer's actions (1 in the original, 0 online). It acts with one of
    ``n_candidates`` actions, drawn by the softmax of their values.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"`` (images), ``"MultiInputPolicy"`` (dict observations) or a class
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param n_diffusion_steps: Number of diffusion steps T
    :param noise_schedule: ``"vp"`` as in the paper, or ``"cosine"``
    :param q_coef: Factor eta of the critic's part of the loss
    :param bc_coef: Factor of the denoising loss
    :param n_candidates: Actions from which one is drawn by value when acting; 1: the policy's own
    :param average_freq: Updates between two steps of the target actor (with ``actor_tau``)
    :param average_start: Updates before the first of them
    :param actor_tau: Soft update coefficient of the target actor
    :param kwargs: Of ``Baseline`` and ``ActorCriticAlgorithm``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = names_of(DiffusionActorPolicy, CnnDiffusionActorPolicy)
    target_networks: ClassVar[dict[str, str]] = {"actor_target": "actor"}  # it acts by the target critics
    accepted: ClassVar[dict[str, Accepted]] = {
        **dict.fromkeys(("n_diffusion_steps", "n_candidates", "average_freq"), at_least(1)),
        **dict.fromkeys(("q_coef", "bc_coef"), NOT_NEGATIVE),
        "average_start": at_least(0),
    }
    _counters: ClassVar[dict[str, Any]] = {"_n_actor_updates": Count}

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: Any,
        *,
        n_diffusion_steps: int = 5,
        noise_schedule: str = "vp",
        q_coef: float = 1.0,
        bc_coef: float = 0.0,
        n_candidates: int = 50,
        average_freq: int = 5,
        average_start: int = 1000,
        actor_tau: float | None = 0.005,
        **kwargs: Any,
    ) -> None:
        self.n_diffusion_steps = n_diffusion_steps
        self.noise_schedule = noise_schedule
        self.q_coef = q_coef
        self.bc_coef = bc_coef
        self.n_candidates = n_candidates
        self.average_freq = average_freq
        self.average_start = average_start
        self._n_actor_updates = 0
        super().__init__(policy, env, actor_tau=actor_tau, **kwargs)

    def _policy_arguments(self) -> dict[str, Any]:
        steps = {"n_diffusion_steps": self.n_diffusion_steps, "noise_schedule": self.noise_schedule}
        return {**super()._policy_arguments(), **steps}

    def _update_actor(self, batch: ModeBatch, metrics: Metrics) -> None:
        condition = self.actor.condition(batch.observations)
        actions = self.actor.diffusion.denoise(condition)
        values = self._values(batch, actions)
        first, second = np.random.permutation(self.critic_settings.n_critics)[[0, -1]]
        loss = -self.q_coef * values[first].mean() / (values[second].abs().mean().detach() + 1e-6)
        if self.bc_coef:
            loss = loss + self.bc_coef * self.actor.diffusion.loss(batch.actions[0], condition)
        metrics["actor_loss"].append(self._step_actor(loss))

    def _average_actor(self, tau: float) -> None:
        self._n_actor_updates += 1
        if self._n_actor_updates <= self.average_start:
            tau = 1.0
        elif self._n_actor_updates % self.average_freq:
            return
        super()._average_actor(tau)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        :param observation: The observation(s)
        :param state: Not used
        :param episode_start: Not used
        :param deterministic: The policy's own action without noise, instead of one of the candidates
        :return: The actions, and the state
        """
        if deterministic or self.n_candidates == 1:
            return super().predict(observation, state, episode_start, deterministic)
        self.policy.set_training_mode(False)
        obs, vectorized = self.policy.obs_to_tensor(observation)
        with th.no_grad():
            actions = self._one_of_many(obs)
        scaled = actions.cpu().numpy().reshape(-1, *self.action_space.shape)  # type: ignore[misc]
        unscaled = self.policy.unscale_action(scaled)
        return unscaled if vectorized else unscaled[0], state

    def _training_actions(self) -> np.ndarray:
        return self.predict(self._last_obs)[0]  # type: ignore[arg-type]

    def _one_of_many(self, obs: Any) -> th.Tensor:
        """For each of N observations one of its candidates, drawn by the softmax of their values, [N, action_dim]."""
        n = self.n_candidates
        tiled = repeated(obs, n)
        actions = self.actor(tiled)
        critics = self.policy.critics_target
        features = self.policy.critic_features(tiled, target=True)
        values = critics.values(critics(features, actions[None]))[0].min(dim=0).values.view(-1, n)
        chosen = th.multinomial(values.softmax(dim=1), 1).squeeze(1)
        return actions.view(-1, n, actions.shape[-1])[th.arange(len(values), device=values.device), chosen]
