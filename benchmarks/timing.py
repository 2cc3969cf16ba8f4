"""How the benchmarks measure."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th


def clock(device: str) -> float:
    """
    :param device: Where the work is done
    :return: Seconds of this process's CPU; with an accelerator, seconds of wall clock once its work is done
    """
    if device == "cpu":
        return time.process_time()
    th.accelerator.synchronize()
    return time.perf_counter()


def median_ms(calls: dict[str, Callable[[], Any]], seconds: float, device: str = "cpu") -> dict[str, float]:
    """
    In turns, so that what slows the machine slows all of them.

    :param calls: What to measure
    :param seconds: For how long
    :param device: Where the work is done
    :return: Median milliseconds by name, see ``clock``
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(next(iter(times.values()))) < 3:
        for name, call in calls.items():
            started = clock(device)
            call()
            times[name].append(clock(device) - started)
    return {name: 1e3 * float(np.median(values)) for name, values in times.items()}
