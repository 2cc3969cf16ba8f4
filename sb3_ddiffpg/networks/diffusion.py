"""Diffusion model over actions (Ho et al., 2020): noise schedule, denoiser, sampling, loss, and the actor made of it."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_ddiffpg.networks.policies import Actor


def squared_cosine_betas(n_steps: int, max_beta: float = 0.999) -> th.Tensor:
    """
    Squared-cosine noise schedule (Nichol & Dhariwal, 2021, eq. 17).

    :param n_steps: Number of diffusion steps T
    :param max_beta: Upper limit of a step's variance, which keeps the last step invertible
    :return: Variances beta_0..beta_{T-1}, shape [T], float64
    """
    time = th.arange(n_steps + 1, dtype=th.float64) / n_steps
    alpha_bar = th.cos((time + 0.008) / 1.008 * math.pi / 2) ** 2
    return (1 - alpha_bar[1:] / alpha_bar[:-1]).clamp(max=max_beta)


def variance_preserving_betas(n_steps: int, low: float = 0.1, high: float = 10.0) -> th.Tensor:
    """
    Discretised variance-preserving schedule (Xiao et al., 2022), which Diffusion-QL uses.

    :param n_steps: Number of diffusion steps T
    :param low: Rate of the noise at the beginning
    :param high: Rate at the end
    :return: Variances beta_0..beta_{T-1}, shape [T], float64
    """
    time = th.arange(1, n_steps + 1, dtype=th.float64)
    return 1 - th.exp(-low / n_steps - 0.5 * (high - low) * (2 * time - 1) / n_steps**2)


NOISE_SCHEDULES: dict[str, Callable[[int], th.Tensor]] = {"cosine": squared_cosine_betas, "vp": variance_preserving_betas}


class SinusoidalEmbedding(nn.Module):
    """
    Transformer-style embedding of a diffusion step.

    :param dim: Size of the embedding, even
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        if dim < 4 or dim % 2:
            raise ValueError(f"time_embedding_dim must be an even number of at least 4, got {dim}")
        half = dim // 2
        frequencies = th.exp(-math.log(10_000) / (half - 1) * th.arange(half, dtype=th.float32))
        self.frequencies: th.Tensor
        self.register_buffer("frequencies", frequencies, persistent=False)

    def forward(self, steps: th.Tensor) -> th.Tensor:
        """
        :param steps: Diffusion steps, shape [N]
        :return: Shape [N, dim]
        """
        angles = steps[:, None].to(self.frequencies.dtype) * self.frequencies[None, :]
        return th.cat((angles.sin(), angles.cos()), dim=1)


class Denoiser(nn.Module):
    """
    Predicts the noise in an action: epsilon(a_t, condition, t).

    The first layer acts on [time embedding, condition, action]. It is kept as three summands, because the time part has
    only T distinct rows and the condition part does not change during a denoising loop: both are computed once.

    :param condition_dim: Size of the condition (observation features and mode embedding)
    :param action_dim: Size of the action
    :param n_steps: Number of diffusion steps T
    :param net_arch: Sizes of the hidden layers; without any the first layer is the last
    :param activation_fn: Activation of the hidden layers
    :param time_embedding_dim: Size of the step's embedding; its MLP has one hidden layer four times as wide
    """

    def __init__(
        self,
        condition_dim: int,
        action_dim: int,
        n_steps: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.SiLU,
        time_embedding_dim: int = 32,
    ) -> None:
        super().__init__()
        if min(net_arch, default=1) < 1:
            raise ValueError(f"net_arch['pi'] must name hidden layers of at least one unit each, got {net_arch}")
        width = net_arch[0] if net_arch else action_dim
        self.time_mlp = nn.Sequential(
            SinusoidalEmbedding(time_embedding_dim),
            nn.Linear(time_embedding_dim, 4 * time_embedding_dim),
            activation_fn(),
            nn.Linear(4 * time_embedding_dim, time_embedding_dim),
        )
        self.time_in = nn.Linear(time_embedding_dim, width, bias=False)
        self.condition_in = nn.Linear(condition_dim, width)
        self.action_in = nn.Linear(action_dim, width, bias=False)
        # The three parts are one layer: initialise them with the fan-in of the whole
        bound = 1 / math.sqrt(time_embedding_dim + condition_dim + action_dim)
        for part in (self.time_in, self.condition_in, self.action_in):
            nn.init.uniform_(part.weight, -bound, bound)
        trunk: list[nn.Module] = []
        for size_in, size_out in pairwise([*net_arch, action_dim]):
            trunk += [activation_fn(), nn.Linear(size_in, size_out)]
        self.trunk = nn.Sequential(*trunk)
        self.steps: th.Tensor
        self.register_buffer("steps", th.arange(n_steps), persistent=False)

    def time_table(self) -> th.Tensor:
        """
        :return: The first layer's time part for every diffusion step, shape [T, net_arch[0]]
        """
        return self.time_in(self.time_mlp(self.steps))

    def forward(self, actions: th.Tensor, condition_part: th.Tensor, time_part: th.Tensor) -> th.Tensor:
        """
        :param actions: Noisy actions, shape [N, action_dim]
        :param condition_part: ``condition_in(condition)``, shape [N, net_arch[0]]
        :param time_part: Rows of ``time_table()``, broadcastable to [N, net_arch[0]]
        :return: Predicted noise, shape [N, action_dim]
        """
        return self.trunk(self.action_in(actions) + condition_part + time_part)


