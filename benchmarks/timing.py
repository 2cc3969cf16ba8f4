"""How the benchmarks measure."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np


def median_ms(calls: dict[str, Callable[[], Any]], seconds: float) -> dict[str, float]:
    """
    In turns, so that what slows the machine slows all of them.

    :param calls: What to measure
    :param seconds: For how long
    :return: Median milliseconds of CPU by name
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(next(iter(times.values()))) < 3:
        for name, call in calls.items():
            started = time.process_time()
            call()
            times[name].append(time.process_time() - started)
    return {name: 1e3 * float(np.median(values)) for name, values in times.items()}
