"""Finished trajectories by mode and outcome: which of them leave the buffer first."""

from collections import deque
from collections.abc import Callable

from sb3_ddiffpg.buffers.trajectory import NO_MODE, PAST_GOAL, Trajectory

#: Index of a mode (or ``NO_MODE``, or ``PAST_GOAL``), and whether its trajectories reached the goal by its own route
Key = tuple[int, bool]


class TrajectoryGroups:
    """
    Trajectories in use, by mode and outcome, and retired ones. The oldest retired one leaves first, then the oldest of
    whichever group holds most rows, so that a rare mode is never crowded out.
    """

    def __init__(self) -> None:
        self.members: dict[Key, deque[Trajectory]] = {}
        self.n_rows: dict[Key, int] = {}
        self.retired: deque[Trajectory] = deque()
        #: Indices of modes whose successes leave last
        self.frozen_modes: set[int] = set()

    def insert(self, trajectory: Trajectory) -> None:
        """
        :param trajectory: Newer than the others of its group
        """
        key = self._key(trajectory)
        self.members.setdefault(key, deque()).append(trajectory)
        self.n_rows[key] = self.n_rows.get(key, 0) + trajectory.length

    @staticmethod
    def _key(trajectory: Trajectory) -> Key:
        return trajectory.mode, trajectory.success and not trajectory.off_mode_success

    def remove(self, trajectory: Trajectory) -> None:
        """
        :param trajectory: One of those in use
        """
        key = self._key(trajectory)
        self.members[key].remove(trajectory)
        self.n_rows[key] -= trajectory.length

    def retire(self, trajectory: Trajectory, trains: bool) -> None:
        """
        :param trajectory: In use no more: from now on it serves exploration
        :param trains: Whether its mode, if it has one, goes on learning from it
        """
        trajectory.trains = trains and trajectory.mode != NO_MODE
        trajectory.mode = trajectory.mode if trajectory.trains else NO_MODE
        trajectory.path = None
        self.retired.append(trajectory)

    def take_training(self) -> list[Trajectory]:
        """
        :return: Retired trajectories that train a mode, which are none of the retired any more
        """
        training = [trajectory for trajectory in self.retired if trajectory.trains]
        if training:
            self.retired = deque(trajectory for trajectory in self.retired if not trajectory.trains)
        return training

    def pop_oldest(self) -> Trajectory | None:
        """
        :return: The trajectory that leaves first, None if none may
        """
        if self.retired:
            return self.retired.popleft()
        # The last success of a mode stays: without it the mode would have nothing to learn from
        spare = [key for key, group in self.members.items() if len(group) > (key[0] != NO_MODE and key[1])]
        spare = [key for key in spare if not (key[0] in self.frozen_modes and key[1])] or spare
        if not spare:
            return None
        largest = max(spare, key=lambda key: self.n_rows[key])
        trajectory = self.members[largest].popleft()
        self.n_rows[largest] -= trajectory.length
        return trajectory

    def of(self, success: bool) -> list[Trajectory]:
        """
        :param success: Goal-reached or failed ones (and those that reached it off their mode's route)
        :return: Those in use, in order of finishing
        """
        found = [each for key, group in self.members.items() if key[1] == success and key[0] != PAST_GOAL for each in group]
        return sorted(found, key=lambda trajectory: trajectory.serial)

    def past_goals(self) -> list[Trajectory]:
        """
        :return: What episodes did after their goals, in order of finishing
        """
        return list(self.members.get((PAST_GOAL, False), ()))

    def judge_again(self, is_success: Callable[[Trajectory], bool]) -> None:
        """
        :param is_success: Says of each trajectory whether it counts as a success of its mode from now on
        """
        for trajectory in self.retired:
            trajectory.success = is_success(trajectory)
        members = [each for group in self.members.values() for each in group]
        self.members, self.n_rows = {}, {}
        for trajectory in sorted(members, key=lambda trajectory: trajectory.serial):
            trajectory.success = trajectory.mode != PAST_GOAL and is_success(trajectory)
            self.insert(trajectory)

    def clear(self) -> None:
        """Forget those in use by modes, or that may be; the others stay."""
        past = self.past_goals()
        self.members, self.n_rows = {}, {}
        for trajectory in past:
            self.insert(trajectory)