class DiffusionModel(nn.Module):
    """
    Denoising diffusion of actions in [-1, 1] with epsilon prediction, clipped x0 and fixed posterior variance.

    :param denoiser: The noise predictor
    :param n_steps: Number of diffusion steps T
    :param noise_schedule: One of ``NOISE_SCHEDULES``
    :raises ValueError: If there is no such schedule
    """

    alpha_bar: th.Tensor
    sqrt_alpha_bar: th.Tensor
    sqrt_one_minus_alpha_bar: th.Tensor

    def __init__(self, denoiser: Denoiser, n_steps: int, noise_schedule: str = "cosine") -> None:
        super().__init__()
        self.denoiser = denoiser
        self.n_steps = n_steps
        if noise_schedule not in NOISE_SCHEDULES:
            raise ValueError(f"noise_schedule must be one of {list(NOISE_SCHEDULES)}, got {noise_schedule!r}")
        with th.device("cpu"):  # wherever the networks are made
            betas = NOISE_SCHEDULES[noise_schedule](n_steps)
            previous = th.ones(1, dtype=th.float64)
        alpha_bar = th.cumprod(1 - betas, dim=0)
        previous = th.cat((previous, alpha_bar[:-1]))
        # Python floats: the loop over T steps then launches no kernels to look them up
        self._x0_scale = alpha_bar.rsqrt().tolist()
        self._noise_scale = (1 / alpha_bar - 1).sqrt().tolist()
        self._mean_x0 = (betas * previous.sqrt() / (1 - alpha_bar)).tolist()
        self._mean_xt = ((1 - betas).sqrt() * (1 - previous) / (1 - alpha_bar)).tolist()
        self._sigma = (betas * (1 - previous) / (1 - alpha_bar)).sqrt().tolist()
        self.register_buffer("sqrt_alpha_bar", alpha_bar.sqrt().float(), persistent=False)
        self.register_buffer("sqrt_one_minus_alpha_bar", (1 - alpha_bar).sqrt().float(), persistent=False)

    @th.no_grad()
    def sample(self, condition: th.Tensor, deterministic: bool = False, noise: th.Tensor | None = None) -> th.Tensor:
        """
        As ``denoise``, without gradients.

        :param condition: Shape [N, condition_dim]
        :param deterministic: See ``denoise``
        :param noise: See ``denoise``
        :return: Actions in [-1, 1], shape [N, action_dim]
        """
        return self.denoise(condition, deterministic, noise)

    def denoise(self, condition: th.Tensor, deterministic: bool = False, noise: th.Tensor | None = None) -> th.Tensor:
        """
        Draw actions by ancestral sampling (Ho et al., 2020, algorithm 2). Gradients reach the condition and the denoiser, but
        not where an action is cut at its bounds.

        :param condition: Shape [N, condition_dim]
        :param deterministic: Start from a zero latent and follow the posterior means, without any noise
        :param noise: The noise to use, shape [T, N, action_dim]: ``noise[0]`` is the initial latent, ``noise[k]``
            enters after the k-th denoising step. Drawn when None
        :return: Actions in [-1, 1], shape [N, action_dim]
        """
        shape = (self.n_steps, condition.shape[0], self.denoiser.action_in.in_features)
        if deterministic:
            actions = condition.new_zeros(shape[1:])
        else:
            noise = th.randn(shape, device=condition.device) if noise is None else noise
            actions = noise[0]
        condition_part = self.denoiser.condition_in(condition)
        time_table = self.denoiser.time_table()
        for t in reversed(range(self.n_steps)):
            epsilon = self.denoiser(actions, condition_part, time_table[t])
            x0 = (self._x0_scale[t] * actions - self._noise_scale[t] * epsilon).clamp(-1.0, 1.0)
            actions = self._mean_x0[t] * x0 + self._mean_xt[t] * actions
            if t > 0 and noise is not None and not deterministic:
                actions = actions + self._sigma[t] * noise[self.n_steps - t]
        return actions

    def loss(
        self,
        actions: th.Tensor,
        condition: th.Tensor,
        weights: th.Tensor | None = None,
        steps: th.Tensor | None = None,
        noise: th.Tensor | None = None,
    ) -> th.Tensor:
        """
        Denoising loss (equation 1 of the DDiffPG paper): mean squared error of the predicted noise.

        :param actions: Clean actions in [-1, 1], shape [N, action_dim]
        :param condition: Shape [N, condition_dim]
        :param weights: Weight of each row, shape [N]; 1 when None
        :param steps: Diffusion step of each row, shape [N]; uniform when None
        :param noise: Shape [N, action_dim]; standard normal when None
        :return: Scalar
        """
        if steps is None:
            steps = th.randint(self.n_steps, (actions.shape[0],), device=actions.device)
        if noise is None:
            noise = th.randn_like(actions)
        noisy = self.sqrt_alpha_bar[steps, None] * actions + self.sqrt_one_minus_alpha_bar[steps, None] * noise
        # index_select: its gradient sums into T rows, where plain indexing would be several times slower
        time_part = self.denoiser.time_table().index_select(0, steps)
        errors = (self.denoiser(noisy, self.denoiser.condition_in(condition), time_part) - noise).pow(2).mean(dim=1)
        return errors.mean() if weights is None else (errors * weights).sum() / weights.sum()


