"""What is different in a world: a weaker motor, less friction, walled passages, so that it can be seen who copes with it."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from math import isfinite
from typing import Any

from sb3_ddiffpg.utils.settings import FLAG, SHARE, Accepted, Settings, at_least, is_integer, is_number, setting

_FACTOR = Accepted("lie in [0, 10]", lambda value: is_number(value) and 0 <= value <= 10)


def _number(key: Any) -> int:
    """Of a motor or joint; JSON has words for keys."""
    number = int(key) if isinstance(key, str) else key
    if not (is_integer(number) and number >= 0):
        raise ValueError(f"{key!r} is no number of a motor or joint")
    return int(number)


def _are_shares(value: Any) -> bool:
    if not isinstance(value, Mapping):
        return SHARE.test(value)
    return all(_number(key) >= 0 and SHARE.test(share) for key, share in value.items())


def _is_obstacle(value: Any) -> bool:
    return len(value) == 6 and all(is_number(each) and isfinite(each) for each in value) and min(value[3:]) > 0


_SHARES = Accepted("be a share in [0, 1], or a dict of such shares by the numbers (from 0) of motors or joints", _are_shares)
_OBSTACLE = Accepted("be x, y and z of a box's centre and its three edges, all in metres", _is_obstacle)
_NAMES = Accepted(
    "be a list of names", lambda value: not isinstance(value, str) and all(isinstance(each, str) for each in value)
)


@dataclass(frozen=True, kw_only=True)
class WorldChange(Settings):
    """
    What is different in the world of one of this package's tasks. It is the same in every episode, but for the walled
    passages, which are drawn. A task refuses what it has not, such as a point mass gravity. The observation and action
    spaces are those of the unchanged world, so that a model that was trained there can be tried here.

    :param motor_strength: share that is left of the motors' strength, 0 for dead: one number for all, or shares by motor (the
        component of the action that drives it); other motors are as strong as ever
    :param friction: factor on the friction of the body, and in mazes of floor and walls. Of a point mass, which loses a share
        of 0.4 of its velocity at each step, on that share; at most 2.5, and it becomes no faster than ``max_speed``
    :param gravity: factor on gravity
    :param n_blocked: number of a maze's passages that are walled, drawn for each episode. It takes the place of the maze's own
        ``n_blocked``, and one goal that can be reached is enough
    :param ends_at_goal: whether a maze's episode ends at a goal; else it goes on, and the goal pays at each step there
    :param joint_range: share that is left of the range of an arm's joints, around the angles at which episodes begin, 0 for a
        joint that is stuck: one number for all, or shares by joint
    :param obstacle: box beside an arm: x, y and z of its centre, and its three edges, in metres
    :param closed: names of an arm's routes that are closed: a drawer that is stuck, a hole that is filled
    """

    group = "changes"

    motor_strength: float | Mapping[int, float] = setting(1.0, _SHARES)
    friction: float = setting(1.0, _FACTOR)
    gravity: float = setting(1.0, _FACTOR)
    n_blocked: int | None = setting(None, at_least(0).or_none())
    ends_at_goal: bool = setting(True, FLAG)
    joint_range: float | Mapping[int, float] = setting(1.0, _SHARES)
    obstacle: tuple[float, ...] | None = setting(None, _OBSTACLE.or_none())
    closed: tuple[str, ...] = setting((), _NAMES)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("motor_strength", "joint_range"):
            value = getattr(self, name)
            if isinstance(value, Mapping):
                object.__setattr__(self, name, {_number(key): float(share) for key, share in value.items()})
        if self.obstacle is not None:
            object.__setattr__(self, "obstacle", tuple(float(each) for each in self.obstacle))
        object.__setattr__(self, "closed", tuple(self.closed))

    def check(self, body: str, accepted: Collection[str]) -> None:
        """
        :param body: words for what is in the world
        :param accepted: names of what can be different there
        :raises ValueError: if something else is to be different
        """
        for each in fields(self):
            value = getattr(self, each.name)
            if value != each.default and each.name not in accepted:
                raise ValueError(f"changes.{each.name}: {value!r} given, but {body} has none; accepted are {sorted(accepted)}")

    def shares(self, name: str, n: int) -> tuple[float, ...]:
        """
        :param name: ``"motor_strength"`` or ``"joint_range"``
        :param n: number of motors or joints
        :return: what is left of each, shape (n,)
        :raises ValueError: if there are fewer than are named
        """
        value = getattr(self, name)
        if not isinstance(value, Mapping):
            return (float(value),) * n
        if beyond := sorted(number for number in value if number >= n):
            raise ValueError(f"changes.{name}: {beyond} given; accepted are the numbers 0 to {n - 1}")
        return tuple(value.get(number, 1.0) for number in range(n))
