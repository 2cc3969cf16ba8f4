"""
The replay buffer at 1e4 to 1e6 transitions: time to sample a batch, to add a step of all environments, and memory. All in one
run, one thread; the ratio says whether cost depends on size. Usage: ``python benchmarks/bench_replay.py [--batch 4096]``
"""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from timing import median_ms

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


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=6.0, help="time spent on each column")
    parser.add_argument("--batch", type=int, default=4096, help="transitions of a sample")
    given = parser.parse_args()
    buffers = {f"{size:,}": filled(size) for size in SIZES}
    columns: dict[str, dict[str, float]] = {}
    for n_steps in (1, 5):
        calls = {name: partial(buffer.sample_modes, given.batch, 0.99, 1, n_steps) for name, (buffer, _) in buffers.items()}
        columns[f"sample {given.batch}, {n_steps}-step (ms)"] = median_ms(calls, given.seconds)
    added = median_ms({name: add for name, (_, add) in buffers.items()}, given.seconds)
    columns["add, per environment (us)"] = {name: 1e3 * added[name] / buffers[name][0].n_envs for name in buffers}
    print("transitions   " + "   ".join(f"{title:>27}" for title in columns) + "      MB   bytes/transition")
    smallest = f"{SIZES[0]:,}"
    for size in SIZES:
        name = f"{size:,}"
        cells = [f"{column[name]:18.2f} ({column[name] / column[smallest]:5.2f}x)" for column in columns.values()]
        stored = buffers[name][0].storage_bytes
        print(f"{name:>11}   " + "   ".join(cells) + f"   {stored / 1e6:5.0f} {stored / size:18.0f}")


if __name__ == "__main__":
    main()
