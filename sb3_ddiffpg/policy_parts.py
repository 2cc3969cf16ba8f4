"""What all policies of this package share: how they are saved, their optimisers, and targets that follow other networks."""

from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy
from torch import nn
from torch.optim.swa_utils import get_ema_multi_avg_fn


class SavablePolicy(BasePolicy):
    """
    A policy that is saved with what it was made of: what a subclass notes in ``_constructor``, and SB3's own arguments.

    :param args: Of ``BasePolicy``
    :param kwargs: Of ``BasePolicy``
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, squash_output=True, **kwargs)
        self._constructor: dict[str, Any] = {}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            self._constructor,
            lr_schedule=self._dummy_schedule,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
            features_extractor_class=self.features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
        )
        return data

    def make_optimizer(self, parameters: Iterable[nn.Parameter], learning_rate: float) -> th.optim.Optimizer:
        """
        :param parameters: What it is to learn
        :param learning_rate: Its first learning rate
        :return: An optimiser of the policy's class
        """
        kwargs = self.optimizer_kwargs
        parameters = list(parameters)
        chosen = {"fused", "foreach", "differentiable"} & set(kwargs)
        without_memory = any(each.is_meta for each in parameters)  # only its sizes are asked for, and no kernel knows it
        if not chosen and self.optimizer_class in (th.optim.Adam, th.optim.AdamW) and not without_memory:
            # One kernel instead of one per parameter: a third of a small update's time
            kwargs = {"fused": True, **kwargs}
        make: Any = self.optimizer_class
        return make(parameters, lr=learning_rate, **kwargs)


def average_networks(online: Sequence[nn.Module], target: Sequence[nn.Module], tau: float) -> None:
    """
    Polyak averaging of the parameters, in one kernel; running statistics, as of a batch norm, are copied, as in SB3.

    :param online: Networks
    :param target: Theirs, which move
    :param tau: Share of the way that they go
    """
    sources, followers = (list(chain(*(each.parameters() for each in part))) for part in (online, target))
    get_ema_multi_avg_fn(1 - tau)(followers, sources, None)
    statistics = (chain(*(each.buffers() for each in part)) for part in (online, target))
    for current, average in zip(*statistics, strict=True):
        average.copy_(current)
