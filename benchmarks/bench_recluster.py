"""
Re-clustering: all successes new, and 50 new ones beside known ones, one thread.

Usage: ``python benchmarks/bench_recluster.py [--points 100]``
"""

import argparse
import time

import numpy as np

from sb3_ddiffpg.clustering.distance_cache import DistanceCache
from sb3_ddiffpg.clustering.linkage import cluster

COUNTS = (50, 200, 500, 1000, 2000)
N_NEW, N_ROUTES = 50, 4


def paths(n: int, n_points: int, rng: np.random.Generator) -> list[np.ndarray]:
    """
    :param n: How many
    :param n_points: Points in each
    :param rng: Draws them
    :return: Noisy copies of a few routes, each [n_points, 2]
    """
    ends = np.array([(10, 10), (10, -10), (-10, 10), (-10, -10)])
    line = np.linspace(0, 1, n_points)[:, None]
    walks = [0.1 * rng.normal(size=(n_points, 2)).cumsum(axis=0) for _ in range(n)]
    return [(line * ends[i % N_ROUTES] + walk).astype(np.float32) for i, walk in enumerate(walks)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=100, help="of a path")
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    DistanceCache()(np.arange(40), paths(40, given.points, rng))  # compiles
    print("successes    distances, all new (s)    50 new (s)    tree and cut (s)   modes")
    for n in COUNTS:
        cache, some = DistanceCache(), paths(n + N_NEW, given.points, rng)
        started = time.process_time()
        distances = cache(np.arange(n), some[:n])
        cold = time.process_time() - started
        started = time.process_time()
        labels = cluster(distances, None)
        cut = time.process_time() - started
        started = time.process_time()
        cache(np.arange(n + N_NEW), some)
        warm = time.process_time() - started
        print(f"{n:9d} {cold:25.2f} {warm:13.2f} {cut:19.2f} {labels.max() + 1:7d}")


if __name__ == "__main__":
    main()
