"""The actor: from an observation and the embedding of a mode to actions, by a diffusion or a flow."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_ddiffpg.networks.denoiser import Denoiser
from sb3_ddiffpg.networks.diffusion import DiffusionModel
from sb3_ddiffpg.networks.flow import FLOW_TIMES, FlowModel
from sb3_ddiffpg.networks.policies import Actor


class DiffusionActor(Actor):
    """
    Diffusion or flow policy conditioned on observation and mode embedding.

    :param observation_space: Observation space
    :param action_space: Action space
    :param net_arch: Hidden layers of the denoiser
    :param features_extractor: Extracts the features of the observation
    :param features_dim: Number of features
    :param activation_fn: Activation of the denoiser
    :param n_diffusion_steps: Number of diffusion steps T. None: a flow, of two steps
    :param mode_embedding_dim: Size of a mode embedding
    :param time_embedding_dim: Size of a step's embedding
    :param normalize_images: Whether images are divided by 255
    :param noise_schedule: See ``diffusion.DiffusionModel``
    :param action_chunk: Steps whose actions are drawn together, one after the other
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: nn.Module,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.SiLU,
        n_diffusion_steps: int | None = 5,
        mode_embedding_dim: int = 5,
        time_embedding_dim: int = 32,
        normalize_images: bool = True,
        noise_schedule: str = "cosine",
        action_chunk: int = 1,
    ) -> None:
        super().__init__(observation_space, action_space, features_extractor, features_dim, normalize_images)
        self.action_chunk = action_chunk
        self.net_arch, self.activation_fn = net_arch, activation_fn
        self.n_diffusion_steps = n_diffusion_steps
        self.mode_embedding_dim, self.time_embedding_dim = mode_embedding_dim, time_embedding_dim
        self.noise_schedule = noise_schedule
        denoiser = Denoiser(
            condition_dim=features_dim + mode_embedding_dim,
            action_dim=action_chunk * int(np.prod(action_space.shape)),
            n_steps=len(FLOW_TIMES) if n_diffusion_steps is None else n_diffusion_steps,
            net_arch=net_arch,
            activation_fn=activation_fn,
            time_embedding_dim=time_embedding_dim,
        )
        self.diffusion: FlowModel | DiffusionModel = (
            FlowModel(denoiser) if n_diffusion_steps is None else DiffusionModel(denoiser, n_diffusion_steps, noise_schedule)
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            net_arch=self.net_arch,
            features_dim=self.features_dim,
            activation_fn=self.activation_fn,
            n_diffusion_steps=self.n_diffusion_steps,
            mode_embedding_dim=self.mode_embedding_dim,
            time_embedding_dim=self.time_embedding_dim,
            features_extractor=self.features_extractor,
            noise_schedule=self.noise_schedule,
            action_chunk=self.action_chunk,
        )
        return data

    def condition(self, obs: PyTorchObs, embeddings: th.Tensor | None = None) -> th.Tensor:
        """
        :param obs: Observations, [N, ...]
        :param embeddings: Mode embeddings, [N, mode_embedding_dim]; zero when None
        :return: What the denoiser is conditioned on, [N, features_dim + mode_embedding_dim]
        """
        features = self.features(obs)
        if embeddings is None:
            embeddings = features.new_zeros(features.shape[0], self.mode_embedding_dim)
        return th.cat((features, embeddings), dim=1)

    def forward(self, obs: PyTorchObs, deterministic: bool = False, embeddings: th.Tensor | None = None) -> th.Tensor:
        """
        :param obs: Observations, [N, ...]
        :param deterministic: Zero initial latent, no noise later
        :param embeddings: Mode embeddings, [N, mode_embedding_dim]; zero when None
        :return: Actions in [-1, 1], [N, action_chunk * action_dim]
        """
        return self.diffusion.sample(self.condition(obs, embeddings), deterministic=deterministic)
