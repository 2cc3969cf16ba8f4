"""Diffusion model over actions (Ho et al., 2020): noise schedule, sampling and loss."""

import math
from collections.abc import Callable

import torch as th

from sb3_ddiffpg.networks.denoiser import ActionModel, Denoiser, weighted_mean


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


class DiffusionModel(ActionModel):
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
        #: Standard normal draws of which an action is made
        self.n_draws = n_steps
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
        shape = (self.n_steps, condition.shape[0], self.denoiser.action_dim)
        if deterministic:
            actions = condition.new_zeros(shape[1:])
        else:
            noise = th.randn(shape, device=condition.device) if noise is None else noise
            actions = noise[0]
        condition_part = self.denoiser.condition_in(condition)
        time_table = self.denoiser.time_table()
        for t in reversed(range(self.n_steps)):
            epsilon = self.denoiser(actions, condition_part, time_table[t])
            x0 = th.add(self._x0_scale[t] * actions, epsilon, alpha=-self._noise_scale[t]).clamp(-1.0, 1.0)
            actions = th.add(self._mean_x0[t] * x0, actions, alpha=self._mean_xt[t])
            if t > 0 and noise is not None and not deterministic:
                actions = th.add(actions, noise[self.n_steps - t], alpha=self._sigma[t])
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
        :param weights: Weight of each row, shape [N], or of each number, [N, action_dim]; 1 when None
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
        return weighted_mean((self.denoiser(noisy, self.denoiser.condition_in(condition), time_part) - noise).pow(2), weights)
