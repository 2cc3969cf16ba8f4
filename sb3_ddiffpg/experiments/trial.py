"""What is to be trained, and how it is tested."""

import math
import re
import reprlib
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import msgspec
import rl_zoo3
import yaml

from sb3_ddiffpg.common.presets import ZOO_KEYS
from sb3_ddiffpg.envs import registered_id
from sb3_ddiffpg.experiments.ablations import register, settings_file
from sb3_ddiffpg.experiments.files import read_yaml
from sb3_ddiffpg.saving.algorithm import SavableAlgorithm
from sb3_ddiffpg.utils.arguments import check_arguments, constructor_arguments, grouped
from sb3_ddiffpg.zoo import ALGOS, check_hyperparameters, config_file


class Tests(msgspec.Struct, forbid_unknown_fields=True):
    """
    How a training is tested.

    :param n_tests: Tests along the way
    :param n_test_episodes: Episodes for each command, in each of these
    :param n_episodes: Episodes for each command in the evaluation at the end
    :param also: Further environments for that evaluation, such as ``AntMazeRandom-v0``; a model with modes replans there
    :param deterministic: Whether actions are the most likely ones, not drawn
    :param last: Whether the last model is evaluated, not the one that did best along the way
    """

    n_tests: int = 30
    n_test_episodes: int = 20
    n_episodes: int = 100
    also: list[str] = []
    deterministic: bool = False
    last: bool = False


