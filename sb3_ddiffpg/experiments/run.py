"""Run a suite, or what is missing of it."""

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from sb3_ddiffpg.experiments.execution import Executor, LocalExecutor, RayExecutor, TrialFailed
from sb3_ddiffpg.experiments.files import check_output
from sb3_ddiffpg.experiments.machine import git_commit
from sb3_ddiffpg.experiments.progress import read_progress
from sb3_ddiffpg.experiments.record import check_folder, has_record, is_complete, read_record
from sb3_ddiffpg.experiments.suite import Suite, read_suite, suite_names
from sb3_ddiffpg.experiments.trial import Trial
from sb3_ddiffpg.utils.processors import n_processors

_SECONDS_BETWEEN_LOOKS = 0.5


class LiveView:
    """
    One line for the suite, and one for each trial that runs.

    :param suite: Its name
    :param n_trials: In all
    :param n_complete: Complete before
    """

    def __init__(self, suite: str, n_trials: int, n_complete: int) -> None:
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[phase]}")
        # Lines as wide as their text where nobody watches
        console = Console(width=None if Console().is_terminal else 200)
        self._bars = Bars(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console)
        self._whole = self._bars.add_task(suite, total=n_trials, completed=n_complete, phase="trials")
        self._lines: dict[Path, Any] = {}

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show it inside the block."""
        with self._bars:
            yield

    def say(self, text: str) -> None:
        """
        :param text: That stays above the lines
        """
        self._bars.console.print(text, markup=False, highlight=False)

    def update(self, folder: Path, name: str) -> None:
        """
        :param folder: Of a trial that may run
        :param name: What it is called
        """
        progress = read_progress(folder / "logs")
        if progress is None or progress.phase == "done":
            return
        if folder not in self._lines:
            self._lines[folder] = self._bars.add_task(name, phase="")
        self._bars.update(self._lines[folder], completed=progress.steps, total=progress.total, phase=progress.phase)

    def end(self, folder: Path, name: str, error: BaseException | None) -> None:
        """
        :param folder: Of a trial that has ended
        :param name: What it is called
        :param error: Why, if it failed
        """
        if folder in self._lines:
            self._bars.remove_task(self._lines.pop(folder))
        if error is None:
            self._bars.advance(self._whole)
        self.say(f"{time.strftime('%H:%M:%S')}  {name}  {'complete' if error is None else f'FAILED: {error}'}")


def missing_trials(suite: Suite, folder: Path) -> dict[Path, Trial]:
    """
    :param suite: The suite
    :param folder: Of the results
    :return: Its trials that are not complete there, by place below the folder
    :raises ValueError: If a place holds another trial
    """
    trials = suite.trials()
    for place, trial in trials.items():
        check_folder(trial, folder / place)
    return {place: trial for place, trial in trials.items() if not is_complete(folder / place)}


def run_suite(name: str, suite: Suite, folder: Path, executor: Executor) -> dict[Path, BaseException]:
    """
    :param name: Of the suite
    :param suite: The suite
    :param folder: Of the results
    :param executor: Where its trials run; stopped at the end
    :return: Which trials failed, and why
    """
    trials = missing_trials(suite, folder)
    view = LiveView(name, suite.n_trials, suite.n_trials - len(trials))
    failed: dict[Path, BaseException] = {}
    try:
        with view.shown():
            # What is half done comes first
            order = sorted(trials, key=lambda place: not has_record(folder / place))
            waiting: dict[Future[None], Path] = {}
            for place in order:
                waiting[executor.submit(trials[place], folder / place, suite.resources)] = place
            while waiting:
                time.sleep(_SECONDS_BETWEEN_LOOKS)
                for future, place in list(waiting.items()):
                    if not future.done():
                        view.update(folder / place, str(place))
                        continue
                    del waiting[future]
                    error = _error_of(future)
                    if error is not None:
                        failed[place] = error
                    view.end(folder / place, str(place), error)
    finally:
        executor.stop()
    return failed


def _error_of(future: "Future[None]") -> BaseException | None:
    try:
        error = future.exception()
    except CancelledError:
        return TrialFailed("cancelled")
    # Ray wraps what a task raised
    return getattr(error, "cause", None) or error


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: Of the command line
    """
    parser.add_argument("suite", help=f"{', '.join(suite_names())}, or the path of a YAML file")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results; what is complete there stays")
    parser.add_argument("--tasks", nargs="+", help="only these of the suite's tasks")
    parser.add_argument("--variants", nargs="+", help="only these of the suite's variants")
    parser.add_argument("--seeds", nargs="+", type=int, help="instead of the suite's seeds")
    parser.add_argument("--workers", type=int, help="trials at the same time; as many as there are cores for if not given")
    parser.add_argument(
        "--ray", nargs="?", const="local", metavar="ADDRESS", help="run on this Ray cluster; without address, a local one"
    )
    parser.add_argument("--retries", type=int, default=2, help="how often a trial that dies is started again")
    parser.add_argument("--no-report", action="store_true", help="leave the report to `report`")
    parser.add_argument("--list", action="store_true", help="say what would run, and run nothing")


