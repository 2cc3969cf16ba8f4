"""The policy of an actor and twin critics: networks, targets and optimisers that all algorithms share."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_ddiffpg.critics import ModeCritics
from sb3_ddiffpg.features import ScaledFlattenExtractor
from sb3_ddiffpg.policy_parts import SavablePolicy


def default_extractor(observation_space: spaces.Space) -> type[BaseFeaturesExtractor]:
    """
    :param observation_space: Observation space
    :return: What flattens observations, or combines those of a dict
    """
    return CombinedExtractor if isinstance(observation_space, spaces.Dict) else ScaledFlattenExtractor


class Actor(BasePolicy):
    """
    What all actors have in common.

    :param observation_space: Observation space
    :param action_space: Action space
    :param features_extractor: Extracts the features of the observation
    :param features_dim: Number of features
    :param normalize_images: Whether images are divided by 255
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_extractor: nn.Module,
        features_dim: int,
        normalize_images: bool = True,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.features_dim = features_dim

    def features(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: Observations, [N, ...]
        :return: [N, features_dim]
        """
        return self.extract_features(obs, self.features_extractor)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self(observation, deterministic)


class TwinCriticPolicy(SavablePolicy):
    """
    An actor, twin critics and their targets, each with a features extractor of its own.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate of the actor
    :param actor_class: Of the actor; it is made with the spaces, ``net_arch``, ``features_extractor``, ``features_dim``,
        ``normalize_images`` and ``actor_kwargs``
    :param actor_kwargs: Its further arguments
    :param net_arch: Hidden layers, a list or ``dict(pi=[...], qf=[...])``
    :param critic_activation_fn: Activation of the critics
    :param features_extractor_class: Features extractor; when None, observations are flattened, and those of a dict combined
    :param features_extractor_kwargs: Its keyword arguments
    :param normalize_images: Whether images are divided by 255
    :param optimizer_class: Optimiser of actor and critics
    :param optimizer_kwargs: Its keyword arguments, without the learning rate
    :param n_groups: Number of groups of critics
    :param n_critics: Critics per group
    :param n_atoms: Atoms of the value distribution, 1 for scalar critics
    :param support: Lower and upper end of the values of all groups but the first
    :param exploration_support: The same for the first
    :param twin_target: What the twins learn from, see ``ModeCritics``
    """

    actor: Any
    critics: ModeCritics
    critics_target: ModeCritics

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        actor_class: type[BasePolicy],
        actor_kwargs: dict[str, Any],
        net_arch: list[int] | dict[str, list[int]] | None = None,
        critic_activation_fn: type[nn.Module] = nn.SiLU,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.AdamW,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_groups: int = 1,
        n_critics: int = 2,
        n_atoms: int = 51,
        support: tuple[float, float] = (0.0, 5.0),
        exploration_support: tuple[float, float] = (0.0, 5.0),
        twin_target: str = "lower_mean",
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
            critic_activation_fn=critic_activation_fn,
            n_critics=n_critics,
            n_atoms=n_atoms,
            support=support,
            exploration_support=exploration_support,
            twin_target=twin_target,
        )
        actor_arch, critic_arch = get_actor_critic_arch([128, 128] if net_arch is None else net_arch)
        extractor = self.make_features_extractor()
        make_actor: Any = actor_class
        self.actor = make_actor(
            observation_space,
            action_space,
            net_arch=actor_arch,
            features_extractor=extractor,
            features_dim=extractor.features_dim,
            normalize_images=normalize_images,
            **actor_kwargs,
        )
        critic_arguments: dict[str, Any] = dict(
            features_dim=extractor.features_dim,
            action_dim=int(np.prod(action_space.shape)),
            net_arch=critic_arch,
            n_groups=n_groups,
            activation_fn=critic_activation_fn,
            n_critics=n_critics,
            n_atoms=n_atoms,
            support=support,
            exploration_support=exploration_support,
            twin_target=twin_target,
        )
        self.critics = ModeCritics(**critic_arguments)
        self.critics_target = ModeCritics(**critic_arguments)
        self.critics_target.load_state_dict(self.critics.state_dict())
        # The critics see through their own extractor: the denoising loss must not shape their features
        self.critic_features_extractor = self.make_features_extractor()
        self.critic_features_extractor_target = self.make_features_extractor()
        self.critic_features_extractor_target.load_state_dict(self.critic_features_extractor.state_dict())
        self.actor.optimizer = self.make_optimizer(self.actor.parameters(), lr_schedule(1))
        parameters = [*self.critics.parameters(), *self.critic_features_extractor.parameters()]
        self.critics.optimizer = self.make_optimizer(parameters, lr_schedule(1))
        self.critics_target.train(False)
        self.critic_features_extractor_target.train(False)

    def critic_features(self, obs: PyTorchObs, target: bool = False) -> th.Tensor:
        """
        :param obs: Observations, G groups of n rows, [G * n, ...]
        :param target: Through the target's extractor
        :return: Shape [G, n, features_dim]
        """
        extractor = self.critic_features_extractor_target if target else self.critic_features_extractor
        features = self.extract_features(obs, extractor)
        return features.unflatten(0, (self.critics.n_groups, -1))

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.actor(observation, deterministic)

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: True for training, False for evaluation (dropout, batch norm of the extractors)
        """
        self.actor.set_training_mode(mode)
        self.critics.train(mode)
        self.critic_features_extractor.train(mode)
        self.training = mode
