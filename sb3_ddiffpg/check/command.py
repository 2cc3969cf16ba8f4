"""The command ``ddiffpg check``."""

import argparse
import ast
from collections.abc import Sequence
from typing import Any

from sb3_ddiffpg.check.probe import check_env
from sb3_ddiffpg.envs import import_packages


def _keyword(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition(":")
    try:
        if not separator:
            raise ValueError
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        raise argparse.ArgumentTypeError(
            f"{text!r} given; accepted is NAME:VALUE with a value of Python, such as size:3 or kind:\"'large'\""
        ) from None


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Print what DDiffPG makes of an environment.

    :param arguments: Command line, without the name of the program; that of the process when None
    :raises SystemExit: With status 1 and what is wrong, if the environment cannot be trained on; 2, if an option is wrong
    """
    parser = argparse.ArgumentParser(
        prog="ddiffpg check",
        description="Take random steps in an environment, and say what DDiffPG makes of it.",
    )
    parser.add_argument("env", help="id of the environment, perhaps with the module that registers it: module:id")
    keywords: dict[str, Any] = {"type": _keyword, "nargs": "+", "default": [], "metavar": "NAME:VALUE"}
    parser.add_argument("--env-kwargs", **keywords, help="arguments of gym.make")
    parser.add_argument("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules that register environments")
    parser.add_argument("-params", "--hyperparams", **keywords, help="arguments of DDiffPG, such as mode_features:[0,1]")
    parser.add_argument("--steps", type=int, default=2000, help="random steps, at least; more if episodes are long")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    try:
        import_packages(given.gym_packages)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    try:
        found = check_env(given.env, given.steps, given.seed, dict(given.env_kwargs), **dict(given.hyperparams))
    except (ValueError, TypeError) as error:
        raise SystemExit(f"{given.env} cannot be trained on: {error}") from None
    print(found)
