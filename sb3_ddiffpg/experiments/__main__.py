"""``python -m sb3_ddiffpg.experiments``, and the console script ``ddiffpg-experiments``."""

import argparse
import importlib
import traceback
from collections.abc import Sequence

from sb3_ddiffpg.experiments.execution import REFUSED

COMMANDS = {
    "run": "run a suite, or what is missing of it, and write its report",
    "trial": "one training that leaves a record",
    "report": "tables and figures of a folder of results",
    "card": "a model card for Hugging Face, beside a recorded training's model",
    "upload": "a recorded training to Hugging Face",
}
_MODULES = {"trial": "training", "upload": "card"}


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: A command and its options; those of the process when None
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_ddiffpg.experiments", description="Trainings that leave a record.")
    commands = parser.add_subparsers(dest="command", required=True)
    for name, help_text in COMMANDS.items():
        commands.add_parser(name, help=help_text, add_help=False)
    known, rest = parser.parse_known_args(arguments)
    # Only now: each needs libraries that the others do not
    module = importlib.import_module(f"sb3_ddiffpg.experiments.{_MODULES.get(known.command, known.command)}")
    own = argparse.ArgumentParser(prog=f"{parser.prog} {known.command}", description=COMMANDS[known.command])
    module.add_arguments(own)
    given = own.parse_args(rest)
    given.command = known.command
    try:
        work = module.prepare(given)
    except ValueError as error:
        own.error(str(error))
    try:
        work()
    except (ValueError, ImportError, OSError) as error:
        if known.command == "trial":  # where it may come from the depths of somebody's environment
            if isinstance(error, OSError):
                raise  # another attempt may do better
            traceback.print_exc()
        own.exit(REFUSED, f"{own.prog}: error: {error}\n")


if __name__ == "__main__":
    main()
