"""
One training run that leaves all that is needed to judge it and to do it again, in one folder: ``model.zip``,
``evaluation.json``, ``curve.csv`` and ``config.yml``.

``python -m sb3_ddiffpg.experiments.run --env AntMazeV1-v0 --conf-file ddiffpg-cpu --seed 1 --out results/AntMazeV1-v0/seed1``;
the same command goes on with a run that was killed, and ``python -m sb3_ddiffpg.experiments.run --again
results/AntMazeV1-v0/seed1 --out DIR`` repeats a recorded one.
"""

import argparse
import csv
import importlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import time
from collections import Counter
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
import yaml
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ddiffpg.actor_critic import NoveltyActorCritic
from sb3_ddiffpg.callbacks import EvaluateModesCallback
from sb3_ddiffpg.checkpoints import RunCheckpointCallback, checkpoint_files
from sb3_ddiffpg.envs import is_ours
from sb3_ddiffpg.evaluation import evaluate_modes
from sb3_ddiffpg.persistence import SavableAlgorithm
from sb3_ddiffpg.safe_files import convert
from sb3_ddiffpg.trajectories import read_success
from sb3_ddiffpg.zoo import ALGO, ALGOS, ModeExperimentManager, config_file, register

# How often the modes are tested in training, as a share of the run, and in how many episodes for each command
N_TESTS, N_TEST_EPISODES = 30, 20
N_CHECKPOINTS = 30
N_EPISODES = 100
PACKAGES = ("sb3_ddiffpg", "stable_baselines3", "torch", "gymnasium", "mujoco", "pybullet", "numpy", "numba")


class Clock:
    """
    Hours since a run began, without those between a kill and its resumption.

    :param hours: So many before
    :param cpu_hours: So many of all processors before
    """

    def __init__(self, hours: float = 0.0, cpu_hours: float = 0.0) -> None:
        self._began, self._cpu = time.perf_counter() - 3600 * hours, time.process_time() - 3600 * cpu_hours

    @property
    def hours(self) -> float:
        """Of the clock on the wall."""
        return (time.perf_counter() - self._began) / 3600

    @property
    def cpu_hours(self) -> float:
        """Of this process."""
        return (time.process_time() - self._cpu) / 3600


