"""What drives each environment through its episode: exploration, a mode, or the zero embedding."""

from collections.abc import Sized
from typing import Any

import msgspec
import numpy as np
from stable_baselines3.common.utils import FloatSchedule

from sb3_ddiffpg.exploration.settings import ExplorationSettings
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.serialization.safetensors_tree import Count, check_array, convert

#: In place of a row of the policy's embedding table: the zero embedding
UNCONDITIONED = -1
#: When nothing new has come until the run is so many times as long, exploration becomes less: it never ends, for what is left
#: to be found is rarer than what was found before
PATIENCE = 10
# So many times as many places are news
MORE_CELLS = 1.05
# More actions than any chunk has: of a plan that is over
_DONE = 2**31


class _State(msgspec.Struct, forbid_unknown_fields=True):
    groups: np.ndarray
    explored: np.ndarray
    handed_over: np.ndarray
    may_hand_over: np.ndarray
    n_turns: Count
    news_at: Count = 0
    n_cells: Count = 0
    plans: list[np.ndarray] | None = None


class EpisodeScheduler:
    """
    The group that drives each environment. It is drawn at an episode's beginning and kept through it: redrawn at every step
    it would mix several in one trajectory. Only an exploring episode may hand over once, to a mode or the zero embedding.

    :param settings: Who explores
    :param modes: The modes of now, of which only the number M is asked
    :param n_envs: Number of environments
    """

    def __init__(self, settings: ExplorationSettings, modes: Sized, n_envs: int = 0) -> None:
        self.settings, self.modes = settings, modes
        self.n_turns = 0
        #: When something new came last, in environment steps of all training, and places that were known then
        self.news_at = self.n_cells = 0
        self._forget(n_envs)

    def _forget(self, n_envs: int) -> None:
        self.groups = np.zeros(n_envs, dtype=np.int64)
        #: Whether the episode began exploring, has handed over, and may yet
        self.explored = np.zeros(n_envs, dtype=bool)
        self.handed_over = np.zeros(n_envs, dtype=bool)
        self.may_hand_over = np.zeros(n_envs, dtype=bool)
        #: Where actions are drawn in chunks, what is left of these: the parts of ``ActionPlans``
        self.plans: tuple[np.ndarray, ...] | None = None

    def exploration_share(self, progress_remaining: float, step: int = 0) -> float:
        """
        :param progress_remaining: Of the training, from 1 to 0
        :param step: Environment steps of all training so far
        :return: Share of the episodes that explore
        """
        share, fraction = self.settings.share, self.settings.fraction
        if share is not None:
            return float(FloatSchedule(share)(progress_remaining))
        if fraction is not None:
            return 1 / (len(self.modes) + 1) if 1 - progress_remaining < fraction else 0.0
        if not len(self.modes):  # also where no places are counted, which would be news
            return 1.0
        return min(1.0, PATIENCE * self.news_at / max(step, 1)) / (len(self.modes) + 1)

    def note_news(self, step: int, n_cells: int, born: bool) -> None:
        """
        How long nothing new has come says how much is explored.

        :param step: Environment steps of all training so far
        :param n_cells: Number of places that are known by now
        :param born: Whether a mode was born
        """
        if born or n_cells > MORE_CELLS * self.n_cells:
            self.news_at, self.n_cells = step, n_cells
        self.n_cells = min(self.n_cells, n_cells)  # cells have been joined

    def begin_all(self, n_envs: int, exploration_share: float) -> None:
        """
        New episodes everywhere.

        :param n_envs: Number of environments
        :param exploration_share: Probability that an episode explores
        """
        self._forget(n_envs)
        for env in range(n_envs):
            self.begin(env, exploration_share)

    def begin(self, env: int, exploration_share: float) -> None:
        """
        A new episode in one environment.

        :param env: Index of the environment
        :param exploration_share: Probability that the episode explores
        """
        if self.plans is not None:
            self.plans[2][env] = _DONE
        self.groups[env] = group = self.draw(exploration_share)
        self.explored[env] = group == EXPLORATORY_GROUP
        self.handed_over[env] = False
        share = self.settings.hand_over if group == EXPLORATORY_GROUP else 0.0
        self.may_hand_over[env] = np.random.rand() < share

    def draw(self, exploration_share: float) -> int:
        """
        :param exploration_share: Probability of exploring; 1 also while there is no mode
        :return: The exploratory group, or in turn a mode's or none
        """
        if not len(self.modes) or np.random.rand() < exploration_share:
            return EXPLORATORY_GROUP
        return self._next_in_turn()

    def _next_in_turn(self) -> int:
        self.n_turns += 1
        turn = self.n_turns % (len(self.modes) + 1)
        return UNCONDITIONED if turn == 0 else turn

    def hand_over(self, probability: float) -> None:
        """
        Let some exploring episodes go on with another group.

        :param probability: Of each episode that may hand over
        """
        leaves = self.may_hand_over & (np.random.rand(len(self.groups)) < probability)
        for env in np.flatnonzero(leaves):
            self.groups[env] = self._next_in_turn()
            self.handed_over[env], self.may_hand_over[env] = True, False

    def assigned_mode(self, env: int) -> int | None:
        """
        :param env: Index of the environment
        :return: The mode that its episode is told to follow, None if none is or it began exploring
        """
        group = int(self.groups[env])
        return group - 1 if group > EXPLORATORY_GROUP and not self.explored[env] else None

    def commanded_mode(self, env: int) -> int | None:
        """
        :param env: Index of the environment
        :return: The mode that has driven its episode from the beginning, None if none has
        """
        return None if self.handed_over[env] else self.assigned_mode(env)

    def follow(self, new_modes: list[int | None]) -> None:
        """
        After a re-clustering the environments go on with the mode they follow, whatever its index is now.

        :param new_modes: New index of every old mode, None if it is gone
        """
        groups = {old + 1: UNCONDITIONED if new is None else new + 1 for old, new in enumerate(new_modes)}
        self.groups = _renumbered(self.groups, groups)
        if self.plans is not None:
            self.plans = _renumbered(self.plans[0], groups), *self.plans[1:]

    def state_dict(self) -> dict[str, Any]:
        """
        :return: Who drives what, for ``load_state_dict``
        """
        known = {name: getattr(self, name) for name in _State.__struct_fields__}
        return {**known, "plans": None if self.plans is None else list(self.plans)}

    def load_state_dict(self, state: Any, n_envs: int) -> None:
        """
        :param state: What ``state_dict`` gave
        :param n_envs: Number of environments
        :raises ValueError: If it is something else
        """
        known, n_modes = convert(state, _State, "episodes"), len(self.modes)
        check_array(known.groups, np.int64, [n_envs], "episodes.groups")
        for name in ("explored", "handed_over", "may_hand_over"):
            check_array(getattr(known, name), bool, known.groups.shape, f"episodes.{name}")
        if len(known.groups) and not UNCONDITIONED <= known.groups.min() <= known.groups.max() <= n_modes:
            raise ValueError(
                f"episodes.groups: there are {n_modes} modes, groups from {known.groups.min()} to {known.groups.max()}"
            )
        for name in _State.__struct_fields__:
            value = getattr(known, name)
            setattr(self, name, value.copy() if isinstance(value, np.ndarray) else value)
        self.plans = None if known.plans is None else _checked_plans(known.plans, n_envs)


def _renumbered(groups: np.ndarray, new: dict[int, int]) -> np.ndarray:
    return np.array([new.get(group, group) for group in groups.tolist()], dtype=np.int64)


def _checked_plans(plans: list[np.ndarray], n_envs: int) -> tuple[np.ndarray, ...]:
    """
    :raises ValueError: If they are of other environments, or no plans
    """
    names = ("groups", "actions", "done")
    if len(plans) != len(names) or plans[1].ndim != 3:
        raise ValueError(f"episodes.plans: arrays of {[each.shape for each in plans]} given; accepted are {names}")
    for name, each, dtype in zip(names, plans, (np.int64, np.float32, np.int64), strict=True):
        check_array(each, dtype, [n_envs, *each.shape[1:]], f"episodes.plans.{name}")
    return tuple(each.copy() for each in plans)
