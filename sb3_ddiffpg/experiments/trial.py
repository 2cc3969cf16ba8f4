"""
One training that leaves all that is needed to judge it and to do it again, in one folder: ``model.zip``,
``evaluation.json``, ``curve.csv`` and ``config.yml``. The same command goes on with a training that was killed.
"""

import argparse
import importlib
import math
import os
import re
import shlex
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import msgspec
import yaml
from filelock import FileLock, Timeout
from stable_baselines3.common.vec_env import VecNormalize, sync_envs_normalization

from sb3_ddiffpg.actor_critic import NoveltyActorCritic
from sb3_ddiffpg.checkpoints import RunCheckpointCallback, checkpoint_files
from sb3_ddiffpg.envs import is_ours, make_vec_env
from sb3_ddiffpg.evaluation import ModeEvaluation, evaluate_modes
from sb3_ddiffpg.experiments.curve import CurveCallback
from sb3_ddiffpg.experiments.machine import git_commit, machine, versions
from sb3_ddiffpg.experiments.progress import Progress, ProgressCallback, write_progress
from sb3_ddiffpg.persistence import SavableAlgorithm
from sb3_ddiffpg.replanning import Replanner
from sb3_ddiffpg.union import evaluate_union
from sb3_ddiffpg.zoo import ALGO, ALGOS, ModeExperimentManager, check_hyperparameters, config_file, register

N_CHECKPOINTS = 30
# A killed training's environments may need this long to end and to let go of the folder
SECONDS_TO_WAIT = 60


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


def recorded_trial(folder: Path) -> Trial:
    """
    :param folder: Of a recorded training
    :return: What was trained
    :raises ValueError: If it is no such folder
    """
    path = folder / "config.yml"
    if not path.is_file():
        raise ValueError(f"{folder} given; accepted is the folder of a recorded training, with a config.yml")
    try:
        recorded = yaml.safe_load(path.read_text())
        known = {name: recorded[name] for name in Trial.__struct_fields__ if name in recorded}
        return msgspec.convert({"variant": recorded["algo"], **known}, Trial)
    except (yaml.YAMLError, UnicodeDecodeError, TypeError, KeyError, msgspec.ValidationError) as error:
        raise ValueError(f"{path} is not the record of a training: {error}") from None


def run_trial(trial: Trial, folder: Path) -> None:
    """
    Train, test along the way, keep the best model, and evaluate it with fresh seeds.

    :param trial: What
    :param folder: Where the record goes. If it holds this trial's beginning, that goes on; it must not hold another one
    :raises ValueError: If it does, or the trial cannot be
    :raises SystemExit: If the training was interrupted
    """
    trial.check()
    check_folder(trial, folder)
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / "logs" / "lock", timeout=SECONDS_TO_WAIT):
            check_folder(trial, folder)  # somebody else's may have come first
            if is_complete(folder):
                print(f"{folder} is complete")
            elif trial.members > 1:
                _run_union(trial, folder)
            else:
                _Training(trial, folder).run()
    except Timeout:
        raise ValueError(f"out: another process is busy with {folder}") from None


def check_folder(trial: Trial, folder: Path) -> None:
    """
    :param trial: What is to be trained
    :param folder: Where its record is to go
    :raises ValueError: If another training's is there
    """
    if (folder / "config.yml").is_file() and recorded_trial(folder) != trial:
        raise ValueError(f"out: {folder} holds another training; accepted is a folder without one, or with this one")


def is_complete(folder: Path) -> bool:
    """
    :param folder: Of a training
    :return: Whether there is nothing left to do
    """
    path = folder / "config.yml"
    recorded = yaml.safe_load(path.read_text()) if path.is_file() else None
    return isinstance(recorded, dict) and bool((recorded.get("result") or {}).get("complete"))


