"""Batches of observations: arrays or tensors, or dicts of such."""

from typing import Any


def batch_size(observations: Any) -> int:
    """
    :param observations: N of them
    :return: N
    """
    return len(next(iter(observations.values())) if isinstance(observations, dict) else observations)


def repeated(observations: Any, n: int) -> Any:
    """
    :param observations: Tensors of N of them, or a dict of such
    :param n: How often
    :return: Each of them n times in a row, N * n
    """
    if isinstance(observations, dict):
        return {key: repeated(each, n) for key, each in observations.items()}
    return observations.repeat_interleave(n, 0)


def rows_of(observations: Any, rows: Any) -> Any:
    """
    :param observations: Arrays or tensors of N of them, or a dict of such
    :param rows: Indices of some
    :return: Those
    """
    return (
        {key: rows_of(each, rows) for key, each in observations.items()}
        if isinstance(observations, dict)
        else observations[rows]
    )
