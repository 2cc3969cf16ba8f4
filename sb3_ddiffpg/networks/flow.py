"""Flow from noise to actions along straight lines (Liu et al., 2023; Lipman et al., 2023), followed in a few steps."""

from itertools import pairwise

import torch as th

from sb3_ddiffpg.networks.denoiser import ActionModel, Denoiser, weighted_mean

#: When the flow asks for its velocity. With the first time alone, a policy that may go left or right at a fork would go
#: straight on: seen from pure noise, an action is the mean of all. The second decides; a later one than half-way more clearly,
#: but then fewer routes were found (docs/research_log/arithmetic.md)
FLOW_TIMES = (1.0, 0.5)


class FlowModel(ActionModel):
    """
    Rectified flow of actions in [-1, 1]: ``x_t = (1 - t) a + t z`` leads from noise z at t = 1 to an action a at t = 0. The
    network learns its velocity ``z - a``, at those times alone at which sampling asks for it.

    :param denoiser: Predicts the velocity at each of the times
    """

    times: th.Tensor
    #: Standard normal draws of which an action is made
    n_draws = 1

    def __init__(self, denoiser: Denoiser) -> None:
        super().__init__()
        self.denoiser = denoiser
        self.register_buffer("times", th.tensor(FLOW_TIMES), persistent=False)

    def denoise(self, condition: th.Tensor, deterministic: bool = False, noise: th.Tensor | None = None) -> th.Tensor:
        """
        Follow the flow. Gradients reach the condition and the network, but not where an action is cut at its bounds.

        :param condition: Shape [N, condition_dim]
        :param deterministic: Start from zero instead of noise
        :param noise: Where to start, shape [1, N, action_dim]. Drawn when None
        :return: Actions in [-1, 1], shape [N, action_dim]
        """
        shape = (condition.shape[0], self.denoiser.action_dim)
        if deterministic:
            actions = condition.new_zeros(shape)
        else:
            actions = th.randn(shape, device=condition.device) if noise is None else noise[0]
        condition_part = self.denoiser.condition_in(condition)
        for time_part, (time, then) in zip(self.denoiser.time_table(), pairwise((*FLOW_TIMES, 0.0)), strict=True):
            velocity = self.denoiser(actions, condition_part, time_part)
            actions = th.add(actions, velocity, alpha=then - time)
        return actions.clamp(-1.0, 1.0)

    def loss(
        self,
        actions: th.Tensor,
        condition: th.Tensor,
        weights: th.Tensor | None = None,
        steps: th.Tensor | None = None,
        noise: th.Tensor | None = None,
    ) -> th.Tensor:
        """
        Flow matching: mean squared error of the predicted velocity.

        :param actions: Clean actions in [-1, 1], shape [N, action_dim]
        :param condition: Shape [N, condition_dim]
        :param weights: Weight of each row, shape [N], or of each number, [N, action_dim]; 1 when None
        :param steps: Euler step of each row, shape [N]; uniform when None
        :param noise: Shape [N, action_dim]; standard normal when None
        :return: Scalar
        """
        if steps is None:
            steps = th.randint(len(FLOW_TIMES), (actions.shape[0],), device=actions.device)
        if noise is None:
            noise = th.randn_like(actions)
        between = th.lerp(actions, noise, self.times[steps, None])
        time_part = self.denoiser.time_table().index_select(0, steps)
        velocity = self.denoiser(between, self.denoiser.condition_in(condition), time_part)
        return weighted_mean((velocity - (noise - actions)).pow(2), weights)
