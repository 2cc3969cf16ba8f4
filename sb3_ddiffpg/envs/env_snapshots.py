"""The running episode of an environment in plain values and arrays. Neither SB3 nor PyTorch is imported: workers import it."""

import sys
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
from gymnasium import wrappers

from sb3_ddiffpg.envs.changed_env import ChangedEnv
from sb3_ddiffpg.serialization.safetensors_tree import Count, check_array, convert

#: What each known wrapper remembers of an episode, and of which type it is; another kind could remember anything
Known = dict[type, dict[str, Any]]


def _plain(kind: type) -> type:
    """The RL zoo puts a time limit of its own, which remembers the same, in the place of gymnasium's."""
    return kind.__mro__[1] if kind.__module__ == "rl_zoo3.gym_patches" else kind


def _known_wrappers() -> Known:
    known: Known = {
        _plain(wrappers.TimeLimit): {"_elapsed_steps": Count | None},
        wrappers.OrderEnforcing: {"_has_reset": bool},
        wrappers.PassiveEnvChecker: {},
        ChangedEnv: {"drawn_from": dict[str, Any] | None},
    }
    monitors = sys.modules.get("stable_baselines3.common.monitor")  # where it was not imported, none is one
    return known if monitors is None else {**known, monitors.Monitor: {"rewards": list[float], "needs_reset": bool}}


class _Layer(msgspec.Struct, forbid_unknown_fields=True):
    kind: str
    values: dict[str, Any]


class Snapshot(msgspec.Struct, forbid_unknown_fields=True):
    layers: list[_Layer]
    core: Any


def env_snapshot(env: gym.Env) -> dict[str, Any] | None:
    """
    :param env: An environment that says with ``state_dict()`` where its episode is; perhaps in wrappers of gymnasium and SB3
    :return: What ``restore_env`` takes; None if it cannot be told
    """
    peeled = peel(env, gym.Wrapper, "env", _known_wrappers())
    if peeled is None or not hasattr(peeled[1], "state_dict"):
        return None
    layers, core = peeled
    return {"layers": layers, "core": core.state_dict()}


def restore_env(env: gym.Env, tree: Any) -> None:
    """
    :param env: Made as the one that was asked
    :param tree: What ``env_snapshot`` gave
    :raises ValueError: If it is of another environment
    """
    snapshot, known = convert(tree, Snapshot, "environment"), _known_wrappers()
    layers, core = match(env, snapshot, "env", known, "environment")
    if isinstance(core, gym.Wrapper) or not hasattr(core, "load_state_dict"):
        raise ValueError(f"environment: saved of another than {type(core).__name__}")
    for wrapper, values in layers:
        for name, value in values.items():
            numbers = check_array(value, np.float64, [None], name).tolist() if isinstance(value, np.ndarray) else value
            setattr(wrapper, name, convert(numbers, known[_plain(type(wrapper))][name], f"environment.{name}"))
        if isinstance(wrapper, wrappers.PassiveEnvChecker):  # it checks first calls, which others were
            wrapper.checked_reset = wrapper.checked_step = wrapper.checked_data_reuse = True
    try:
        core.load_state_dict(snapshot.core)
    except (LookupError, TypeError, AttributeError) as error:  # somebody's own may trust what it is given
        raise ValueError(f"environment: {type(core).__name__} cannot be there: {error!r}") from error


def peel(env: Any, wrapper: type, inner: str, known: Known) -> tuple[list[dict[str, Any]], Any] | None:
    """What each wrapper remembers, from the outermost on, and what is within; None if one is not known."""
    layers = []
    while isinstance(env, wrapper):
        kind = _plain(type(env))
        if kind not in known:
            return None
        values = {name: getattr(env, name) for name in known[kind]}
        # A file holds many numbers only as arrays
        values = {name: np.array(each, dtype=np.float64) if isinstance(each, list) else each for name, each in values.items()}
        layers.append({"kind": kind.__name__, "values": values})
        env = getattr(env, inner)
    return layers, env


def match(env: Any, snapshot: Snapshot, inner: str, known: Known, what: str) -> tuple[list[tuple[Any, dict[str, Any]]], Any]:
    """Each wrapper with what one of its kind remembered, and what is within."""
    layers = []
    for layer in snapshot.layers:
        kind = _plain(type(env))
        if kind not in known or kind.__name__ != layer.kind or set(layer.values) != set(known[kind]):
            raise ValueError(f"{what}: saved with a {layer.kind[:50]} where there is a {kind.__name__}")
        layers.append((env, layer.values))
        env = getattr(env, inner)
    return layers, env
