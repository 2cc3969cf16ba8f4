"""Chunks of actions that are being followed, one for each environment."""

from typing import ClassVar

import numpy as np


class ActionPlans:
    """
    What is left of the chunks of N environments.

    :param chunk: Actions in a chunk, k
    :param state: ``state`` of the plans of the step before; None: there are none yet
    :param episode_start: Which environments begin an episode, and so another plan, [N] or a scalar; None: none
    :raises ValueError: If the state is something else
    """

    #: Of ``state``: the group that each plan is of, [N]; the actions, [N, k, action_dim], in [-1, 1]; how many are done, [N]
    PARTS: ClassVar[tuple[str, ...]] = ("groups", "actions", "done")

    def __init__(
        self, chunk: int, state: tuple[np.ndarray, ...] | None = None, episode_start: np.ndarray | None = None
    ) -> None:
        self.chunk = chunk
        self._is_new = state is None or not len(state)
        if self._is_new:
            return
        parts = [np.array(each) for each in state]  # type: ignore[union-attr]
        shapes = [each.shape for each in parts]
        if len(parts) != 3 or len(shapes[1]) != 3 or shapes[1][1] != chunk or not shapes[0] == shapes[2] == shapes[1][:1]:
            raise ValueError(f"state must be what the previous call of predict returned, got arrays of {shapes}")
        self.groups, self.actions, self.done = parts
        if episode_start is not None:
            self.done[np.broadcast_to(np.asarray(episode_start, dtype=bool), self.done.shape)] = chunk

    def over(self, groups: np.ndarray) -> np.ndarray:
        """
        :param groups: Who is to act, [N]
        :return: Environments that need another plan: theirs is done, or somebody else's
        :raises ValueError: If the plans are of another number of environments
        """
        if self._is_new:
            return np.arange(len(groups))
        if len(groups) != len(self.groups):
            raise ValueError(f"Got modes, state or episode_start of {len(self.groups)} for {len(groups)} observation(s)")
        return np.flatnonzero((self.done >= self.chunk) | (self.groups != groups))

    def make(self, envs: np.ndarray, groups: np.ndarray, chunks: np.ndarray) -> None:
        """
        :param envs: Environments, M of them; all, the first time
        :param groups: Who acts there, [M]
        :param chunks: The actions, one after the other, [M, k * action_dim]
        """
        chunks = chunks.reshape(len(envs), self.chunk, -1)
        if self._is_new:
            self.groups, self.actions, self.done = groups.copy(), chunks.copy(), np.zeros(len(envs), dtype=np.int64)
            self._is_new = False
        self.groups[envs], self.actions[envs], self.done[envs] = groups, chunks, 0

    def next_actions(self) -> np.ndarray:
        """
        :return: Of each environment the next action of its plan, which is done then, [N, action_dim]
        """
        actions = self.actions[np.arange(len(self.done)), self.done]
        self.done += 1
        return actions

    @property
    def state(self) -> tuple[np.ndarray, ...]:
        """What the plans of the next step go on from."""
        return tuple(getattr(self, name) for name in self.PARTS)
