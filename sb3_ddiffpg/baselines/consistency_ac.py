"""Consistency-AC, online: a consistency model as actor, through which the critic's gradient goes back."""

import math
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_ddiffpg.baselines.baseline import Baseline, BaselinePolicy, names_of
from sb3_ddiffpg.buffers.batch import ModeBatch
from sb3_ddiffpg.common.actor_critic import Metrics
from sb3_ddiffpg.networks.denoiser import Denoiser
from sb3_ddiffpg.networks.policies import Actor
from sb3_ddiffpg.utils.settings import NOT_NEGATIVE, Accepted, at_least, is_integer

SIGMA_DATA, SIGMA_MIN, SIGMA_MAX = 0.5, 0.002, 80.0
RHO = 7.0


class ConsistencyActor(Actor):
    """
    Consistency model (Song et al., 2023): one network takes a noisy action of any level to a clean one.

    :param observation_space: Observation space
    :param action_space: Action space
    :param net_arch: Hidden layers of the network
    :param features_dim: Number of features
    :param activation_fn: Activation of the network
    :param n_diffusion_steps: Evaluations of the network for one action
    :param time_embedding_dim: Size of a noise level's embedding
    :param kwargs: Of ``Actor``
    """

    sigmas: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_dim: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.SiLU,
        n_diffusion_steps: int = 2,
        time_embedding_dim: int = 32,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, features_dim=features_dim, **kwargs)
        self.network = Denoiser(
            features_dim, get_action_dim(action_space), n_diffusion_steps, net_arch, activation_fn, time_embedding_dim
        )
        self.register_buffer("sigmas", th.linspace(SIGMA_MAX, 2.0, n_diffusion_steps), persistent=False)

    def consistency(self, actions: th.Tensor, condition_part: th.Tensor, sigma: th.Tensor) -> th.Tensor:
        """
        The consistency function, which leaves an action of the smallest noise level as it is.

        :param actions: Noisy actions, shape [N, action_dim]
        :param condition_part: ``network.condition_in`` of the features, shape [N, width]
        :param sigma: Noise levels, shape [N]
        :return: Clean actions, shape [N, action_dim]
        """
        sigma = sigma[:, None]
        skip = SIGMA_DATA**2 / ((sigma - SIGMA_MIN) ** 2 + SIGMA_DATA**2)
        out = SIGMA_DATA * (sigma - SIGMA_MIN) / (sigma**2 + SIGMA_DATA**2).sqrt()
        scale = 1 / (sigma**2 + SIGMA_DATA**2).sqrt()
        time_part = self.network.time_in(self.network.time_mlp(250 * sigma[:, 0].log()))
        return skip * actions + out * self.network(scale * actions, condition_part, time_part)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """
        Multistep sampling.

        :param obs: Observations, [N, ...]
        :param deterministic: Zero latent and noise
        :return: Actions in [-1, 1], [N, action_dim]
        """
        condition_part = self.network.condition_in(self.features(obs))
        shape = (len(condition_part), self.network.action_dim)

        def noise() -> th.Tensor:
            draw = th.zeros if deterministic else th.randn
            return draw(shape, device=condition_part.device)

        actions = SIGMA_MAX * noise()
        for step, sigma in enumerate(self.sigmas):
            if step:
                actions = actions + (sigma**2 - SIGMA_MIN**2).sqrt() * noise()
            actions = self.consistency(actions, condition_part, sigma.expand(shape[0])).clamp(-1.0, 1.0)
        return actions


class ConsistencyActorPolicy(BaselinePolicy):
    """
    Twin critics and a consistency model.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate of the actor
    :param activation_fn: Activation of the network
    :param n_diffusion_steps: Evaluations of the network for one action
    :param time_embedding_dim: Size of a noise level's embedding
    :param kwargs: Of ``TwinCriticPolicy``
    """

    def __init__(
        self,
        observation_space: Any,
        action_space: Any,
        lr_schedule: Any,
        activation_fn: type[nn.Module] = nn.SiLU,
        n_diffusion_steps: int = 2,
        time_embedding_dim: int = 32,
        **kwargs: Any,
    ) -> None:
        actor_kwargs = dict(
            activation_fn=activation_fn, n_diffusion_steps=n_diffusion_steps, time_embedding_dim=time_embedding_dim
        )
        super().__init__(observation_space, action_space, lr_schedule, ConsistencyActor, actor_kwargs, **kwargs)
        self._constructor.update(actor_kwargs)


