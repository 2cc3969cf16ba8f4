"""What of a model is neither parameter nor argument: counters, and the records of its parts, in plain values and arrays."""

import contextlib
from typing import Any

from sb3_ddiffpg.saving._legacy import state_of_0_1
from sb3_ddiffpg.serialization.codec import NeededError, from_plain, to_plain
from sb3_ddiffpg.serialization.safetensors_tree import convert


def declared(algorithm: type, name: str) -> dict[str, Any]:
    """
    :param algorithm: A class
    :param name: Of a class attribute, a dict
    :return: What it and the classes above it declare there, together
    """
    return {key: each for kind in reversed(algorithm.__mro__) for key, each in vars(kind).get(name, {}).items()}


def parts_tree(model: Any, to_train: bool = True) -> dict[str, Any]:
    """
    :param model: One of this package's algorithms
    :param to_train: Whether what only training needs is part of it
    :return: What its parts know beside parameters
    """
    parts = {name: getattr(model, attribute) for name, attribute in declared(type(model), "_parts").items()}
    return {
        name: part.acting_state() if not to_train and hasattr(part, "acting_state") else part.state_dict()
        for name, part in parts.items()
    }


def saved_part(model: Any, name: str) -> Any:
    """
    :param model: One of this package's algorithms, while it is made of a file
    :param name: Of a part
    :return: What the file says of it, None if nothing
    """
    return None if model.saved_parts is None else model.saved_parts.get(name)


def state_tree(model: Any) -> dict[str, Any]:
    """
    :param model: One of this package's algorithms
    :return: Its numbers and records
    """
    return {
        "counters": {name: getattr(model, name) for name in declared(type(model), "_counters")},
        "mode_features": to_plain(model.resolved_features),
        "novelty_cell_size": model.novelty_cell_size,
        "parts": parts_tree(model),
    }


def load_state_tree(model: Any, tree: Any) -> None:
    """
    :param model: One of this package's algorithms, whose parts are not made yet
    :param tree: What ``state_tree`` gave, here or in version 0.1
    :raises ValueError: If it is something else
    """
    tree = state_of_0_1(tree)
    counters = convert(tree.get("counters"), dict[str, Any], "model.state.counters")
    known = declared(type(model), "_counters")
    if not set(counters) <= set(known):
        raise ValueError(f"model.state.counters: {sorted(counters)} given; accepted are {sorted(known)}")
    for name, value in counters.items():  # what an older file does not have begins anew
        setattr(model, name, convert(value, known[name], f"model.state.counters.{name}"))
    with contextlib.suppress(NeededError):  # then the constructor's argument says it
        model.resolved_features = from_plain(tree.get("mode_features"))
    model.novelty_cell_size = convert(tree.get("novelty_cell_size"), float | None, "model.state.novelty_cell_size")
    model.saved_parts = convert(tree.get("parts"), dict[str, Any], "model.state.parts")


def episodes_tree(model: Any) -> dict[str, Any]:
    """
    :param model: One of this package's algorithms
    :return: What drives its episodes in progress
    """
    part = type(model).episode_part
    return {} if part is None else getattr(model, part).state_dict()


def load_episodes_tree(model: Any, tree: Any) -> None:
    """
    :param model: One of this package's algorithms
    :param tree: What ``episodes_tree`` gave
    :raises ValueError: If it is something else
    """
    part = type(model).episode_part
    if part is not None:
        getattr(model, part).load_state_dict(tree, model.n_envs)
