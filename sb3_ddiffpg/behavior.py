"""What drives each environment through its episode: exploration, a mode, or the zero embedding."""

from typing import Any

import msgspec
import numpy as np

from sb3_ddiffpg.safe_files import Count, check_array, convert

# Rows of the policy's embedding table: 0 explores, m + 1 is mode m. No row: the zero embedding.
EXPLORATORY_GROUP = 0
UNCONDITIONED = -1


class _State(msgspec.Struct, forbid_unknown_fields=True):
    groups: np.ndarray
    explored: np.ndarray
    handed_over: np.ndarray
    may_hand_over: np.ndarray
    n_turns: Count


class Behavior:
    """
    The group that drives each environment. It is drawn at an episode's beginning and kept through it: redrawn at every step
    it would mix several in one trajectory. Only once may an episode hand over: an exploring one to a mode or the zero
    embedding, one that follows a mode to another mode.

    :param n_envs: Number of environments
    """

    def __init__(self, n_envs: int) -> None:
        self.n_turns = 0
        self._forget(n_envs)

    def _forget(self, n_envs: int) -> None:
        self.groups = np.zeros(n_envs, dtype=np.int64)
        #: Whether the episode began exploring, has handed over, and may yet
        self.explored = np.zeros(n_envs, dtype=bool)
        self.handed_over = np.zeros(n_envs, dtype=bool)
        self.may_hand_over = np.zeros(n_envs, dtype=bool)

    def begin_all(
        self, n_envs: int, n_modes: int, exploration_share: float, explore_then_exploit: float, switch_modes: float = 0.0
    ) -> None:
        """
        New episodes everywhere.

        :param n_envs: Number of environments
        :param n_modes: Number of modes M
        :param exploration_share: Probability that an episode explores
        :param explore_then_exploit: Probability that an exploring episode may hand over
        :param switch_modes: Probability that one that follows a mode may
        """
        self._forget(n_envs)
        for env in range(n_envs):
            self.begin(env, n_modes, exploration_share, explore_then_exploit, switch_modes)

    def begin(
        self, env: int, n_modes: int, exploration_share: float, explore_then_exploit: float, switch_modes: float = 0.0
    ) -> None:
        """
        A new episode in one environment.

        :param env: Index of the environment
        :param n_modes: Number of modes M
        :param exploration_share: Probability that the episode explores
        :param explore_then_exploit: Probability that it may hand over if it explores
        :param switch_modes: Probability that it may if it follows a mode
        """
        self.groups[env] = group = self.draw(n_modes, exploration_share)
        self.explored[env] = group == EXPLORATORY_GROUP
        self.handed_over[env] = False
        share = {EXPLORATORY_GROUP: explore_then_exploit, UNCONDITIONED: 0.0}.get(group, switch_modes)
        self.may_hand_over[env] = np.random.rand() < share

    def draw(self, n_modes: int, exploration_share: float) -> int:
        """
        :param n_modes: Number of modes M
        :param exploration_share: Probability of exploring; 1 also while there is no mode
        :return: The exploratory group, or in turn a mode's or none
        """
        if not n_modes or np.random.rand() < exploration_share:
            return EXPLORATORY_GROUP
        return self._next_in_turn(n_modes)

    def _next_in_turn(self, n_modes: int) -> int:
        self.n_turns += 1
        turn = self.n_turns % (n_modes + 1)
        return UNCONDITIONED if turn == 0 else turn

    def hand_over(self, n_modes: int, probability: float) -> None:
        """
        Let some episodes go on with another group.

        :param n_modes: Number of modes M
        :param probability: Of each episode that may hand over
        """
        leaves = self.may_hand_over & (np.random.rand(len(self.groups)) < probability)
        for env in np.flatnonzero(leaves):
            group = int(self.groups[env])
            if group == EXPLORATORY_GROUP:
                self.groups[env] = self._next_in_turn(n_modes)
            elif group > EXPLORATORY_GROUP and n_modes > 1:
                self.groups[env] = (group + np.random.randint(1, n_modes) - 1) % n_modes + 1
            else:
                continue
            self.handed_over[env], self.may_hand_over[env] = True, False

    def told_mode(self, env: int) -> int | None:
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
        return None if self.handed_over[env] else self.told_mode(env)

    def follow(self, new_modes: list[int | None]) -> None:
        """
        After a re-clustering the environments go on with the mode they follow, whatever its index is now.

        :param new_modes: New index of every old mode, None if it is gone
        """
        groups = {old + 1: UNCONDITIONED if new is None else new + 1 for old, new in enumerate(new_modes)}
        self.groups = np.array([groups.get(group, group) for group in self.groups.tolist()], dtype=np.int64)

    def state_dict(self) -> dict[str, Any]:
        """
        :return: Who drives what, for ``load_state_dict``
        """
        return {name: getattr(self, name) for name in _State.__struct_fields__}

    def load_state_dict(self, state: Any, n_envs: int, n_modes: int) -> None:
        """
        :param state: What ``state_dict`` gave
        :param n_envs: Number of environments
        :param n_modes: Number of modes M
        :raises ValueError: If it is something else
        """
        known = convert(state, _State, "behavior")
        check_array(known.groups, np.int64, [n_envs], "behavior.groups")
        for name in ("explored", "handed_over", "may_hand_over"):
            check_array(getattr(known, name), bool, known.groups.shape, f"behavior.{name}")
        if len(known.groups) and not UNCONDITIONED <= known.groups.min() <= known.groups.max() <= n_modes:
            raise ValueError(
                f"behavior.groups: there are {n_modes} modes, groups from {known.groups.min()} to {known.groups.max()}"
            )
        for name in _State.__struct_fields__:
            value = getattr(known, name)
            setattr(self, name, value.copy() if isinstance(value, np.ndarray) else value)
