"""The running episodes of environments in plain values and arrays, so that a run can go on in another process."""

from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
from gymnasium import wrappers
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)

from sb3_ddiffpg.safe_files import check_array, convert

# What each known wrapper remembers of an episode; another kind could remember anything
_GYM_WRAPPERS: dict[type, tuple[str, ...]] = {
    wrappers.TimeLimit: ("_elapsed_steps",),
    wrappers.OrderEnforcing: ("_has_reset",),
    wrappers.PassiveEnvChecker: (),
    Monitor: ("rewards", "needs_reset"),
}
_VEC_WRAPPERS: dict[type, tuple[str, ...]] = {
    VecMonitor: ("episode_returns", "episode_lengths", "episode_count"),
    VecNormalize: ("returns",),
    VecTransposeImage: (),
    VecCheckNan: (),
}


class _Layer(msgspec.Struct, forbid_unknown_fields=True):
    kind: str
    values: dict[str, Any]


class _Snapshot(msgspec.Struct, forbid_unknown_fields=True):
    layers: list[_Layer]
    core: Any


class _Moments(msgspec.Struct, forbid_unknown_fields=True):
    mean: np.ndarray
    var: np.ndarray
    count: float


class _Normalization(msgspec.Struct, forbid_unknown_fields=True):
    observations: dict[str, _Moments]
    returns: _Moments


def env_snapshot(env: gym.Env) -> dict[str, Any] | None:
    """
    :param env: An environment that says with ``state_dict()`` where its episode is; perhaps in wrappers of gymnasium and SB3
    :return: What ``restore_env`` takes; None if it cannot be told
    """
    peeled = _peel(env, gym.Wrapper, "env", _GYM_WRAPPERS)
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
    snapshot = convert(tree, _Snapshot, "environment")
    layers, core = _match(env, snapshot, "env", _GYM_WRAPPERS, "environment")
    if isinstance(core, gym.Wrapper) or not hasattr(core, "load_state_dict"):
        raise ValueError(f"environment: saved of another than {type(core).__name__}")
    for wrapper, values in layers:
        for name, value in values.items():
            setattr(wrapper, name, value)
        if isinstance(wrapper, wrappers.PassiveEnvChecker):  # it checks first calls, which others were
            wrapper.checked_reset = wrapper.checked_step = wrapper.checked_data_reuse = True
    core.load_state_dict(snapshot.core)


def vec_env_snapshot(env: VecEnv) -> dict[str, Any] | None:
    """
    :param env: Vectorised environments
    :return: What ``restore_vec_env`` takes; None if it cannot be told
    """
    peeled = _peel(env, VecEnvWrapper, "venv", _VEC_WRAPPERS)
    if peeled is None:
        return None
    layers, inner = peeled
    if hasattr(inner, "state_dict"):
        core = inner.state_dict()
    else:
        core = [env_snapshot(each) for each in inner.envs] if isinstance(inner, DummyVecEnv) else None
    known = core is not None and not (isinstance(core, list) and None in core)
    return {"layers": layers, "core": core} if known else None


def restore_vec_env(env: VecEnv, tree: Any) -> None:
    """
    :param env: Made as the one that was asked
    :param tree: What ``vec_env_snapshot`` gave
    :raises ValueError: If it is of another
    """
    snapshot = convert(tree, _Snapshot, "environments")
    layers, core = _match(env, snapshot, "venv", _VEC_WRAPPERS, "environments")
    for wrapper, values in layers:
        for name, value in values.items():
            before = getattr(wrapper, name)
            if isinstance(before, np.ndarray):
                array = convert(value, np.ndarray, name)
                value = check_array(array, before.dtype, before.shape, f"environments.{name}").copy()
            else:
                value = convert(value, type(before), f"environments.{name}")
            setattr(wrapper, name, value)
    if isinstance(core, DummyVecEnv):
        states = convert(snapshot.core, list[Any], "environments")
        if len(states) != core.num_envs:
            raise ValueError(f"environments: {len(states)} saved, there are {core.num_envs}")
        for each, state in zip(core.envs, states, strict=True):
            restore_env(each, state)
        # What a new one is made with waits for its first reset, which this one has had
        core._reset_seeds()
        core._reset_options()
    elif hasattr(core, "load_state_dict"):
        core.load_state_dict(snapshot.core)
    else:
        raise ValueError(f"environments: saved of another kind than {type(core).__name__}")


def _peel(env: Any, wrapper: type, inner: str, known: dict[type, tuple[str, ...]]) -> tuple[list[dict[str, Any]], Any] | None:
    """What each wrapper remembers, from the outermost on, and what is within; None if one is not known."""
    layers = []
    while isinstance(env, wrapper):
        if type(env) not in known:
            return None
        values = {name: getattr(env, name) for name in known[type(env)]}
        layers.append({"kind": type(env).__name__, "values": values})
        env = getattr(env, inner)
    return layers, env


def _match(
    env: Any, snapshot: _Snapshot, inner: str, known: dict[type, tuple[str, ...]], what: str
) -> tuple[list[tuple[Any, dict[str, Any]]], Any]:
    """Each wrapper with what one of its kind remembered, and what is within."""
    layers = []
    for layer in snapshot.layers:
        if type(env).__name__ != layer.kind or set(layer.values) != set(known.get(type(env), ())):
            raise ValueError(f"{what}: saved with a {layer.kind} where there is a {type(env).__name__}")
        layers.append((env, layer.values))
        env = getattr(env, inner)
    return layers, env


def normalization(env: VecNormalize) -> dict[str, Any]:
    """
    :param env: Normalises observations, rewards or both
    :return: Its running statistics
    """
    moments = {key: _moments(each) for key, each in _of_observations(env).items()}
    return {"observations": moments, "returns": _moments(env.ret_rms)}


def restore_normalization(env: VecNormalize, tree: Any) -> None:
    """
    :param env: Normalises the same
    :param tree: What ``normalization`` gave
    :raises ValueError: If it is of other observations
    """
    state = convert(tree, _Normalization, "normalization")
    own = _of_observations(env)
    if set(own) != set(state.observations):
        raise ValueError(f"normalization: of {sorted(state.observations)}, the environment's is of {sorted(own)}")
    pairs = [(own[key], each) for key, each in state.observations.items()] + [(env.ret_rms, state.returns)]
    for target, saved in pairs:
        for name in ("mean", "var"):
            check_array(getattr(saved, name), np.float64, np.shape(getattr(target, name)), f"normalization.{name}")
        if not (np.isfinite(saved.mean).all() and (saved.var >= 0).all() and saved.count >= 0):
            raise ValueError("normalization: there are numbers that no observations have")
    for target, saved in pairs:
        target.mean, target.var, target.count = saved.mean.copy(), saved.var.copy(), saved.count


def _of_observations(env: VecNormalize) -> dict[str, RunningMeanStd]:
    if not env.norm_obs:
        return {}  # SB3 makes none then
    return env.obs_rms if isinstance(env.obs_rms, dict) else {"": env.obs_rms}


def _moments(moments: RunningMeanStd) -> dict[str, Any]:
    return {"mean": np.asarray(moments.mean), "var": np.asarray(moments.var), "count": float(moments.count)}
