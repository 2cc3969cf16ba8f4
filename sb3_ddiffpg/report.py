"""
One page about a trained model, without network: ``python -m sb3_ddiffpg.report MODEL.zip --output PAGE.html``. Needs the extra
``plots``.
"""

import argparse
import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from sb3_ddiffpg.ddiffpg import DDiffPG
from sb3_ddiffpg.envs import import_packages
from sb3_ddiffpg.evaluation.task import Task
from sb3_ddiffpg.visualization.report import make_report


def _command(given: argparse.Namespace, task: Task) -> str:
    words = ["python", "-m", "sb3_ddiffpg.report", str(given.model), "--output", str(given.output), "--env", task.id]
    words += ["--gym-packages", *given.gym_packages] if given.gym_packages else []
    if task.kwargs:
        words += ["--env-kwargs", *(f"{name}={json.dumps(value)}" for name, value in task.kwargs.items())]
    for option, value in (
        ("--replay-buffer", given.replay_buffer),
        ("--vec-normalize", given.vec_normalize),
        ("--title", given.title),
        ("--compare", given.compare),
    ):
        words += [] if value is None else [option, str(value)]
    words += ["--episodes", str(given.episodes), "--seed", str(given.seed), *(["--no-videos"] if given.no_videos else [])]
    return shlex.join(words)


def _label(path: Path, other: Path | None) -> str:
    """How a page calls a model: its file, with as much of its folder as tells it from the other one."""
    if other is None:
        return path.name
    own, others = path.resolve().parts, other.resolve().parts
    n = next((n for n in range(1, len(own) + 1) if own[-n:] != others[-n:]), 1)
    return "/".join(own[-n:])


def _compared(given: argparse.Namespace) -> tuple[str, DDiffPG, Task]:
    """
    The other model, in the environment that is named, else in its own.

    :raises ValueError: If it cannot be shown there
    """
    model = DDiffPG.load(given.compare)
    task = Task.of(model, given.env, dict(given.env_kwargs) if given.env else {})
    task = replace(task, statistics=given.vec_normalize if model.is_normalized else None)
    try:
        task.check(model)
    except ValueError as error:
        raise ValueError(f"--compare: {error}") from None
    name = _label(given.compare, given.model)
    return name if name != _label(given.model, given.compare) else f"{name} again", model, task


@contextmanager
def _written_or_absent(output: Path) -> Iterator[None]:
    """The page can be written, and nothing of it is left if it is not."""
    new = [each for each in (output, *output.parents) if not each.exists()]
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.touch()
        yield
    except BaseException:
        for each in new:
            with suppress(OSError):
                each.unlink() if each == output else each.rmdir()
        raise


def _keyword(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition("=")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r} given; accepted is NAME=VALUE")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def main(arguments: list[str] | None = None) -> None:
    """
    :param arguments: Command line; that of the process when None
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_ddiffpg.report", description="One page about a trained model.")
    parser.add_argument("model", type=Path, help="a .zip that was saved by DDiffPG; loading runs code in it: trust its source")
    parser.add_argument("--output", type=Path, required=True, help="the page, .html")
    parser.add_argument("--env", help="id of the environment, or module:id; where the model was trained if left out")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules to import, which register environments")
    parser.add_argument("--env-kwargs", type=_keyword, nargs="+", default=[], metavar="NAME=VALUE", help="values are JSON")
    parser.add_argument("--replay-buffer", type=Path, help="saved with the model: for the dendrogram, and values of an arm")
    parser.add_argument(
        "--vec-normalize", type=Path, help="statistics that VecNormalize saved, if observations are normalised"
    )
    parser.add_argument("--episodes", type=int, default=100, help="for each mode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-videos", action="store_true")
    parser.add_argument("--title")
    parser.add_argument("--compare", type=Path, metavar="OTHER.zip", help="another model, which the page shows beside it")
    given = parser.parse_args(arguments)
    for path in (given.model, given.replay_buffer, given.vec_normalize, given.compare):
        if path is not None and not path.is_file():
            raise SystemExit(f"{path} does not exist")
    if given.episodes < 1:
        raise SystemExit(f"--episodes: {given.episodes} given; accepted are whole numbers from 1 up")
    if given.output.is_dir() or given.output.suffix == ".json":
        raise SystemExit(f"--output: {given.output} given; accepted is the path of a page, such as page.html")
    with _written_or_absent(given.output):
        try:
            import_packages(given.gym_packages)
            model = DDiffPG.load(given.model)
            if given.replay_buffer is not None:
                model.load_replay_buffer(given.replay_buffer)
            task = replace(Task.of(model, given.env, dict(given.env_kwargs)), statistics=given.vec_normalize)
            task.check(model)
            compared = None if given.compare is None else _compared(given)
        except (OSError, ValueError) as error:
            raise SystemExit(str(error)) from error
        command = _command(given, task)
        found = make_report(
            model,
            given.output,
            task,
            given.episodes,
            given.seed,
            not given.no_videos,
            given.title,
            command,
            compared,
            _label(given.model, given.compare),
        )
    found.save(given.output.with_suffix(".json"))
    print(f"{found}\n\nwrote {given.output} and {given.output.with_suffix('.json')}")


if __name__ == "__main__":
    main()
