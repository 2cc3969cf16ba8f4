"""The episodes in progress: their rows, one episode for each environment."""

import numpy as np


class RunningEpisodes:
    """
    Rows of the episodes in progress, in order, and what they have returned so far.

    :param n_envs: Number of environments
    """

    def __init__(self, n_envs: int) -> None:
        self.rows = np.empty((n_envs, 64), dtype=np.int32)
        self.lengths = np.zeros(n_envs, dtype=np.int64)
        self.returns = np.zeros(n_envs)

    def of(self, env: int) -> np.ndarray:
        """
        :param env: Index of an environment
        :return: Rows of its episode, shape [length]
        """
        return self.rows[env, : self.lengths[env]]

    def latest(self) -> tuple[np.ndarray, np.ndarray]:
        """
        :return: Environments whose episodes have begun, and the rows of their latest steps
        """
        envs = np.flatnonzero(self.lengths > 0)
        return envs, self.rows[envs, self.lengths[envs] - 1]

    def extend(self, rows: np.ndarray, rewards: np.ndarray) -> None:
        """
        :param rows: Of one further step of each environment, shape [n_envs]
        :param rewards: Of these steps, shape [n_envs]
        """
        if int(self.lengths.max(initial=0)) == self.rows.shape[1]:
            self.rows = np.concatenate((self.rows, np.empty_like(self.rows)), axis=1)
        self.rows[np.arange(len(self.rows)), self.lengths] = rows
        self.lengths += 1
        self.returns += rewards

    def end(self, env: int) -> tuple[np.ndarray, float]:
        """
        :param env: Environment whose episode is over
        :return: Its rows, shape [length], and its return
        """
        rows, total = self.of(env).copy(), float(self.returns[env])
        self.lengths[env] = 0
        self.returns[env] = 0.0
        return rows, total

    def all_rows(self) -> np.ndarray:
        """
        :return: Rows of all episodes, one environment after the other
        """
        return np.concatenate([self.rows[:0, 0], *(self.of(env) for env in range(len(self.rows)))])

    def restore(self, rows: np.ndarray, lengths: np.ndarray, returns: np.ndarray) -> None:
        """
        :param rows: What ``all_rows`` gave
        :param lengths: Number of steps of each episode, shape [n_envs]
        :param returns: What each has returned so far, shape [n_envs]
        """
        self.rows = np.empty((len(lengths), max(64, 2 * int(lengths.max(initial=0)))), dtype=np.int32)
        self.lengths, self.returns = lengths.copy(), returns.copy()
        for env, (end, length) in enumerate(zip(np.cumsum(lengths), lengths, strict=True)):
            self.rows[env, :length] = rows[end - length : end]
