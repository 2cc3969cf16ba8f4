"""The running episodes of environments in plain values and arrays, so that a run can go on in another process."""

from typing import Any

import msgspec
import numpy as np
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

from sb3_ddiffpg.envs.env_snapshots import Known, Snapshot, env_snapshot, match, peel, restore_env
from sb3_ddiffpg.serialization.safetensors_tree import Count, check_array, convert
from sb3_ddiffpg.utils.settings import LARGEST

# What each known wrapper remembers, and of which type it is; another kind could remember anything
_VEC_WRAPPERS: Known = {
    VecMonitor: {"episode_returns": np.ndarray, "episode_lengths": np.ndarray, "episode_count": Count},
    VecNormalize: {"returns": np.ndarray},
    VecTransposeImage: {},
    VecCheckNan: {},
}


class _Moments(msgspec.Struct, forbid_unknown_fields=True):
    mean: np.ndarray
    var: np.ndarray
    count: float


class _Normalization(msgspec.Struct, forbid_unknown_fields=True):
    observations: dict[str, _Moments]
    returns: _Moments


def vec_env_snapshot(env: VecEnv) -> dict[str, Any] | None:
    """
    :param env: Vectorised environments
    :return: What ``restore_vec_env`` takes; None if it cannot be told
    """
    peeled = peel(env, VecEnvWrapper, "venv", _VEC_WRAPPERS)
    if peeled is None:
        return None
    layers, inner = peeled
    if hasattr(inner, "state_dict"):
        core = inner.state_dict()
    else:
        core = [env_snapshot(each) for each in inner.envs] if isinstance(inner, DummyVecEnv) else None
    known = core is not None and not (isinstance(core, list) and None in core)
    return {"layers": layers, "core": core} if known else None


def awaits_seeds(env: VecEnv) -> bool:
    """
    :param env: Vectorised environments
    :return: Whether they have been given seeds that the first reset will take, which no snapshot holds
    """
    while isinstance(env, VecEnvWrapper):
        env = env.venv
    return any(seed is not None for seed in getattr(env, "_seeds", ()))  # of another library it may have none


def restore_vec_env(env: VecEnv, tree: Any) -> None:
    """
    :param env: Made as the one that was asked
    :param tree: What ``vec_env_snapshot`` gave
    :raises ValueError: If it is of another
    """
    snapshot = convert(tree, Snapshot, "environments")
    layers, core = match(env, snapshot, "venv", _VEC_WRAPPERS, "environments")
    for wrapper, values in layers:
        for name, value in values.items():
            before, found = getattr(wrapper, name), convert(value, _VEC_WRAPPERS[type(wrapper)][name], f"environments.{name}")
            if isinstance(found, np.ndarray):
                found = check_array(found, before.dtype, before.shape, f"environments.{name}").copy()
            setattr(wrapper, name, found)
    if isinstance(core, DummyVecEnv):
        states = convert(snapshot.core, list[Any], "environments")
        if len(states) != core.num_envs:
            raise ValueError(f"environments: {len(states)} saved, there are {core.num_envs}")
        for each, state in zip(core.envs, states, strict=True):
            restore_env(each, state)
    elif hasattr(core, "load_state_dict"):
        core.load_state_dict(snapshot.core)
    else:
        raise ValueError(f"environments: saved of another kind than {type(core).__name__}")
    # What a new one is made with waits for its first reset, which this one has had
    core._reset_seeds()
    core._reset_options()


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
        moments = (np.abs(saved.mean) < LARGEST).all() and ((0 <= saved.var) & (saved.var < LARGEST**2)).all()
        if not (moments and 0 <= saved.count < 2**53):
            raise ValueError("normalization: there are numbers that no observations have")
    for target, saved in pairs:
        target.mean, target.var, target.count = saved.mean.copy(), saved.var.copy(), saved.count


class SoundNormalization:
    """What VecNormalize knew when all was well, which it gets back after it was given what is not finite."""

    def __init__(self) -> None:
        self._known: dict[str, Any] | None = None

    def note(self, env: VecNormalize | None) -> None:
        """
        :param env: All is well; None: nothing is normalised
        """
        self._known = None if env is None else normalization(env)

    def restore(self, env: VecNormalize | None) -> None:
        """
        :param env: Gets it back
        """
        if env is not None and self._known is not None:
            restore_normalization(env, self._known)


def _of_observations(env: VecNormalize) -> dict[str, RunningMeanStd]:
    if not env.norm_obs:
        return {}  # SB3 makes none then
    return env.obs_rms if isinstance(env.obs_rms, dict) else {"": env.obs_rms}


def _moments(moments: RunningMeanStd) -> dict[str, Any]:
    return {"mean": np.asarray(moments.mean), "var": np.asarray(moments.var), "count": float(moments.count)}
