"""Environments in a few worker processes, several in each, for simulators that step one environment at a time."""

import contextlib
import math
import multiprocessing
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.util import Finalize
from typing import Any, NoReturn

import gymnasium as gym

from sb3_ddiffpg.envs.vec_env.group import NOBODY
from sb3_ddiffpg.envs.vec_env.grouped import GroupedVecEnv, check_groups, first_of_groups
from sb3_ddiffpg.envs.vec_env.worker_process import Pickled, work
from sb3_ddiffpg.utils.processors import n_processors
from sb3_ddiffpg.utils.signals import uninterrupted


def _end(remotes: Sequence[Connection], processes: Sequence[Any]) -> None:
    try:
        for remote in remotes:
            with contextlib.suppress(OSError):  # gone already
                remote.send(("close", None))
        for process in processes:
            process.join(timeout=5)
    finally:  # also when it is interrupted: they do not listen to signals
        for process in processes:
            if process.is_alive():
                process.kill()
                process.join()
        for remote in remotes:
            remote.close()


class WorkerVecEnv(GroupedVecEnv):
    """
    SB3's ``SubprocVecEnv`` with several environments in each process: one process for each of many environments costs more
    memory than the environments, and time to tell each its action. A worker imports SB3 and PyTorch only if an environment
    does, or the script's own file outside of ``if __name__ == "__main__":``.

    An environment that raises or hangs, and a worker that dies, end the run with an error that names the environment and the
    cause.

    :param env_fns: functions that make the environments
    :param n_workers: number of processes; None: one per processor that this process may use
    :param timeout: seconds for which the environments of a worker may be at work on one answer, the first of which comes after
        the process has begun and made them; None: for ever
    :raises ValueError: if ``n_workers`` is less than 1, or ``timeout`` is not positive
    """

    def __init__(
        self, env_fns: Sequence[Callable[[], gym.Env]], n_workers: int | None = None, timeout: float | None = 300.0
    ) -> None:
        if n_workers is None:
            n_workers = n_processors()
        check_groups(n_workers, timeout)
        self.timeout = math.inf if timeout is None else timeout
        n_workers = min(n_workers, len(env_fns))
        self.first = first_of_groups(len(env_fns), n_workers)
        # Not fork: simulators and networks have threads by then. No server that forks: a signal to all would end it, and them
        context: Any = multiprocessing.get_context("spawn")
        self.remotes: list[Connection] = []
        self.processes: list[Any] = []
        self._turns: list[Any] = []
        self._closed = self._made = False
        for first, last in zip(self.first[:-1], self.first[1:], strict=True):
            remote, theirs = context.Pipe()
            turn = context.RawValue("i", NOBODY)
            # A daemon, so that it does not outlive a crash of this process
            process = context.Process(
                target=work, args=(theirs, remote, Pickled(list(env_fns[first:last])), turn), daemon=True
            )
            process.start()
            self._turns.append(turn)
            theirs.close()
            self.remotes.append(remote)
            self.processes.append(process)
        # At the end of this process, before it waits for its daemons, which do not listen to its signals
        self._ending = Finalize(self, _end, (self.remotes, self.processes), exitpriority=10)
        #: Answers that each worker still owes
        self._owed = [0] * n_workers
        observation_space, action_space, self.render_mode = self._ask("make", [None] * n_workers)[0]
        self._made = True
        super().__init__(len(env_fns), observation_space, action_space)

    # ------------------------------------------------------------------ talking to the workers

    def _tell(self, command: str, arguments: Sequence[Any]) -> None:
        if self._closed:
            raise RuntimeError("The environments are closed")
        for worker, (remote, argument) in enumerate(zip(self.remotes, arguments, strict=True)):
            while self._owed[worker]:  # somebody was interrupted before he heard it
                self._hear_one(worker)
            try:
                with uninterrupted():
                    remote.send((command, argument))
                    self._owed[worker] += 1
            except OSError:
                self._fail(worker)

    def _hear(self) -> list[Any]:
        return self._results([self._hear_one(worker) for worker in range(len(self.remotes))])

    def _hear_one(self, worker: int) -> tuple[str, Any]:
        remote = self.remotes[worker]
        left = self.timeout
        # In slices: while all processes are stopped (Ctrl-Z), the clock goes on
        while not wait([remote, self.processes[worker].sentinel], min(left, 1.0)):
            left -= 1.0
            if left <= 0:
                self._give_up(worker)
        try:
            # An answer may still lie in the pipe of a worker that has ended since
            if remote.poll():
                with uninterrupted():
                    answer: tuple[str, Any] = remote.recv()
                    self._owed[worker] -= 1
                    return answer
        except (EOFError, ConnectionResetError):
            pass
        return self._fail(worker)

    def _give_up(self, worker: int) -> NoReturn:
        who = self._who(worker, self._turns[worker].value)
        for process in self.processes:
            process.kill()  # who hangs would not hear that he is to close
        self.close()
        raise RuntimeError(f"{who} has hung: no answer for {self.timeout:g} seconds (timeout of WorkerVecEnv)")

    def _fail(self, worker: int) -> NoReturn:
        process = self.processes[worker]
        process.join(timeout=5)
        code = process.exitcode
        self.close()
        cause = f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"
        hint = "" if self._made else ". A script that makes such environments must do so under `if __name__ == '__main__':`"
        raise RuntimeError(f"{self._who(worker)} has died ({cause}){hint}")

    def _who(self, worker: int, turn: int = NOBODY) -> str:
        first, last = self.first[worker], self.first[worker + 1] - 1
        return f"The worker process with environments {first} to {last}" if turn == NOBODY else f"Environment {first + turn}"

    def close(self) -> None:
        """End the workers; those that do not end by themselves are killed."""
        if self._closed:
            return
        self._closed = True
        self._ending()
