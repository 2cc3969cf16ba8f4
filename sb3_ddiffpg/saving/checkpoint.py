"""Checkpoints of a whole run: written so that no crash loses the one before, and from which it goes on bit for bit."""

import contextlib
import copy
import errno
import warnings
from collections import deque
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    BaseCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.buffers.state import buffer_state, restore_buffer
from sb3_ddiffpg.envs.snapshots import awaits_seeds, restore_vec_env, vec_env_snapshot
from sb3_ddiffpg.exploration.noise import check_noise
from sb3_ddiffpg.saving._legacy import routes_of_0_1
from sb3_ddiffpg.saving.model import model_tree
from sb3_ddiffpg.saving.records import episodes_tree, load_episodes_tree
from sb3_ddiffpg.serialization.codec import NeededError, from_plain, to_plain
from sb3_ddiffpg.serialization.random_states import global_rng, restore_global_rng
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert, read, write
from sb3_ddiffpg.utils.nested_callbacks import nested_callbacks
from sb3_ddiffpg.utils.rng import preserved_rng

#: What the file says it is
KIND = "checkpoint"
NAMES = "checkpoint_*.safetensors"
# What SB3's callbacks have gathered: numbers, and lists of them
_GATHERED: dict[type[BaseCallback], tuple[str, ...]] = {
    EvalCallback: (
        *("best_mean_reward", "last_mean_reward"),
        *("evaluations_timesteps", "evaluations_results", "evaluations_length", "evaluations_successes"),
    ),
    EveryNTimesteps: ("last_time_trigger",),
    StopTrainingOnMaxEpisodes: ("n_episodes",),
    StopTrainingOnNoModelImprovement: ("last_best_mean_reward", "no_improvement_evals"),
}


class _Callback(msgspec.Struct, forbid_unknown_fields=True):
    kind: str
    state: dict[str, Any]


class _Run(msgspec.Struct, forbid_unknown_fields=True):
    last_obs: Any
    last_original_obs: Any
    last_episode_starts: np.ndarray
    episode_infos: list[dict[str, float]]
    episode_successes: list[float]
    noise: Any
    episodes: dict[str, Any]
    environments: Any
    buffer: Any
    random: Any
    callbacks: list[_Callback]


class _Checkpoint(msgspec.Struct, forbid_unknown_fields=True):
    model: Any
    run: _Run


def checkpoint_files(folder: str | Path) -> list[Path]:
    """
    :param folder: Where a ``RunCheckpointCallback`` writes
    :return: Its checkpoints, the newest first
    """
    return sorted((path for path in Path(folder).glob(NAMES) if _n_steps(path) >= 0), key=_n_steps, reverse=True)


def read_checkpoint(path: str | Path) -> tuple[Path, _Checkpoint]:
    """
    :param path: Of a checkpoint, or of a folder of them, of which the newest that is whole is taken
    :return: Which one, and what it holds
    :raises FileNotFoundError: If there is none
    :raises ValueError: If none is whole
    """
    path = Path(path)
    candidates = checkpoint_files(path) if path.is_dir() else [path]
    if not candidates:
        raise FileNotFoundError(errno.ENOENT, "There is no checkpoint in this folder", str(path))
    for candidate in candidates:
        try:
            return candidate, convert(read(candidate, KIND), _Checkpoint, "checkpoint")
        except (ValueError, OSError) as error:  # somebody else may have removed it meanwhile
            if candidate == candidates[-1]:
                raise
            warnings.warn(f"{error}. Going on with the checkpoint before it")
    raise AssertionError


def write_checkpoint(path: Path, model: Any, callback: BaseCallback | None = None) -> None:
    """
    :param path: Of the file
    :param model: In the middle of ``learn``, at the beginning of a rollout
    :param callback: All that is called in this training
    :raises OSError: If it cannot be written; what was there before still is
    """
    # Other entries of a Monitor's may be anything, and nothing here reads them
    numbers = (int, float, np.number)
    infos = [
        {key: float(value) for key, value in each.items() if isinstance(value, numbers)} for each in model.ep_info_buffer or ()
    ]
    run = {
        "last_obs": model._last_obs,
        "last_original_obs": model._last_original_obs,
        "last_episode_starts": model._last_episode_starts,
        "episode_infos": infos,
        "episode_successes": [float(each) for each in model.ep_success_buffer or ()],
        "noise": to_plain(model.action_noise),
        "episodes": episodes_tree(model),
        "environments": vec_env_snapshot(model.env),
        "buffer": buffer_state(model.replay_buffer),
        "random": global_rng(),
        "callbacks": [{"kind": type(each).__name__, "state": _callback_state(each)} for each in nested_callbacks(callback)],
    }
    write(path, KIND, {"model": model_tree(model), "run": run})


