"""NovelD's intrinsic reward on a measure of novelty: random network distillation or visit counts."""

from functools import cache
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_ddiffpg.serialization.codec import registered
from sb3_ddiffpg.utils.divergence import step_unless


def noveld_reward(novelty: th.Tensor, next_novelty: th.Tensor, scale: float) -> th.Tensor:
    """
    NovelD (Zhang et al., 2021): ``max(nov(s') - scale * nov(s), 0)``, paid where novelty rises.

    :param novelty: Novelty of s, any shape
    :param next_novelty: Novelty of s', same shape
    :param scale: The factor alpha
    :return: Same shape
    """
    return (next_novelty - scale * novelty).clamp(min=0.0)


class RunningMoments(nn.Module):
    """
    Running mean and variance of every component.

    :param dim: Number of components
    :param max_count: Weight of the past, in samples: older ones fade
    """

    mean: th.Tensor
    var: th.Tensor
    count: th.Tensor

    def __init__(self, dim: int, max_count: float = float("inf")) -> None:
        super().__init__()
        self.max_count = max_count
        self.register_buffer("mean", th.zeros(dim))
        self.register_buffer("var", th.zeros(dim))
        self.register_buffer("count", th.zeros(1))

    @th.no_grad()
    def update(self, values: th.Tensor) -> None:
        """
        :param values: Shape [N, dim]
        """
        self.count.add_(values.shape[0]).clamp_(max=self.max_count)
        share = (values.shape[0] / self.count).clamp(max=1.0)
        variance, mean = th.var_mean(values, dim=0, correction=0)
        self.var.lerp_(th.addcmul(variance, 1 - share, (mean - self.mean).square()), share)
        self.mean.lerp_(mean, share)

    def standardize(self, values: th.Tensor) -> th.Tensor:
        """
        :param values: Shape [..., dim]
        :return: Same shape
        """
        return (values - self.mean) / (self.var.sqrt() + 1e-8)


@registered("sb3_ddiffpg.intrinsic.RandomNetworkDistillation")
class RandomNetworkDistillation(nn.Module):
    """
    Novelty as the error of a trained network on a frozen random one (Burda et al., 2018). Positions also enter as
    sines and cosines of frequencies 2^0..2^(L-1), which makes nearby places distinguishable; many frequencies blur the
    frontier between seen and unseen.

    :param position_dim: Size of the position features
    :param observation_dim: Size of the observation features
    :param with_observation: Whether the networks see the observation features beside the position, as in the paper
    :param net_arch: Sizes of the hidden layers and of the output
    :param n_frequencies: Number L of frequencies of the positional encoding
    :param learning_rate: Learning rate of the predictor
    """

    def __init__(
        self,
        position_dim: int,
        observation_dim: int,
        with_observation: bool = False,
        net_arch: tuple[int, ...] = (128, 128, 64),
        n_frequencies: int = 3,
        learning_rate: float = 1e-3,
    ) -> None:
        super().__init__()
        self.with_observation = with_observation
        self.frequencies: th.Tensor
        self.register_buffer("frequencies", 2.0 ** th.arange(n_frequencies), persistent=False)
        self.position_scale = RunningMoments(position_dim)
        size = position_dim * (1 + 2 * n_frequencies) + observation_dim * with_observation
        self.target = self._network(size, net_arch)
        self.predictor = self._network(size, net_arch)
        self.target.requires_grad_(False)
        self.optimizer = th.optim.Adam(self.predictor.parameters(), lr=learning_rate, fused=True)

    @staticmethod
    def _network(size: int, net_arch: tuple[int, ...]) -> nn.Sequential:
        layers: list[nn.Module] = []
        for size_in, size_out in zip((size, *net_arch[:-1]), net_arch, strict=True):
            linear = nn.Linear(size_in, size_out)
            nn.init.orthogonal_(linear.weight)
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.ELU()]
        return nn.Sequential(*layers[:-1])

    def _inputs(self, positions: th.Tensor, observations: th.Tensor) -> th.Tensor:
        """[N, position_dim], [N, observation_dim] -> [N, inputs of the networks]."""
        scaled = self.position_scale.standardize(positions)
        angles = (scaled[..., None] * self.frequencies).flatten(-2)
        parts = (scaled, angles.sin(), angles.cos())
        return th.cat((*parts, observations), dim=-1) if self.with_observation else th.cat(parts, dim=-1)

    @th.no_grad()
    def observe(self, positions: th.Tensor) -> None:
        """
        Take note of visited states: the running scale of the positions.

        :param positions: Shape [N, position_dim]
        """
        self.position_scale.update(positions)

    @th.no_grad()
    def novelty(self, positions: th.Tensor, observations: th.Tensor) -> th.Tensor:
        """
        :param positions: Shape [N, position_dim]
        :param observations: Shape [N, observation_dim]
        :return: L2 distance between the two networks, shape [N]
        """
        inputs = self._inputs(positions, observations)
        return (self.predictor(inputs) - self.target(inputs)).norm(dim=-1)

    def update(self, positions: th.Tensor, observations: th.Tensor) -> th.Tensor:
        """
        One gradient step of the predictor.

        :param positions: Shape [N, position_dim]
        :param observations: Shape [N, observation_dim]
        :return: The loss, a scalar
        """
        inputs = self._inputs(positions, observations)
        with th.no_grad():
            target = self.target(inputs)
        loss = (self.predictor(inputs) - target).pow(2).mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        step_unless(~loss.isfinite(), self.optimizer)
        return loss.detach()


