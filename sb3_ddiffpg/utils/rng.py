"""Random states that stay as they were while a model is looked at."""

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th


@contextmanager
def preserved_rng() -> Iterator[None]:
    """What is drawn inside leaves the global random states of Python, NumPy and PyTorch as they were."""
    states = random.getstate(), np.random.get_state(), th.get_rng_state()
    cuda = th.cuda.get_rng_state_all() if th.cuda.is_available() else []
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])
        th.set_rng_state(states[2])
        if cuda:
            th.cuda.set_rng_state_all(cuda)