class InterruptedRun:
    """
    What of a run must be put back when ``learn`` has begun again.

    :param run: As read from a checkpoint
    """

    def __init__(self, run: Any) -> None:
        self.run = run

    def restore_buffer_and_environments(self, model: Any) -> None:
        """
        :param model: Built from the same checkpoint
        :raises ValueError: If something does not fit the model or its environments
        """
        run = self.run
        with preserved_rng():
            restore_global_rng(run.random)  # or it would be known only when ``learn`` has begun
        noise = self._noise(model)
        if noise is not None:
            check_noise(noise, model.n_envs, int(np.prod(model.action_space.shape)))
        load_episodes_tree(model, run.episodes)
        restore_buffer(model.replay_buffer, run.buffer)
        if (routes := routes_of_0_1(run.buffer)) is not None:
            model.bonus.load_state_dict({**model.bonus.state_dict(), "routes": routes})
        model.bonus.recall_episodes(model.replay_buffer)
        model.ep_info_buffer = deque(run.episode_infos, maxlen=model._stats_window_size)
        model.ep_success_buffer = deque(run.episode_successes, maxlen=model._stats_window_size)
        if run.environments is None:
            warnings.warn("These environments cannot be saved in the middle of an episode: new episodes begin")
            return
        restore_vec_env(model.env, run.environments)
        model._last_obs = _observations(run.last_obs, model, "last_obs")
        model._last_original_obs = _observations(run.last_original_obs, model, "last_original_obs")
        model._last_episode_starts = check_array(run.last_episode_starts, bool, [model.n_envs], "last_episode_starts")

    def go_on(self, model: Any, callback: BaseCallback) -> None:
        """
        :param model: Whose ``learn`` has begun
        :param callback: All that is called in it
        :raises ValueError: If something does not fit
        """
        run = self.run
        if run.environments is not None:
            load_episodes_tree(model, run.episodes)
        model.action_noise = self._noise(model)
        known = [(each.kind, each.state) for each in run.callbacks]
        for each in nested_callbacks(callback):
            match = next((i for i, (kind, _) in enumerate(known) if kind == type(each).__name__), None)
            if match is not None:
                _load_callback_state(each, known.pop(match)[1])
        restore_global_rng(run.random)

    def _noise(self, model: Any) -> ActionNoise | None:
        try:
            return from_plain(copy.deepcopy(self.run.noise))  # it changes its arrays
        except NeededError:  # one's own kind: custom_objects had it
            return model.action_noise


def _observations(value: Any, model: Any, what: str) -> Any:
    """Of all environments, as the model sees them."""
    if value is None:
        return None
    space = model.observation_space
    parts = {f"{what}.{key}": each for key, each in space.spaces.items()} if isinstance(space, spaces.Dict) else {what: space}
    given = {f"{what}.{key}": each for key, each in value.items()} if isinstance(value, dict) else {what: value}
    if set(given) != set(parts):
        raise ValueError(f"{what}: {sorted(given)} given; accepted are {sorted(parts)}")
    for name, each in parts.items():
        array = convert(given[name], np.ndarray, name)
        check_array(array, array.dtype, [model.n_envs, *(each.shape or ())], name)
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: there are numbers that are not finite")
    return value


def _gathered(callback: BaseCallback) -> list[str]:
    return [name for kind, names in _GATHERED.items() if isinstance(callback, kind) for name in names]


def _callback_state(callback: BaseCallback) -> dict[str, Any]:
    state: dict[str, Any] = {"n_calls": callback.n_calls}
    if isinstance(tests := getattr(callback, "eval_env", None), VecEnv) and not awaits_seeds(tests):
        with contextlib.suppress(Exception):  # one that was never reset may not know where it is
            state["eval_env"] = vec_env_snapshot(tests)  # so that further tests draw as they would have
    state.update({name: getattr(callback, name) for name in _gathered(callback)})
    if hasattr(callback, "state_dict"):
        state["own"] = callback.state_dict()
    return state


def _load_callback_state(callback: BaseCallback, state: dict[str, Any]) -> None:
    callback.n_calls = convert(state.get("n_calls"), int, "callback.n_calls")
    for name in _gathered(callback):
        value = convert(state.get(name), list[Any] | float | int, f"callback.{name}")
        if isinstance(value, list) is not isinstance(getattr(callback, name), list):
            raise ValueError(f"callback.{name}: {str(value)[:100]} given, where {getattr(callback, name)!r} was")
        setattr(callback, name, value)
    if isinstance(tests := getattr(callback, "eval_env", None), VecEnv) and state.get("eval_env") is not None:
        try:
            restore_vec_env(tests, state["eval_env"])
        except ValueError as error:
            warnings.warn(f"{type(callback).__name__} tests in other environments than before: {error}")
    if hasattr(callback, "load_state_dict") and "own" in state:
        callback.load_state_dict(state["own"])


def _n_steps(path: Path) -> int:
    """Environment steps of a checkpoint, by its name; -1 for another name, such as of somebody's copy."""
    digits = path.stem.removeprefix("checkpoint_")
    return int(digits) if digits.isdecimal() else -1
