"""Multi-step returns of the transitions of all groups: what of a window counts, and what ends it."""

from itertools import accumulate
from typing import NamedTuple

import numpy as np

from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP


class GroupReturns(NamedTuple):
    """
    Returns of n transitions of each of G groups, over windows of up to ``n_steps``.

    ``rewards`` [G, n] are discounted sums, ``discounts`` [G, n] what the value at the window's last step counts, and
    ``new_routes`` [n] the part of the exploratory group's rewards from goals by routes of which a mode has not its fill.
    ``last`` [G, n] are the last steps' rows, and ``lost`` [G, n, n_steps] the steps that lie beyond the mode's route.
    """

    rewards: np.ndarray
    discounts: np.ndarray
    new_routes: np.ndarray
    last: np.ndarray
    lost: np.ndarray


def group_returns(
    windows: np.ndarray,
    notes: np.ndarray,
    rewards: np.ndarray,
    gammas: np.ndarray,
    explore_beyond_goals: bool,
    new_routes_pay: bool,
    goals_are_told: bool | np.ndarray = True,
    lost_value: float = 0.0,
) -> GroupReturns:
    """
    :param windows: Rows from each transition on, -1 where they end, [G, n, n_steps]; the exploratory group first
    :param notes: What the buffer has noted of these steps, same shape
    :param rewards: Theirs, as they train, same shape
    :param gammas: Discount factor of each group, [G]
    :param explore_beyond_goals: Whether a goal does not end the exploratory group's returns
    :param new_routes_pay: Whether that group is paid for goals by new routes
    :param goals_are_told: Whether goals are the environment's, and not the ends of the best episodes, perhaps of each step
    :param lost_value: What it is worth to leave the mode's route
    :return: The returns
    """
    present = windows >= 0
    gammas = gammas.astype(np.float32)[:, None]
    # For its mode a step off the route ends the episode, so that no way back is worth anything. What it is worth to have left
    # it must be no more than to fail: where each step costs, 0 would be the best of all
    lost = np.logical_or.accumulate(notes["off_route"] & present, axis=-1)
    lost[EXPLORATORY_GROUP] = False
    powers = gammas[..., None] ** np.arange(windows.shape[-1], dtype=np.float32)
    terminates = notes["dones"] & ~notes["timeouts"]
    paid = notes["goals"] & (notes["route_novelty"] > 0) & new_routes_pay
    # At a goal the environment may go on. A mode's return ends there all the same: no transition from beyond is the mode's,
    # so its critics would learn from their own guesses there, and climb without end. It is worth what the goal pays for ever,
    # as to one who stays: less, and it would be better to linger before it where rewards are dense. One that pays nothing, or
    # takes, is worth no more than that: what each step on the way has cost is over
    reached = notes["goals"] & ~terminates & goals_are_told
    stays = reached & (rewards > 0) & (gammas[..., None] < 1)
    stays[EXPLORATORY_GROUP] = False
    rewards = np.where(stays, rewards / np.maximum(1 - gammas, 1e-6)[..., None], rewards)
    # Explorers go on with the environment. But a goal for which they are paid ends what exploring is worth, or it would be
    # paid again and again
    reached[EXPLORATORY_GROUP] &= paid[EXPLORATORY_GROUP]
    if explore_beyond_goals:
        # Any other that ended it would be the one place that explorers keep away from
        terminates[EXPLORATORY_GROUP] &= ~(notes["goals"] & ~paid)[EXPLORATORY_GROUP]

    rewards = np.where(present & ~lost, rewards, np.where(lost.cumsum(axis=-1) == 1, lost_value, 0.0)) * powers
    lengths = present.sum(axis=-1)
    ends = lengths[..., None] - 1
    ended = np.take_along_axis(terminates | reached, ends, axis=-1)[..., 0]
    return GroupReturns(
        rewards=rewards.sum(axis=-1),
        discounts=gammas**lengths * ~(ended | lost.any(axis=-1)),
        new_routes=(rewards[EXPLORATORY_GROUP] * notes["route_novelty"][EXPLORATORY_GROUP]).sum(axis=-1),
        last=np.take_along_axis(windows, ends, axis=-1)[..., 0],
        lost=lost,
    )


def discounted_returns(rewards: np.ndarray, gamma: float, then: str = "ends") -> np.ndarray:
    """
    :param rewards: Of an episode, shape [length]
    :param gamma: Discount factor
    :param then: What comes after it: it ``"ends"``; it ``"goes on"`` as it was, with the mean of as many of its last rewards
        as count; or it ``"stays"`` at its goal, see ``group_returns``
    :return: From each step on, the last first, same shape
    """
    latest_first = np.array(rewards[::-1], dtype=np.float64)
    if gamma < 1 and then == "goes on":
        latest_first[0] += gamma / (1 - gamma) * latest_first[: round(1 / (1 - gamma))].mean()
    elif gamma < 1 and then == "stays" and latest_first[0] > 0:
        latest_first[0] /= 1 - gamma
    # As ``scipy.signal.lfilter``, which takes longer to import than this ever takes
    return np.fromiter(accumulate(latest_first.tolist(), lambda after, reward: reward + gamma * after), np.float64)
