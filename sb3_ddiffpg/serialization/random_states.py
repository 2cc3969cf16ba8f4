"""Random states told in plain values, so that a run can go on in another process."""

import random
from typing import Any

import msgspec
import numpy as np

from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert


class _Global(msgspec.Struct, forbid_unknown_fields=True):
    python: tuple[int, list[int], float | None]
    numpy_key: np.ndarray
    numpy_rest: tuple[int, int, float]
    torch: np.ndarray
    cuda: list[np.ndarray]


def global_rng() -> dict[str, Any]:
    """
    :return: The global random states of Python, NumPy and PyTorch
    """
    import torch as th  # only here: workers restore generators alone

    version, numbers, gauss = random.getstate()
    name, key, *rest = np.random.get_state(legacy=True)
    assert name == "MT19937"
    cuda = th.cuda.get_rng_state_all() if th.cuda.is_available() else []
    return {
        "python": [version, list(numbers), gauss],
        "numpy_key": key,
        "numpy_rest": rest,
        "torch": th.get_rng_state(),
        "cuda": cuda,
    }


def restore_global_rng(tree: Any) -> None:
    """
    :param tree: What ``global_rng`` gave, on a machine with as many accelerators
    :raises ValueError: If it is something else
    """
    import torch as th

    state = convert(tree, _Global, "random states")
    check_array(state.numpy_key, np.uint32, [624], "random states.numpy")
    check_array(state.torch, np.uint8, [len(th.get_rng_state())], "random states.torch")
    if not 0 <= state.numpy_rest[0] <= 624:  # NumPy would read beyond its array
        raise ValueError(f"random states.numpy: position {state.numpy_rest[0]} given; accepted are 0 to 624")
    # Of torch's generator: how many of its 624 numbers are left, and which is next; it would read beyond them too
    left, following = int(state.torch[8:12].view(np.int32)[0]), int(state.torch[16:24].view(np.uint64)[0])
    if (left, following) != (1, 0) and not (1 <= left <= 624 and left + following == 625):
        raise ValueError(f"random states.torch: {left} left and {following} next given; accepted are 625 together")
    version, numbers, gauss = state.python
    try:
        random.setstate((version, tuple(numbers), gauss))
        np.random.set_state(("MT19937", state.numpy_key, *state.numpy_rest))
        th.set_rng_state(th.from_numpy(state.torch))
        if state.cuda and th.cuda.is_available():
            th.cuda.set_rng_state_all([th.from_numpy(each) for each in state.cuda])
    except (ValueError, TypeError, OverflowError, RuntimeError) as error:
        raise ValueError(f"random states: {error}") from None


def restore_generator(generator: np.random.Generator, state: Any) -> None:
    """
    :param generator: Of an environment
    :param state: What ``generator.bit_generator.state`` was
    :raises ValueError: If it is something else
    """
    try:
        generator.bit_generator.state = state
    except (ValueError, TypeError, KeyError, OverflowError, AttributeError) as error:
        raise ValueError(f"random state of an environment: {error!r}") from None
