"""Vectorised environments that live in groups elsewhere: what is asked of each group, and how the answers come together."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_ddiffpg.envs.vec_env.group import NOBODY, by_name
from sb3_ddiffpg.serialization.safetensors_tree import convert


def check_groups(n_workers: int | None, timeout: float | None) -> None:
    """
    :param n_workers: number of groups, None if nobody said it
    :param timeout: seconds to wait for an answer; None: for ever
    :raises ValueError: if there are none, or no time
    """
    if n_workers is not None and n_workers < 1:
        raise ValueError(f"n_workers: {n_workers} given; accepted are whole numbers from 1 up")
    if timeout is not None and not timeout > 0:
        raise ValueError(f"timeout: {timeout} given; accepted are numbers above 0, and None")


def first_of_groups(n_envs: int, n_groups: int) -> np.ndarray:
    """
    :param n_envs: number of environments
    :param n_groups: number of groups, of sizes as equal as can be
    :return: first environment of each group, and the number of environments
    """
    return np.linspace(0, n_envs, n_groups + 1).round().astype(int)


class GroupedVecEnv(VecEnv):
    """
    Environments in groups, each of which is one ``EnvGroup`` somewhere else. A subclass says how they are asked.
    """

    #: First environment of each group, and the number of environments
    first: np.ndarray

    @abstractmethod
    def _tell(self, command: str, arguments: Sequence[Any]) -> None:
        """Give each group a command, with its own argument."""

    @abstractmethod
    def _hear(self) -> list[Any]:
        """What each group has answered to the latest command."""

    @abstractmethod
    def _who(self, group: int, turn: int = NOBODY) -> str:
        """A group, or the one of its environments whose turn it is, for messages."""

    def _results(self, answers: Sequence[tuple[str, Any]]) -> list[Any]:
        """
        Of each group what it has found, or the error that one has met.

        :param answers: ``("ok", result)``, or ``("error", (environment, lacks, text))``, where ``lacks`` says whether it was
            an AttributeError, after which all go on
        """
        for group, (status, result) in enumerate(answers):
            if status == "error":
                env, lacks, text = result
                message = f"{self._who(group, env)} raised an error:\n{text}"
                if lacks:
                    raise AttributeError(message)
                self.close()
                raise RuntimeError(message)
        return [result for _, result in answers]

    def _ask(self, command: str, arguments: Sequence[Any]) -> list[Any]:
        self._tell(command, arguments)
        return self._hear()

    def _join(self, parts: list[Any]) -> VecEnvObs:
        if isinstance(parts[0], dict):
            return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        return np.concatenate(parts)

    def _split(self, values: Any) -> list[Any]:
        return [values[first:last] for first, last in zip(self.first[:-1], self.first[1:], strict=True)]

    def reset(self) -> VecEnvObs:
        """
        :return: observations of new episodes
        """
        seeds_and_options = zip(self._split(self._seeds), self._split(self._options), strict=True)
        answers = self._ask("reset", list(seeds_and_options))
        self.reset_infos = [info for _, infos in answers for info in infos]
        self._reset_seeds()
        self._reset_options()
        return self._join([observations for observations, _ in answers])

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: shape ``(n_envs, *action shape)``
        """
        self._tell("step", self._split(actions))

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations, rewards, dones and infos
        """
        observations, rewards, dones, infos, reset_infos = zip(*self._hear(), strict=True)
        self.reset_infos = [info for part in reset_infos for info in part]
        joined = [info for part in infos for info in part]
        return self._join(list(observations)), np.concatenate(rewards), np.concatenate(dones), joined

    def state_dict(self) -> list[Any]:
        """
        :return: of each environment what ``env_snapshot`` gives, for ``load_state_dict``
        """
        return [each for part in self._ask("state_dict", [None] * self._n_groups) for each in part]

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: what ``state_dict`` gave
        :raises ValueError: if it is of other environments
        """
        states = convert(state, list[Any], "environments")
        if len(states) != self.num_envs:
            raise ValueError(f"environments: {len(states)} saved, there are {self.num_envs}")
        self._ask("load_state_dict", self._split(states))

    def _each(self, name: str, indices: VecEnvIndices, *arguments: Any, **keywords: Any) -> list[Any]:
        """Call a method of the groups' ``EnvGroup`` for some environments, which are given it as ``indices``."""
        chosen = list(self._get_indices(indices))
        local = [[i - first for i in chosen if first <= i < last] for first, last in self._ranges()]
        answers = self._ask("call", [(name, arguments, {**keywords, "indices": part}) for part in local])
        by_env = {
            first + i: value
            for (first, _), part, values in zip(self._ranges(), local, answers, strict=True)
            for i, value in zip(part, values, strict=True)
        }
        return [by_env[i] for i in chosen]

    @property
    def _n_groups(self) -> int:
        return len(self.first) - 1

    def _ranges(self) -> list[tuple[int, int]]:
        return list(zip(self.first[:-1].tolist(), self.first[1:].tolist(), strict=True))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :param attr_name: name of an attribute
        :param indices: which environments, None for all
        :return: one value per environment
        """
        return self._each("get_attr", indices, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :param attr_name: name of an attribute
        :param value: its value
        :param indices: which environments, None for all
        """
        self._each("set_attr", indices, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        :param method_name: name of a method
        :param indices: which environments, None for all
        :return: one result per environment
        """
        return self._each("env_method", indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """
        :param wrapper_class: a wrapper
        :param indices: which environments, None for all
        :return: one answer per environment
        """
        return self._each("env_is_wrapped", indices, by_name(wrapper_class))

    def has_attr(self, attr_name: str) -> bool:
        """
        :param attr_name: name of an attribute
        :return: whether every environment has it
        """
        return all(self._ask("call", [("has_attr", (attr_name,), {})] * self._n_groups))

    def get_images(self) -> Sequence[np.ndarray | None]:
        """
        :return: one RGB image per environment
        """
        if self.render_mode != "rgb_array":
            return [None] * self.num_envs
        return self.env_method("render")
