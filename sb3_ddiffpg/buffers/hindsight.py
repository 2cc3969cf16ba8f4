"""Goals that trajectories have come to, in place of those that they were given (Andrychowicz et al., 2017)."""

import warnings
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.buffers.trajectory import Trajectory
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.utils.vec_envs import ask_first, has_method

#: Of a mode's transitions: four others for each that keeps its goal, as in the paper and in SB3's ``HerReplayBuffer``
RELABELLED_SHARE = 0.8
# Rows that are looked at to see whether goals differ and rewards follow from them, and how many of them may not
_LOOKED_AT, _MOST_OTHERS = 256, 0.05
# Goals that lie so near each other, as a share of where it has been, are the same: a sensor's noise
_SAME = 0.01
ACHIEVED, DESIRED, METHOD = "achieved_goal", "desired_goal", "compute_reward"
_ACHIEVED_NEXT, _DESIRED_NEXT = f"next_observations/{ACHIEVED}", f"next_observations/{DESIRED}"


class Relabelling(NamedTuple):
    """Which transitions have other goals, [G, n], and these goals, in their order, [N, goal_dim]."""

    chosen: np.ndarray
    goals: np.ndarray


class Hindsight:
    """
    Where the goal differs between episodes, whoever reaches it by chance learns little of the others. Every trajectory has
    reached some goal: told afterwards that this was meant, a mode's critics and its policy learn from all of them.

    Each chosen transition is given what its trajectory achieves at a later step, drawn evenly. Its return ends where that is
    reached first: where the reward is what it would be on the goal itself.

    :param env: Environments with a dict of ``achieved_goal`` and ``desired_goal``, and ``compute_reward`` of these and info
    """

    def __init__(self, env: VecEnv) -> None:
        self.env = env
        #: Whether goals differ, and rewards follow from them, in what is stored
        self.in_use = False
        self._warned = False
        self._known: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    @classmethod
    def of(cls, env: VecEnv) -> "Hindsight | None":
        """
        :param env: The environments
        :return: None if they have no goals that could be others
        :raises ValueError: If their processes have died of the question
        """
        space = env.observation_space
        if not (isinstance(space, spaces.Dict) and {ACHIEVED, DESIRED} <= set(space.spaces) and has_method(env, METHOD)):
            return None
        made, goals = cls(env), np.stack([space[ACHIEVED].sample() for _ in range(3)])
        try:
            return made if made.rewards(goals, goals).shape == (3,) else None
        except Exception as error:  # whatever an environment raises that takes one goal at a time
            if hasattr(env.unwrapped, "remotes"):  # worker processes, which are of no use any more
                raise ValueError(f"{METHOD} of the environment must take arrays of goals, [N, goal_dim]: {error}") from error
            return None

    def rewards(self, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        """
        :param achieved: Shape [N, goal_dim]
        :param desired: Shape [N, goal_dim]
        :return: The environment's reward for having achieved the one when the other was desired, [N]
        """
        infos: list[dict[str, Any]] = [{} for _ in achieved]
        return np.asarray(ask_first(self.env, METHOD, achieved, desired, infos), dtype=np.float32)

    # ------------------------------------------------------------------ what is known of the trajectories

    def judge(self, buffer: Any) -> None:
        """
        :param buffer: A ``ModeReplayBuffer``, in which trajectories have ended
        """
        if (seen := _looked_at(buffer)) is None:
            return
        rows, achieved, desired = seen
        if not _differ(achieved, desired):
            self.in_use = False
            return
        alike = np.isclose(self.rewards(achieved, desired), buffer.rewards[rows], rtol=1e-3, atol=1e-5)
        self.in_use = bool(1 - alike.mean() <= _MOST_OTHERS)
        if not self.in_use and not self._warned:
            self._warned = True
            warnings.warn(
                f"{METHOD} gives other rewards than the environment in {1 - alike.mean():.0%} of its steps: episodes "
                "learn from their own goals only"
            )

    def forget(self) -> None:
        """Which trajectories train modes has changed."""
        self._known = None

    def _index(self, trajectories: list[Trajectory], n_rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of all trajectories, one after the other; each row's place there, and where its trajectory ends."""
        if self._known is None:
            ordered = np.concatenate([np.zeros(0, dtype=np.int32), *(each.rows for each in trajectories)])
            lengths = np.array([each.length for each in trajectories], dtype=np.int64)
            place, end = np.zeros(n_rows, dtype=np.int64), np.zeros(n_rows, dtype=np.int64)
            place[ordered] = np.arange(len(ordered))
            end[ordered] = np.repeat(lengths.cumsum(), lengths)
            self._known = ordered, place, end
        return self._known

    # ------------------------------------------------------------------ relabelling

    def relabel(self, buffer: Any, rows: np.ndarray, windows: np.ndarray, notes: np.ndarray) -> Relabelling | None:
        """
        Give some transitions other goals. Their windows end at these, and their notes say what is true of these, in place.

        :param buffer: A ``ModeReplayBuffer``
        :param rows: Rows of the transitions, [G, n]
        :param windows: Rows from each on, -1 where they end, [G, n, n_steps]
        :param notes: What the buffer has noted of these, same shape
        :return: Which, and their goals; None if there are none
        """
        ordered, place, end = self._index(buffer.training_trajectories(), buffer.buffer_size)
        chosen = (np.random.rand(*rows.shape) < RELABELLED_SHARE) & (end[rows] > 0)
        chosen[EXPLORATORY_GROUP] = False
        if not chosen.any():
            return None
        row, window, note = rows[chosen], windows[chosen], notes[chosen]
        goals = _part(buffer.nexts, _ACHIEVED_NEXT, ordered[np.random.randint(place[row], end[row])])
        there = window >= 0
        achieved = _part(buffer.nexts, _ACHIEVED_NEXT, window[there])
        desired = np.repeat(goals[:, None], window.shape[1], axis=1)[there]
        rewards, on_goal = np.split(self.rewards(np.concatenate((achieved, desired)), np.concatenate((desired, desired))), 2)
        reached = np.zeros(window.shape, dtype=bool)
        reached[there] = rewards >= on_goal - 1e-6 * np.abs(on_goal)
        note["rewards"][there], note["goals"] = rewards, reached
        note["dones"] = note["timeouts"] = note["off_route"] = False
        window[reached.cumsum(axis=1) > reached] = -1
        windows[chosen], notes[chosen] = window, note
        return Relabelling(chosen, goals)


def goals_differ(buffer: Any) -> bool:
    """
    :param buffer: A ``ModeReplayBuffer``
    :return: Whether episodes that are stored have other goals, beyond a sensor's noise
    """
    space = buffer.observation_space
    if not (isinstance(space, spaces.Dict) and {ACHIEVED, DESIRED} <= set(space.spaces)):
        return False
    seen = _looked_at(buffer)
    return seen is not None and _differ(*seen[1:])


def _looked_at(buffer: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Some rows from all over, and their goals, achieved and desired; None where none is stored."""
    rows = buffer.stored_rows.spread(_LOOKED_AT)
    if not len(rows):
        return None
    return rows, _part(buffer.nexts, _ACHIEVED_NEXT, rows), _part(buffer.nexts, _DESIRED_NEXT, rows)


def _differ(achieved: np.ndarray, desired: np.ndarray) -> bool:
    return bool(np.ptp(desired, axis=0).max() > _SAME * np.ptp(achieved, axis=0).max())


def _part(part: Any, field: str, rows: np.ndarray) -> np.ndarray:
    """One field of some rows, flattened, in the main memory, [N, dim]."""
    return part.tensors(rows)[field].cpu().numpy().reshape(len(rows), -1)


def with_goals(observation: Any, relabelling: Relabelling | None) -> Any:
    """
    :param observation: Dict of tensors [G * n, ...], which is changed
    :param relabelling: None: nothing is
    :return: The observation, in which other goals are desired
    """
    if relabelling is not None:
        desired = observation[DESIRED]
        chosen = th.from_numpy(relabelling.chosen.ravel()).to(desired.device)
        goals = th.from_numpy(relabelling.goals).to(desired.device, desired.dtype)
        desired[chosen] = goals.reshape(-1, *desired.shape[1:])
    return observation
