"""
One training that leaves all that is needed to judge it and to do it again, in one folder: ``model.zip``,
``evaluation.json``, ``curve.csv`` and ``config.yml``. The same command goes on with a training that was killed.
"""

import argparse
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import yaml
from filelock import FileLock, Timeout
from stable_baselines3.common.vec_env import VecNormalize, sync_envs_normalization

from sb3_ddiffpg.callbacks.checkpoint import RunCheckpointCallback
from sb3_ddiffpg.callbacks.evaluation import score
from sb3_ddiffpg.common.actor_critic import ActorCriticAlgorithm
from sb3_ddiffpg.envs import import_packages, is_ours, make_vec_env, registered_id, registered_spec
from sb3_ddiffpg.evaluation.ensemble import evaluate_ensemble
from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.replanner import Replanner
from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.experiments.ablations import load_to_act, register
from sb3_ddiffpg.experiments.curve import CurveCallback
from sb3_ddiffpg.experiments.files import check_output, parse_yaml, task_file_name
from sb3_ddiffpg.experiments.progress import Progress, ProgressCallback, write_progress
from sb3_ddiffpg.experiments.record import (
    check_folder,
    is_complete,
    new_record,
    read_record,
    recorded_trial,
    write_record,
)
from sb3_ddiffpg.experiments.trial import Tests, Trial, hyperparameters
from sb3_ddiffpg.saving.algorithm import SavableAlgorithm
from sb3_ddiffpg.saving.checkpoint import checkpoint_files
from sb3_ddiffpg.utils.disk import written_whole
from sb3_ddiffpg.zoo import ALGO, ALGOS, ModeExperimentManager

N_CHECKPOINTS = 30
# A killed training's environments may need this long to end and to let go of the folder
SECONDS_TO_WAIT = 60


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


