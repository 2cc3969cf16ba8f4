"""What ``ddiffpg watch`` shows of a run in progress."""

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
from stable_baselines3.common.callbacks import BaseCallback

from sb3_ddiffpg.utils.disk import written_whole
from sb3_ddiffpg.utils.vec_envs import env_attribute
from sb3_ddiffpg.visualization.sketch import LIVE_FILE, sketch


class LiveCallback(BaseCallback):
    """
    Writes ``live.json`` from time to time: modes, their history, known cells, for ``ddiffpg watch FOLDER``. The file is whole
    or it is the one before. When it cannot be written (a full disk), training goes on. The run learns the same without.

    :param folder: Where the file goes; it is made if there is none
    :param seconds: Between two of them, of the clock on the wall
    :raises ValueError: If ``seconds`` is negative
    """

    def __init__(self, folder: str | Path, seconds: float = 10.0) -> None:
        super().__init__()
        if not seconds >= 0:
            raise ValueError(f"seconds: {seconds} given; accepted are numbers from 0 up")
        self.folder, self.seconds, self._next = Path(folder), seconds, 0.0

    def _on_training_start(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._next = 0.0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if time.monotonic() >= self._next:
            self.write()
            self._next = time.monotonic() + self.seconds

    def _on_training_end(self) -> None:
        self.write()

    def write(self) -> None:
        """Write the file now; nothing is raised if it cannot be."""
        env: Any = self.training_env
        spec = env_attribute(env, "spec")
        found = sketch(self.model, "" if spec is None else spec.id, env_attribute(env, "maze"))
        with suppress(OSError), written_whole(self.folder / LIVE_FILE) as unfinished:  # not worth the run
            unfinished.write_bytes(msgspec.json.encode(found))
