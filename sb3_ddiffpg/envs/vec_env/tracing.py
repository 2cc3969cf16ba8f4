"""Environments that are stepped one after the other, and whose turn it was when one of them raised."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import gymnasium as gym
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_ddiffpg.envs.vec_env.group import TracedEnvs


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
