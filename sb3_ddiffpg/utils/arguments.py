"""Arguments of the algorithms: what they accept, in which groups, and how they were given in version 0.1."""

import difflib
import inspect
import warnings
from collections.abc import Mapping
from typing import Any

from sb3_ddiffpg.utils.settings import (
    POSITIVE,
    POSITIVE_OR_INFINITE,
    RATE,
    SHARE,
    Accepted,
    Settings,
    at_least,
    is_integer,
)


def _is_frequency(value: Any) -> bool:
    frequency, unit = value if isinstance(value, tuple) and len(value) == 2 else (value, "step")
    return is_integer(frequency) and frequency >= 1 and getattr(unit, "value", unit) in ("step", "episode")


#: Arguments that every algorithm has beside its groups of settings
ACCEPTED: dict[str, Accepted] = {
    "learning_rate": RATE,
    "qf_learning_rate": RATE.or_none(),
    "buffer_size": at_least(1),
    "learning_starts": at_least(0),
    "batch_size": at_least(1),
    "tau": SHARE,
    "gamma": SHARE,
    "train_freq": Accepted("be an integer of at least 1, or a tuple of one and 'step' or 'episode'", _is_frequency),
    "gradient_steps": at_least(-1),
    "n_steps": at_least(1),
    "reward_scale": POSITIVE,
    "max_grad_norm": POSITIVE_OR_INFINITE,
    "success_key": Accepted("be a string or None", lambda value: value is None or isinstance(value, str)),
}
#: Arguments of version 0.1 that are gone, what they were when nothing was said, and what is left to do
GONE: dict[str, tuple[Any, str]] = {
    "switch_modes": (0.0, "no episode that follows a mode goes on with another one"),
    "min_return_ratio": (0.0, "delete_mode removes a mode that returns too little"),
    "control": (None, "see sb3_ddiffpg.experiments.ablations"),
}


def accepted_by(algorithm: type) -> dict[str, Accepted]:
    """
    :param algorithm: One of this package's
    :return: What its arguments accept, by name, without groups
    """
    own = [vars(each).get("accepted", {}) for each in reversed(algorithm.__mro__)]
    return {**ACCEPTED, **{name: each for part in own for name, each in part.items()}}


def constructor_arguments(algorithm: type) -> set[str]:
    """
    :param algorithm: A class whose constructor may hand ``**kwargs`` on to the one above it
    :return: Names of all that it takes, but for those of version 0.1
    """
    arguments: set[str] = set()
    for each in algorithm.__mro__:
        if "__init__" in vars(each):
            parameters = inspect.signature(vars(each)["__init__"]).parameters.values()
            arguments |= {parameter.name for parameter in parameters if parameter.kind is not parameter.VAR_KEYWORD}
            if not any(parameter.name == "kwargs" for parameter in parameters):
                break
    groups = groups_of(algorithm) if hasattr(algorithm, "settings_groups") else {}
    return (arguments | set(groups)) - {"self"}


def check_arguments(algorithm: type, arguments: Mapping[str, Any]) -> None:
    """
    :param algorithm: One of this package's
    :param arguments: Some of its arguments, by name; groups as dicts or settings
    :raises ValueError: For the first that is not accepted, naming it
    """
    groups, accepted = groups_of(algorithm), accepted_by(algorithm)
    changes, rest = _sorted_out(algorithm, arguments)
    for name, value in rest.items():
        if name in accepted:
            accepted[name].check(name, value)
    for group, each in changes.items():
        groups[group].of(each)


def groups_of(algorithm: type) -> dict[str, type[Settings]]:
    """
    :param algorithm: One of this package's
    :return: Its groups of settings, by the argument that takes them
    """
    return {kind.group: kind for kind in algorithm.settings_groups}  # type: ignore[attr-defined]


def flat_names(algorithm: type) -> dict[str, tuple[str, str]]:
    """
    :param algorithm: One of this package's
    :return: Arguments of version 0.1, and the groups and settings that they are now
    """
    return {flat: (group, name) for group, kind in groups_of(algorithm).items() for flat, name in kind.flat_names().items()}


def settings_attribute(group: str) -> str:
    """
    :param group: Name of a group, as an argument
    :return: Name of the attribute that holds it
    """
    return f"{group.removesuffix('s')}_settings"


def single_setting(algorithm: type, name: str) -> tuple[str, str] | None:
    """
    :param algorithm: One of this package's
    :param name: ``"critic.v_max"``, or a flat name of version 0.1
    :return: The group and the setting that are meant, None if it is neither
    """
    group, dot, setting = name.partition(".")
    return (group, setting) if dot and group in groups_of(algorithm) else flat_names(algorithm).get(name)


