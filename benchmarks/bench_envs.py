"""
Environment steps per second with random actions, all variants in one run: this package's vectorised mazes beside SB3's
DummyVecEnv and, for the ant, gymnasium-robotics' own maze. Memory is what the process holds more after making them.

Only ratios carry over to another machine. Usage: ``python benchmarks/bench_envs.py [--seconds 3] [--envs 256]``
"""

import argparse
import contextlib
import gc
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import gymnasium_robotics
import numpy as np
from stable_baselines3.common.env_util import make_vec_env as make_sb3_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.envs import HideGoal, make_vec_env

PAGE = resource.getpagesize()


def resident() -> float:
    """
    :return: memory held by this process and its children, in MB; NaN where the system does not say
    """
    if not Path("/proc/self/statm").exists():
        return float("nan")
    parents = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it may have ended since
            parents[int(status.parent.name)] = int(status.read_text().rpartition(")")[2].split()[1])
    family = {os.getpid()}
    while more := {child for child, parent in parents.items() if parent in family} - family:
        family |= more
    total = 0
    for process in family:
        with contextlib.suppress(OSError):
            total += int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return total * PAGE / 1e6


def steps_per_second(env: VecEnv, seconds: float) -> float:
    """
    :param env: is closed in the end
    :param seconds: measured in five parts, of which the median counts
    :return: steps of all environments per second of wall time
    """
    rng = np.random.default_rng(0)
    shape = (env.num_envs, *env.action_space.shape)
    actions = rng.uniform(-1, 1, (16, *shape)).astype(np.float32)
    env.reset()
    rates = []
    for _ in range(5):
        start, n = time.perf_counter(), 0
        while time.perf_counter() - start < seconds / 5:
            env.step(actions[n % 16])
            n += 1
        rates.append(n * env.num_envs / (time.perf_counter() - start))
    env.close()
    return float(np.median(rates))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3.0, help="time spent on each variant")
    parser.add_argument("--envs", type=int, default=256, help="number of environments")
    arguments = parser.parse_args()
    n = arguments.envs
    gym.register_envs(gymnasium_robotics)
    ant = "AntMazeV3-v0"

    def robotics() -> VecEnv:
        return make_sb3_vec_env("AntMaze_UMaze-v5", 1, wrapper_class=HideGoal)

    variants: list[tuple[str, Callable[[], VecEnv]]] = [
        ("point, DummyVecEnv", lambda: make_sb3_vec_env("PointMazeV3-v0", n)),
        (f"point, ours, {n}", lambda: make_vec_env("PointMazeV3-v0", n)),
        ("point random, ours", lambda: make_vec_env("PointMazeRandom-v0", n)),
        ("AntMaze_UMaze-v5, 1", robotics),
    ]
    for integrator in ("rk4", "euler"):
        variants += [
            (f"ant {integrator}, ours, 1", lambda i=integrator: make_vec_env(ant, 1, integrator=i)),
            (f"ant {integrator}, DummyVecEnv", lambda i=integrator: make_sb3_vec_env(ant, n, env_kwargs={"integrator": i})),
            (f"ant {integrator}, ours, 1 thread", lambda i=integrator: make_vec_env(ant, n, n_threads=1, integrator=i)),
            (f"ant {integrator}, ours, 2 threads", lambda i=integrator: make_vec_env(ant, n, n_threads=2, integrator=i)),
        ]
    try:
        import pybullet  # noqa: F401
    except ImportError:
        print("without pybullet: no arm")
    else:
        variants += [
            ("arm, DummyVecEnv, 16", lambda: make_sb3_vec_env("FrankaDrawerClose-v0", 16)),
            ("arm, ours, 1 worker", lambda: make_vec_env("FrankaDrawerClose-v0", 16, n_threads=1)),
            ("arm, ours, 2 workers", lambda: make_vec_env("FrankaDrawerClose-v0", 16, n_threads=2)),
        ]
    print(f"{'variant':<28} {'steps/s':>12} {'to DummyVecEnv':>15} {'MB':>7}")
    reference = float("nan")
    for name, make in variants:
        gc.collect()
        before = resident()
        env = make()
        env.reset()
        memory = resident() - before
        rate = steps_per_second(env, arguments.seconds)
        if "DummyVecEnv" in name:
            reference = rate
        ratio = f"{rate / reference:14.1f}x" if "ours, " in name and not name.endswith(", 1") else " " * 15
        print(f"{name:<28} {rate:>12,.0f} {ratio} {memory:>7.0f}", flush=True)
        del env


if __name__ == "__main__":
    main()
