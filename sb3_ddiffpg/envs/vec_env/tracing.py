"""Environments that are stepped one after the other, and whose turn it was when one of them raised."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn


class TracedEnvs(list):
    """
    Environments, of which it can be seen whose turn it was last.

    :param envs: the environments
    :param turn: its ``value`` becomes the index of the one that is taken out of the list
    """

    def __init__(self, envs: Sequence[gym.Env], turn: Any) -> None:
        super().__init__(envs)
        self.turn = turn

    def __getitem__(self, index: Any) -> Any:
        self.turn.value = index
        return super().__getitem__(index)

    def __iter__(self) -> Iterator[gym.Env]:
        return (self[index] for index in range(len(self)))


class TracingDummyVecEnv(DummyVecEnv):
    """
    SB3's ``DummyVecEnv``, whose errors say in which environment they were raised.

    :param env_fns: functions that make the environments
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]]) -> None:
        super().__init__(env_fns)
        self._turn = SimpleNamespace(value=0)
        self.envs = TracedEnvs(self.envs, self._turn)

    def reset(self) -> VecEnvObs:
        """
        :return: observations of new episodes
        """
        with self._said_where():
            return super().reset()

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations, rewards, dones and infos
        """
        with self._said_where():
            return super().step_wait()

    @contextmanager
    def _said_where(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            error.add_note(f"Raised by environment {self._turn.value}")
            raise
