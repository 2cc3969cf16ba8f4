"""What counts as a success, and at which step of an episode."""

import math
import warnings
from collections import deque
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple

import numpy as np

from sb3_ddiffpg.utils.vec_envs import route_label

SUCCESS_KEYS = ("is_success", "success")
NO_KEY = "is not in an episode's last info"
# So much alike are names of which one may be a misspelling of the other
CLOSE = 0.8
#: Of the returns seen lately, while nobody has told a success
BEST_SHARE = 0.2


def read_success(info: dict[str, Any], success_key: str | None = None) -> bool | None:
    """
    :param info: Of one step
    :param success_key: Key that marks a success; None looks for ``SUCCESS_KEYS``
    :return: Whether the goal was reached, None if this step says nothing of it
    :raises ValueError: If what it says is no truth value
    """
    for key in SUCCESS_KEYS if success_key is None else (success_key,):
        said = info.get(key)
        if said is True or said is False:
            return said
        if said is not None:
            return _truth(key, said)
    return None


def _truth(key: str, said: Any) -> bool:
    value = np.asarray(said.cpu() if hasattr(said, "cpu") else said)
    if value.size == 1 and value.dtype.kind in "biuf":
        number = value.item()
        if math.isnan(number):
            return False
        if value.dtype.kind != "f" or number in (0.0, 1.0):
            return bool(number)
    raise ValueError(f"info[{key!r}]: {str(said)[:100]} given; accepted is True or False (1 or 0, NaN for no success)")


class Outcome(NamedTuple):
    """
    What an episode has come to: whether it reached its goal, None if nobody has said, the number of steps to the goal (all
    its steps if it did not), and the ground truth of its route, None if there is none.
    """

    success: bool | None
    length: int
    label: str | None


class GoalWatch:
    """
    Follows running episodes up to their goals. **An episode is a success if any of its steps says so, and what counts of it
    ends at the first that does**: an environment may go on after its goal, and may have forgotten it when the time is up.

    Where one environment has ever said something, an episode that says nothing has failed: some say only what succeeds.

    :param n_envs: Number of environments
    :param success_key: Key of ``info``; None looks for ``SUCCESS_KEYS``
    :param labelled: Whether ``info["mode"]`` labels an episode's route, see ``labels_routes``
    """

    def __init__(self, n_envs: int = 1, success_key: str | None = None, labelled: bool = False) -> None:
        self.success_key, self.labelled = success_key, labelled
        #: Whether an environment has ever said something
        self.has_signal = False
        #: Whether it has ever been that a goal was reached
        self.has_goal = False
        #: And whether it was said by the key that is looked for now
        self.has_key = False
        #: Steps of each running episode, and how many it took to its goal, 0 while it has not got there
        self.steps = np.zeros(n_envs, dtype=np.int64)
        self.goal_steps = np.zeros(n_envs, dtype=np.int64)
        #: Route by which the goal was reached, by the environment's own account
        self.labels: list[str | None] = [None] * n_envs

    def read(self, infos: Sequence[dict[str, Any]]) -> list[bool | None]:
        """
        :param infos: Of one step of each environment
        :return: What each says, see ``read_success``
        """
        return [read_success(info, self.success_key) for info in infos]

    def observe(self, infos: Sequence[dict[str, Any]], said: Sequence[bool | None] | None = None) -> None:
        """
        :param infos: Of one further step of each environment
        :param said: What ``read`` gave of them, if it was asked
        """
        for env, each in enumerate(self.read(infos) if said is None else said):
            self._observe(env, infos[env], each)

    def observe_one(self, env: int, info: dict[str, Any]) -> None:
        """
        :param env: Index of an environment
        :param info: Of one further step of it
        """
        self._observe(env, info, read_success(info, self.success_key))

    def _observe(self, env: int, info: dict[str, Any], said: bool | None) -> None:
        self.steps[env] += 1
        if said is not None:
            self.has_signal = self.has_key = True
            self.has_goal |= said
            if said and not self.goal_steps[env]:
                self.goal_steps[env], self.labels[env] = self.steps[env], route_label(info, self.labelled)

    def so_far(self, env: int, info: dict[str, Any]) -> Outcome:
        """
        :param env: Index of an environment
        :param info: Of the latest step of its episode
        :return: What the episode would be if it ended here
        """
        goal = int(self.goal_steps[env])
        label = self.labels[env] if goal and self.labels[env] is not None else route_label(info, self.labelled)
        return Outcome(goal > 0 if self.has_signal else None, goal or int(self.steps[env]), label)

    def end(self, env: int) -> None:
        """
        :param env: Environment whose episode is over
        """
        self.steps[env] = self.goal_steps[env] = 0
        self.labels[env] = None


class SuccessRule(GoalWatch):
    """
    Tells whether a stored episode reached its goal: by the environment's word, or, while no environment has ever told of a
    goal, by a return in the top fifth of those seen lately, so that the algorithm also learns where rewards lead the way.
    Where they do not, all returns are alike before the first goal, and none stands in for it.

    :param success_key: Key of ``info``; None looks for ``SUCCESS_KEYS``. One that is given is waited for: until then all fail
    :param n_envs: Number of environments
    """

    def __init__(self, success_key: str | None = None, n_envs: int = 1) -> None:
        super().__init__(n_envs, success_key)
        self.recent_returns: deque[float] = deque(maxlen=500)
        self._warned = False

    def among_best(self, episode_return: float) -> bool:
        """
        What stands in for a success while nobody has told one.

        :param episode_return: Of an episode that has just been stored
        :return: Whether it is in the top fifth of those seen lately
        """
        if not self._stands_in:
            return False
        self.recent_returns.append(episode_return)
        least = self.best_from()
        return least is not None and episode_return >= least

    def best_from(self) -> float | None:
        """
        :return: The return from which an episode is among the best; None if nothing stands in for a success, or all are alike
        """
        returns = np.array(self.recent_returns)
        more = returns[returns > returns.min(initial=np.inf)]
        if not self._stands_in or not len(more):
            return None
        return float(max(np.quantile(returns, 1 - BEST_SHARE, method="higher"), more.min()))

    @property
    def _stands_in(self) -> bool:
        return not self.has_goal and self.success_key is None

    def check_key(self, info: dict[str, Any]) -> None:
        """
        :param info: Of an episode's last step
        :raises ValueError: If ``success_key`` was given, no step has had it yet, and this one has a key that it may be a
            misspelling of
        """
        if self.has_key or self.success_key is None:
            return
        complaint = f"success_key={self.success_key!r} {NO_KEY}; its keys: {sorted(info)}"
        if alike := get_close_matches(self.success_key, [key for key in info if isinstance(key, str)], 1, CLOSE):
            raise ValueError(f"{complaint}; did you mean {alike[0]!r}?")
        if not self._warned:
            self._warned = True
            told = [key for key in SUCCESS_KEYS if key in info] or get_close_matches(self.success_key, SUCCESS_KEYS, 1, CLOSE)
            hint = f"; without success_key, {told[0]!r} would be it" if told else ""
            warnings.warn(f"{complaint}. Episodes count as failures until one has it, as where it is told only if True{hint}")
