"""Settings that check themselves where they are declared."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self

import numpy as np

#: Squares of smaller numbers, and sums of some, fit into 32 bits
LARGEST = 1e18


@dataclass(frozen=True)
class Accepted:
    """
    What a setting accepts.

    :param words: Said of it after "must" in an error
    :param test: Whether a value is accepted; what it raises counts as no
    """

    words: str
    test: Callable[[Any], bool]

    def check(self, name: str, value: Any) -> None:
        """
        :param name: Of the setting
        :param value: Given for it
        :raises ValueError: If it is not accepted
        """
        try:
            right, problem = self.test(value), None
        except Exception as error:  # such as of a schedule
            right, problem = False, error
        if not right:
            why = "" if problem is None else f": {problem!r}"
            raise ValueError(f"{name} must {self.words}, got {value!r}{why}") from problem

    def or_none(self) -> "Accepted":
        """
        :return: The same, or None
        """
        return Accepted(f"{self.words}, or be None", lambda value: value is None or self.test(value))

    def or_schedule(self) -> "Accepted":
        """
        :return: The same, or a function of the remaining progress (from 1 to 0) with such values
        """

        def test(value: Any) -> bool:
            if not callable(value):
                return self.test(value)
            return all(self.test(float(value(progress))) for progress in (1.0, 0.5, 0.0))

        return Accepted(f"{self.words}, or be a schedule of such numbers", test)


def is_integer(value: Any) -> bool:
    """
    :param value: Anything
    :return: Whether it is a whole number of 64 bits, and no truth value
    """
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and abs(int(value)) < 2**63


def is_number(value: Any) -> bool:
    """
    :param value: Anything
    :return: Whether it is a number, perhaps infinite, but not NaN
    """
    return is_integer(value) or (isinstance(value, (float, np.floating)) and not np.isnan(value))


def at_least(least: int) -> Accepted:
    """
    :param least: The smallest integer that is accepted
    :return: Integers from it on
    """
    return Accepted(f"be an integer of at least {least}", lambda value: is_integer(value) and value >= least)


def one_of(*values: str) -> Accepted:
    """
    :param values: All that are accepted
    :return: These
    """
    return Accepted(f"be one of {list(values)}", lambda value: isinstance(value, str) and value in values)


FLAG = Accepted("be True or False", lambda value: isinstance(value, (bool, np.bool_)))
SHARE = Accepted("lie in [0, 1]", lambda value: is_number(value) and 0 <= value <= 1)
NUMBER = Accepted(f"be a number between -{LARGEST:g} and {LARGEST:g}", lambda value: is_number(value) and abs(value) < LARGEST)
POSITIVE = Accepted(f"be positive and below {LARGEST:g}", lambda value: is_number(value) and 0 < value < LARGEST)
POSITIVE_OR_INFINITE = Accepted("be positive", lambda value: is_number(value) and value > 0)
NOT_NEGATIVE = Accepted(f"be at least 0 and below {LARGEST:g}", lambda value: is_number(value) and 0 <= value < LARGEST)
# Beyond 1000 a parameter may become infinite in one step
RATE = Accepted("lie in [0, 1000]", lambda value: is_number(value) and 0 <= value <= 1000).or_schedule()


def setting(default: Any, accepted: Accepted, flat: str | None = None) -> Any:
    """
    A field of ``Settings``.

    :param default: Its value if none is given
    :param accepted: What it accepts
    :param flat: The constructor argument that it was in version 0.1
    :return: What ``dataclass`` wants
    """
    return field(default=default, metadata={"accepted": accepted, "flat": flat})


@dataclass(frozen=True, kw_only=True)
class Settings:
    """
    A group of settings. A subclass declares each with ``setting``, which says what it accepts.

    :raises ValueError: If a value is not accepted, naming it
    """

    #: The constructor argument by which the group is given
    group: ClassVar[str]

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            each.metadata["accepted"].check(f"{self.group}.{each.name}", value)
            if isinstance(value, np.generic):  # YAML and files know Python's
                object.__setattr__(self, each.name, value.item())

    @classmethod
    def of(cls, given: Any, base: Self | None = None) -> Self:
        """
        :param given: Such settings, a mapping of some of them, or None
        :param base: What holds where nothing is given; the defaults when None
        :return: The settings
        :raises ValueError: If there is no such setting, or its value is not accepted
        """
        base = cls() if base is None else base
        if given is None:
            return base
        if isinstance(given, cls):
            return given
        if isinstance(given, Settings) and given.group == cls.group:  # of an algorithm with other defaults
            given = given.to_dict()
        if not isinstance(given, Mapping):
            given = cls.short_form(given)
        known = cls.names()
        for name in given:
            if name not in known:
                near = difflib.get_close_matches(str(name), known)
                hint = f"did you mean {' or '.join(map(repr, near))}?" if near else f"accepted are {known}"
                raise ValueError(f"{cls.group}[{name!r}] is no setting: {hint}")
        return replace(base, **given)

    @classmethod
    def short_form(cls, given: Any) -> dict[str, Any]:
        """
        :param given: For the whole group, and neither such settings nor a mapping
        :return: What it stands for
        :raises ValueError: If it stands for nothing
        """
        raise ValueError(f"{cls.group} must be {cls.__name__} or a dict of some of them, got {given!r}")

    def to_dict(self) -> dict[str, Any]:
        """
        :return: All of them by name, which ``of`` takes
        """
        return {name: getattr(self, name) for name in self.names()}

    @classmethod
    def names(cls) -> list[str]:
        """
        :return: Of all settings
        """
        return [each.name for each in fields(cls)]

    @classmethod
    def flat_names(cls) -> dict[str, str]:
        """
        :return: Names of constructor arguments of version 0.1, and of the settings that they are now
        """
        return {each.metadata["flat"]: each.name for each in fields(cls) if each.metadata["flat"] is not None}
