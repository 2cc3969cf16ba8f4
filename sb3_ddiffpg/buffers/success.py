"""What counts as a success."""

from collections import deque
from typing import Any

import numpy as np

SUCCESS_KEYS = ("is_success", "success")


def read_success(info: dict[str, Any], success_key: str | None = None) -> bool | None:
    """
    :param info: Of an episode's last step
    :param success_key: Key that marks a success; None looks for ``SUCCESS_KEYS``
    :return: Whether the goal was reached, None if the environment does not say
    :raises ValueError: If what it says is no truth value
    """
    for key in SUCCESS_KEYS if success_key is None else (success_key,):
        if key in info:
            said = np.asarray(info[key])
            if said.size != 1 or said.dtype.kind not in "biuf":
                raise ValueError(f"info[{key!r}]: {str(info[key])[:100]} given; accepted is True or False")
            return bool(said.item())
    return None


class SuccessRule:
    """
    Tells whether a finished episode reached its goal: by the environment's word, or, where no environment ever gives it, by
    a return in the top fifth of those seen lately, so that the algorithm also learns on an ordinary dense-reward task.

    :param success_key: Key of ``info``; None looks for ``SUCCESS_KEYS``
    """

    def __init__(self, success_key: str | None = None) -> None:
        self.success_key = success_key
        self.has_signal = False
        self.recent_returns: deque[float] = deque(maxlen=500)

    def __call__(self, info: dict[str, Any], episode_return: float) -> bool:
        """
        :param info: Of the episode's last step
        :param episode_return: Sum of its rewards
        :raises ValueError: If ``success_key`` was given and is not there
        """
        success = read_success(info, self.success_key)
        if success is not None:
            self.has_signal = True
            return success
        if self.success_key is not None:
            raise ValueError(f"success_key={self.success_key!r} is not in an episode's last info; its keys: {sorted(info)}")
        if self.has_signal:
            return False
        self.recent_returns.append(episode_return)
        if len(self.recent_returns) < 5:
            return False
        return bool(episode_return >= np.quantile(self.recent_returns, 0.8) and episode_return > min(self.recent_returns))
