"""What is to be trained, and how it is tested."""

import importlib
import math
import re
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import msgspec
import yaml

from sb3_ddiffpg.zoo import ALGOS, check_hyperparameters, config_file, register


class Tests(msgspec.Struct, forbid_unknown_fields=True):
    """
    How a training is tested.

    :param n_tests: Tests along the way
    :param n_test_episodes: Episodes for each command, in each of these
    :param n_episodes: Episodes for each command in the evaluation at the end
    :param also: Further environments for that evaluation, such as ``AntMazeRandom-v0``; a model with modes replans there
    """

    n_tests: int = 30
    n_test_episodes: int = 20
    n_episodes: int = 100
    also: list[str] = []


class Trial(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """
    What is to be trained.

    :param env: Id of the environment
    :param algo: Name of the algorithm in the zoo
    :param variant: Under which the result is reported
    :param seed: Of the training
    :param hyperparams: As in an entry of the zoo's YAML files
    :param members: More than one: so many trainings, each with its share of the steps, evaluated as one union
    :param tests: How it is tested
    """

    env: str
    algo: str
    variant: str
    seed: int
    hyperparams: dict[str, Any]
    members: int = 1
    tests: Tests = msgspec.field(default_factory=Tests)

    def check(self) -> None:
        """
        :raises ValueError: If there is no such algorithm, environment or hyperparameter, or a number is out of its range
        """
        register()
        if self.algo not in ALGOS:
            raise ValueError(f"algo: {self.algo!r} given; accepted are {', '.join(sorted(ALGOS))}")
        for env_id in (self.env, *self.tests.also):
            if env_id not in gym.registry:
                gym.register_envs(importlib.import_module("gymnasium_robotics"))
            if env_id not in gym.registry:
                raise ValueError(f"env: {env_id!r} given; accepted is the id of a registered environment")
        try:
            check_hyperparameters(self.algo, list(self.hyperparams))
        except TypeError as error:
            raise ValueError(f"settings of {self.variant} in {self.env}: {error}") from None
        if re.fullmatch(r"\w[\w .,+=()-]{0,60}", self.variant) is None:
            accepted = "1 to 61 letters, digits, blanks and .,+=()-_ that begin with a letter or digit"
            raise ValueError(f"variant: {self.variant!r} given; accepted are {accepted}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed: {self.seed} given; accepted are whole numbers from 0 to {2**31 - 1}")
        if self.tests.also and self.members > 1:
            raise ValueError(f"also: {self.tests.also} given beside members: {self.members}; accepted is one of both")
        if self.hyperparams.get("normalize") and (self.tests.also or self.members > 1):
            raise ValueError("normalize: given beside also or members, whose environments are not normalised")
        counts: dict[str, Any] = {"members": self.members, "n_timesteps": self.hyperparams.get("n_timesteps")}
        counts |= {name: getattr(self.tests, name) for name in ("n_tests", "n_test_episodes", "n_episodes")}
        for name, value in counts.items():
            if not isinstance(value, (int, float)) or not 1 <= value < math.inf:
                raise ValueError(f"{name}: {value!r} given; accepted are numbers from 1 up")
        if counts["n_timesteps"] < self.members:
            raise ValueError(
                f"members: {self.members} given for {counts['n_timesteps']:g} steps; accepted is one step for each"
            )


def hyperparameters(algo: str, env_id: str, conf_file: str | None, overrides: dict[str, Any]) -> dict[str, Any]:
    """
    :param algo: Name of the algorithm in the zoo
    :param env_id: Id of the environment
    :param conf_file: A YAML file as the zoo's, or the name of one of ours; the algorithm's own when None
    :param overrides: What differs from its entry
    :return: The settings
    :raises ValueError: If there is no such file or entry
    """
    path = config_file(conf_file or algo) or Path(conf_file or algo)
    if not path.is_file():
        raise ValueError(f"conf-file: {conf_file!r} given for {algo!r}; accepted is a YAML file, or the name of one of ours")
    entries = _entries(path, path.stat().st_mtime_ns)
    if not isinstance(entries, dict) or not isinstance(entries.get(env_id), dict):
        known = ", ".join(sorted(map(str, entries))) if isinstance(entries, dict) else "nothing"
        raise ValueError(f"env: {env_id!r} given; {path.name} has settings for {known}")
    return {name: _number(value) for name, value in {**entries[env_id], **overrides}.items()}


@cache
def _entries(path: Path, changed_at: int) -> Any:
    """A suite reads the same file for every trial."""
    try:
        return yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"conf-file: {path} is no YAML: {error}") from None


def _number(value: Any) -> Any:
    """YAML reads 1e5 as a string."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value
