"""Files that are whole or not there, and such as a run goes on without: where the disk is full, a warning says so."""

import errno
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from stable_baselines3.common.monitor import Monitor, ResultsWriter
from stable_baselines3.common.vec_env import VecMonitor

Env = TypeVar("Env", bound=Any)

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


@contextmanager
def missed_if_full(what: str) -> Iterator[None]:
    """
    :param what: What is written inside; for the warning
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            raise
        warnings.warn(f"{what} cannot be written: {error}. Training goes on without")


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """
    Let a file be written so that at any moment the one before or the whole new one is there.

    :param path: Of the file
    :return: Where to write it, beside its place and with its suffix. An error leaves nothing there
    """
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.unfinished{path.suffix}")
    try:
        yield unfinished
        os.replace(unfinished, path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


class SparedResultsWriter:
    """
    SB3's writer of monitor files, which a full disk does not end.

    :param writer: Writes the file
    """

    def __init__(self, writer: ResultsWriter) -> None:
        self.writer = writer

    def write_row(self, epinfo: dict[str, float]) -> None:
        """
        :param epinfo: Return, length and time of an episode
        """
        with missed_if_full("What the monitor notes"):
            self.writer.write_row(epinfo)

    def close(self) -> None:
        """Close the file."""
        with missed_if_full("What the monitor notes"):
            self.writer.close()


def spared_monitor(env: Env) -> Env:
    """
    :param env: Perhaps a monitor that writes a file
    :return: The same, which a full disk does not end
    """
    if isinstance(env, (Monitor, VecMonitor)) and env.results_writer is not None:
        env.results_writer = SparedResultsWriter(env.results_writer)  # type: ignore[assignment]
    return env