class CnnConsistencyActorPolicy(ConsistencyActorPolicy):
    """``ConsistencyActorPolicy`` for images, which go through SB3's ``NatureCNN``."""

    default_features_extractor = NatureCNN


class ConsistencyAC(Baseline):
    """
    Consistency models as a policy class (Ding and Jin, 2024, https://arxiv.org/abs/2309.16984), here online: the actor
    maximises the smaller of the critics; with ``consistency_coef`` also the consistency loss on the buffer's actions (1 in the
    original, which is offline; 0 online).

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"`` (images), ``"MultiInputPolicy"`` (dict observations) or a class
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param n_diffusion_steps: Evaluations of the network for one action
    :param consistency_coef: Factor of the consistency loss
    :param n_levels: Noise levels of the consistency loss at the beginning of the training, and one less than at its end
    :param actor_tau: Soft update coefficient of the target actor
    :param kwargs: Of ``Baseline`` and ``ActorCriticAlgorithm``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = names_of(ConsistencyActorPolicy, CnnConsistencyActorPolicy)
    accepted: ClassVar[dict[str, Accepted]] = {
        "n_diffusion_steps": at_least(1),
        "consistency_coef": NOT_NEGATIVE,
        "n_levels": Accepted(
            "be two integers, of at least 2, in order",
            lambda value: (
                isinstance(value, (list, tuple))
                and len(value) == 2
                and all(map(is_integer, value))
                and 2 <= value[0] <= value[1]
            ),
        ),
    }

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: Any,
        *,
        n_diffusion_steps: int = 2,
        consistency_coef: float = 0.0,
        n_levels: tuple[int, int] = (2, 150),
        actor_tau: float | None = 0.005,
        **kwargs: Any,
    ) -> None:
        self.n_diffusion_steps = n_diffusion_steps
        self.consistency_coef = consistency_coef
        self.n_levels = n_levels
        super().__init__(policy, env, actor_tau=actor_tau, **kwargs)

    def _policy_arguments(self) -> dict[str, Any]:
        return {**super()._policy_arguments(), "n_diffusion_steps": self.n_diffusion_steps}

    def _update_actor(self, batch: ModeBatch, metrics: Metrics) -> None:
        values = self._values(batch, self.actor(batch.observations))
        loss = -values.min(dim=0).values.mean()
        if self.consistency_coef:
            loss = loss + self.consistency_coef * self._consistency_loss(batch)
        metrics["actor_loss"].append(self._step_actor(loss))

    def _consistency_loss(self, batch: ModeBatch) -> th.Tensor:
        """Two neighbouring noise levels of one action must lead to the same clean one (Song et al., 2023, algorithm 3)."""
        first, last = self.n_levels
        progress = 1 - self._current_progress_remaining
        n_levels = math.ceil(math.sqrt(progress * ((last + 1) ** 2 - first**2) + first**2) - 1) + 1
        actions, noise = batch.actions[0], th.randn_like(batch.actions[0])
        level = th.randint(n_levels - 1, (len(actions),), device=actions.device)
        low, high = (karras_sigmas(step, n_levels) for step in (level, level + 1))
        online, target = self.actor, self._target_actor()

        def clean(actor: Any, sigma: th.Tensor) -> th.Tensor:
            features = actor.features(batch.observations)
            return actor.consistency(actions + sigma[:, None] * noise, actor.network.condition_in(features), sigma)

        with th.no_grad():
            aim = clean(target, low)
        return (clean(online, high) - aim).pow(2).mean()


def karras_sigmas(step: th.Tensor, n_levels: int) -> th.Tensor:
    """
    Noise levels (Karras et al., 2022, equation 5), from the smallest to the largest.

    :param step: Number of the level, 0 to ``n_levels - 1``, any shape
    :param n_levels: How many there are
    :return: Same shape
    """
    low, high = SIGMA_MIN ** (1 / RHO), SIGMA_MAX ** (1 / RHO)
    return (low + step / (n_levels - 1) * (high - low)) ** RHO