class _Training:
    """
    A trial's one training.

    :param trial: What
    :param folder: Where the record goes
    """

    def __init__(self, trial: Trial, folder: Path) -> None:
        self.trial, self.folder, self.logs = trial, folder, folder / "logs"
        self.record = _new_record(trial, folder)

    def run(self) -> None:
        """Train and evaluate, or go on with that."""
        entry = self.logs / "hyperparams.yml"
        entry.write_text(yaml.safe_dump({self.trial.env: self.trial.hyperparams}))
        checkpoints = self.logs / "checkpoints"
        manager = ModeExperimentManager(
            argparse.Namespace(),
            self.trial.algo,
            self.trial.env,
            str(self.logs),
            seed=self.trial.seed,
            config=str(entry),
            eval_freq=-1,
            log_interval=-2,
            verbose=1,
            resume=self.logs if checkpoint_files(checkpoints) else None,
        )
        manager.save_path = str(self.logs)
        manager.params_path = str(self.logs)
        prepared = manager.setup_experiment()
        assert prepared is not None
        model = prepared[0]
        self._write_record()
        # One fixed start, for the tasks that have start noise
        manager.eval_env_kwargs = {
            **manager.env_kwargs,
            **({"start_noise": 0.0} if is_ours(self.trial.env) else {}),
        }
        tests = self.trial.tests
        test_env = manager.create_envs(tests.n_test_episodes, eval_env=True)
        test_env.seed(self.trial.seed + 500)
        every = max(1, manager.n_timesteps // tests.n_tests)
        curve = CurveCallback(self.folder, eval_env=test_env, eval_freq=every, n_episodes=tests.n_test_episodes)
        # The zoo tells the first one when it was interrupted
        manager.callbacks.insert(0, curve)
        manager.callbacks.append(ProgressCallback(self.logs, manager.n_timesteps))
        if isinstance(model, SavableAlgorithm):
            manager.callbacks.append(RunCheckpointCallback(checkpoints, max(1, manager.n_timesteps // N_CHECKPOINTS)))
        with curve.stopwatch.timing(model):
            manager.learn(model)
        result: dict[str, Any] = {
            "complete": False,
            "steps": model.num_timesteps,
            "updates": model._n_updates,
            "hours": round(curve.clock.hours, 3),
            "cpu_hours": round(curve.clock.cpu_hours, 3),
            "seconds": {part: round(seconds, 1) for part, seconds in curve.stopwatch.seconds.items()},
            "best_step": curve.best_step,
        }
        self._write_record(result)
        if model.num_timesteps < manager.n_timesteps:
            test_env.close()
            raise SystemExit(f"Stopped after {model.num_timesteps} of {manager.n_timesteps} steps; the same command goes on")
        write_progress(self.logs, Progress(model.num_timesteps, manager.n_timesteps, "evaluation"))
        if isinstance(test_env, VecNormalize):
            trained_in = model.get_env()
            assert trained_in is not None
            sync_envs_normalization(trained_in, test_env)  # a resumed training may not have tested since
        model.save(self.logs / "final_model.zip")
        if curve.best_step is None:
            shutil.copy(self.logs / "final_model.zip", self.folder / "model.zip")
        self._evaluate(test_env, manager.eval_env_kwargs)
        test_env.close()
        self._write_record({**result, "complete": True})
        shutil.rmtree(checkpoints, ignore_errors=True)
        write_progress(self.logs, Progress(model.num_timesteps, manager.n_timesteps, "done"))

    def _evaluate(self, test_env: Any, env_kwargs: dict[str, Any]) -> None:
        seed, n_episodes = self.trial.seed + 1_000, self.trial.tests.n_episodes
        paths = {"final": self.logs / "final_model.zip", "best": self.folder / "model.zip"}
        for name, path in paths.items():
            statistics, env = path.with_name("vecnormalize.pkl"), test_env
            if isinstance(test_env, VecNormalize) and statistics.exists():  # beside the best model only
                env = VecNormalize.load(str(statistics), test_env.venv)
            tested: Any = ALGOS[self.trial.algo].load(path)
            found = evaluate_modes(tested, env, n_episodes, seed=seed)
            found.save(self.folder / ("evaluation.json" if name == "best" else "logs/evaluation_final.json"))
            if name == "best" and isinstance(tested, NoveltyActorCritic):
                smaller = self.logs / "model_without_optimizers.zip"
                tested.save(smaller, optimizers=False)
                os.replace(smaller, path)  # there is no other copy
            print(f"\n{name} model\n{found}")
        for env_id in self.trial.tests.also:
            found = self._evaluate_elsewhere(tested, env_id, seed, env_kwargs)
            found.save(self.folder / f"evaluation_{env_id.replace('/', '-')}.json")
            print(f"\nin {env_id}\n{found}")

    def _evaluate_elsewhere(self, model: Any, env_id: str, seed: int, env_kwargs: dict[str, Any]) -> ModeEvaluation:
        n_episodes = self.trial.tests.n_episodes
        env = make_vec_env(env_id, min(n_episodes, 25), seed=seed, **env_kwargs)
        try:
            agent = Replanner(model) if len(getattr(model, "modes", ())) else model
            return evaluate_modes(agent, env, n_episodes, n_uncommanded=n_episodes, seed=seed)
        finally:
            env.close()

    def _write_record(self, result: dict[str, Any] | None = None) -> None:
        if result is not None:
            self.record["result"] = result
        _write(self.record, self.folder)


def _run_union(trial: Trial, folder: Path) -> None:
    """Its members one after the other, and their evaluation as one model. They share the steps of one training."""
    record = _new_record(trial, folder)
    _write(record, folder)
    steps = int(trial.hyperparams["n_timesteps"] // trial.members)
    results, models = [], []
    for number in range(trial.members):
        member = Trial(
            env=trial.env,
            algo=trial.algo,
            variant=trial.algo,
            seed=trial.seed * trial.members + number,
            hyperparams={**trial.hyperparams, "n_timesteps": steps},
            tests=trial.tests,
        )
        place = folder / f"member_{number}"
        run_trial(member, place)
        results.append(yaml.safe_load((place / "config.yml").read_text())["result"])
        models.append(ALGOS[trial.algo].load(place / "model.zip"))
        write_progress(folder / "logs", Progress(steps * (number + 1), steps * trial.members))
    env_kwargs = trial.hyperparams.get("env_kwargs", {})
    found = evaluate_union(models, trial.env, trial.tests.n_episodes, seed=trial.seed + 1_000, **env_kwargs)
    found.save(folder / "evaluation.json")
    print(f"\nunion\n{found}")
    record["result"] = {
        "complete": True,
        **{name: sum(result[name] for result in results) for name in ("steps", "updates", "hours", "cpu_hours")},
    }
    _write(record, folder)
    write_progress(folder / "logs", Progress(record["result"]["steps"], record["result"]["steps"], "done"))


def command_line(trial: Trial, folder: Path) -> list[str]:
    """
    :param trial: What
    :param folder: Where its record goes
    :return: Arguments of ``python -m sb3_ddiffpg.experiments`` that do it, whatever files there are
    """
    words = ["trial", "--algo", trial.algo, "--env", trial.env, "--variant", trial.variant, "--seed", str(trial.seed)]
    words += ["--members", str(trial.members)] if trial.members > 1 else []
    for option, value in (("--settings", trial.hyperparams), ("--tests", msgspec.to_builtins(trial.tests))):
        words += [option, yaml.safe_dump(value, default_flow_style=True, width=10**6).strip()]
    return [*words, "--out", str(folder)]


def _new_record(trial: Trial, folder: Path) -> dict[str, Any]:
    return {
        **msgspec.to_builtins(trial),
        "command": shlex.join(["python", "-m", "sb3_ddiffpg.experiments", *command_line(trial, folder)]),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "git_commit": git_commit(),
        "machine": machine(),
        "versions": versions(),
    }


def _write(record: dict[str, Any], folder: Path) -> None:
    """Whole, or the one before."""
    unfinished = folder / "logs" / "config.yml"
    unfinished.write_text(yaml.safe_dump(record, sort_keys=False))
    os.replace(unfinished, folder / "config.yml")


def _end_with_parent() -> None:
    """Whoever started this process holds the other end of its standard input: when that closes, it is dead."""

    def wait() -> None:
        while sys.stdin.read(1):
            pass
        signal.raise_signal(signal.SIGTERM)  # which writes a checkpoint

    threading.Thread(target=wait, daemon=True).start()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: Of the command line
    """
    parser.add_argument("--algo", help=f"{ALGO} if not given")
    parser.add_argument("--env")
    parser.add_argument("--seed", type=int, help="0 if not given")
    parser.add_argument("--variant", help="name under which the result is reported; the algorithm's if not given")
    parser.add_argument(
        "--conf-file", help="a YAML file as the zoo's, or the name of one of ours; the algorithm's own if not given"
    )
    parser.add_argument("--override", type=_settings, help="settings as YAML, such as '{n_timesteps: 1e5}'")
    parser.add_argument("--settings", type=_settings, help="all settings as YAML, in place of a file's")
    parser.add_argument("--members", type=int, help="trainings that share the steps and are evaluated as one")
    parser.add_argument("--tests", type=_settings, help="as YAML: n_tests, n_test_episodes, n_episodes, also")
    parser.add_argument("--again", type=Path, help="folder of a recorded training, to do the same again")
    parser.add_argument("--out", type=Path, required=True, help="folder for the record")
    parser.add_argument("--attached", action="store_true", help="end when standard input closes")


def prepare(given: argparse.Namespace) -> Callable[[], None]:
    """
    :param given: The command line
    :return: What does it
    :raises ValueError: If it asks for what there is not
    """
    register()
    if (given.env is None) == (given.again is None):
        raise ValueError("--env or --again is needed, and not both")
    others = ("algo", "seed", "variant", "conf_file", "override", "settings", "members", "tests")
    if given.again is not None and (beside := [name for name in others if getattr(given, name) is not None]):
        raise ValueError(f"--again: given beside {', '.join(beside)}; a recorded training is done again as it was")
    trial = recorded_trial(given.again) if given.again is not None else _asked_for(given)
    trial.check()
    check_folder(trial, given.out)
    if given.attached:
        _end_with_parent()
    return partial(run_trial, trial, given.out)


def _asked_for(given: argparse.Namespace) -> Trial:
    algo = given.algo or ALGO
    if algo not in ALGOS:
        raise ValueError(f"--algo: {algo!r} given; accepted are {', '.join(sorted(ALGOS))}")
    if given.settings is None:
        settings = hyperparameters(algo, given.env, given.conf_file, given.override or {})
    elif given.conf_file is None and not given.override:
        settings = given.settings
    else:
        raise ValueError("--settings: given beside --conf-file or --override; accepted is one or the other")
    try:
        tests = msgspec.convert(given.tests or {}, Tests)
    except msgspec.ValidationError as error:
        raise ValueError(f"--tests: {error}") from None
    return Trial(
        env=given.env,
        algo=algo,
        variant=algo if given.variant is None else given.variant,
        seed=given.seed or 0,
        hyperparams=settings,
        members=1 if given.members is None else given.members,
        tests=tests,
    )


def _settings(text: str) -> dict[str, Any]:
    """Of ``--override``, ``--settings`` and ``--tests``."""
    try:
        settings = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no YAML: {error}") from None
    if not isinstance(settings, dict):
        raise argparse.ArgumentTypeError(f"{text!r} given; accepted are settings as '{{name: value}}'")
    return settings


def _number(value: Any) -> Any:
    """YAML reads 1e5 as a string."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value
