"""A finished episode in the replay buffer, and what one step of all environments has brought."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

NO_MODE = -1
#: In place of a mode: what an episode did after its goal, which trains none
PAST_GOAL = -2


@dataclass(eq=False)
class Trajectory:
    """
    A finished episode in the buffer, up to its goal; what it did after that is another trajectory.

    :param rows: Rows of its transitions in order, shape [length], int32
    :param success: Whether it reached the goal
    :param episode_return: Sum of its rewards, after the goal too
    :param serial: Running number in order of finishing
    :param mode: Index of the mode that owns it, ``NO_MODE`` before the first clustering or for an outlier, ``PAST_GOAL``
    :param trains: Whether the mode learns from it, or only remembers it for the next clustering
    :param assigned_mode: Number of the mode that it was told to follow, None if none
    :param off_mode_success: It followed a command to its mode, but reached the goal by another mode's route: its mode is shown
        it as a failure, so that it learns to keep to its own
    :param label: Ground truth of the route it took, ``info["mode"]`` where it reached the goal or ended; None: there is none,
        or the environment declares no ``listed_modes``; for evaluation, no part of the algorithm sees it
    :param path: What clustering compares: mode features resampled to equal steps, shape [n_path_points, dim]; made when first
        needed
    """

    rows: np.ndarray
    success: bool
    episode_return: float
    serial: int
    mode: int = NO_MODE
    trains: bool = False
    assigned_mode: int | None = None
    off_mode_success: bool = False
    label: str | None = None
    path: np.ndarray | None = field(default=None, repr=False)

    def __setstate__(self, state: dict[str, Any]) -> None:
        for old, now in (("commanded", "assigned_mode"), ("foreign", "off_mode_success")):  # of version 0.1
            if old in state:
                state[now] = state.pop(old)
        self.__dict__.update(state)

    @property
    def length(self) -> int:
        """Number of transitions."""
        return len(self.rows)


class StepRecord(NamedTuple):
    """
    What one step of all environments has brought, as the buffer has stored it.

    ``rows`` [n_envs] are its rows, ``positions`` [n_envs, dim] the mode features that were reached, and ``scale`` [dim] what
    they are divided by where paths are compared, None while that is not known. ``started`` are the environments whose
    episodes began with this step, ``start_positions`` [len(started), dim] where. ``finished`` are the environments whose
    episodes ended, with their trajectories. ``parts`` are those whose episodes go on, though they are so long that what they
    have done so far is stored as a trajectory of its own.
    """

    rows: np.ndarray
    positions: np.ndarray
    scale: np.ndarray | None
    started: np.ndarray
    start_positions: np.ndarray
    finished: list[tuple[int, Trajectory]]
    parts: Sequence[tuple[int, Trajectory]] = ()