class DiffusionActor(Actor):
    """
    Diffusion policy conditioned on observation and mode embedding.

    :param observation_space: Observation space
    :param action_space: Action space
    :param net_arch: Hidden layers of the denoiser
    :param features_extractor: Extracts the features of the observation
    :param features_dim: Number of features
    :param activation_fn: Activation of the denoiser
    :param n_diffusion_steps: Number of diffusion steps T
    :param mode_embedding_dim: Size of a mode embedding
    :param time_embedding_dim: Size of a diffusion step's embedding
    :param normalize_images: Whether images are divided by 255
    :param noise_schedule: See ``diffusion.DiffusionModel``
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: nn.Module,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.SiLU,
        n_diffusion_steps: int = 5,
        mode_embedding_dim: int = 5,
        time_embedding_dim: int = 32,
        normalize_images: bool = True,
        noise_schedule: str = "cosine",
    ) -> None:
        super().__init__(observation_space, action_space, features_extractor, features_dim, normalize_images)
        self.net_arch, self.activation_fn = net_arch, activation_fn
        self.n_diffusion_steps = n_diffusion_steps
        self.mode_embedding_dim, self.time_embedding_dim = mode_embedding_dim, time_embedding_dim
        denoiser = Denoiser(
            condition_dim=features_dim + mode_embedding_dim,
            action_dim=int(np.prod(action_space.shape)),
            n_steps=n_diffusion_steps,
            net_arch=net_arch,
            activation_fn=activation_fn,
            time_embedding_dim=time_embedding_dim,
        )
        self.noise_schedule = noise_schedule
        self.diffusion = DiffusionModel(denoiser, n_diffusion_steps, noise_schedule)

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
        :param deterministic: Zero initial latent, posterior means
        :param embeddings: Mode embeddings, [N, mode_embedding_dim]; zero when None
        :return: Actions in [-1, 1], [N, action_dim]
        """
        return self.diffusion.sample(self.condition(obs, embeddings), deterministic=deterministic)
