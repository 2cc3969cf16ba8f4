"""How many processors there are."""

import os


def n_processors() -> int:
    """
    :return: Processors that this process may use
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