class _Training:
    """
    A trial's one training.

    :param trial: What
    :param folder: Where the record goes
    """

    def __init__(self, trial: Trial, folder: Path) -> None:
        self.trial, self.folder, self.logs = trial, folder, folder / "logs"
        self.record = new_record(trial, folder)

    def run(self) -> None:
        """Train and evaluate, or go on with that."""
        entry = self.logs / "hyperparams.yml"
        entry.write_text(yaml.safe_dump({registered_id(self.trial.env): self.trial.hyperparams}))
        checkpoints = self.logs / "checkpoints"
        manager = ModeExperimentManager(
            argparse.Namespace(),
            self.trial.algo,
            registered_id(self.trial.env),
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
        how = {"n_episodes": tests.n_test_episodes, "deterministic": tests.deterministic}
        curve = CurveCallback(self.folder, eval_env=test_env, eval_freq=every, **how)
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
        if curve.best_step is None or tests.last:
            self._keep_final(model)
            result["best_step"] = model.num_timesteps
        elif curve.best_step < model.num_timesteps and self._final_is_better(model, test_env):
            result["best_step"] = model.num_timesteps
        self._evaluate(test_env, manager.eval_env_kwargs, final_is_best=result["best_step"] == model.num_timesteps)
        test_env.close()
        self._write_record({**result, "complete": True})
        shutil.rmtree(checkpoints, ignore_errors=True)
        write_progress(self.logs, Progress(model.num_timesteps, manager.n_timesteps, "done"))

    def _final_is_better(self, model: Any, test_env: Any) -> bool:
        """Or as good. It takes the place of the model that did best in a test, of few episodes: both are compared in more."""
        seed, paths = self.trial.seed + 750, (self.logs / "final_model.zip", self.folder / "model.zip")
        final, best = (score(self._tested(path, test_env, seed)[1]) for path in paths)
        if final < best:
            return False
        self._keep_final(model)
        return True

    def _keep_final(self, model: Any) -> None:
        """In place of the one that did best in a test."""
        with written_whole(self.folder / "model.zip") as unfinished:
            shutil.copy(self.logs / "final_model.zip", unfinished)
        if (normalizer := model.get_vec_normalize_env()) is not None:
            normalizer.save(str(self.folder / "vecnormalize.pkl"))

    def _tested(self, path: Path, test_env: Any, seed: int) -> tuple[Any, ModeEvaluation]:
        """The model of a file, and what was found of it."""
        statistics, env = path.with_name("vecnormalize.pkl"), test_env
        if isinstance(test_env, VecNormalize) and statistics.exists():  # beside the best model only
            env = VecNormalize.load(str(statistics), test_env.venv)
        model = load_to_act(self.trial.algo, path)
        tests = self.trial.tests
        return model, evaluate_modes(model, env, tests.n_episodes, seed=seed, deterministic=tests.deterministic)

    def _evaluate(self, test_env: Any, env_kwargs: dict[str, Any], final_is_best: bool) -> None:
        seed = self.trial.seed + 1_000
        paths = {} if final_is_best else {"final": self.logs / "final_model.zip"}
        paths["best"] = self.folder / "model.zip"
        for name, path in paths.items():
            tested, found = self._tested(path, test_env, seed)
            found.save(self.folder / ("evaluation.json" if name == "best" else "logs/evaluation_final.json"))
            if name == "best" and isinstance(tested, ActorCriticAlgorithm):
                with written_whole(path) as smaller:  # there is no other copy
                    tested.save(smaller, to_train=False)
            print(f"\n{name} model\n{found}")
        for env_id in self.trial.tests.also:
            found = self._evaluate_elsewhere(tested, env_id, seed, env_kwargs)
            found.save(self.folder / f"evaluation_{task_file_name(env_id)}.json")
            print(f"\nin {env_id}\n{found}")

    def _evaluate_elsewhere(self, model: Any, env_id: str, seed: int, env_kwargs: dict[str, Any]) -> ModeEvaluation:
        n_episodes = self.trial.tests.n_episodes
        env = make_vec_env(env_id, min(n_episodes, 25), seed=seed, env_kwargs=env_kwargs)
        try:
            agent = Replanner(model) if len(getattr(model, "modes", ())) else model
            return evaluate_modes(agent, env, n_episodes, n_uncommanded=n_episodes, seed=seed)
        finally:
            env.close()

    def _write_record(self, result: dict[str, Any] | None = None) -> None:
        if result is not None:
            self.record["result"] = result
        write_record(self.record, self.folder)


def _run_union(trial: Trial, folder: Path) -> None:
    """Its members one after the other, and their evaluation as one model. They share the steps of one training."""
    record = new_record(trial, folder)
    write_record(record, folder)
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
        results.append(read_record(place)["result"])
        models.append(load_to_act(trial.algo, place / "model.zip"))
        write_progress(folder / "logs", Progress(steps * (number + 1), steps * trial.members))
    env_kwargs = trial.hyperparams.get("env_kwargs", {})
    found = evaluate_ensemble(models, trial.env, trial.tests.n_episodes, seed=trial.seed + 1_000, env_kwargs=env_kwargs)
    found.save(folder / "evaluation.json")
    print(f"\nunion\n{found}")
    record["result"] = {
        "complete": True,
        **{name: sum(result[name] for result in results) for name in ("steps", "updates", "hours", "cpu_hours")},
        "seconds": {
            part: round(sum(result["seconds"][part] for result in results), 1)
            for part in set.intersection(*(set(result["seconds"]) for result in results))
        },
    }
    write_record(record, folder)
    write_progress(folder / "logs", Progress(record["result"]["steps"], record["result"]["steps"], "done"))


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
    parser.add_argument("--env", help="id of the environment, or module:id with the module that registers it")
    parser.add_argument("--gym-packages", nargs="+", help="modules that register environments; the record says module:id")
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
    check_output(given.out)
    if (given.env is None) == (given.again is None):
        raise ValueError("--env or --again is needed, and not both")
    others = ("algo", "gym_packages", "seed", "variant", "conf_file", "override", "settings", "members", "tests")
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
    env = _with_module(given.env, given.gym_packages or [])
    if given.settings is None:
        settings = hyperparameters(algo, env, given.conf_file, given.override or {})
    elif given.conf_file is None and not given.override:
        settings = given.settings
    else:
        raise ValueError("--settings: given beside --conf-file or --override; accepted is one or the other")
    try:
        tests = msgspec.convert(given.tests or {}, Tests)
    except msgspec.ValidationError as error:
        raise ValueError(f"--tests: {error}") from None
    return Trial(
        env=env,
        algo=algo,
        variant=algo if given.variant is None else given.variant,
        seed=given.seed or 0,
        hyperparams=settings,
        members=1 if given.members is None else given.members,
        tests=tests,
    )


def _with_module(env_id: str, packages: list[str]) -> str:
    """Whoever does the same again has to import the same."""
    import_packages(packages)
    if not packages or ":" in env_id:
        return env_id
    registered_id(env_id)
    maker = str(registered_spec(env_id).entry_point).partition(":")[0]
    of_it = [each for each in packages if maker.partition(".")[0] == each.partition(".")[0]]
    if len(packages) > 1 and len(of_it) != 1:
        raise ValueError(
            f"--gym-packages: {packages} given, but which of them registers {env_id}? Accepted is --env module:id"
        )
    return f"{(of_it or packages)[0]}:{env_id}"


def _settings(text: str) -> dict[str, Any]:
    """Of ``--override``, ``--settings`` and ``--tests``."""
    try:
        settings = parse_yaml(text)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no YAML: {error}") from None
    if not isinstance(settings, dict):
        raise argparse.ArgumentTypeError(f"{text!r} given; accepted are settings as '{{name: value}}'")
    return settings
