"""RPG's networks: an actor that sees a latent variable, its inference, and the model of the task."""

import copy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    NatureCNN,
    create_mlp,
    get_actor_critic_arch,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_ddiffpg.baselines.sac_c51 import GaussianActor
from sb3_ddiffpg.baselines.world_model import WorldModel
from sb3_ddiffpg.networks.policies import SavablePolicy
from sb3_ddiffpg.utils.observations import batch_size


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
            features_extractor_class,
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
            n_rows = batch_size(n_obs)
            if latents.shape not in ((1, self.latent_dim), (n_rows, self.latent_dim)):
                raise ValueError(f"latents must be of shape [{n_rows}, {self.latent_dim}], got {list(latents.shape)}")
            latents = np.broadcast_to(latents, (n_rows, self.latent_dim)).copy()
            state = (latents,)
            self._latents_in_use = th.from_numpy(latents).to(self.device)
        try:
            return super().predict(observation, state, episode_start, deterministic)
        finally:
            self._latents_in_use = None

    @th.no_grad()
    def state_values(self, obs: PyTorchObs, n_actions: int) -> th.Tensor:
        """
        :param obs: N observations
        :param n_actions: Latent variables drawn for each; the values know no action
        :return: Mean over these of the smaller of the values, [N]
        """
        drawn = []
        for _ in range(n_actions):
            states = self.encode(obs)
            drawn.append(self.model.values(states, self.draw_latents(len(states))).amin(dim=0))
        return th.stack(drawn).mean(dim=0)

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: True for training, False for evaluation (dropout, batch norm of the extractors)
        """
        self.actor.set_training_mode(mode)
        self.model.train(mode)
        self.inference.train(mode)
        self.training = mode


class CnnRPGPolicy(RPGPolicy):
    """``RPGPolicy`` for images, which go through SB3's ``NatureCNN``."""

    default_features_extractor = NatureCNN
