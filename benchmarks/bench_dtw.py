"""
DTW distances between all pairs of a set of paths: this package beside dtaidistance's C, one thread each, in one run.

Only the ratio carries over to another machine. Usage: ``python benchmarks/bench_dtw.py [--seconds 1.0] [--dims 2]``
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
from dtaidistance import dtw_ndim

from sb3_ddiffpg.clustering.dtw import dtw_distances

LENGTHS = (48, 100, 300)


def random_walks(n_paths: int, length: int, dims: int, rng: np.random.Generator) -> list[np.ndarray]:
    """
    :param n_paths: number of paths
    :param length: points in each
    :param dims: coordinates of each point
    :param rng: draws the steps
    :return: float64 paths, each of shape ``[length, dims]``
    """
    return list(rng.normal(size=(n_paths, length, dims)).cumsum(axis=1))


def pairs_per_second(distances: Callable[[], np.ndarray], n_paths: int, seconds: float) -> float:
    """
    :param distances: computes all pairs of ``n_paths`` paths once
    :param n_paths: how many there are
    :param seconds: keep repeating for so long
    :return: pairs per second of process CPU time, of the fastest repetition
    """
    best = np.inf
    end = time.perf_counter() + seconds
    while best == np.inf or time.perf_counter() < end:
        start = time.process_time()
        distances()
        best = min(best, time.process_time() - start)
    return n_paths * (n_paths - 1) / 2 / best


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=1.0, help="time spent on each entry")
    parser.add_argument("--dims", type=int, default=2, help="coordinates of each point")
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    dtw_distances(random_walks(2, 4, arguments.dims, rng))  # compiles, or loads what an earlier run compiled

    print(f"{'length':>6} {'ours, pairs/s':>15} {'dtaidistance C':>15} {'ratio':>7} {'largest difference':>19}")
    for length in LENGTHS:
        # As many paths as keep one repetition near a tenth of a second, for us; the C library gets a part of them.
        many = random_walks(max(64, 20_000 // length), length, arguments.dims, rng)
        few = many[:32]

        def ours(paths: list[np.ndarray] = many) -> np.ndarray:
            return dtw_distances(paths, normalize=False)

        def theirs(paths: list[np.ndarray] = few) -> np.ndarray:
            return dtw_ndim.distance_matrix(paths, ndim=arguments.dims, use_c=True, parallel=False)

        fast = pairs_per_second(ours, len(many), arguments.seconds)
        slow = pairs_per_second(theirs, len(few), arguments.seconds)
        pairs = np.triu_indices(len(few), k=1)
        reference = theirs()[pairs]
        difference = np.abs(ours()[pairs] / reference - 1.0).max()
        print(f"{length:>6} {fast:>15,.0f} {slow:>15,.0f} {fast / slow:>6.1f}x {difference:>19.1e}")


if __name__ == "__main__":
    main()