def _sorted_out(algorithm: type, given: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arguments, in groups or one by one, as changes of groups, and the rest."""
    groups = groups_of(algorithm)
    changes: dict[str, Any] = {}
    rest = {}
    for name, value in given.items():
        if (single := single_setting(algorithm, name)) is not None:
            changes.setdefault(single[0], {})[single[1]] = value
        elif name not in groups:
            rest[name] = value
    for group, kind in groups.items():
        value = given.get(group)
        if isinstance(value, Settings):
            changes[group] = value if group not in changes else {**value.to_dict(), **changes[group]}
        elif isinstance(value, Mapping):
            changes[group] = {**value, **changes.get(group, {})}
        elif value is not None:
            changes[group] = {**kind.short_form(value), **changes.get(group, {})}
    return changes, rest


def grouped(algorithm: type, arguments: Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """
    :param algorithm: One of this package's
    :param arguments: Some of its arguments, as today or in version 0.1
    :param changes: Others, which hold where both say something; of a group, setting by setting
    :return: The arguments of today, groups as dicts
    """
    found = {}
    for each in (arguments, changes or {}):
        groups, rest = _sorted_out(algorithm, each)
        found.update({name: value for name, value in rest.items() if name not in GONE})
        for group, some in groups.items():
            some = some.to_dict() if isinstance(some, Settings) else some
            found[group] = {**found.get(group, {}), **some}
    return found


def take_settings(model: Any, given: Mapping[str, Any]) -> None:
    """
    Set the groups of settings of a model that is made.

    :param model: One of this package's algorithms
    :param given: Groups by argument, and further arguments as in version 0.1
    :raises TypeError: If there is no such argument
    :raises ValueError: If a value is not accepted
    """
    algorithm = type(model)
    groups, names = groups_of(algorithm), flat_names(algorithm)
    for name, value in given.items():
        if name in groups or single_setting(algorithm, name) is not None:
            continue
        if name in GONE:
            default, instead = GONE[name]
            if value != default:
                raise TypeError(f"{name}={value!r} is no argument any more: {instead}")
            continue
        near = difflib.get_close_matches(name, sorted(constructor_arguments(algorithm)))
        hint = f"; did you mean {' or '.join(map(repr, near))}?" if near else ""
        raise TypeError(f"{algorithm.__name__} has no argument {name!r}{hint}")
    old = {name: value for name, value in given.items() if name in names}
    if old:
        warnings.warn(f"Arguments of version 0.1: instead of {_call(old)} write {_grouped(names, old)}", FutureWarning)
    changes, _ = _sorted_out(algorithm, given)
    for group, kind in groups.items():
        setattr(model, settings_attribute(group), kind.of(changes.get(group)))


def _call(arguments: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in arguments.items())


def _grouped(names: Mapping[str, tuple[str, str]], old: Mapping[str, Any]) -> str:
    groups: dict[str, dict[str, Any]] = {}
    for name, value in old.items():
        group, setting = names[name]
        groups.setdefault(group, {})[setting] = value
    return ", ".join(f"{group}=dict({_call(each)})" for group, each in groups.items())


def one_by_one(algorithm: type, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param algorithm: One of this package's
    :param arguments: Some of its arguments
    :return: The same with ``"critic.v_max"`` in place of groups, so that they change a group without replacing it
    """
    changes, rest = _sorted_out(algorithm, arguments)
    groups = {group: each.to_dict() if isinstance(each, Settings) else each for group, each in changes.items()}
    return {**rest, **{f"{group}.{name}": value for group, each in groups.items() for name, value in each.items()}}


def absorb_settings(model: Any) -> None:
    """
    SB3's ``load`` sets attributes by the names of arguments, those of a file and those that are given. Make groups of settings
    of them, whatever version the file is of.

    :param model: One of this package's algorithms
    :raises ValueError: If a value is not accepted
    """
    algorithm, groups = type(model), groups_of(type(model))
    attributes = vars(model)
    names = [name for name in attributes if name in groups or single_setting(algorithm, name) is not None]
    found = {name: attributes.pop(name) for name in names}
    for name, (default, instead) in GONE.items():
        if attributes.pop(name, default) != default:
            warnings.warn(f"The model was made with {name}, which is no argument any more: {instead}")
    changes, _ = _sorted_out(algorithm, found)
    for group, kind in groups.items():
        attribute = settings_attribute(group)
        setattr(model, attribute, kind.of(changes.get(group), attributes.get(attribute)))