class CurveCallback(EvaluateModesCallback):
    """
    Keeps the best model so far, and a line of ``curve.csv`` for each test of it.

    :param folder: Of the run
    :param kwargs: Of ``EvaluateModesCallback``
    """

    def __init__(self, folder: Path, **kwargs: Any) -> None:
        super().__init__(path=folder / "logs" / "evaluations.jsonl", best_model_path=folder / "model.zip", **kwargs)
        self.folder = folder
        #: Goals reached in training, by the environment's label of the way
        self.reached: Counter[str] = Counter()
        self.rows: list[dict[str, Any]] = []
        self.clock = Clock()

    def _on_step(self) -> bool:
        for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            if done and info.get("mode") is not None and read_success(info, getattr(self.model, "success_key", None)):
                self.reached[str(info["mode"])] += 1
        return super()._on_step()

    def _on_training_end(self) -> None:
        if not self.evaluations or self.evaluations[-1][0] < self.num_timesteps:
            self._on_period()

    def _on_period(self) -> None:
        super()._on_period()
        step, found = self.evaluations[-1]
        row: dict[str, Any] = {
            "step": step,
            "hours": round(self.clock.hours, 4),
            "cpu_hours": round(self.clock.cpu_hours, 4),
            "updates": self.model._n_updates,
            "cells": len(visits) if (visits := getattr(self.model, "visits", None)) is not None else "",
            "modes": len(getattr(self.model, "modes", ())),
            "commanded_modes": round(found.commanded_modes, 3),
            "expected_modes": round(found.expected_modes(), 3),
            "robust_modes": found.robust_modes,
            "success_rate": round(found.uncommanded.success_rate, 3),
        }
        for label in found.listed:
            shares = [each.labels.get(label, 0) / each.n_episodes for each in (*found.commanded, found.uncommanded)]
            row[label] = round(max(shares), 3)
            row[f"reached {label}"] = self.reached[label]
        self.rows.append(row)
        with (self.folder / "curve.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            writer.writeheader()
            writer.writerows(self.rows)

    def state_dict(self) -> dict[str, Any]:
        """
        :return: What a resumed run must know, for ``load_state_dict``
        """
        clock = [self.clock.hours, self.clock.cpu_hours]
        return {**super().state_dict(), "reached": dict(self.reached), "rows": self.rows, "clock": clock}

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: What ``state_dict`` gave
        :raises ValueError: If it is something else
        """
        super().load_state_dict(state)
        self.reached = Counter(convert(state.get("reached"), dict[str, int], "callback.reached"))
        self.rows = convert(state.get("rows"), list[dict[str, Any]], "callback.rows")
        self.clock = Clock(*convert(state.get("clock"), tuple[float, float], "callback.clock"))


def run(algo: str, env_id: str, seed: int, hyperparams: dict[str, Any], folder: Path) -> None:
    """
    Train, test along the way, keep the best model, and evaluate it with fresh seeds.

    :param algo: Name of the algorithm in the zoo
    :param env_id: Of the environment
    :param seed: Of the run
    :param hyperparams: As in an entry of the zoo's YAML files
    :param folder: Where the record goes. If it holds this run's beginning, that goes on; it must not hold another one
    """
    wanted = {"algo": algo, "env": env_id, "seed": seed, "hyperparams": hyperparams}
    before = yaml.safe_load((folder / "config.yml").read_text()) if (folder / "config.yml").exists() else None
    if before is not None and any(before.get(key) != value for key, value in wanted.items()):
        raise SystemExit(f"--out: {folder} holds another run already; accepted is a folder without one, or with this one")
    if before is not None and before.get("result", {}).get("complete"):
        print(f"{folder} is complete")
        return
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    entry = folder / "logs" / "hyperparams.yml"
    entry.write_text(yaml.safe_dump({env_id: hyperparams}))
    checkpoints = folder / "logs" / "checkpoints"
    manager = ModeExperimentManager(
        argparse.Namespace(),
        algo,
        env_id,
        str(folder / "logs"),
        seed=seed,
        config=str(entry),
        eval_freq=-1,
        log_interval=-2,
        verbose=1,
        resume=folder / "logs" if checkpoint_files(checkpoints) else None,
    )
    manager.save_path = str(folder / "logs")
    manager.params_path = str(folder / "logs")
    prepared = manager.setup_experiment()
    assert prepared is not None
    model = prepared[0]
    record: dict[str, Any] = {
        **wanted,
        "command": shlex.join(["python", "-m", "sb3_ddiffpg.experiments.run", *sys.argv[1:]]),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "git_commit": _git_commit(),
        "machine": _machine(),
        "versions": _versions(),
    }
    # One fixed start, for the tasks that have start noise
    manager.eval_env_kwargs = {**manager.env_kwargs, **({"start_noise": 0.0} if is_ours(env_id) else {})}
    test_env = manager.create_envs(N_TEST_EPISODES, eval_env=True)
    test_env.seed(seed + 500)
    curve = CurveCallback(
        folder, eval_env=test_env, eval_freq=max(1, manager.n_timesteps // N_TESTS), n_episodes=N_TEST_EPISODES
    )
    # The zoo tells the first one when it was interrupted
    manager.callbacks.insert(0, curve)
    if isinstance(model, SavableAlgorithm):
        every = max(1, manager.n_timesteps // N_CHECKPOINTS)
        manager.callbacks.append(RunCheckpointCallback(checkpoints, every))
    (folder / "config.yml").write_text(yaml.safe_dump(record, sort_keys=False))
    manager.learn(model)
    record["result"] = {
        "complete": model.num_timesteps >= manager.n_timesteps,
        "steps": model.num_timesteps,
        "updates": model._n_updates,
        "hours": round(curve.clock.hours, 3),
        "cpu_hours": round(curve.clock.cpu_hours, 3),
        "best_step": curve.best_step,
    }
    (folder / "config.yml").write_text(yaml.safe_dump(record, sort_keys=False))
    if not record["result"]["complete"]:
        test_env.close()
        raise SystemExit(f"Stopped after {model.num_timesteps} of {manager.n_timesteps} steps; the same command goes on")
    model.save(folder / "logs" / "final_model.zip")
    if curve.best_step is None:
        shutil.copy(folder / "logs" / "final_model.zip", folder / "model.zip")
    for name, path in (("final", folder / "logs" / "final_model.zip"), ("best", folder / "model.zip")):
        statistics, env = path.with_name("vecnormalize.pkl"), test_env
        if isinstance(test_env, VecNormalize) and statistics.exists():  # beside the best model only
            env = VecNormalize.load(str(statistics), test_env.venv)
        tested = ALGOS[algo].load(path)
        found = evaluate_modes(tested, env, N_EPISODES, seed=seed + 1_000)
        found.save(folder / ("evaluation.json" if name == "best" else "logs/evaluation_final.json"))
        if name == "best" and isinstance(tested, NoveltyActorCritic):
            tested.save(path, optimizers=False)
        print(f"\n{name} model\n{found}")
    test_env.close()


def _git_commit() -> str | None:
    root = Path(__file__).parents[2]
    try:
        done = subprocess.run(
            ["git", "-C", root, "describe", "--always", "--dirty"], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def _machine() -> dict[str, Any]:
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "torch_threads": th.get_num_threads(),
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def main() -> None:
    """Read the command line, and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", default=ALGO)
    parser.add_argument("--env")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--conf-file", help="a YAML file as the zoo's, or the name of one of ours; the algorithm's own if not given"
    )
    parser.add_argument("--override", type=_settings, default={}, help="settings as YAML, such as '{n_timesteps: 1e5}'")
    parser.add_argument("--again", type=Path, help="folder of a recorded run: same algorithm, environment, seed and settings")
    parser.add_argument("--out", type=Path, required=True, help="folder for the record")
    given = parser.parse_args()
    if (given.env is None) == (given.again is None):
        raise SystemExit("--env or --again is needed, and not both")
    register()
    if given.again is not None:
        path = given.again / "config.yml"
        if not path.is_file():
            raise SystemExit(f"--again: {given.again} given; accepted is the folder of a recorded run, with a config.yml")
        recorded = yaml.safe_load(path.read_text())
        algo, env_id, seed, hyperparams = (recorded[key] for key in ("algo", "env", "seed", "hyperparams"))
    else:
        algo, env_id, seed = given.algo, given.env, given.seed
        path = config_file(given.conf_file or algo) or Path(given.conf_file or algo)
        if not path.is_file():
            raise SystemExit(f"--conf-file: {given.conf_file!r} given for --algo {algo}; accepted is a YAML file")
        entries = yaml.safe_load(path.read_text())
        if env_id not in entries:
            raise SystemExit(f"--env: {env_id!r} given; {path.name} has settings for {', '.join(sorted(entries))}")
        hyperparams = entries[env_id]
    if algo not in ALGOS:
        raise SystemExit(f"--algo: {algo!r} given; accepted are {', '.join(sorted(ALGOS))}")
    if env_id not in gym.registry:
        gym.register_envs(importlib.import_module("gymnasium_robotics"))
    if env_id not in gym.registry:
        raise SystemExit(f"--env: {env_id!r} given; accepted is the id of a registered environment")
    merged = {**hyperparams, **given.override}
    run(algo, env_id, seed, {name: _number(value) for name, value in merged.items()}, given.out)


def _settings(text: str) -> dict[str, Any]:
    """Of ``--override``."""
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


if __name__ == "__main__":
    main()
