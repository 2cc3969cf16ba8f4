"""What all policies share: actor and twin critics, their targets and optimisers, and how they are saved."""

from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from sb3_ddiffpg.networks.critics import ModeCritics
from sb3_ddiffpg.networks.extractors import adapt_extractors, default_extractor


class SavablePolicy(BasePolicy):
    """
    A policy that is saved with what it was made of: what a subclass notes in ``_constructor``, and SB3's own arguments.

    :param observation_space: Observation space
    :param action_space: Action space
    :param features_extractor_class: Features extractor; when None, that of ``default_features_extractor``
    :param features_extractor_kwargs: Its keyword arguments
    :param kwargs: Of ``BasePolicy``
    """

    #: When None, observations are flattened, and those of a dict combined
    default_features_extractor: ClassVar[type[BaseFeaturesExtractor] | None] = None

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        extractor = features_extractor_class or self.default_features_extractor
        super().__init__(
            observation_space,
            action_space,
            extractor or default_extractor(observation_space, features_extractor_kwargs),
            features_extractor_kwargs,
            squash_output=True,
            **kwargs,
        )
        self._constructor: dict[str, Any] = {}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            self._constructor,
            lr_schedule=self._dummy_schedule,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
            features_extractor_class=self.features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
        )
        return data

    def adapt_inputs(self, obs: PyTorchObs) -> None:
        """
        Let what the networks see have mean 0 and one deviation, see ``StandardizedExtractor``.

        :param obs: Observations from all over where the run has been, [N, ...]
        """
        adapt_extractors(self, preprocess_obs(obs, self.observation_space, self.normalize_images))

    def make_optimizer(self, parameters: Iterable[nn.Parameter], learning_rate: float) -> th.optim.Optimizer:
        """
        :param parameters: What it is to learn
        :param learning_rate: Its first learning rate
        :return: An optimiser of the policy's class
        """
        kwargs = self.optimizer_kwargs
        parameters = list(parameters)
        chosen = {"fused", "foreach", "differentiable"} & set(kwargs)
        without_memory = any(each.is_meta for each in parameters)  # only its sizes are asked for, and no kernel knows it
        if not chosen and self.optimizer_class in (th.optim.Adam, th.optim.AdamW) and not without_memory:
            # One kernel instead of one per parameter: a third of a small update's time
            kwargs = {"fused": True, **kwargs}
        make: Any = self.optimizer_class
        return make(parameters, lr=learning_rate, **kwargs)


def average_networks(online: Sequence[nn.Module], target: Sequence[nn.Module], tau: float) -> None:
    """
    Polyak averaging of the parameters, in one kernel; running statistics, as of a batch norm, are copied, as in SB3.

    :param online: Networks
    :param target: Theirs, which move
    :param tau: Share of the way that they go
    """
    sources, followers = (list(chain(*(each.parameters() for each in part))) for part in (online, target))
    get_ema_multi_avg_fn(1 - tau)(followers, sources, None)
    statistics = (chain(*(each.buffers() for each in part)) for part in (online, target))
    for current, average in zip(*statistics, strict=True):
        average.copy_(current)


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
    :param action_chunk: Steps whose actions are judged together, one after the other
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
        action_chunk: int = 1,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
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
            action_chunk=action_chunk,
        )
        self.action_chunk = action_chunk
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
            action_dim=action_chunk * int(np.prod(action_space.shape)),
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

    @th.no_grad()
    def state_values(self, obs: PyTorchObs, n_actions: int) -> th.Tensor:
        """
        :param obs: N observations
        :param n_actions: Actions drawn for each
        :return: Mean over actions drawn from the policy of the smaller of the twins' values, [N]
        """
        drawn = []
        for _ in range(n_actions):
            features, actions = self.critic_features(obs), self(obs)
            drawn.append(self.critics.values(self.critics(features, actions[None])).amin(dim=1)[0])
        return th.stack(drawn).mean(dim=0)

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: True for training, False for evaluation (dropout, batch norm of the extractors)
        """
        if mode == self.training:
            return  # to look into every module takes a fifth of an action's time
        self.actor.set_training_mode(mode)
        self.critics.train(mode)
        self.critic_features_extractor.train(mode)
        self.training = mode
