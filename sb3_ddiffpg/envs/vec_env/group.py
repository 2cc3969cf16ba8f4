"""
Environments that are stepped one after the other in another process, as ``DummyVecEnv`` does it. Neither SB3 nor PyTorch is
imported here: with them a worker would take seconds to begin, and most of its memory.
"""

import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_ddiffpg.envs.env_snapshots import env_snapshot, restore_env

# Before the first environment's turn
NOBODY = -1


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


class EnvGroup:
    """
    What ``DummyVecEnv`` is to its environments. The answers are sent elsewhere at once: they are no copies.

    :param env_fns: functions that make the environments
    :param turn: its ``value`` says whose turn it is
    :raises ValueError: if two of them are one environment, or one is no environment
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]], turn: Any) -> None:
        made = []
        for env_idx, make in enumerate(env_fns):
            turn.value = env_idx
            made.append(_gymnasium_env(make()))
        if len({id(env.unwrapped) for env in made}) != len(made):
            raise ValueError("env_fns: two of them returned the same environment; accepted are functions that make a new one")
        self.envs = TracedEnvs(made, turn)
        self.observation_space, self.action_space = made[0].observation_space, made[0].action_space
        subspaces = _subspaces(self.observation_space)
        self._observations = {
            key: np.zeros((len(made), *(space.shape or ())), dtype=space.dtype) for key, space in subspaces.items()
        }
        self._rewards, self._dones = np.zeros(len(made), dtype=np.float32), np.zeros(len(made), dtype=bool)
        self._infos: list[dict[str, Any]] = [{} for _ in made]
        self.reset_infos: list[dict[str, Any]] = [{} for _ in made]
        render_modes = self.get_attr("render_mode") if self.has_attr("render_mode") else [None]
        assert all(mode == render_modes[0] for mode in render_modes), "render_mode must be the same for all environments"
        self.render_mode = render_modes[0]

    def reset(self, seeds: Sequence[int | None], options: Sequence[dict[str, Any]]) -> Any:
        """
        :param seeds: one for each environment
        :param options: the same
        :return: observations of new episodes
        """
        for env_idx, (seed, option) in enumerate(zip(seeds, options, strict=True)):
            said = {"options": option} if option else {}
            observation, self.reset_infos[env_idx] = self.envs[env_idx].reset(seed=seed, **said)
            self._keep(env_idx, observation)
        return self._kept()

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """
        :param actions: one for each environment
        :return: observations, rewards, dones and infos
        """
        for env_idx, action in enumerate(actions):
            env = self.envs[env_idx]
            observation, self._rewards[env_idx], terminated, truncated, info = env.step(action)
            self._infos[env_idx] = info
            self._dones[env_idx] = done = terminated or truncated
            info["TimeLimit.truncated"] = truncated and not terminated
            if done:
                info["terminal_observation"] = observation
                observation, self.reset_infos[env_idx] = env.reset()
            self._keep(env_idx, observation)
        return self._kept(), self._rewards, self._dones, self._infos

    def close(self) -> None:
        """Close all."""
        for env in self.envs:
            env.close()

    def get_attr(self, attr_name: str, indices: Sequence[int] | None = None) -> list[Any]:
        """See ``VecEnv``."""
        return [env.get_wrapper_attr(attr_name) for env in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Sequence[int] | None = None) -> None:
        """See ``VecEnv``."""
        for env in self._chosen(indices):
            setattr(env, attr_name, value)

    def env_method(
        self, method_name: str, *arguments: Any, indices: Sequence[int] | None = None, **keywords: Any
    ) -> list[Any]:
        """See ``VecEnv``."""
        return [env.get_wrapper_attr(method_name)(*arguments, **keywords) for env in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Sequence[int] | None = None) -> list[bool]:
        """
        :param wrapper_class: as ``by_name`` gives it
        :param indices: which environments, None for all
        :return: one answer per environment
        """
        kind = (
            getattr(sys.modules.get(wrapper_class[0]), wrapper_class[1], None)
            if type(wrapper_class) is tuple
            else wrapper_class
        )
        return [kind is not None and _is_wrapped(env, kind) for env in self._chosen(indices)]

    def has_attr(self, attr_name: str) -> bool:
        """See ``VecEnv``."""
        try:
            self.get_attr(attr_name)
        except AttributeError:
            return False
        return True

    def _chosen(self, indices: Sequence[int] | None) -> list[Any]:
        return [self.envs[env_idx] for env_idx in (range(len(self.envs)) if indices is None else indices)]

    def _keep(self, env_idx: int, observation: Any) -> None:
        for key, kept in self._observations.items():
            kept[env_idx] = observation if key is None else observation[key]

    def _kept(self) -> Any:
        if isinstance(self.observation_space, spaces.Dict):
            return self._observations
        if isinstance(self.observation_space, spaces.Tuple):
            return tuple(self._observations.values())
        return self._observations[None]


def by_name(wrapper_class: type[gym.Wrapper]) -> Any:
    """
    :param wrapper_class: that of the environments' wrappers one is asked for elsewhere
    :return: its module and name if they are enough to know it there: with the class itself its module would be imported, as
        SB3's with PyTorch, only to hear that there is none
    """
    module, name = wrapper_class.__module__, wrapper_class.__qualname__
    found = getattr(sys.modules.get(module), name, None)
    # One with a metaclass may take the wrappers of others for its own; the main file is another one there
    return (module, name) if type(wrapper_class) is type and found is wrapper_class and module != "__main__" else wrapper_class


def answer_of(envs: Any, command: str, argument: Any) -> Any:
    """
    :param envs: an ``EnvGroup``
    :param command: what they are to do
    :param argument: of the command
    :return: the answer
    """
    if command == "reset":
        return envs.reset(*argument), envs.reset_infos
    if command == "step":
        return *envs.step(argument), envs.reset_infos
    if command == "state_dict":
        return [env_snapshot(env) for env in envs.envs]
    if command == "load_state_dict":
        for env, state in zip(envs.envs, argument, strict=True):
            restore_env(env, state)
        return None
    name, arguments, keywords = argument
    indices = keywords.pop("indices", None)
    if indices is None:
        return getattr(envs, name)(*arguments, **keywords)
    answers = []
    for env_idx in indices:
        answers.append((getattr(envs, name)(*arguments, **keywords, indices=[env_idx]) or [None])[0])
    return answers


class Actor:
    """
    What a Ray cluster runs for ``RayVecEnv``: a group of environments on some machine. It answers ``("ok", result)`` or
    ``("error", (environment, lacks, text))``, where ``lacks`` says whether it was an AttributeError. So an exception that
    arrives is always one of Ray's.
    """

    def __init__(self) -> None:
        self.envs: Any = None
        self.turn = SimpleNamespace(value=NOBODY)

    def answer(self, command: str, argument: Any) -> tuple[str, Any]:
        """
        :param command: what it is to do
        :param argument: of the command
        :return: the answer
        """
        try:
            if command == "make":
                self.envs = EnvGroup(argument, self.turn)
                return "ok", (self.envs.observation_space, self.envs.action_space, self.envs.render_mode)
            return "ok", answer_of(self.envs, command, argument)
        except Exception as error:
            return "error", (self.turn.value, isinstance(error, AttributeError), traceback.format_exc())


def _gymnasium_env(env: Any) -> gym.Env:
    """Of gym's predecessors SB3 knows more."""
    if isinstance(env, gym.Env):
        return env
    from stable_baselines3.common.vec_env.patch_gym import _patch_env

    return _patch_env(env)


def _subspaces(space: spaces.Space) -> dict[Any, spaces.Space]:
    """Of which arrays an observation consists."""
    if not isinstance(space, (spaces.Dict, spaces.Tuple)):
        return {None: space}
    found = dict(space.spaces if isinstance(space, spaces.Dict) else enumerate(space.spaces))
    if any(isinstance(each, (spaces.Dict, spaces.Tuple)) for each in found.values()):
        raise NotImplementedError("Nested observation spaces are not supported (Tuple/Dict space inside Tuple/Dict space).")
    return found


def _is_wrapped(env: gym.Env, wrapper_class: type[gym.Wrapper]) -> bool:
    while isinstance(env, gym.Wrapper):
        if isinstance(env, wrapper_class):
            return True
        env = env.env
    return False