def prepare(given: argparse.Namespace) -> Callable[[], None]:
    """
    :param given: The command line
    :return: What does it
    :raises ValueError: If it asks for what there is not
    """
    suite = read_suite(given.suite, given.tasks, given.variants, given.seeds)
    for name, least in (("workers", 1), ("retries", 0)):
        value = getattr(given, name)
        if value is not None and value < least:
            raise ValueError(f"--{name}: {value} given; accepted are whole numbers from {least} up")
    if given.workers is not None and given.ray not in (None, "local"):
        raise ValueError(f"--workers: {given.workers} given beside --ray {given.ray}; accepted is one of both")
    folder = given.out.resolve()
    check_output(folder)
    for task, needed in suite.leave_out().items():
        print(f"{task} is left out; it needs: pip install {needed}", flush=True)
    if not suite.tasks:
        raise ValueError("tasks: none of those that are asked for can be made with what is installed")
    missing = missing_trials(suite, folder)
    print(f"{suite.description}\n{len(missing)} of {suite.n_trials} trials to run", flush=True)
    commits = Counter(read_record(folder / place).get("git_commit") for place in suite.trials().keys() - missing.keys())
    here = git_commit()
    others = ", ".join(f"{n} of commit {commit}" for commit, n in commits.items() if commit != here)
    if others:
        print(f"What is complete already is not of this commit ({here}): {others}", flush=True)
    if given.list:
        return partial(print, *missing, sep="\n", end="\n" if missing else "")
    return partial(_run, given, suite, folder, bool(missing))


def _run(given: argparse.Namespace, suite: Suite, folder: Path, missing: bool) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    try:
        held = FileLock(folder / ".lock").acquire(blocking=False)
    except Timeout:
        raise ValueError(f"--out: {folder} given, where another run is at work; accepted is another folder") from None
    with held:
        _run_alone(given, suite, folder, missing)


def _run_alone(given: argparse.Namespace, suite: Suite, folder: Path, missing: bool) -> None:
    name = Path(given.suite).stem
    if missing:
        cores = n_processors()
        executor: Executor
        if given.ray is None:
            executor = LocalExecutor(given.workers or max(1, cores // suite.resources.cpus), given.retries)
        else:
            executor = RayExecutor(given.ray, given.retries, given.workers and given.workers * suite.resources.cpus)
            try:
                executor.check(suite.resources)
            except ValueError as error:
                executor.stop()
                raise SystemExit(str(error)) from None
        failed = run_suite(name, suite, folder, executor)
        if failed:
            raise SystemExit(f"{len(failed)} trials failed: {', '.join(map(str, failed))}. The same command tries them again")
    if not given.no_report:
        from sb3_ddiffpg.experiments.report import make_report  # needs the extra "plots"

        # What else may lie there is no part of it; seeds that were trained before are
        whole = read_suite(given.suite)
        print(f"wrote {make_report(folder, folder / 'report', name, suite.ablation, (whole.tasks, whole.variants))}")
