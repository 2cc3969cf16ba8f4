"""Checkpoints of a whole run: written so that no crash loses the one before, and from which it goes on bit for bit."""

import contextlib
import copy
import errno
import signal
import threading
import warnings
from collections import deque
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from filelock import FileLock, Timeout
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.buffer_state import buffer_state, restore_buffer
from sb3_ddiffpg.envs.snapshots import awaits_seeds, restore_vec_env, vec_env_snapshot
from sb3_ddiffpg.model_file import model_tree
from sb3_ddiffpg.noise import check_noise
from sb3_ddiffpg.plain_values import NeededError, from_plain, to_plain
from sb3_ddiffpg.rng import global_rng, preserved_rng, restore_global_rng
from sb3_ddiffpg.safe_files import DamagedError, check_array, convert, read, remove_unfinished, write

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
        "episodes": model.episodes_tree(),
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
        model.load_episodes_tree(run.episodes)
        restore_buffer(model.replay_buffer, run.buffer)
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
            model.load_episodes_tree(run.episodes)
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


def nested_callbacks(callback: BaseCallback | None) -> list[BaseCallback]:
    """
    :param callback: A callback, perhaps with others inside; None: none
    :return: It and those inside, a list itself not counted
    """
    if callback is None:
        return []
    if isinstance(callback, CallbackList):
        return [each for child in callback.callbacks for each in nested_callbacks(child)]
    children = (getattr(callback, name, None) for name in ("callback", "callback_on_new_best"))
    return [callback, *(each for child in children if isinstance(child, BaseCallback) for each in nested_callbacks(child))]


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


def _refuse_another_run(folder: Path, run_id: str, n_steps: int) -> list[Path]:
    """
    What has come furthest is the newest, so that a second run in a folder would be lost beside a longer first one, and so
    would one that goes on from an older checkpoint. Gives back what is damaged.
    """
    damaged: list[Path] = []
    for path in checkpoint_files(folder):
        try:
            found = read_checkpoint(path)[1].model.get("state", {}).get("counters", {}).get("run_id")
        except DamagedError:
            damaged.append(path)  # passed over by ``resume`` too
            continue
        except OSError:
            continue
        if found != run_id:
            raise ValueError(
                f"folder: {folder} holds checkpoints of another run ({path.name}): resume that one, or name another folder"
            )
        if _n_steps(path) > n_steps:
            raise ValueError(
                f"folder: {folder} holds a checkpoint that is further than step {n_steps} ({path.name}): resume that one, "
                "remove it, or name another folder"
            )
        break
    return damaged


def _n_steps(path: Path) -> int:
    """Environment steps of a checkpoint, by its name; -1 for another name, such as of somebody's copy."""
    digits = path.stem.removeprefix("checkpoint_")
    return int(digits) if digits.isdecimal() else -1


class RunCheckpointCallback(BaseCallback):
    """
    Writes the whole run to a file from time to time: networks, optimisers, replay buffer, modes, environments in the middle of
    their episodes, and random states. ``DDiffPG.resume(folder, env)`` goes on from it.

    A file is complete or it is not there, and holds its own checksum. The first is written before the first step: what cannot
    be saved ends the training there. When a later one cannot be written (a full disk), a warning says so, the ones before
    stay, and training goes on. SIGINT and SIGTERM write one more and end ``learn`` as if its steps were done; a second SIGINT
    interrupts at once.

    :param folder: Where the files ``checkpoint_<environment steps>.safetensors`` go
    :param save_freq: Environment steps between two of them
    :param keep: How many of the newest stay
    :param verbose: 1 prints a line for each
    :raises ValueError: If ``save_freq`` or ``keep`` is less than 1; when training starts, if the folder holds another run's
        checkpoint or one that is further, or another training writes to it
    """

    def __init__(self, folder: str | Path, save_freq: int = 100_000, keep: int = 2, verbose: int = 0) -> None:
        super().__init__(verbose)
        for name, value in (("save_freq", save_freq), ("keep", keep)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self.folder, self.save_freq, self.keep = Path(folder), save_freq, keep
        self.all_callbacks: BaseCallback = self
        self._last = 0
        self._signal: int | None = None
        self._stopped = False
        self._first = True
        self._damaged: list[Path] = []

    def _on_training_start(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._hold_folder()
        remove_unfinished(self.folder, NAMES)
        model: Any = self.model
        self._damaged = _refuse_another_run(self.folder, model.run_id, model.lifetime_steps)
        if vec_env_snapshot(self.training_env) is None:
            warnings.warn("These environments cannot be saved in the middle of an episode: a run that goes on begins new ones")
        self._last, self._signal, self._stopped, self._first = self.model.num_timesteps, None, False, True
        self.all_callbacks = self.locals.get("callback", self)
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, self._note_signal)  # ``learn`` puts back what was there

    def _hold_folder(self) -> None:
        """As long as ``learn`` goes on. Two runs from one checkpoint would remove each other's."""
        lock = FileLock(self.folder / ".lock")
        try:
            lock.acquire(blocking=False)
        except Timeout:
            raise ValueError(f"folder: another training writes its checkpoints to {self.folder}") from None
        except OSError as error:  # some file systems have no locks
            warnings.warn(f"{self.folder} cannot be held: {error}. See to it that no other training writes there")
            return
        self.model.until_learn_ends.callback(lock.release)  # type: ignore[attr-defined]

    def _note_signal(self, number: int, frame: Any) -> None:
        if self._signal is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self._signal = number
        print(f"{signal.Signals(number).name}: training ends with a checkpoint after this step")

    def _on_rollout_start(self) -> None:
        # Here everything that belongs to the steps so far has been done
        if self._first:
            self._first = False
            try:
                # What cannot be saved ends the training now, not in hours
                write_checkpoint(self._path(), self.model, self.all_callbacks)
            except OSError as error:
                if not checkpoint_files(self.folder):
                    raise
                self._warn_of(error)
        due = self.num_timesteps // self.save_freq > self._last // self.save_freq
        if due or self._signal is not None:
            self.save()
            self._last = self.num_timesteps
        self._stopped = self._signal is not None

    def _on_step(self) -> bool:
        return not self._stopped

    def _on_training_end(self) -> None:
        if not self._stopped and self.num_timesteps > self._last:
            self.save()

    def _path(self) -> Path:
        return self.folder / f"checkpoint_{self.model.lifetime_steps:012d}.safetensors"  # type: ignore[attr-defined]

    def save(self) -> bool:
        """
        Write a checkpoint now.

        :return: Whether it could be written
        """
        path = self._path()
        try:
            write_checkpoint(path, self.model, self.all_callbacks)
        except Exception as error:  # a full disk, or what environments or callbacks have come to hold: not worth the run
            self._warn_of(error)
            return False
        others = [each for each in checkpoint_files(self.folder) if each != path]
        damaged = [each for each in self._damaged if each in others]
        sound = [each for each in others if each not in damaged]
        for old in [*damaged, *sound[self.keep - 1 :]]:
            try:
                old.unlink(missing_ok=True)
            except OSError as error:
                warnings.warn(f"{old} is not needed any more, and cannot be removed: {error}")
        if self.verbose >= 1:
            print(f"[checkpoint] {path}")
        return True

    def _warn_of(self, error: Exception) -> None:
        after = "training goes on" if self._signal is None else "training ends without it"
        what = error if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        warnings.warn(f"No checkpoint at step {self.num_timesteps}: {what}. The ones before stay, {after}")
