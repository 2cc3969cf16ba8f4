"""Constructor arguments as plain values: numbers, lists, dicts, arrays, and a closed list of classes by their names."""

import importlib
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

# Modules and the names in them that a file may ask for: nothing else is ever imported or called on its behalf
CLASSES: dict[str, tuple[str, ...]] = {
    "numpy": ("float32", "float64"),
    "torch.nn": (
        *("CELU", "ELU", "GELU", "Hardswish", "Hardtanh", "LeakyReLU", "LogSigmoid", "Mish", "PReLU", "ReLU", "ReLU6"),
        *("RReLU", "SELU", "SiLU", "Sigmoid", "Softplus", "Softsign", "Tanh"),
    ),
    "torch.optim": ("Adagrad", "Adam", "AdamW", "Adamax", "NAdam", "RAdam", "RMSprop", "SGD"),
    "stable_baselines3.common.torch_layers": ("CombinedExtractor", "FlattenExtractor", "NatureCNN"),
}
# Those of which an object may be made, by setting its attributes
OBJECTS: dict[str, tuple[str, ...]] = {
    "stable_baselines3.common.utils": ("ConstantSchedule", "FloatSchedule", "LinearSchedule"),
    "stable_baselines3.common.noise": ("NormalActionNoise", "OrnsteinUhlenbeckActionNoise", "VectorizedActionNoise"),
    "rl_zoo3.utils": ("SimpleLinearSchedule",),
}


# The same for our own classes, which register themselves; wherever they move, their names in files stay
_OWN_CLASSES: dict[str, type] = {}
_OWN_OBJECTS: dict[str, type] = {}
Kind = TypeVar("Kind", bound=type)


def registered(name: str, objects: bool = False) -> Callable[[Kind], Kind]:
    """
    Let files name a class of ours.

    :param name: By which they do, for ever
    :param objects: Whether an object of it may be made, by setting its attributes; otherwise the class itself is named
    :return: A decorator of the class
    """

    def register(kind: Kind) -> Kind:
        (_OWN_OBJECTS if objects else _OWN_CLASSES)[name] = kind
        return kind

    return register


class NeededError(ValueError):
    """A value is not in the file, because it is code."""


def to_plain(value: Any) -> Any:
    """
    :param value: A constructor argument
    :return: What ``from_plain`` makes it of again; what is code becomes a note of what it was
    """
    if value is None or isinstance(value, (bool, int, float, str, np.ndarray)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if type(value) is list:
        return [to_plain(each) for each in value]
    if isinstance(value, tuple):
        return {"tuple": [to_plain(each) for each in value]}
    if isinstance(value, Mapping) and all(isinstance(key, str) and key[:1] != "$" for key in value):
        return {"dict": {key: to_plain(each) for key, each in value.items()}}
    if isinstance(value, type):
        name = _listed_name(value, CLASSES, _OWN_CLASSES)
        return {"needed": _full_name(value)} if name is None else {"class": name}
    if (name := _listed_name(type(value), OBJECTS, _OWN_OBJECTS)) is not None:
        return {"object": name, "state": {key: to_plain(each) for key, each in vars(value).items()}}
    return {"needed": getattr(value, "__qualname__", _full_name(type(value)))}


def from_plain(plain: Any) -> Any:
    """
    :param plain: What ``to_plain`` gave, or anything else that was in a file
    :return: The value
    :raises NeededError: If it was code
    :raises ValueError: If it is nothing that ``to_plain`` gives
    """
    if plain is None or isinstance(plain, (bool, int, float, str, np.ndarray)):
        return plain
    if isinstance(plain, list):
        return [from_plain(each) for each in plain]
    if isinstance(plain, dict):
        match plain:
            case {"tuple": list(values)} if len(plain) == 1:
                return tuple(from_plain(each) for each in values)
            case {"dict": dict(values)} if len(plain) == 1:
                return {key: from_plain(each) for key, each in values.items()}
            case {"class": str(name)} if len(plain) == 1:
                return _find(name, CLASSES, _OWN_CLASSES)
            case {"object": str(name), "state": dict(state)} if len(plain) == 2:
                return _make(_find(name, OBJECTS, _OWN_OBJECTS), state)
            case {"needed": str(name)} if len(plain) == 1:
                raise NeededError(name)
    raise ValueError(f"{str(plain)[:100]!r} is no value that is saved here")


def _full_name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__name__}"


def _listed_name(kind: type, table: dict[str, tuple[str, ...]], own: dict[str, type]) -> str | None:
    """Of the class itself, not of another one that is called the same; None if no file may name it."""
    for name, registered_kind in own.items():
        if registered_kind is kind:
            return name
    for module, names in table.items():
        if kind.__name__ in names and kind.__module__.split(".")[0] == module.split(".")[0]:
            if getattr(importlib.import_module(module), kind.__name__, None) is kind:
                return f"{module}.{kind.__name__}"
    return None


def _find(name: str, table: dict[str, tuple[str, ...]], own: dict[str, type]) -> Any:
    if name in own:
        return own[name]
    module, _, attribute = name.rpartition(".")
    if attribute not in table.get(module, ()):
        raise ValueError(f"{name[:100]!r} is not among the classes that a file may name")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{name!r} is not there: {error}") from None


def _make(kind: Any, state: dict[str, Any]) -> Any:
    made = kind.__new__(kind)
    for key, each in state.items():
        if not key.isidentifier() or key.startswith("__") or (hasattr(kind, key) and callable(getattr(kind, key))):
            raise ValueError(f"{key[:100]!r} is no attribute of a {kind.__name__}")
        setattr(made, key, from_plain(each))
    return made
