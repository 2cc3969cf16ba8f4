"""Declared mode features under wrappers of Gymnasium: where they are in what the wrappers make of the observation."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces, wrappers
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.utils.changing_wrappers import CHANGES, SAME_COMPONENTS, ChangesComponents
from sb3_ddiffpg.utils.vec_envs import env_attribute, is_wrapped


class _LostError(ValueError):
    """A wrapper has changed the observation, and nobody knows how."""


def wrapped_mode_features(env: VecEnv) -> Any:
    """
    What the first environment declares as its ``mode_features``, as found in the observations of its outermost wrapper.

    :param env: The environments, which declare them
    :return: Indices of the flat observation, a key, or a callable
    :raises ValueError: If a wrapper has changed the observations so that it cannot be known
    """
    declared = env_attribute(env, "mode_features")
    innermost: Any = env
    while hasattr(innermost, "venv"):
        innermost = innermost.venv
    try:
        if isinstance(getattr(innermost, "envs", None), list):
            return _followed(declared, innermost.envs[0])
        return _of_a_worker(declared, env)
    except _LostError as error:
        raise ValueError(
            f"The environment declares mode_features={declared!r}, but its observations are changed by {error}: say with "
            "mode_features= where they are now, as indices (or a key) of what the wrappers give"
        ) from None


def _followed(declared: Any, env: Any) -> Any:
    """Through the wrappers round whoever declares them, from within to without."""
    chain = []
    while isinstance(env, gym.Wrapper) and "mode_features" not in vars(env) and not hasattr(type(env), "mode_features"):
        chain.append(env)
        env = env.env
    for wrapper in reversed(chain):
        declared = _through(declared, wrapper)
    return declared


def _through(declared: Any, wrapper: gym.Wrapper) -> Any:
    inner, outer = wrapper.env.observation_space, wrapper.observation_space
    for kind, rule in _RULES.items():
        if isinstance(wrapper, kind):
            found = rule(declared, wrapper, inner, outer)
            if found is None:
                break
            return found
    else:
        # Of any other that is made to change observations one cannot know; one for rewards, actions or time limits leaves them
        if inner == outer and not isinstance(wrapper, CHANGES):
            return declared
    raise _LostError(type(wrapper).__name__)


def _kept(declared: Any, wrapper: Any, inner: Any, outer: Any) -> Any:
    """By a callable the environment means what it gives itself."""
    return None if callable(declared) else declared


def _flattened(declared: Any, wrapper: Any, inner: Any, outer: Any) -> Any:
    if isinstance(inner, spaces.Dict):
        return _part(declared, inner)
    return declared if isinstance(inner, spaces.Box) and not callable(declared) else None


def _part(key: Any, space: spaces.Dict) -> Any:
    """Where an entry, a vector, lies in the flattened dict."""
    if not isinstance(key, str) or not isinstance(space.spaces.get(key), spaces.Box):
        return None
    sizes = {name: spaces.flatdim(each) for name, each in space.spaces.items()}
    names = list(sizes)
    start = sum(sizes[name] for name in names[: names.index(key)])
    return np.arange(start, start + sizes[key])


def _stacked(declared: Any, wrapper: Any, inner: Any, outer: Any) -> Any:
    """The newest frame comes last."""
    if callable(declared) or isinstance(declared, str) or not isinstance(inner, spaces.Box):
        return None
    return np.asarray(declared) + int(np.prod(outer.shape)) - int(np.prod(inner.shape))


def _filtered(declared: Any, wrapper: Any, inner: Any, outer: Any) -> Any:
    if callable(declared) or not isinstance(inner, spaces.Dict) or not isinstance(outer, spaces.Dict):
        return None
    return declared if isinstance(declared, str) and inner.spaces.get(declared) == outer.spaces.get(declared) else None


def _with_time(declared: Any, wrapper: Any, inner: Any, outer: Any) -> Any:
    """The time is one component more, the last one. Of a flattened dict it may be anywhere."""
    if not wrapper.flatten:
        return _filtered(declared, wrapper, inner, outer)
    return declared if isinstance(inner, spaces.Box) and not callable(declared) else None


_RULES: dict[Any, Callable[[Any, Any, Any, Any], Any]] = {
    SAME_COMPONENTS: _kept,
    wrappers.FlattenObservation: _flattened,
    wrappers.FrameStackObservation: _stacked,
    wrappers.TimeAwareObservation: _with_time,
    (wrappers.FilterObservation, wrappers.AddRenderObservation): _filtered,
}


def _of_a_worker(declared: Any, env: VecEnv) -> Any:
    """In another process one can only ask whether there is such a wrapper."""
    kind: Any = gym.ObservationWrapper if callable(declared) else ChangesComponents
    if is_wrapped(env, kind):
        raise _LostError("a wrapper in another process (where DummyVecEnv has them, most can be followed)")
    return declared
