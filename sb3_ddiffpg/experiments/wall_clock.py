"""What a training spends its time on: the paper's four parts, and what of learning belongs to none of them."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any
from unittest.mock import patch

from stable_baselines3.common.callbacks import BaseCallback

#: Part -> the algorithm's methods that do it, as far as it has them
PARTS = {
    "collection": ("collect_rollouts", "recluster"),
    "critic": ("_update_critics", "_update_model"),
    "policy": ("_update_policy", "_update_actor"),
    "target action": ("_improve_target_actions",),
    "other learning": ("train",),  # drawing batches, novelty, target networks
}
#: Tests, checkpoints and logging, in the midst of the collection
CALLBACKS = "callbacks"


class Stopwatch:
    """
    Seconds of each part. A part that is called within another one is not counted twice.

    :param seconds: So many before
    """

    def __init__(self, seconds: dict[str, float] | None = None) -> None:
        self.seconds = dict.fromkeys([*PARTS, CALLBACKS], 0.0) | (seconds or {})
        self._inner: list[float] = []

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """
        :param part: To which it belongs
        :param function: That is to be timed
        :return: The same, timed
        """

        @wraps(function)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            began = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                took = time.perf_counter() - began
                self.seconds[part] += took - self._inner.pop()
                if self._inner:
                    self._inner[-1] += took

        return wrapped

    @contextmanager
    def timing(self, model: Any) -> Iterator[None]:
        """
        Time the parts of a model's training inside the block. What an accelerator does meanwhile is counted where it is
        waited for.

        :param model: A model
        """
        with ExitStack() as stack:
            parts: list[tuple[type, str, tuple[str, ...]]] = [(type(model), part, names) for part, names in PARTS.items()]
            parts.append((BaseCallback, CALLBACKS, ("on_rollout_start", "on_step", "on_rollout_end")))
            for owner, part, names in parts:
                for name in names:
                    if hasattr(owner, name):
                        stack.enter_context(patch.object(owner, name, self.timed(part, getattr(owner, name))))
            yield
