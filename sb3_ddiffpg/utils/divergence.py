"""Training whose numbers are no longer any is stopped before a parameter takes one of them."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_ddiffpg.utils.settings import LARGEST

# A loss this many times the square of the critics' support is an explosion: values a thousand supports away
EXPLODED = 1e6


class DivergedError(ArithmeticError):
    """A loss, a gradient or a value is not a number, infinite, or beyond all reason. No parameter has taken part of it."""


def step_unless(bad: th.Tensor, optimizer: th.optim.Optimizer) -> None:
    """
    A step of an optimiser, or none. A fused optimiser decides on its device, any other waits for the answer.

    :param bad: Whether there must be none, a scalar
    :param optimizer: With the gradients at its parameters
    """
    if all(group.get("fused") for group in optimizer.param_groups):
        optimizer.found_inf = bad.float()  # type: ignore[attr-defined]
        try:
            optimizer.step()
        finally:
            del optimizer.found_inf  # type: ignore[attr-defined]
    elif not bad.item():
        optimizer.step()


def check_finite(name: str, value: Any) -> None:
    """
    :param name: What the value is, for the message
    :param value: One row per environment, or a dict of such
    :raises ValueError: If a value is not finite, or its square is not in 32 bits, naming the environment
    """
    for array in value.values() if isinstance(value, dict) else [value]:
        array = np.asarray(array)
        if array.dtype.kind == "f" and not (good := np.abs(array) < LARGEST).all():
            env = int(np.flatnonzero(~good.reshape(len(array), -1).all(axis=1))[0])
            what = "too large" if np.isfinite(array[env]).all() else "not finite"
            raise ValueError(f"The {name} of environment {env} is {what}: {array[env]}. Nothing of this step was stored")


class _Seen(NamedTuple):
    names: list[str]
    values: th.Tensor
    limits: list[float]


class DivergenceWatch:
    """
    Looks at what is about to change parameters or the buffer. On the CPU it raises at once; an accelerator, which is waited
    for only where an optimiser is not fused, takes no such step, and ``report`` raises.

    :param device: Where training is computed
    :param largest_loss: Above this a loss has exploded
    """

    def __init__(self, device: th.device, largest_loss: float = math.inf) -> None:
        self.largest_loss = largest_loss
        self._at_once = device.type == "cpu"
        self._seen: list[_Seen] = []

    def step(
        self,
        parts: Sequence[str],
        optimizer: th.optim.Optimizer,
        losses: th.Tensor,
        norms: th.Tensor,
        bounded: bool = True,
        others: Sequence[str] = (),
    ) -> None:
        """
        One step of an optimiser, unless a loss or gradient is at fault.

        :param parts: What learns, G names
        :param optimizer: With the gradients at its parameters
        :param losses: Of each part, [G], or a scalar
        :param norms: Of the gradient of each part, and of each of the others, [G + O], or a scalar
        :param bounded: Whether ``largest_loss`` holds
        :param others: What learns by the same losses, O names
        :raises DivergedError: See the class
        """
        losses, norms = losses.detach(), norms.detach()
        limit = self.largest_loss if bounded else math.inf
        names = [
            *(f"the loss of the {part}" for part in parts),
            *(f"the gradient of the {part}" for part in (*parts, *others)),
        ]
        limits = [*[limit] * len(parts), *[math.inf] * (len(parts) + len(others))]
        self._look(names, th.cat((losses.reshape(-1), norms.reshape(-1))), limits)
        if self._at_once:
            optimizer.step()
        else:
            step_unless(~((losses.abs() < limit).all() & norms.isfinite().all()), optimizer)

    def finite(self, name: str, values: th.Tensor, instead: th.Tensor | float) -> th.Tensor:
        """
        :param name: What they are
        :param values: Any shape
        :param instead: What stands for those that are not finite, or not below ``LARGEST``, where nothing is raised at once
        :return: The values
        :raises DivergedError: See the class
        """
        self._look([name], values.detach().abs().max().reshape(1), [LARGEST])
        return values if self._at_once else th.where(values.abs() < LARGEST, values, instead)

    def _look(self, names: list[str], values: th.Tensor, limits: list[float]) -> None:
        self._seen.append(_Seen(names, values, limits))
        if self._at_once:
            self.report()

    def report(self) -> None:
        """
        :raises DivergedError: If something was at fault since the report before, naming it
        """
        seen, self._seen = self._seen, []
        if not seen:
            return
        values = iter(th.cat([each.values for each in seen]).tolist())
        given = [(name, next(values), limit) for each in seen for name, limit in zip(each.names, each.limits, strict=True)]
        wrong = {name: f"{name} is {value:.4g}" for name, value, limit in given if not abs(value) < limit}
        if wrong:
            raise DivergedError(
                f"Training has diverged: {'; '.join(wrong.values())}. Nothing of it has reached a parameter or the "
                "replay buffer: the model can be saved. A lower learning_rate, rewards within the critics' support "
                "[v_min, v_max], or observations of moderate size (VecNormalize) may help"
            )
