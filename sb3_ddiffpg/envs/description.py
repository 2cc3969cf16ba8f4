"""What an environment is made of, as it is remembered in the file of a model, and another one made of it."""

import contextlib
import dataclasses
import inspect
import json
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.utils.settings import Settings
from sb3_ddiffpg.utils.vec_envs import env_attribute

# Of these modules a file may name wrappers; of others where the user has imported them
_KNOWN_MODULES = (
    "gymnasium.wrappers",
    "stable_baselines3.common",
    "rl_zoo3.wrappers",
    "sb3_ddiffpg.envs.wrappers",
    "sb3_ddiffpg.envs.changed_env",
)
# What only looks on; RecordVideo would write where a file tells it to
_LOOKING_ON = ("Monitor", "RecordEpisodeStatistics", "RecordVideo", "HumanRendering", "RenderCollection")


def describe_env(env: VecEnv) -> str | None:
    """
    :param env: The environments
    :return: Id, entry point, arguments and wrappers of one of them, as JSON of gymnasium's ``EnvSpec``; a wrapper whose
        arguments nobody knows has None. None: it is not registered, or JSON cannot hold its arguments
    """
    spec = env_attribute(env, "spec")
    if not isinstance(spec, EnvSpec):
        return None
    said = env_attribute(env, "wrappers_said")
    layers = [_said_of(each) for each in spec.additional_wrappers]
    if said is not None:  # the RL zoo's come behind SB3's monitor, and some are made of several layers
        names = [each["name"] for each in layers]
        layers = [*layers[: names.index("Monitor") if "Monitor" in names else 0], *said]
    wrappers = [each for each in layers if not _looks_on(each["entry_point"])]
    entry_point = spec.entry_point
    if callable(entry_point):
        entry_point = f"{entry_point.__module__}:{getattr(entry_point, '__qualname__', type(entry_point).__qualname__)}"
    fields = {field.name: getattr(spec, field.name) for field in dataclasses.fields(spec) if field.init}
    fields |= {"entry_point": entry_point, "vector_entry_point": None, "additional_wrappers": wrappers}
    return _json(fields)


def wrappers_said(env_wrapper: Any) -> list[dict[str, Any]]:
    """
    :param env_wrapper: What a YAML file of the RL zoo says: a dotted name, ``{name: arguments}``, or a list of them
    :return: These wrappers as :func:`describe_env` has them
    """
    if not env_wrapper:
        return []
    said = []
    for each in env_wrapper if isinstance(env_wrapper, list) else [env_wrapper]:
        name, kwargs = next(iter(each.items())) if isinstance(each, dict) else (each, {})
        name = f"{name.__module__}.{name.__qualname__}" if isinstance(name, type) else name
        kwargs = kwargs if _json(kwargs) is not None else None
        said.append({"name": name, "entry_point": ":".join(name.rsplit(".", 1)), "kwargs": kwargs})
    return said


def _said_of(layer: WrapperSpec) -> dict[str, Any]:
    kwargs = layer.kwargs
    if kwargs is None and (wrapper := _imported(layer.entry_point)) is not None:
        kwargs = {} if _takes_nothing_else(wrapper) else None
    return {"name": layer.name, "entry_point": layer.entry_point, "kwargs": None if _json(kwargs) is None else kwargs}


def _takes_nothing_else(wrapper: type[gym.Wrapper]) -> bool:
    """Beside the environment."""
    variable = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    takes = inspect.signature(wrapper).parameters.values()
    return len(takes) == 1 and all(each.kind not in variable for each in takes)


def _looks_on(entry_point: str) -> bool:
    return entry_point.rpartition(":")[2] in _LOOKING_ON


def _json(value: Any) -> str | None:
    try:
        return json.dumps(value, default=_plain)
    except (TypeError, ValueError):
        return None


def _plain(value: Any) -> dict[str, Any]:
    """What stands for a value that JSON does not know, and is accepted in its place."""
    if isinstance(value, Settings):
        return value.to_dict()
    raise TypeError(f"{value!r} is neither plain nor a group of settings")


def _imported(entry_point: str) -> Any:
    """A wrapper of a module that is imported already; None if there is none."""
    module, _, name = entry_point.partition(":")
    # Not getattr: a module may import what it is asked for
    found = vars(sys.modules[module]).get(name) if module in sys.modules else None
    return found if isinstance(found, type) and issubclass(found, gym.Wrapper) else None


