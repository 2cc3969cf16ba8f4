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
    layers = []
    while isinstance(env, gym.Wrapper):
        if type(env) not in _GYM_WRAPPERS:
            return None
        values = {name: getattr(env, name) for name in _GYM_WRAPPERS[type(env)]}
        layers.append({"kind": type(env).__name__, "values": values})
        env = env.env
    return {"layers": layers, "core": env.state_dict()} if hasattr(env, "state_dict") else None


def restore_env(env: gym.Env, tree: Any) -> None:
    """
    :param env: Made as the one that was asked
    :param tree: What ``env_snapshot`` gave
    :raises ValueError: If it is of another environment
    """
    snapshot = convert(tree, _Snapshot, "environment")
    for layer in snapshot.layers:
        if type(env).__name__ != layer.kind or set(layer.values) != set(_GYM_WRAPPERS.get(type(env), ())):
            raise ValueError(f"environment: saved with a {layer.kind} where there is a {type(env).__name__}")
        for name, value in layer.values.items():
            setattr(env, name, value)
        if isinstance(env, wrappers.PassiveEnvChecker):  # it checks first calls, which others were
            env.checked_reset = env.checked_step = env.checked_data_reuse = True
        env = env.env  # type: ignore[attr-defined]
    if isinstance(env, gym.Wrapper) or not hasattr(env, "load_state_dict"):
        raise ValueError(f"environment: saved of another than {type(env).__name__}")
    env.load_state_dict(snapshot.core)


def vec_env_snapshot(env: VecEnv) -> dict[str, Any] | None:
    """
    :param env: Vectorised environments
    :return: What ``restore_vec_env`` takes; None if it cannot be told
    """
    layers = []
    while isinstance(env, VecEnvWrapper):
        if type(env) not in _VEC_WRAPPERS:
            return None
        values = {name: getattr(env, name) for name in _VEC_WRAPPERS[type(env)]}
        layers.append({"kind": type(env).__name__, "values": values})
        env = env.venv
    if hasattr(env, "state_dict"):
        core = env.state_dict()
    else:
        core = [env_snapshot(each) for each in env.envs] if isinstance(env, DummyVecEnv) else None
    known = core is not None and not (isinstance(core, list) and None in core)
    return {"layers": layers, "core": core} if known else None


def restore_vec_env(env: VecEnv, tree: Any) -> None:
    """
    :param env: Made as the one that was asked
    :param tree: What ``vec_env_snapshot`` gave
    :raises ValueError: If it is of another
    """
    snapshot = convert(tree, _Snapshot, "environments")
    for layer in snapshot.layers:
        if type(env).__name__ != layer.kind or set(layer.values) != set(_VEC_WRAPPERS.get(type(env), ())):
            raise ValueError(f"environments: saved with a {layer.kind} where there is a {type(env).__name__}")
        for name, value in layer.values.items():
            before = getattr(env, name)
            if isinstance(before, np.ndarray):
                value = check_array(
                    convert(value, np.ndarray, name), before.dtype, before.shape, f"environments.{name}"
                ).copy()
            else:
                value = convert(value, type(before), f"environments.{name}")
            setattr(env, name, value)
        env = env.venv  # type: ignore[attr-defined]
    if isinstance(env, DummyVecEnv):
        states = convert(snapshot.core, list[Any], "environments")
        if len(states) != env.num_envs:
            raise ValueError(f"environments: {len(states)} saved, there are {env.num_envs}")
        for each, state in zip(env.envs, states, strict=True):
            restore_env(each, state)
    elif hasattr(env, "load_state_dict"):
        env.load_state_dict(snapshot.core)
    else:
        raise ValueError(f"environments: saved of another kind than {type(env).__name__}")


def normalization(env: VecNormalize) -> dict[str, Any]:
    """
    :param env: Normalises observations, rewards or both
    :return: Its running statistics
    """
    moments = env.obs_rms if isinstance(env.obs_rms, dict) else {"": env.obs_rms} if env.norm_obs else {}
    return {"observations": {key: _moments(each) for key, each in moments.items()}, "returns": _moments(env.ret_rms)}


def restore_normalization(env: VecNormalize, tree: Any) -> None:
    """
    :param env: Normalises the same
    :param tree: What ``normalization`` gave
    :raises ValueError: If it is of other observations
    """
    state = convert(tree, _Normalization, "normalization")
    own: Any = env.obs_rms if isinstance(env.obs_rms, dict) else {"": env.obs_rms} if env.norm_obs else {}
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


def _moments(moments: RunningMeanStd) -> dict[str, Any]:
    return {"mean": np.asarray(moments.mean), "var": np.asarray(moments.var), "count": float(moments.count)}
