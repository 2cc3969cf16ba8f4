"""
The whole loop of training: milliseconds of wall clock for each step of all environments, by part, with different numbers of
torch's and the simulator's threads, beside SB3's TD3 with as many updates of the same batch and hidden sizes.

Usage: ``python benchmarks/bench_loop.py [--seconds 20] [--env PointMazeV1-v0 AntMazeV1-v0]``, or for a GPU, at the
paper's sizes, ``python benchmarks/bench_loop.py --paper [--precision high]``
"""

import argparse
import os
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch as th
import yaml
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.common.presets import config_file, preset
from sb3_ddiffpg.envs import make_vec_env

CONFIG = {"PointMazeV1-v0": "ddiffpg", "AntMazeV1-v0": "ddiffpg-cpu"}


class StopAfter(BaseCallback):
    """
    Ends the training after so many seconds, and forgets what was measured in the first fifth of them.

    :param seconds: Of wall clock, from the end of the random actions on
    :param times: By part
    """

    def __init__(self, seconds: float, times: dict[str, float]) -> None:
        super().__init__()
        self.seconds, self.times = seconds, times
        self.started = self.measured_from = 0.0

    def _on_step(self) -> bool:
        now = time.perf_counter()
        if self.num_timesteps <= self.model.learning_starts:  # type: ignore[attr-defined]
            self.started = now
        elif not self.measured_from and now > self.started + self.seconds / 5:
            self.times.clear()
            self.measured_from = now
        self.times["steps"] += 1
        return not self.measured_from or now < self.measured_from + self.seconds


def timed(owner: Any, method: str, name: str, times: dict[str, float]) -> None:
    """
    :param owner: Object
    :param method: Of it, whose calls are to be timed
    :param name: Under which
    :param times: Where
    """
    function: Callable[..., Any] = getattr(owner, method)

    def call(*args: Any, **kwargs: Any) -> Any:
        started = time.perf_counter()
        result = function(*args, **kwargs)
        times[name] += time.perf_counter() - started
        return result

    setattr(owner, method, call)


def measure(
    algo: str, env_id: str, conf_file: str, torch_threads: int, simulator_threads: int, seconds: float
) -> dict[str, float]:
    """
    :param algo: "DDiffPG" or "TD3"
    :param env_id: Of the environments
    :param conf_file: With their settings
    :param torch_threads: Threads of torch
    :param simulator_threads: Threads that step the environments
    :param seconds: For how long
    :return: Milliseconds of a step of all environments, by part
    """
    th.set_num_threads(torch_threads)
    path = config_file(conf_file)
    assert path is not None
    entry = yaml.safe_load(path.read_text())[env_id]
    kwargs = {**entry.get("env_kwargs", {}), **({"n_threads": simulator_threads} if env_id.startswith("Ant") else {})}
    env = make_vec_env(env_id, entry["n_envs"], seed=0, **kwargs)
    if algo == "DDiffPG":
        model: Any = DDiffPG.from_preset(f"{conf_file}:{env_id}", env, seed=0)
    else:
        settings = preset(f"{conf_file}:{env_id}")
        sizes = settings.get("policy_kwargs", {}).get("net_arch", [128, 128])
        names = ("learning_starts", "gradient_steps", "batch_size", "gamma")
        shared = {"gradient_steps": 1, **{name: settings[name] for name in names if name in settings}}
        model = TD3("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": sizes}, **shared)
    model.set_logger(configure(None, []))
    times: dict[str, float] = defaultdict(float)
    timed(env, "step", "simulation", times)
    timed(model, "_sample_action", "acting", times)
    timed(model, "_store_transition", "storing", times)
    timed(model, "train", "updates", times)
    if algo == "DDiffPG":
        timed(model, "recluster", "re-clustering", times)
    model.learn(10**9, callback=StopAfter(seconds, times), log_interval=10**9)
    env.close()
    steps = times.pop("steps")
    elapsed = {name: 1e3 * value / steps for name, value in times.items()}
    return {**elapsed, "environment steps/s": env.num_envs / sum(elapsed.values()) * 1e3}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="time spent on each row")
    parser.add_argument("--env", nargs="*", default=list(CONFIG), choices=list(CONFIG))
    parser.add_argument("--paper", action="store_true", help="AntMazeV1-v0 with the paper's sizes, and nothing else")
    parser.add_argument("--precision", default="highest", help="of products in 32 bits: highest, or high (TF32 on a GPU)")
    given = parser.parse_args()
    th.set_float32_matmul_precision(given.precision)
    parts = ("simulation", "acting", "storing", "updates", "re-clustering", "environment steps/s")
    cores = os.cpu_count() or 1
    if given.paper:
        given.env = []
        print("AntMazeV1-v0, the paper's sizes")
        for name, value in measure("DDiffPG", "AntMazeV1-v0", "ddiffpg", 4, cores, given.seconds).items():
            print(f"  {name:<20} {value:9.2f}")
    for env_id in given.env:
        print(f"\n{env_id:<14} torch simulator   " + " ".join(f"{part:>13}" for part in parts))
        counts = (
            [(1, 1)]
            if cores == 1
            else [(1, 1), (cores, 1)]
            if env_id.startswith("Point")
            else [(1, 1), (1, cores), (cores, cores)]
        )
        for algo, threads in [*(("DDiffPG", each) for each in counts), ("TD3", counts[0])]:
            found = measure(algo, env_id, CONFIG[env_id], *threads, seconds=given.seconds)
            print(f"{algo:<14} {threads[0]:5d} {threads[1]:9d}   " + " ".join(f"{found.get(part, 0):13.2f}" for part in parts))


if __name__ == "__main__":
    main()