@dataclass(frozen=True)
class RememberedEnv:
    """
    What a model remembers of its environment.

    :param id: By which it is registered
    :param kwargs: Arguments of ``gym.make``
    :param wrappers: Around it, the innermost first
    :param entry_point: Where it was defined. It is told, not imported
    """

    id: str
    kwargs: dict[str, Any]
    wrappers: tuple[WrapperSpec, ...]
    entry_point: str

    @staticmethod
    def of(env_spec: str) -> "RememberedEnv":
        """
        :param env_spec: What :func:`describe_env` wrote
        :return: What it says
        :raises ValueError: If it says nothing that could be
        """
        try:
            spec = EnvSpec.from_json(env_spec)
            kwargs = {**spec.kwargs, "max_episode_steps": spec.max_episode_steps}
            for each in spec.additional_wrappers:
                if not isinstance(each.entry_point, str) or not isinstance(each.kwargs, dict | None):
                    raise ValueError(f"{each} is no wrapper")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, AssertionError, gym.error.Error) as error:
            raise ValueError(f"what the model remembers is no environment: {error!r}") from None
        said = {name: value for name, value in kwargs.items() if name != "render_mode" and value is not None}
        wrappers = tuple(each for each in spec.additional_wrappers if not _looks_on(each.entry_point))
        return RememberedEnv(spec.id, said, wrappers, str(spec.entry_point)[:200])

    def check(self) -> None:
        """
        Nothing is imported on behalf of a file, which may be a stranger's, but of gymnasium, SB3, its zoo and this package.

        :raises ValueError: If it or one of its wrappers is not known here
        """
        lacking = [] if self.id in gym.registry else [re.split(r"[.:]", self.entry_point)[0]]
        for spec in self.wrappers:
            module = spec.entry_point.partition(":")[0]
            if any(f"{module}.".startswith(f"{known}.") for known in _KNOWN_MODULES):
                with contextlib.suppress(ImportError):
                    import_module(module)
            if module not in sys.modules:
                lacking.append(module)
            elif _imported(spec.entry_point) is None:
                raise ValueError(f"the model was trained behind {spec.entry_point}, but {module} has no such wrapper")
        if lacking:
            made_of = ", ".join([self.entry_point, *(spec.entry_point for spec in self.wrappers)])
            named = " ".join(dict.fromkeys(lacking))
            raise ValueError(
                f"the model was trained in {self.id!r} ({made_of}). It is not registered here, or a wrapper not imported, and "
                f"a file imports nothing: import what it needs if you trust it, or name it, as in --gym-packages {named}"
            )

    def wrapper(self) -> Callable[[gym.Env], gym.Env] | None:
        """
        :return: What puts the wrappers around an environment of this id; None if there are none
        :raises ValueError: If one of them is not known here
        """
        self.check()
        return _Rewrapping(self.wrappers, [_imported(each.entry_point) for each in self.wrappers]) if self.wrappers else None


class _Rewrapping:
    """
    Puts an environment behind the wrappers behind which a model was trained, but for those that it has already.

    :param specs: The wrappers, the innermost first
    :param classes: Theirs
    """

    def __init__(self, specs: Sequence[WrapperSpec], classes: Sequence[type[gym.Wrapper]]) -> None:
        self.specs, self.classes = specs, classes

    def __call__(self, env: gym.Env) -> gym.Env:
        there = _layers(env)
        n_there = _n_same(there, self.specs)
        for spec, wrapper in zip(self.specs[n_there:], self.classes[n_there:], strict=True):
            if spec.kwargs is None:
                raise ValueError(
                    f"with which arguments the wrapper {spec.entry_point} was made, the model does not know: let it inherit "
                    "from gymnasium.utils.RecordConstructorArgs, or give environments that are made already"
                )
            env = wrapper(env, **spec.kwargs)
        # Said by the zoo, a wrapper may consist of several; found one by one, none may have made others
        wanted = [spec.name for spec in self.specs]
        if not any("." in name for name in wanted) and [each.name for each in _layers(env)] != wanted:
            raise ValueError(f"the wrappers {wanted} make others, which would be there twice: give environments that are made")
        return env


def _layers(env: gym.Env) -> list[WrapperSpec]:
    spec = env.spec
    return [] if spec is None else [each for each in spec.additional_wrappers if not _looks_on(each.entry_point)]


def _n_same(there: Sequence[WrapperSpec], wanted: Sequence[WrapperSpec]) -> int:
    """How many of the first are the same."""
    same = [one.entry_point == other.entry_point for one, other in zip(there, wanted, strict=False)]
    return [*same, False].index(False)
