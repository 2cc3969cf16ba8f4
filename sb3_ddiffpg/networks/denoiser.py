"""The network that a diffusion or a flow of actions asks: what is noise in an action, given an observation and a mode."""

import math
from itertools import pairwise

import torch as th
from torch import nn


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
    Predicts the noise in an action, epsilon(a_t, condition, t), or in which direction it lies.

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
        self.action_dim = action_dim
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
        # The steps are always the same; only what is made of their embedding changes
        self.embedded_steps: th.Tensor
        self.register_buffer("embedded_steps", self.time_mlp[0](th.arange(n_steps)), persistent=False)

    def time_table(self) -> th.Tensor:
        """
        :return: The first layer's time part for every diffusion step, shape [T, net_arch[0]]
        """
        part = self.embedded_steps
        _, *layers = self.time_mlp
        for layer in layers:
            part = layer(part)
        return self.time_in(part)

    def forward(self, actions: th.Tensor, condition_part: th.Tensor, time_part: th.Tensor) -> th.Tensor:
        """
        :param actions: Noisy actions, shape [N, action_dim]
        :param condition_part: ``condition_in(condition)``, shape [N, net_arch[0]]
        :param time_part: Rows of ``time_table()``, broadcastable to [N, net_arch[0]]
        :return: Predicted noise, shape [N, action_dim]
        """
        return self.trunk(th.addmm(condition_part + time_part, actions, self.action_in.weight.T))


class ActionModel(nn.Module):
    """What makes actions of noise by a denoiser: a diffusion or a flow."""

    #: The network that is asked
    denoiser: Denoiser

    def denoise(self, condition: th.Tensor, deterministic: bool = False, noise: th.Tensor | None = None) -> th.Tensor:
        """
        See the subclass.

        :param condition: Shape [N, condition_dim]
        :param deterministic: Whether no noise is drawn
        :param noise: The noise to use; drawn when None
        :return: Actions in [-1, 1], shape [N, action_dim]
        """
        raise NotImplementedError

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


def weighted_mean(squares: th.Tensor, weights: th.Tensor | None) -> th.Tensor:
    """
    :param squares: Of errors, [N, action_dim]
    :param weights: Of each row, [N], or of each of them, [N, action_dim]; None: alike
    :return: Scalar
    """
    if weights is None:
        return squares.mean()
    if weights.dim() == 1:
        squares = squares.mean(dim=1)
    return (squares * weights).sum() / weights.sum()
