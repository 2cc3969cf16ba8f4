"""How far a training is, in a small file that others read while it runs."""

import time
from contextlib import suppress
from pathlib import Path

import msgspec
from stable_baselines3.common.callbacks import BaseCallback

from sb3_ddiffpg.utils.disk import written_whole

_SECONDS_BETWEEN = 1.0


class Progress(msgspec.Struct):
    """
    How far a training is.

    :param steps: Environment steps done
    :param total: Environment steps to do
    :param phase: ``"training"``, ``"evaluation"`` or ``"done"``
    """

    steps: int
    total: int
    phase: str = "training"


def write_progress(folder: Path, progress: Progress) -> None:
    """
    :param folder: Of the training
    :param progress: How far it is
    """
    # A full disk must not end a training for the sake of a progress bar
    with suppress(OSError), written_whole(folder / "progress.json") as unfinished:
        unfinished.write_bytes(msgspec.json.encode(progress))


def read_progress(folder: Path) -> Progress | None:
    """
    :param folder: Of a training
    :return: How far it is; None before its first step
    """
    try:
        return msgspec.json.decode((folder / "progress.json").read_bytes(), type=Progress)
    except (OSError, msgspec.DecodeError):
        return None


class ProgressCallback(BaseCallback):
    """
    Says once a second how far a training is.

    :param folder: Where the file goes
    :param total: Environment steps to do
    """

    def __init__(self, folder: Path, total: int) -> None:
        super().__init__()
        self.folder, self.total, self._next = folder, total, 0.0

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now >= self._next:
            self._next = now + _SECONDS_BETWEEN
            write_progress(self.folder, Progress(self.num_timesteps, self.total))
        return True
