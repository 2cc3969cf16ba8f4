"""
Time of ``predict``, 5 denoising steps, for 1 to 4096 observations, with the small networks and the paper's, one thread.

Usage: ``python benchmarks/bench_acting.py [--seconds 2]``
"""

import argparse
import time
from typing import Any

import numpy as np
import torch as th
from bench_update import Noise
from torch import nn

from sb3_ddiffpg import DDiffPG

NETWORKS: dict[str, dict[str, Any]] = {
    "small, 128-128": {},
    "paper, 1024-512-256": {
        "net_arch": {"pi": [1024, 512, 256], "qf": [64]},
        "activation_fn": nn.Mish,
        "time_embedding_dim": 256,
    },
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=2.0, help="time spent on each entry")
    given = parser.parse_args()
    th.set_num_threads(1)
    print("networks             observations    median ms    99 % ms   us/observation")
    for name, policy_kwargs in NETWORKS.items():
        model = DDiffPG("DiffusionPolicy", Noise(29, 8), policy_kwargs=policy_kwargs, device="cpu")
        for n in (1, 16, 256, 4096):
            observations = np.random.default_rng(0).normal(size=(n, 29)).astype(np.float32)
            model.predict(observations)
            times = []
            end = time.perf_counter() + given.seconds
            while time.perf_counter() < end:
                started = time.perf_counter()
                model.predict(observations)
                times.append(1e3 * (time.perf_counter() - started))
            median = float(np.median(times))
            print(f"{name:<20} {n:12d} {median:12.2f} {np.quantile(times, 0.99):10.2f} {1e3 * median / n:16.1f}")


if __name__ == "__main__":
    main()
