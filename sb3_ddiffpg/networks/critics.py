"""Twin distributional critics of the exploratory group and of every mode, stacked in one set of tensors."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise

import torch as th
from torch import nn
from torch.nn import functional as F

# The projected distribution of the twin with the lower mean; or the element-wise minimum of all, with binary cross-entropy, as
# in the authors' code
TWIN_TARGETS = ("lower_mean", "elementwise")
#: Row of everything that is kept by group: 0 explores, m + 1 is mode m
EXPLORATORY_GROUP = 0
ALL_GROUPS = slice(None)
# What optimisers call the mean of the gradients
DIRECTIONS = ("exp_avg", "momentum_buffer")


class ModeCritics(nn.Module):
    """
    The critics of G groups: group 0 explores, group m + 1 is mode m. Each group has ``n_critics`` independent C51 critics
    (Bellemare et al., 2017), or scalar ones when ``n_atoms=1``. Every layer holds one weight per group and critic, so that
    all critics are evaluated by one batched product; groups come and go with ``inherit``.

    :param features_dim: Size F of the observation features
    :param action_dim: Size A of the action
    :param net_arch: Sizes of the hidden layers; without any the critics are linear
    :param n_groups: Number of groups G
    :param activation_fn: Activation of the hidden layers
    :param n_critics: Critics per group C; the minimum over them is used, as in TD3
    :param n_atoms: Atoms of the value distribution, 1 for scalar critics
    :param support: Lower and upper end of the values of the modes' critics
    :param exploration_support: The same for the exploratory group
    :param twin_target: What the C51 critics of a group learn from, one of ``TWIN_TARGETS``
    """

    optimizer: th.optim.Optimizer
    lower: th.Tensor
    upper: th.Tensor
    atoms: th.Tensor
    kinds: th.Tensor

    def __init__(
        self,
        features_dim: int,
        action_dim: int,
        net_arch: Sequence[int],
        n_groups: int = 1,
        activation_fn: type[nn.Module] = nn.SiLU,
        n_critics: int = 2,
        n_atoms: int = 51,
        support: tuple[float, float] = (0.0, 5.0),
        exploration_support: tuple[float, float] = (0.0, 5.0),
        twin_target: str = "lower_mean",
    ) -> None:
        super().__init__()
        if min(net_arch, default=1) < 1:
            raise ValueError(f"net_arch['qf'] must name hidden layers of at least one unit each, got {net_arch}")
        self.n_critics, self.n_atoms, self.twin_target = n_critics, n_atoms, twin_target
        self.features_dim, self.action_dim = features_dim, action_dim
        self.activation = activation_fn()
        sizes = [features_dim + action_dim, *net_arch, n_atoms]
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for size_in, size_out in pairwise(sizes):
            bound = 1 / math.sqrt(size_in)  # the uniform initialisation of nn.Linear
            self.weights.append(nn.Parameter(th.empty(n_groups, n_critics, size_in, size_out).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(th.empty(n_groups, n_critics, 1, size_out).uniform_(-bound, bound)))
        # Supports per group: a table of two rows (exploring, mode) indexed by group
        lower, upper = th.tensor([exploration_support, support], dtype=th.float32).T
        self.register_buffer("lower", lower, persistent=False)
        self.register_buffer("upper", upper, persistent=False)
        self.register_buffer("kinds", self._kinds_of(n_groups), persistent=False)
        fractions = th.linspace(0, 1, n_atoms)
        self.register_buffer("atoms", lower[:, None] + fractions * (upper - lower)[:, None], persistent=False)
        for group in range(n_groups):
            self._reset_output(group, zero_weights=False)

    @property
    def n_groups(self) -> int:
        """Number of groups G: the exploratory one and the modes."""
        return self.weights[0].shape[0]

    @staticmethod
    def _kinds_of(n_groups: int) -> th.Tensor:
        """Row of the support tables for every group, shape [G]."""
        return th.arange(n_groups).clamp(max=1)

    @th.no_grad()
    def _reset_output(self, group: int, zero_weights: bool = True) -> None:
        """
        Let a group's values start near zero: a uniform distribution would start in the middle of the support,
        where unseen actions look better than any reachable return.
        """
        if zero_weights:
            self.weights[-1].data[group] = 0.0
        if self.n_atoms == 1:
            self.biases[-1].data[group] = 0.0
            return
        kind = 0 if group == 0 else 1
        self.biases[-1].data[group] = -8.0 * self.atoms[kind].abs() / (self.upper[kind] - self.lower[kind])

    def forward(self, features: th.Tensor, actions: th.Tensor, frozen: bool = False) -> th.Tensor:
        """
        :param features: Observation features of each group's rows, shape [G, n, F]
        :param actions: Shape [G, n, A]
        :param frozen: Whether the weights are constants, which makes a gradient with respect to the actions cheaper
        :return: Logits over the atoms (values when scalar), shape [G, C, n, n_atoms]
        """
        return self._outputs(th.cat((features, actions), dim=2), self._stacked(frozen))

    def _stacked(self, frozen: bool) -> list[tuple[th.Tensor, th.Tensor]]:
        """Weights [G * C, in, out] and biases [G * C, 1, out] of all layers."""
        layers = [[parameter.flatten(0, 1) for parameter in layer] for layer in zip(self.weights, self.biases, strict=True)]
        return [(weight.detach(), bias.detach()) if frozen else (weight, bias) for weight, bias in layers]

    def _outputs(self, inputs: th.Tensor, parameters: list[tuple[th.Tensor, th.Tensor]]) -> th.Tensor:
        """Of all critics of g groups, [g, C, n, n_atoms], whose rows are [g, n, in]."""
        shared = inputs[:, None].expand(-1, self.n_critics, -1, -1).flatten(0, 1)  # [g * C, n, in]
        return self._layers(shared, parameters)[-1].unflatten(0, (-1, self.n_critics))

    def _layers(self, inputs: th.Tensor, parameters: list[tuple[th.Tensor, th.Tensor]]) -> list[th.Tensor]:
        """What every layer gives before its activation, [N, n, width] each, of N networks whose rows are [N, n, in]."""
        layers: list[th.Tensor] = []
        hidden = inputs
        for weight, bias in parameters:
            layers.append(th.baddbmm(bias, hidden, weight))
            hidden = self.activation(layers[-1]) if len(layers) < len(parameters) else hidden
        return layers

    def values(self, logits: th.Tensor, groups: slice = ALL_GROUPS) -> th.Tensor:
        """
        :param logits: Output of ``forward``, shape [G, C, n, n_atoms]
        :param groups: Which groups they are of
        :return: Expected values, shape [G, C, n]
        """
        if self.n_atoms == 1:
            return logits.squeeze(-1)
        return (logits.softmax(dim=-1) * self.atoms[self.kinds[groups]][:, None, None, :]).sum(dim=-1)

    def values_by(self, groups: slice, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param groups: Which groups are asked, g of them
        :param features: Observation features of n rows, which all of them judge, [n, F]
        :param actions: Actions there, [n, A]
        :return: Of each group the smaller of the twins' values, [g, n]
        """
        layers = zip(self.weights, self.biases, strict=True)
        parameters = [(weight[groups].flatten(0, 1), bias[groups].flatten(0, 1)) for weight, bias in layers]
        inputs = th.cat((features, actions), dim=1).expand(len(parameters[0][0]) // self.n_critics, -1, -1)
        return self.values(self._outputs(inputs, parameters), groups).min(dim=1).values

    @th.no_grad()
    def bellman_target(self, features: th.Tensor, actions: th.Tensor, rewards: th.Tensor, discounts: th.Tensor) -> th.Tensor:
        """
        Target of the lower-mean twin: its distribution, shifted by the reward and projected on the support. With
        ``twin_target="elementwise"`` the minimum of all twins' projections, atom by atom, which does not sum to one.

        :param features: Features of the bootstrap states, shape [G, n, F]
        :param actions: Actions there, shape [G, n, A]
        :param rewards: (n-step) rewards, shape [G, n]
        :param discounts: gamma^k, or 0 where the episode terminated, shape [G, n]
        :return: Target probabilities, shape [G, n, n_atoms]; scalar targets, shape [G, n, 1], when ``n_atoms=1``
        """
        logits = self(features, actions)
        kind = self.kinds
        low, high = self.lower[kind][:, None], self.upper[kind][:, None]  # [G, 1]
        if self.n_atoms == 1:
            values = logits.squeeze(-1).amin(dim=1)  # [G, n]
            return (rewards + discounts * values).clamp(low, high)[..., None]
        twins = logits.softmax(dim=-1)  # [G, C, n, n_atoms]
        atoms = self.atoms[kind][:, None, :]
        if self.twin_target == "elementwise":
            projections = [project_distribution(twin, atoms, rewards, discounts) for twin in twins.unbind(dim=1)]
            return th.stack(projections).amin(dim=0).clamp(0.0, 1.0)  # rounding can exceed one
        lower_twin = (twins * atoms[:, None]).sum(dim=-1).argmin(dim=1)  # [G, n]
        index = lower_twin[:, None, :, None].expand(-1, 1, -1, self.n_atoms)
        probabilities = twins.gather(1, index).squeeze(1)  # [G, n, n_atoms]
        return project_distribution(probabilities, atoms, rewards, discounts)

    def loss(self, features: th.Tensor, actions: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """
        :param features: Shape [G, n, F]
        :param actions: Shape [G, n, A]
        :param targets: From ``bellman_target``, shape [G, n, n_atoms]
        :return: Loss of every group, summed over its critics and averaged over its rows, shape [G]
        """
        logits = self(features, actions)
        if self.n_atoms == 1:
            return (logits - targets[:, None]).pow(2).mean(dim=(2, 3)).sum(dim=1)
        if self.twin_target == "elementwise":
            probabilities, targets = logits.softmax(dim=-1), targets[:, None].expand_as(logits)
            errors = F.binary_cross_entropy(probabilities, targets, reduction="none")
            return errors.sum(dim=-1).mean(dim=2).sum(dim=1)
        return -(targets[:, None] * F.log_softmax(logits, dim=-1)).sum(dim=-1).mean(dim=2).sum(dim=1)

    def share_at_top(self, targets: th.Tensor) -> th.Tensor:
        """
        How much of the targets lies at the upper end of the support, where larger values would look the same.

        :param targets: From ``bellman_target``, shape [G, n, n_atoms]
        :return: Share of every group, shape [G]
        """
        if self.n_atoms > 1:
            return targets[..., -1].mean(dim=1)
        return (targets[..., 0] >= self.upper[self.kinds][:, None]).float().mean(dim=1)

    def action_gradient(self, features: th.Tensor) -> Callable[[th.Tensor], th.Tensor]:
        """
        The gradient of each group's first critic, as in TD3's actor, with respect to each row's own action: it does not depend
        on the batch's size.

        :param features: Shape [G, n, F]
        :return: The gradient as a function of the actions, [G, n, A] to [G, n, A]
        """
        layers = zip(self.weights, self.biases, strict=True)
        (weight, bias), *others = [(weight.detach()[:, 0], bias.detach()[:, 0]) for weight, bias in layers]
        # The features' part of the first layer is the same at every step of an ascent
        first = weight[:, self.features_dim :], th.baddbmm(bias, features, weight[:, : self.features_dim])
        return partial(self._first_critics_gradient, [first, *others])

    @th.no_grad()
    def _first_critics_gradient(self, parameters: list[tuple[th.Tensor, th.Tensor]], actions: th.Tensor) -> th.Tensor:
        """By hand, half of autograd's kernels."""
        *hidden, output = self._layers(actions, parameters)
        backward = th.ones_like(output)
        if self.n_atoms > 1:  # of the expected value with respect to the logits: p (z - E z)
            probabilities, atoms = output.softmax(dim=-1), self.atoms[self.kinds][:, None, :]
            backward = probabilities * (atoms - (probabilities * atoms).sum(dim=-1, keepdim=True))
        for (weight, _), before in zip(parameters[:0:-1], hidden[::-1], strict=True):
            backward = self._through_activation(th.bmm(backward, weight.mT), before)
        return th.bmm(backward, parameters[0][0].mT)

    def _through_activation(self, gradient: th.Tensor, before: th.Tensor) -> th.Tensor:
        """
        :param gradient: Of what comes after the activation
        :param before: What went into it, same shape
        :return: Gradient of what went into it, same shape
        """
        if type(self.activation) is nn.SiLU:
            return th.ops.aten.silu_backward(gradient, before)
        if type(self.activation) is nn.ELU:
            return th.ops.aten.elu_backward(gradient, self.activation.alpha, 1.0, 1.0, False, before)
        before = before.detach().requires_grad_()
        with th.enable_grad():
            return th.autograd.grad(self.activation(before), before, gradient)[0]

    @th.no_grad()
    def inherit(
        self, parents: Sequence[int | None], fresh: Sequence[bool], optimizer: th.optim.Optimizer | None, reset_output: bool
    ) -> None:
        """
        Rebuild the stack after a re-clustering, in place: weights and optimiser moments move together.

        :param parents: For every new mode, the old mode whose critics it takes, or None: the exploratory critics
        :param fresh: For every new mode, whether its optimiser's momentum restarts at zero
        :param optimizer: Optimiser of this stack (None for a target network)
        :param reset_output: Whether a mode without parent starts with a zeroed output layer; the exploratory values
            it copies are on another scale than a mode's
        """
        source = th.tensor([0] + [0 if parent is None else parent + 1 for parent in parents], device=self.atoms.device)
        restart = [group + 1 for group, new in enumerate(fresh) if new]
        replaced: dict[nn.Parameter, nn.Parameter] = {}
        for parameters in (self.weights, self.biases):
            for layer, parameter in enumerate(parameters):
                replaced[parameter] = nn.Parameter(parameter[source].clone())
                parameters[layer] = replaced[parameter]
        self.kinds = self._kinds_of(self.n_groups).to(self.atoms.device)
        if optimizer is not None:
            for param_group in optimizer.param_groups:
                param_group["params"] = [replaced.get(parameter, parameter) for parameter in param_group["params"]]
            for old, new in replaced.items():
                state = optimizer.state.pop(old, None)
                if state is None:
                    continue
                for name, value in state.items():
                    if isinstance(value, th.Tensor) and value.shape == old.shape:
                        state[name] = value[source].clone()
                        # Only the direction is forgotten: the step count is shared by all groups, and second moments that
                        # restarted at zero beside it would make the first steps three learning rates long
                        if name in DIRECTIONS:
                            state[name][restart] = 0.0
                optimizer.state[new] = state
        if reset_output:
            for mode, parent in enumerate(parents):
                if parent is None:
                    self._reset_output(mode + 1)

    @contextmanager
    def at_rest(self, groups: Sequence[int]) -> Iterator[None]:
        """
        Groups that nothing trains stay as they are: an optimiser's step would move them too, by decay and momentum.

        :param groups: Which of them
        """
        moved: list[tuple[th.Tensor, th.Tensor]] = []
        for parameter in self.stacked_parameters() if len(groups) else []:
            gathered = self.optimizer.state.get(parameter, {}).values()
            moments = [each for each in gathered if isinstance(each, th.Tensor) and each.shape == parameter.shape]
            moved += [(each, each[groups].clone()) for each in (parameter.data, *moments)]
        yield
        for tensor, before in moved:
            tensor[groups] = before

    def stacked_parameters(self) -> list[nn.Parameter]:
        """
        :return: The parameters whose first dimension is the group
        """
        return [*self.weights, *self.biases]

    @th.no_grad()
    def clip_gradients(self, max_norm: float) -> th.Tensor:
        """
        Clip every group's gradient on its own: one group's exploding loss must not shrink the steps of the others.

        :param max_norm: Largest allowed norm of one group's gradient
        :return: What each norm was, [G]
        """
        gradients = [parameter.grad for parameter in self.stacked_parameters() if parameter.grad is not None]
        norms = th.stack([th.linalg.vector_norm(gradient, dim=(1, 2, 3)) for gradient in gradients]).norm(dim=0)  # [G]
        scale = (max_norm / (norms + 1e-6)).clamp(max=1.0)[:, None, None, None]
        for gradient in gradients:
            gradient.mul_(scale)
        return norms


def project_distribution(probabilities: th.Tensor, atoms: th.Tensor, rewards: th.Tensor, discounts: th.Tensor) -> th.Tensor:
    """
    Distributional Bellman projection (Bellemare et al., 2017, algorithm 1): move every atom to ``r + discount * z`` and
    split its probability between the two neighbouring atoms.

    :param probabilities: Shape [G, n, n_atoms]
    :param atoms: Equally spaced support, broadcastable to [G, n, n_atoms]
    :param rewards: Shape [G, n]
    :param discounts: Shape [G, n], 0 at a terminal state
    :return: Projected probabilities, shape [G, n, n_atoms]
    """
    n_atoms = atoms.shape[-1]
    low, high = atoms[..., :1], atoms[..., -1:]
    step = (high - low) / (n_atoms - 1)
    # Where every atom comes to lie, counted in atoms from the lower end
    first = (rewards[..., None] + (discounts[..., None] - 1.0) * low) / step
    position = th.addcmul(first, discounts[..., None], th.arange(n_atoms, device=atoms.device)).clamp_(0, n_atoms - 1)
    left = position.long()
    right_share = (position - left).mul_(probabilities)
    # One atom more: to the right of the last one there is nothing, and nothing comes there
    projected = probabilities.new_zeros(*probabilities.shape[:-1], n_atoms + 1)
    projected.scatter_add_(-1, left, probabilities - right_share).scatter_add_(-1, left + 1, right_share)
    return projected[..., :n_atoms]
