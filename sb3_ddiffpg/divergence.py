"""Training whose numbers are no longer any is stopped before a parameter takes one of them."""

import math
from collections.abc import Sequence

import torch as th

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


class DivergenceWatch:
    """
    Looks at what is about to change parameters or the buffer. On the CPU it raises at once; an accelerator, which nothing here
    waits for, takes no such step, and ``report`` raises.

    :param device: Where training is computed
    :param largest_loss: Above this a loss has exploded
    """

    def __init__(self, device: th.device, largest_loss: float = math.inf) -> None:
        self.largest_loss = largest_loss
        self._at_once = device.type == "cpu"
        self._names: list[str] = []
        self._limits: list[float] = []
        self._values: list[th.Tensor] = []

    def step(self, parts: str | Sequence[str], optimizer: th.optim.Optimizer, losses: th.Tensor, bounded: bool = True) -> None:
        """
        One step of an optimiser, unless its loss or gradient is at fault.

        :param parts: What learns, a name for each loss
        :param optimizer: With the gradients at its parameters
        :param losses: A scalar, or several
        :param bounded: Whether ``largest_loss`` holds for them
        :raises DivergedError: See the class
        """
        parts = [parts] if isinstance(parts, str) else parts
        gradients = [each.grad for group in optimizer.param_groups for each in group["params"] if each.grad is not None]
        values = th.cat((losses.detach().reshape(-1), th.nn.utils.get_total_norm(gradients).reshape(1)))
        limit = self.largest_loss if bounded else math.inf
        names = [f"the loss of the {part}" for part in parts] + ["the gradient of the " + ", ".join(parts)]
        self._look(names, values, [*[limit] * len(parts), math.inf])
        bad = ~((values[:-1].abs() < limit).all() & values[-1].isfinite())
        step_unless(bad, optimizer)

    def finite(self, name: str, values: th.Tensor, instead: th.Tensor | float) -> th.Tensor:
        """
        :param name: What they are
        :param values: Any shape
        :param instead: What stands for those that are not finite, where nothing is raised at once
        :return: The values
        :raises DivergedError: See the class
        """
        self._look([name], values.detach().abs().amax().reshape(1), [math.inf])
        return values if self._at_once else th.where(values.isfinite(), values, instead)

    def _look(self, names: list[str], values: th.Tensor, limits: list[float]) -> None:
        self._names += names
        self._limits += limits
        self._values.append(values)
        if self._at_once:
            self.report()

    def report(self) -> None:
        """
        :raises DivergedError: If something was at fault since the report before, naming it
        """
        names, limits, values = self._names, self._limits, self._values
        self._names, self._limits, self._values = [], [], []
        if not names:
            return
        given = zip(names, th.cat(values).tolist(), limits, strict=True)
        wrong = {name: f"{name} is {value:.4g}" for name, value, limit in given if not abs(value) < limit}
        if wrong:
            raise DivergedError(
                f"Training has diverged: {'; '.join(wrong.values())}. No parameter has taken part of it: the model is as it "
                "was before, and can be saved. A lower learning_rate, rewards within the critics' support [v_min, v_max], or "
                "observations of moderate size (VecNormalize) may help"
            )
