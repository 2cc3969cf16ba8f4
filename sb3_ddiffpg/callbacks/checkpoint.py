"""Checkpoints of a whole run while it goes on."""

import signal
import threading
import warnings
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from stable_baselines3.common.callbacks import (
    BaseCallback,
)

from sb3_ddiffpg.envs.snapshots import vec_env_snapshot
from sb3_ddiffpg.saving.checkpoint import NAMES, _n_steps, checkpoint_files, read_checkpoint, write_checkpoint
from sb3_ddiffpg.serialization.safetensors_tree import DamagedError, remove_unfinished


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
