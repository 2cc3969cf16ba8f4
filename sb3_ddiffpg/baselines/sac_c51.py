"""SAC with distributional critics."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import NatureCNN, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_ddiffpg.baselines.baseline import Baseline, MlpActorPolicy, names_of
from sb3_ddiffpg.baselines.entropy_tuning import EntropyTuning
from sb3_ddiffpg.buffers.batch import ModeBatch
from sb3_ddiffpg.common.actor_critic import Metrics
from sb3_ddiffpg.exploration.settings import NoveltySettings
from sb3_ddiffpg.networks.policies import Actor
from sb3_ddiffpg.networks.settings import CriticSettings
from sb3_ddiffpg.utils.settings import NOT_NEGATIVE, Settings, setting

LOG_STD_RANGE = (-5.0, 5.0)


class GaussianActor(Actor):
    """
    Squashed Gaussian actor.

    :param observation_space: Observation space
    :param action_space: Action space
    :param net_arch: Hidden layers
    :param features_dim: Number of features
    :param activation_fn: Activation of the hidden layers
    :param kwargs: Of ``Actor``
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_dim: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ELU,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, features_dim=features_dim, **kwargs)
        action_dim = get_action_dim(action_space)
        self.latent = nn.Sequential(*create_mlp(features_dim, 2 * action_dim, net_arch, activation_fn))
        self.distribution = SquashedDiagGaussianDistribution(action_dim)

    def sample(self, obs: PyTorchObs, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor]:
        """
        :param obs: Observations, [N, ...]
        :param deterministic: The squashed mean
        :return: Actions in [-1, 1], [N, action_dim], and their log probabilities, [N]
        """
        return self.sample_from(self.features(obs), deterministic)

    def sample_from(self, features: th.Tensor, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: Shape [N, features_dim]
        :param deterministic: The squashed mean
        :return: See ``sample``
        """
        mean, log_std = self.latent(features).chunk(2, dim=1)
        distribution = self.distribution.proba_distribution(mean, log_std.clamp(*LOG_STD_RANGE))
        actions = distribution.get_actions(deterministic)
        return actions, distribution.log_prob(actions, distribution.gaussian_actions)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """
        :param obs: Observations, [N, ...]
        :param deterministic: The squashed mean
        :return: Actions in [-1, 1], [N, action_dim]
        """
        return self.sample(obs, deterministic)[0]


class GaussianActorPolicy(MlpActorPolicy):
    """Twin critics and a squashed Gaussian actor, with the factor of its entropy."""

    actor_class = GaussianActor

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # Tuned by the algorithm
        self.log_entropy_coef = nn.Parameter(th.zeros(()))


class CnnGaussianActorPolicy(GaussianActorPolicy):
    """``GaussianActorPolicy`` for images, which go through SB3's ``NatureCNN``."""

    default_features_extractor = NatureCNN


@dataclass(frozen=True, kw_only=True)
class SACCriticSettings(CriticSettings):
    """``CriticSettings``, but for the default of the noise in the target: SAC's policy has its own."""

    target_policy_noise: float = setting(0.0, NOT_NEGATIVE, flat="target_policy_noise")


class SACC51(EntropyTuning, Baseline):
    """
    SAC (Haarnoja et al., 2018, https://arxiv.org/abs/1812.05905) with C51 critics and NovelD; the entropy is part of the
    projected target.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"`` (images), ``"MultiInputPolicy"`` (dict observations) or a class
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param entropy_learning_rate: As in ``EntropyTuning``
    :param initial_entropy_coef: As there
    :param kwargs: Of ``EntropyTuning``, ``Baseline`` and ``ActorCriticAlgorithm``
    """

    policy: GaussianActorPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = names_of(GaussianActorPolicy, CnnGaussianActorPolicy)
    settings_groups: ClassVar[tuple[type[Settings], ...]] = (SACCriticSettings, NoveltySettings)

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: Any,
        *,
        entropy_learning_rate: float = 5e-3,
        initial_entropy_coef: float = 1.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            policy,
            env,
            entropy_learning_rate=entropy_learning_rate,
            initial_entropy_coef=initial_entropy_coef,
            **kwargs,
        )

    def _next_actions(self, batch: ModeBatch) -> tuple[th.Tensor, th.Tensor | float]:
        actions, log_probabilities = self._target_actor().sample(batch.next_observations)
        return actions, -self.entropy_coef * log_probabilities[None]

    def _update_actor(self, batch: ModeBatch, metrics: Metrics) -> None:
        actions, log_probabilities = self.actor.sample(batch.observations)
        values = self._values(batch, actions).min(dim=0).values
        metrics["actor_loss"].append(self._step_actor((self.entropy_coef * log_probabilities - values).mean()))
        self._tune_entropy(log_probabilities, metrics)
