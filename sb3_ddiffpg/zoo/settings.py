"""Settings of an algorithm in the zoo: the YAML files, and what they may say."""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from rl_zoo3.utils import ALGOS

from sb3_ddiffpg.common.presets import ZOO_KEYS, config_file
from sb3_ddiffpg.saving.algorithm import SavableAlgorithm
from sb3_ddiffpg.utils.arguments import GONE, constructor_arguments, groups_of, single_setting

ALGO = "ddiffpg"

__all__ = ["ALGO", "ALGOS", "check_config_file", "check_hyperparameters", "config_file"]

# Constructor arguments that come from the command line
COMMAND_LINE_ARGUMENTS = {"env", "tensorboard_log", "seed", "verbose", "device", "_init_setup_model"}


def check_config_file(path: str | Path | None, env_id: str | None) -> None:
    """
    :param path: Of a YAML file; anything else is not looked at
    :param env_id: Whose settings must be such
    :raises SystemExit: If it is no mapping of environments to mappings of hyperparameters
    """
    if path is None or Path(path).suffix not in (".yml", ".yaml"):
        return
    try:
        settings = yaml.safe_load(Path(path).read_text())
    except (yaml.YAMLError, UnicodeError) as error:
        raise SystemExit(f"--conf-file: {path} is no YAML file: {error}") from None
    if not isinstance(settings, dict):
        raise SystemExit(f"--conf-file: {path} holds {str(settings)[:99]!r}; accepted is a mapping of environments")
    own = settings.get(env_id, {})
    if not isinstance(own, dict) or not all(isinstance(key, str) for key in own):
        raise SystemExit(f"--conf-file: {path} has {str(own)[:100]!r} for {env_id}; accepted is a mapping of hyperparameters")


def _is_setting(algorithm: Any, key: str) -> bool:
    """Whether it is one of a group, as ``critic.v_max``, or of version 0.1."""
    single = single_setting(algorithm, key)
    return key in GONE or (single is not None and single[1] in groups_of(algorithm)[single[0]].names())


def check_hyperparameters(algo: str, keys: Sequence[str]) -> None:
    """
    The zoo hands unknown keys on when it builds a model, and drops them silently when it resumes one.

    :param algo: Name of an algorithm in the zoo
    :param keys: Names of hyperparameters, from a YAML file or the command line
    :raises TypeError: If one is neither a key of the zoo nor an argument of the algorithm. Not a ValueError: the zoo
        takes those for an unlucky trial when it optimises.
    """
    arguments = constructor_arguments(ALGOS[algo]) - COMMAND_LINE_ARGUMENTS
    own = issubclass(ALGOS[algo], SavableAlgorithm)
    for key in keys:
        if key in arguments or key in ZOO_KEYS or (own and _is_setting(ALGOS[algo], key)):
            continue
        group, name = (single_setting(ALGOS[algo], key) if own else None) or ("", key)
        taken, who = (groups_of(ALGOS[algo])[group].names(), group) if group else (sorted(arguments), "it")
        near = difflib.get_close_matches(name, [*taken, *([] if group else ZOO_KEYS)])
        meant = [repr(f"{group}.{each}" if group else each) for each in near]
        hint = f"did you mean {' or '.join(meant)}?" if near else f"{who} takes {', '.join(taken)}"
        raise TypeError(f"{key!r} is not a hyperparameter of {algo}: {hint}")
