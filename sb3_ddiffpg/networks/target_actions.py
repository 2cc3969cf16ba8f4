"""Gradient ascent on actions: a_target <- a_target + eta * grad_a Q(s, a_target)."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch as th

# Actions stay inside the bounds by this much, so that a gradient can still pull them back
ACTION_LIMIT = 1 - 1e-5
ACTION_OPTIMIZERS = ("sgd", "normalized", "relative", "adam")


def ascend(
    gradient: Callable[[th.Tensor], th.Tensor],
    actions: th.Tensor,
    learning_rate: float,
    n_steps: int = 1,
    optimizer: str = "adam",
) -> th.Tensor:
    """
    Improve every action on its own: but for ``"relative"``, the result for a row does not depend on the rest of the batch.

    ``"sgd"`` takes plain steps (the paper's equation), ``"normalized"`` steps of length ``learning_rate`` along the
    gradient, ``"adam"`` restarts Adam (Kingma & Ba, 2015) for every call, so that its first step is a sign step.
    ``"relative"`` steps are those of ``"normalized"``, but shorter in proportion where the gradient is less than its group's
    mean: where all actions are worth nearly the same, its direction is that of the critics' errors, and full steps would make
    the policy sure of any action at all.

    :param gradient: Maps actions to the gradient of their value, both [..., n, action_dim]
    :param actions: Where to start, shape [..., n, action_dim], the n rows of each group
    :param learning_rate: Step size eta
    :param n_steps: Number of steps K
    :param optimizer: One of ``ACTION_OPTIMIZERS``
    :return: Improved actions inside [-1, 1], same shape
    """
    mean, square = th.zeros_like(actions), th.zeros_like(actions)
    for step in range(1, n_steps + 1):
        ascent = gradient(actions)
        if optimizer in ("normalized", "relative"):
            sizes = ascent.norm(dim=-1, keepdim=True)
            if optimizer == "relative":
                sizes = sizes.maximum(sizes.mean(dim=-2, keepdim=True))
            ascent = ascent / (sizes + 1e-8)
        elif optimizer == "adam":
            mean.lerp_(ascent, 0.1)
            square.lerp_(ascent.square(), 0.001)
            ascent = mean / (1 - 0.9**step) / (square / (1 - 0.999**step)).sqrt_().add_(1e-8)
        actions = th.add(actions, ascent, alpha=learning_rate).clamp_(-ACTION_LIMIT, ACTION_LIMIT)
    return actions


def climb(policy: Any, batch: Any, settings: Any, largest_norm: float | None = None) -> th.Tensor:
    """
    Let the target actions of a batch climb the critics that own them.

    :param policy: A ``TwinCriticPolicy``
    :param batch: A ``ModeBatch``
    :param settings: ``TargetActionSettings``
    :param largest_norm: Of the gradient of the whole batch; None: no limit
    :return: Improved target actions, [G, n, action_dim]
    """
    with th.no_grad():
        features = policy.critic_features(batch.observations)
    gradient = policy.critics.action_gradient(features)
    if largest_norm is not None:
        gradient = partial(_limited, gradient, largest_norm)
    return ascend(gradient, batch.target_actions, settings.learning_rate, settings.n_steps, settings.optimizer)


def _limited(gradient: Callable[[th.Tensor], th.Tensor], limit: float, actions: th.Tensor) -> th.Tensor:
    found = gradient(actions)
    return found * (limit / (found.norm() + 1e-8)).clamp(max=1.0)
