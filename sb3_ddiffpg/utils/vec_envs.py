"""Questions to vectorised environments, whoever has written them."""

from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnv


def env_attribute(env: VecEnv, name: str, default: Any = None) -> Any:
    """
    Ask the first environment for an attribute. VecEnvs of other libraries may take no single index, or answer no questions at
    all: then it is not there.

    :param env: The environments
    :param name: Of the attribute
    :param default: What to return where it is not there
    :return: Its value
    """
    try:
        # Asked first: a worker process would die of an attribute that its environment does not have
        return env.get_attr(name, indices=[0])[0] if env.has_attr(name) else default
    except (AttributeError, NotImplementedError, TypeError):
        return default


def has_method(env: VecEnv, name: str) -> bool:
    """
    :param env: The environments
    :param name: Of a method
    :return: Whether the first environment has it; False where it cannot be asked
    """
    try:
        return bool(env.has_attr(name))
    except (AttributeError, NotImplementedError, TypeError):
        return False


def ask_first(env: VecEnv, method: str, *arguments: Any) -> Any:
    """
    :param env: The environments
    :param method: That they have, see ``has_method``
    :param arguments: Of it
    :return: What the first environment answers
    """
    return env.env_method(method, *arguments, indices=[0])[0]


def is_wrapped(env: VecEnv, kind: type[gym.Wrapper]) -> bool:
    """
    :param env: The environments
    :param kind: Of a wrapper
    :return: Whether the first environment has one of this kind round it; False where it cannot be asked
    """
    try:
        return bool(env.env_is_wrapped(kind, indices=[0])[0])
    except (AttributeError, NotImplementedError, TypeError):
        return False


def labels_routes(env: VecEnv) -> bool:
    """
    Any environment may put a ``"mode"`` into its info, and mean something else by it.

    :param env: The environments
    :return: Whether it labels the route of an episode: those say so that declare ``listed_modes``, even if these are none
    """
    return env_attribute(env, "listed_modes") is not None


def route_label(info: dict[str, Any], labelled: bool) -> str | None:
    """
    :param info: Of an episode's last step
    :param labelled: What ``labels_routes`` says of its environment
    :return: Ground truth of the route that it took, None if there is none
    """
    label = info.get("mode") if labelled else None
    return None if label is None else str(label)
