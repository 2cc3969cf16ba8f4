"""A model of the task in a latent space: encoder, dynamics, reward, the episode's end, and values."""

from collections.abc import Sequence

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from torch import nn

from sb3_ddiffpg.networks.critics import ModeCritics


class WorldModel(nn.Module):
    """
    Latent states lie in (-1, 1), where a gated recurrent unit leaves them.

    :param features_extractor: Features of an observation
    :param features_dim: Their number
    :param action_dim: Size A of the action
    :param condition_dim: Size Z of what values depend on beside the state
    :param net_arch: Hidden layers of encoder, heads and values
    :param state_dim: Size L of a latent state
    :param activation_fn: Activation of the hidden layers
    :param n_critics: Values for each state, of which the smallest counts
    :param support: Lower and upper end of the values
    """

    def __init__(
        self,
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        action_dim: int,
        condition_dim: int,
        net_arch: Sequence[int],
        state_dim: int,
        activation_fn: type[nn.Module],
        n_critics: int,
        support: tuple[float, float],
    ) -> None:
        super().__init__()
        self.features_extractor = features_extractor
        self.encoder = nn.Sequential(*create_mlp(features_dim, state_dim, list(net_arch), activation_fn, squash_output=True))
        self.dynamics = nn.GRUCell(action_dim, state_dim)
        self.heads = nn.Sequential(*create_mlp(state_dim + action_dim, 2, list(net_arch), activation_fn))
        self.critics = ModeCritics(
            state_dim,
            condition_dim,
            net_arch,
            activation_fn=activation_fn,
            n_critics=n_critics,
            n_atoms=1,
            support=support,
            exploration_support=support,
        )

    def step(self, states: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        :param states: Latent states, [N, L]
        :param actions: In [-1, 1], [N, A]
        :return: Next states [N, L], rewards [N], and the logits of the episode's end there [N]
        """
        rewards, ends = self.heads(th.cat((states, actions), dim=1)).unbind(dim=1)
        return self.dynamics(actions, states), rewards, ends

    def values(self, states: th.Tensor, conditions: th.Tensor) -> th.Tensor:
        """
        :param states: Latent states, [N, L]
        :param conditions: [N, Z]
        :return: Each critic's value of them, [C, N]
        """
        return self.critics.values(self.critics(states[None], conditions[None]))[0]
