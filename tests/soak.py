"""
A long training with a full buffer and many re-clusterings, watched: memory, open files, threads, processes and processor time.
Ends with an error if one of them grew between its second quarter and its last.

    python tests/soak.py                      # 2e6 steps
    python tests/soak.py --steps 200000
"""

import argparse
import sys
import tempfile
from statistics import median

import psutil
from stable_baselines3.common.callbacks import BaseCallback

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.callbacks.checkpoint import RunCheckpointCallback
from sb3_ddiffpg.envs import make_vec_env

N_SAMPLES, N_ENVS = 40, 64
# Shares by which the last quarter may be more than the second, and by how much at least, where a clock is coarse
ALLOWED = {"memory_mb": 0.02, "files": 0.0, "threads": 0.0, "processes": 0.0, "cpu_seconds": 0.15}
RESOLUTION = 0.1


def memory_mb(process: psutil.Process) -> float:
    """
    :param process: Of this machine
    :return: MiB that hold its data. Not those of files: a library's pages are a process's own as soon as no other has it open
    """
    memory = process.memory_info()
    return (memory.rss - getattr(memory, "shared", 0)) / 2**20


class Watch(BaseCallback):
    """
    Measures the process from time to time.

    :param every: Environment steps between two measurements
    """

    def __init__(self, every: int) -> None:
        super().__init__()
        self.every, self.process = every, psutil.Process()
        self.samples: list[dict[str, float]] = []
        self._then = 0.0

    def _on_training_start(self) -> None:
        self._then = self._cpu_seconds()
        print("steps", *ALLOWED, "modes", sep="\t")

    def _cpu_seconds(self) -> float:
        """Not the clock's: others may be busy too."""
        times = self.process.cpu_times()
        return times.user + times.system

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps < self.every * (len(self.samples) + 1):
            return
        now = self._cpu_seconds()
        sample = {
            "memory_mb": memory_mb(self.process),
            "files": self.process.num_fds(),
            "threads": self.process.num_threads(),
            "processes": len(self.process.children(recursive=True)),
            "cpu_seconds": now - self._then,
        }
        self._then = now
        self.samples.append(sample)
        n_modes = len(self.model.modes)  # type: ignore[attr-defined]
        print(self.num_timesteps, *(f"{value:.1f}" for value in sample.values()), n_modes, sep="\t", flush=True)


def grown(samples: list[dict[str, float]]) -> list[str]:
    """
    :param samples: At equal distances
    :return: What grew by more than it may, in words
    """
    quarter = len(samples) // 4
    found = []
    for name, share in ALLOWED.items():
        early, late = (median(each[name] for each in part) for part in (samples[quarter : 2 * quarter], samples[-quarter:]))
        if late - early > max(share * early, RESOLUTION):
            found.append(f"{name}: {early:.1f} in the second quarter, {late:.1f} in the last")
    return found


def main() -> None:
    """Read the command line, train and judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2_000_000)
    parser.add_argument("--env", default="PointMazeV1-v0")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.steps < N_SAMPLES * N_ENVS:
        parser.error(f"--steps must be at least {N_SAMPLES * N_ENVS}, got {options.steps}")
    env = make_vec_env(options.env, N_ENVS, seed=options.seed)
    model = DDiffPG("DiffusionPolicy", env, buffer_size=20_000, recluster_freq=1, seed=options.seed, device="cpu")
    watch = Watch(options.steps // N_SAMPLES)
    with tempfile.TemporaryDirectory() as folder:
        model.learn(options.steps, callback=[watch, RunCheckpointCallback(folder, save_freq=options.steps // 20)])
    problems = grown(watch.samples)
    sys.exit("\n".join(problems) if problems else 0)


if __name__ == "__main__":
    main()
