"""TD3 with distributional critics."""

from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import NatureCNN, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_ddiffpg.baselines.baseline import Baseline, MlpActorPolicy, names_of
from sb3_ddiffpg.buffers.batch import ModeBatch
from sb3_ddiffpg.common.actor_critic import Metrics
from sb3_ddiffpg.networks.policies import Actor
from sb3_ddiffpg.serialization.safetensors_tree import Count
from sb3_ddiffpg.utils.settings import Accepted, at_least


class TanhActor(Actor):
    """
    Deterministic actor.

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
        self.mu = nn.Sequential(
            *create_mlp(features_dim, get_action_dim(action_space), net_arch, activation_fn, squash_output=True)
        )

    def forward(self, obs: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        """
        :param obs: Observations, [N, ...]
        :param deterministic: Not used
        :return: Actions in [-1, 1], [N, action_dim]
        """
        return self.mu(self.features(obs))


class TanhActorPolicy(MlpActorPolicy):
    """Twin critics and a deterministic actor."""

    actor_class = TanhActor


class CnnTanhActorPolicy(TanhActorPolicy):
    """``TanhActorPolicy`` for images, which go through SB3's ``NatureCNN``."""

    default_features_extractor = NatureCNN


class TD3C51(Baseline):
    """
    TD3 (Fujimoto et al., 2018, https://arxiv.org/abs/1802.09477) with C51 critics and NovelD. As in the DDiffPG paper's
    comparison the actor climbs the smaller of both critics at every update. What else differs from TD3, and by which arguments
    it need not, is listed in ``docs/algorithm/baselines.md``.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"`` (images), ``"MultiInputPolicy"`` (dict observations) or a class
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param policy_delay: Updates of the critics for each of the actor and of the target networks
    :param kwargs: Of ``Baseline`` and ``ActorCriticAlgorithm``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = names_of(TanhActorPolicy, CnnTanhActorPolicy)
    accepted: ClassVar[dict[str, Accepted]] = {"policy_delay": at_least(1)}
    _counters: ClassVar[dict[str, Any]] = {"_n_critic_updates": Count}

    def __init__(self, policy: str | type[BasePolicy], env: Any, *, policy_delay: int = 1, **kwargs: Any) -> None:
        self.policy_delay = policy_delay
        self._n_critic_updates = 0
        super().__init__(policy, env, **kwargs)

    def _update_actor(self, batch: ModeBatch, metrics: Metrics) -> None:
        self._n_critic_updates += 1
        if self._policy_is_due():
            values = self._values(batch, self.actor(batch.observations))
            metrics["actor_loss"].append(self._step_actor(-values.min(dim=0).values.mean()))

    def _update_targets(self) -> None:
        if self._policy_is_due():
            super()._update_targets()

    def _policy_is_due(self) -> bool:
        return self._n_critic_updates % self.policy_delay == 0
