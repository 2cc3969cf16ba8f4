"""Where trials run: as processes on this machine, or on a Ray cluster."""

import os
import subprocess
import sys
import threading
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Protocol

from sb3_ddiffpg.experiments.record import command_line
from sb3_ddiffpg.experiments.suite import Resources
from sb3_ddiffpg.experiments.trial import Trial

# Exit code of a command that cannot do what it was asked for, as argparse has it
REFUSED = 2
# Every library that would otherwise take all cores
_THREAD_LIMITS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


class TrialFailed(Exception):
    """A trial's process ended otherwise than by having done its work."""


class TrialRefused(Exception):
    """A trial cannot be what it was asked to be: another attempt would end alike."""


class Executor(Protocol):
    """Runs trials, some at a time."""

    def submit(self, trial: Trial, folder: Path, resources: Resources) -> "Future[None]":
        """
        :param trial: What to run
        :param folder: Where its record goes
        :param resources: What it takes
        :return: Done when the trial is, with a ``TrialFailed`` if it failed after all attempts, or a ``TrialRefused``
        """

    def stop(self) -> None:
        """End what runs, each with a checkpoint, and run nothing more."""


def command_of(trial: Trial, folder: Path) -> list[str]:
    """
    :param trial: What to run
    :param folder: Where its record goes
    :return: The command that does it, and ends with the process that started it
    """
    return [sys.executable, "-m", "sb3_ddiffpg.experiments", *command_line(trial, folder), "--attached"]


def run_process(command: list[str], folder: Path, threads: int, running: "set[subprocess.Popen[bytes]] | None" = None) -> None:
    """
    :param command: To run
    :param folder: Where its output goes, into ``logs/output.log``
    :param threads: That it may use
    :param running: Holds the process while it runs
    :raises TrialFailed: If it fails
    :raises TrialRefused: If it says, by its exit code, that it cannot be
    """
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, **{name: str(threads) for name in _THREAD_LIMITS}}
    with (folder / "logs" / "output.log").open("ab") as log:
        # Its standard input closes when this process dies, however it does
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
        )
    if running is not None:
        running.add(process)
    try:
        code = process.wait()
    finally:
        process.terminate()
        process.wait()
        assert process.stdin is not None
        process.stdin.close()
        if running is not None:
            running.discard(process)
    if code != 0:
        how = f"signal {-code}" if code < 0 else f"code {code}"
        kind = TrialRefused if code == REFUSED else TrialFailed
        raise kind(f"ended with {how}: {_last_line(Path(log.name))} (see {log.name})")


def _last_line(path: Path) -> str:
    lines = path.read_text(errors="replace").strip().splitlines()
    return lines[-1][:300] if lines else "it said nothing"


class LocalExecutor:
    """
    Processes on this machine. One that dies is started again and goes on from its last checkpoint.

    :param workers: Trials at the same time
    :param retries: How often one is started again
    """

    def __init__(self, workers: int, retries: int) -> None:
        self.retries = retries
        self._pool = ThreadPoolExecutor(workers)
        self._futures: list[Future[None]] = []
        self._running: set[subprocess.Popen[bytes]] = set()
        self._stopped = threading.Event()

    def submit(self, trial: Trial, folder: Path, resources: Resources) -> "Future[None]":
        """See ``Executor``."""
        future = self._pool.submit(self._attempt, command_of(trial, folder), folder, resources.cpus)
        self._futures.append(future)
        return future

    def _attempt(self, command: list[str], folder: Path, threads: int) -> None:
        for attempt in range(self.retries + 1):
            if self._stopped.is_set():
                raise TrialFailed("stopped")
            try:
                return run_process(command, folder, threads, self._running)
            except TrialFailed:
                if attempt == self.retries:
                    raise

    def stop(self) -> None:
        """See ``Executor``."""
        self._stopped.set()
        self._pool.shutdown(wait=False, cancel_futures=True)
        told: set[subprocess.Popen[bytes]] = set()
        while not all(future.done() for future in self._futures):
            for process in self._running - told:  # one may only just have started
                process.terminate()
                told.add(process)
            wait(self._futures, timeout=0.5)


class RayExecutor:
    """
    Tasks of a Ray cluster, whose machines share the folder of results. Ray queues them, gives each its cores and
    accelerators, and starts one again whose process or machine dies. Needs the extra ``cluster``.

    :param address: Of the cluster; ``"local"`` starts one on this machine
    :param retries: How often a trial is started again
    :param workers: Cores of a local cluster; all of the machine when None
    """

    def __init__(self, address: str, retries: int, workers: int | None = None) -> None:
        try:
            import ray
        except ImportError as error:
            raise ImportError(f"Ray is an extra ({error}); install it with: pip install 'sb3_ddiffpg[cluster]'") from error
        self._ray, self.retries = ray, retries
        arguments: dict[str, Any] = {"address": address, "log_to_driver": False, "configure_logging": False}
        if address == "local":
            # Its workers would otherwise wait until nothing else wants a core
            os.environ.setdefault("RAY_worker_niceness", "0")
            arguments |= {"num_cpus": workers, "include_dashboard": False}
        ray.init(**arguments)
        self._tasks: list[Any] = []

    def check(self, resources: Resources) -> None:
        """
        :param resources: What a trial takes
        :raises ValueError: If no machine of the cluster has as much: Ray would wait for one that does
        """
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        if not any(node.get("CPU", 0) >= resources.cpus and node.get("GPU", 0) >= resources.gpus for node in nodes):
            has = ", ".join(f"{node.get('CPU', 0):g} cpus and {node.get('GPU', 0):g} gpus" for node in nodes)
            raise ValueError(
                f"resources: {resources.cpus} cpus and {resources.gpus:g} gpus for a trial; the machines have {has}"
            )

    def submit(self, trial: Trial, folder: Path, resources: Resources) -> "Future[None]":
        """See ``Executor``."""
        remote = self._ray.remote(run_process).options(
            name=str(folder),
            num_cpus=resources.cpus,
            num_gpus=resources.gpus,
            max_retries=self.retries,
            retry_exceptions=[TrialFailed],
        )
        task = remote.remote(command_of(trial, folder), folder, resources.cpus)
        self._tasks.append(task)
        return task.future()

    def stop(self) -> None:
        """See ``Executor``."""
        for task in self._tasks:
            self._ray.cancel(task)
        self._ray.wait(self._tasks, num_returns=len(self._tasks), timeout=60)
        self._ray.shutdown()
