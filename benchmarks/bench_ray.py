"""
A step of environments in the actors of a local Ray, beside the same in worker processes and in this process: what it costs to
ask, and to carry observations of different sizes. Medians of the wall clock, all in turns, two workers.

Usage: ``python benchmarks/bench_ray.py [--envs 16] [--seconds 5]``
"""

import argparse
import time

import gymnasium as gym
import numpy as np
import ray
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_ddiffpg.envs.vec_env import RayVecEnv, WorkerVecEnv


class Idle(gym.Env[np.ndarray, np.ndarray]):
    """
    Does nothing for a while.

    :param size: Numbers of an observation
    :param seconds: That a step takes
    """

    def __init__(self, size: int, seconds: float) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (size,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (8,), np.float32)
        self.seconds = seconds

    def reset(self, **_: object) -> tuple[np.ndarray, dict]:
        """Always the same."""
        return np.zeros(self.observation_space.shape, np.float32), {}

    def step(self, _: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """The same again."""
        end = time.perf_counter() + self.seconds
        while time.perf_counter() < end:
            pass
        return np.zeros(self.observation_space.shape, np.float32), 0.0, False, False, {}


def step_ms(envs: dict[str, VecEnv], seconds: float) -> dict[str, float]:
    """
    :param envs: By name
    :param seconds: Spent on each
    :return: Median milliseconds of a step
    """
    times: dict[str, list[float]] = {name: [] for name in envs}
    actions = np.zeros((next(iter(envs.values())).num_envs, 8), np.float32)
    for env in envs.values():
        env.reset()
        env.step(actions)
    end = time.perf_counter() + seconds * len(envs)
    while time.perf_counter() < end:
        for name, env in envs.items():
            started = time.perf_counter()
            env.step(actions)
            times[name].append(1e3 * (time.perf_counter() - started))
    return {name: float(np.median(each)) for name, each in times.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=5.0, help="time spent on each entry")
    given = parser.parse_args()
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, configure_logging=False)
    print(f"{given.envs} environments, ms a step of all    {'one process':>12} {'workers':>10} {'Ray':>10}   Ray - workers")
    for size, seconds in ((30, 0.0), (30, 0.001), (3 * 84 * 84, 0.0)):

        def make(size: int = size, seconds: float = seconds) -> Idle:
            return Idle(size, seconds)

        makers = [make] * given.envs
        envs = {"one": DummyVecEnv(makers), "workers": WorkerVecEnv(makers, 2), "ray": RayVecEnv(makers, 2)}
        found = step_ms(envs, given.seconds)
        what = f"{size} numbers, {1e3 * seconds:g} ms each"
        times = f"{found['one']:12.2f} {found['workers']:10.2f} {found['ray']:10.2f}"
        print(f"{what:<36} {times} {found['ray'] - found['workers']:15.2f}")
        for env in envs.values():
            env.close()


if __name__ == "__main__":
    main()
