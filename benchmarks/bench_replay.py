"""
The replay buffer at 1e4 to 1e6 transitions: time to sample a batch, to add a step of all environments, and memory. All in one
run, one thread; the ratio says whether cost depends on size. Usage: ``python benchmarks/bench_replay.py [--batch 4096]``
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_ddiffpg import ModeReplayBuffer

OBSERVATION_DIM, ACTION_DIM, N_ENVS, LENGTH, N_MODES = 29, 8, 256, 500, 4
SIZES = (10_000, 100_000, 1_000_000)


def filled(size: int) -> tuple[ModeReplayBuffer, Callable[[], None]]:
    """
    :param size: Capacity, in transitions
    :return: A full buffer whose trajectories belong to modes, and a function that adds one step of all environments
    """
    n_envs, length = min(N_ENVS, size // 100), min(LENGTH, 50 if size < 100_000 else LENGTH)
    observation_space = spaces.Box(-np.inf, np.inf, (OBSERVATION_DIM,), dtype=np.float32)
    action_space = spaces.Box(-1.0, 1.0, (ACTION_DIM,), dtype=np.float32)
    buffer = ModeReplayBuffer(size, observation_space, action_space, "cpu", n_envs, mode_features=[0, 1])
    rng, steps = np.random.default_rng(0), 0
    obs = rng.normal(size=(n_envs, OBSERVATION_DIM)).astype(np.float32)
    action, reward = np.zeros((n_envs, ACTION_DIM), dtype=np.float32), np.zeros(n_envs)
    offsets = np.arange(n_envs) * length // n_envs

    def add() -> None:
        nonlocal steps
        steps += 1
        done = (steps + offsets) % length == 0
        infos: list[dict[str, Any]] = [{"is_success": bool((steps + i) % 2)} for i in range(n_envs)]
        buffer.add(obs, obs, action, reward, done, infos)

    while not buffer.full:
        add()
    successes, failures = buffer.trajectories(True), buffer.trajectories(False)
    labels = [np.arange(len(part)) % N_MODES for part in (successes, failures)]
    buffer.assign_modes(successes, labels[0], failures, labels[1], [None] * N_MODES)
    return buffer, add


def median_ms(call: Callable[[], Any], seconds: float) -> float:
    """
    :param call: What to measure
    :param seconds: For how long
    :return: Median milliseconds of CPU
    """
    times = []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        started = time.process_time()
        call()
        times.append(time.process_time() - started)
    return 1e3 * float(np.median(times))


def megabytes(buffer: ModeReplayBuffer) -> float:
    """
    :param buffer: A buffer
    :return: Size of its arrays
    """
    arrays = [getattr(buffer, name) for name in buffer._row_arrays()]
    return sum(array.nbytes for array in arrays) / 1e6


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3.0, help="time spent on each entry")
    parser.add_argument("--batch", type=int, default=4096, help="transitions of a sample")
    given = parser.parse_args()
    print(f"transitions   sample {given.batch} (ms)   add, per environment (us)     MB   bytes/transition")
    first: tuple[float, float] | None = None
    for size in SIZES:
        buffer, add = filled(size)
        sample = median_ms(lambda buffer=buffer: buffer.sample_modes(given.batch, 0.99, 1, 1), given.seconds)  # type: ignore[misc]
        adding = 1e3 * median_ms(add, given.seconds) / buffer.n_envs
        first = first or (sample, adding)
        memory = megabytes(buffer)
        print(
            f"{size:>11,} {sample:12.2f} ({sample / first[0]:4.2f}x) {adding:19.2f} ({adding / first[1]:4.2f}x)"
            f" {memory:6.0f} {1e6 * memory / size:18.0f}"
        )


if __name__ == "__main__":
    main()