def cell_entries(positions: th.Tensor, edges: th.Tensor, table_size: int) -> th.Tensor:
    """
    Cells of a grid without bounds, hashed into a table of fixed size, so that the map's extent need not be known. The same
    cell has the same entry in every process.

    :param positions: Shape [N, dim]
    :param edges: Of a cell along each component, in their unit, shape [dim] or [1]
    :param table_size: Number of entries of the table
    :return: Entry of each position's cell, shape [N]
    """
    cells = (positions / edges).floor().long()
    mixed = (cells * _multipliers(positions.shape[1], positions.device)).sum(dim=-1)
    return (mixed ^ (mixed >> 21)) % table_size


@cache
def _multipliers(dim: int, device: th.device) -> th.Tensor:
    """Fixed odd numbers."""
    numbers = np.random.default_rng(0).integers(1, 2**31, size=dim, dtype=np.int64) * 2 + 1
    return th.as_tensor(numbers, device=device)


# Of a thousand cells four share their entry with another one
TABLE_SIZE = 2**18  # 1 MB


class CellTable(nn.Module):
    """
    A value for every cell, see ``cell_entries``. It is as large as the one that is loaded into it.

    :param edge: Of a cell, in the unit of the positions, until ``resize`` says others
    :param name: Of the values
    :param values: For all cells, shape [table_size]
    """

    edges: th.Tensor

    def __init__(self, edge: float, name: str, values: th.Tensor) -> None:
        super().__init__()
        self._name = name
        self.register_buffer("edges", th.tensor([edge], dtype=th.float32), persistent=False)
        self.register_buffer(name, values)

    def resize(self, edges: np.ndarray) -> None:
        """
        Forget all cells: they are others now.

        :param edges: Of a cell along each component, in the unit of the positions, shape [dim]
        """
        self.use_edges(edges)
        getattr(self, self._name).zero_()

    def use_edges(self, edges: np.ndarray) -> None:
        """
        :param edges: Of the cells that the table knows, shape [dim]
        """
        self.edges = th.as_tensor(edges, dtype=th.float32, device=self.edges.device)

    def _entries(self, positions: th.Tensor) -> th.Tensor:
        return cell_entries(positions, self.edges, len(getattr(self, self._name)))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        values, stored = getattr(self, self._name), state_dict.get(prefix + self._name)
        if stored is not None and stored.ndim == 1 and len(stored):
            setattr(self, self._name, values.new_zeros(len(stored)))
        super()._load_from_state_dict(state_dict, prefix, *args)


@registered("sb3_ddiffpg.intrinsic.VisitCounts")
class VisitCounts(CellTable):
    """
    Novelty as ``1 / sqrt(1 + n)``, n the visits of the position's cell (Bellemare et al., 2016).

    :param position_dim: Size of the position features
    :param observation_dim: Not used: counting needs few dimensions
    :param cell_size: Edge of a cell, in the unit of the positions; the bonus says another where none is given
    :param table_size: Number of entries of the hash table
    """

    default_cell_size = 0.5
    counts: th.Tensor

    def __init__(
        self, position_dim: int, observation_dim: int, cell_size: float = default_cell_size, table_size: int = TABLE_SIZE
    ) -> None:
        if cell_size <= 0:
            raise ValueError(f"novelty.kwargs['cell_size'] must be positive, got {cell_size}")
        if table_size < 1:
            raise ValueError(f"novelty.kwargs['table_size'] must be at least 1, got {table_size}")
        super().__init__(cell_size, "counts", th.zeros(table_size))
        self.optimizer: th.optim.Optimizer | None = None

    @th.no_grad()
    def observe(self, positions: th.Tensor) -> None:
        """
        Count the visits.

        :param positions: Shape [N, position_dim]
        """
        entries = self._entries(positions)
        self.counts.index_add_(0, entries, th.ones_like(entries, dtype=self.counts.dtype))

    @th.no_grad()
    def forget(self, positions: th.Tensor) -> None:
        """
        Take back visits that were counted.

        :param positions: Shape [N, position_dim]
        """
        entries = self._entries(positions)
        self.counts.index_add_(0, entries, -th.ones_like(entries, dtype=self.counts.dtype)).clamp_(min=0)

    @th.no_grad()
    def novelty(self, positions: th.Tensor, observations: th.Tensor) -> th.Tensor:
        """
        :param positions: Shape [N, position_dim]
        :param observations: Not used
        :return: Shape [N]
        """
        return (1 + self.counts[self._entries(positions)]).rsqrt()

    def update(self, positions: th.Tensor, observations: th.Tensor) -> th.Tensor:
        """
        Nothing to learn.

        :param positions: Not used
        :param observations: Not used
        :return: Zero
        """
        return th.zeros(())


# Another measure is an nn.Module with the same methods, made with (position_dim, observation_dim, **kwargs) and passed
# as ``novelty=``; ``optimizer`` is None if it does not learn, ``with_observation`` (False) asks for the observation features;
# ``forget`` is for those that can
NOVELTY_MEASURES: dict[str, Any] = {"rnd": RandomNetworkDistillation, "counts": VisitCounts}