class Trial(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """
    What is to be trained.

    :param env: Id of the environment, perhaps with the module that registers it: ``"module:id"``
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
            registered_id(env_id)
        try:
            check_hyperparameters(self.algo, list(self.hyperparams))
            if issubclass(ALGOS[self.algo], SavableAlgorithm):  # the zoo makes more of texts and lists
                given = {name: each for name, each in self.hyperparams.items() if not isinstance(each, (str, list))}
                check_arguments(ALGOS[self.algo], given)
        except (TypeError, ValueError) as error:
            raise ValueError(f"settings of {self.variant} in {self.env}: {error}") from None
        if re.fullmatch(r"\w([\w .,+=()-]{0,59}[\w.,+=()-])?", self.variant) is None:
            accepted = "1 to 61 letters, digits, blanks and .,+=()-_ that begin with a letter or digit and end with no blank"
            raise ValueError(f"variant: {self.variant!r} given; accepted are {accepted}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed: {self.seed} given; accepted are whole numbers from 0 to {2**31 - 1}")
        self._check_environments()
        counts: dict[str, Any] = {"members": self.members, "n_timesteps": self.hyperparams.get("n_timesteps")}
        counts["n_envs"] = self.hyperparams.get("n_envs", 1)
        counts |= {name: getattr(self.tests, name) for name in ("n_tests", "n_test_episodes", "n_episodes")}
        for name, value in counts.items():
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 1 <= value < math.inf:
                raise ValueError(f"{name}: {reprlib.repr(value)} given; accepted are numbers from 1 up")
        if counts["n_timesteps"] < self.members:
            raise ValueError(
                f"members: {self.members} given for {counts['n_timesteps']:g} steps; accepted is one step for each"
            )

    def _check_environments(self) -> None:
        if self.tests.also and self.members > 1:
            raise ValueError(f"also: {self.tests.also} given beside members: {self.members}; accepted is one of both")
        for name in ("normalize", "env_wrapper", "vec_env_wrapper", "frame_stack"):
            if self.hyperparams.get(name) and (self.tests.also or self.members > 1):
                raise ValueError(f"{name}: given beside also or members, whose environments are tested as they are")
        env_kwargs = self.hyperparams.get("env_kwargs", {})
        if not isinstance(env_kwargs, dict):
            raise ValueError(
                f"env_kwargs: {reprlib.repr(env_kwargs)} given; accepted are arguments of the environment by name"
            )
        spaces, *others = (_spaces_of(env_id, yaml.safe_dump(env_kwargs)) for env_id in (self.env, *self.tests.also))
        for env_id, other in zip(self.tests.also, others, strict=True):
            if not all(map(_alike, other, spaces)):
                raise ValueError(f"also: {env_id} given, whose observations or actions are not those of {self.env}")


def can_be_made(env_id: str, env_kwargs: dict[str, Any]) -> bool:
    """
    :param env_id: Id of an environment, perhaps with the module that registers it
    :param env_kwargs: Arguments of ``gym.make``
    :return: Whether this Python has what it needs
    """
    try:
        registered_id(env_id)
        _spaces_of(env_id, yaml.safe_dump(env_kwargs))
    except ValueError:
        return False
    return True


def hyperparameters(
    algo: str, env_id: str, conf_file: str | None, *overrides: dict[str, Any], entry: str | None = None
) -> dict[str, Any]:
    """
    :param algo: Name of the algorithm in the zoo
    :param env_id: Id of the environment
    :param conf_file: A YAML file as the zoo's, or the name of one of ours; the algorithm's own when None. ``"constructor"``:
        no file, what is not said is as the algorithm has it; ``"rl_zoo3"``: the RL zoo's own file of the algorithm
    :param overrides: What differs from its entry; of a group of settings only what is given, the last one holds
    :param entry: In the RL zoo's file, the environment whose entry it is, if it is not this one: ``"Hopper-v4"``; of another
        algorithm's file, ``"sac:FetchReach-v1"``, what this algorithm takes is added to its own ``default``
    :return: The settings
    :raises ValueError: If there is no such file or entry
    """
    register()
    if conf_file == "constructor":
        settings = {}
    elif conf_file == "rl_zoo3":
        settings = _zoo_settings(algo, registered_id(env_id), entry)
    else:
        settings = _own_settings(algo, env_id, conf_file)
    algorithm: Any = ALGOS.get(algo)
    for each in overrides:
        own = isinstance(algorithm, type) and issubclass(algorithm, SavableAlgorithm)
        settings = grouped(algorithm, settings, each) if own else {**settings, **each}
    return {name: _number(value) for name, value in settings.items()}


def _zoo_settings(algo: str, env_id: str, entry: str | None) -> dict[str, Any]:
    """The RL zoo's."""
    other, _, name = (entry or env_id).rpartition(":")
    files = {each: Path(rl_zoo3.__file__).parent / "hyperparams" / f"{each}.yml" for each in (algo, other or algo)}
    for path in files.values():
        if not path.is_file():
            raise ValueError(f"conf-file: 'rl_zoo3' given for {path.stem!r}, for which the RL zoo has no settings")
    own, others = (_entries(path, path.stat().st_mtime_ns) for path in (files[algo], files[other or algo]))
    if name not in others and entry is not None:
        raise ValueError(f"entry: {entry!r} given; {other or algo}.yml of the RL zoo has {', '.join(others)}")
    if not other:
        return dict(own.get(name, own["default"]))
    taken = constructor_arguments(ALGOS[algo]) | ZOO_KEYS
    return {**own["default"], **{key: value for key, value in others[name].items() if key in taken}}


def _own_settings(algo: str, env_id: str, conf_file: str | None) -> dict[str, Any]:
    """Of a file of ours, or one as the zoo's."""
    path = config_file(conf_file or settings_file(algo)) or Path(conf_file or algo)
    if not path.is_file():
        raise ValueError(f"conf-file: {conf_file!r} given for {algo!r}; accepted is a YAML file, or the name of one of ours")
    entries = _entries(path, path.stat().st_mtime_ns)
    module, _, entry = env_id.rpartition(":")
    if isinstance(entries, dict) and entry not in entries and (module or entry in gym.registry):
        entry = "default"  # as in the zoo
    if not isinstance(entries, dict) or not isinstance(entries.get(entry), dict):
        known = ", ".join(sorted(map(str, entries.keys() - {"default", "paper"}))) if isinstance(entries, dict) else "nothing"
        raise ValueError(f"env: {env_id!r} given; {path.name} has settings for {known}")
    return dict(entries[entry])


def setting_of(trial: Trial, name: str) -> Any:
    """
    :param trial: A training
    :param name: Of one of its settings: ``"batch_size"``, or ``"target_action.learning_rate"`` of a group
    :return: Its value, None if nothing is said of it
    """
    value: Any = trial.hyperparams
    for part in name.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return value


@cache
def _entries(path: Path, changed_at: int) -> Any:
    """A suite reads the same file for every trial."""
    return read_yaml("conf-file", path)


def _alike(one: gym.Space, other: gym.Space) -> bool:
    """Bounds may differ: of another maze they do."""
    if isinstance(one, gym.spaces.Box) and isinstance(other, gym.spaces.Box):
        return (one.shape, one.dtype) == (other.shape, other.dtype)
    if isinstance(one, gym.spaces.Dict) and isinstance(other, gym.spaces.Dict):
        return one.keys() == other.keys() and all(_alike(one[key], other[key]) for key in one)
    return one == other


@cache
def _spaces_of(env_id: str, env_kwargs: str) -> tuple[gym.Space, gym.Space]:
    """Made once, to see that it can be."""
    try:
        env = gym.make(env_id, **yaml.safe_load(env_kwargs))
    except Exception as error:  # whatever somebody's environment raises
        raise ValueError(f"env: {env_id} cannot be made with env_kwargs {env_kwargs.strip()}: {error}") from None
    env.close()
    return env.observation_space, env.action_space


def _number(value: Any) -> Any:
    """YAML reads 1e5 as a string."""
    if isinstance(value, dict):
        return {name: _number(each) for name, each in value.items()}
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value
