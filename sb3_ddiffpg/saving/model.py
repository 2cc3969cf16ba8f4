"""A model in plain values and arrays, and the same model made of them again: for ``export`` and a safe ``load``."""

import warnings
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_ddiffpg.envs.snapshots import normalization, restore_normalization
from sb3_ddiffpg.exploration.noise import check_noise
from sb3_ddiffpg.networks.extractors import unknown_to_0_1
from sb3_ddiffpg.saving._legacy import parameters_of_0_1
from sb3_ddiffpg.saving.records import load_state_tree, state_tree
from sb3_ddiffpg.serialization.codec import NeededError, from_plain, to_plain
from sb3_ddiffpg.serialization.parameters import fitting_parameters, optimizer_tree
from sb3_ddiffpg.serialization.safetensors_tree import convert
from sb3_ddiffpg.utils.arguments import (
    GONE,
    constructor_arguments,
    flat_names,
    grouped,
    groups_of,
    one_by_one,
    settings_attribute,
    single_setting,
)
from sb3_ddiffpg.utils.rng import preserved_rng

Model = TypeVar("Model", bound=Any)
Built = TypeVar("Built", bound=th.nn.Module)

#: What a file that holds a model says it is
KIND = "model"
# Beyond these a small file would take hours or all of the memory
MOST_ENVS = 2**16
MOST = {
    **dict.fromkeys(("n_diffusion_steps", "target_action.n_steps", "n_candidates", "n_path_points"), 10_000),
    **dict.fromkeys(("n_steps", "modes.n_steps", "exploration.n_steps", "gradient_steps", "train_freq"), 100_000),
    "batch_size": 2**24,
}
# Of arrays of numbers
_DTYPES = {str(np.dtype(kind)) for kind in "?bhilqBHILQefd"}
# Parts of a model, and the argument by which one of one's own comes
_MADE_WITH = {"policy": "policy_kwargs", "bonus.novelty_model": "novelty"}
# Of the constructor, but not the model's: given again when it is loaded
GIVEN_AT_LOADING = {"policy", "env", "device", "tensorboard_log", "_init_setup_model"}


class _Space(msgspec.Struct, forbid_unknown_fields=True):
    kind: str
    dtype: str | None = None
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    n: list[int] | None = None
    shape: list[int] | None = None
    parts: dict[str, Any] | None = None


class _Normalizer(msgspec.Struct, forbid_unknown_fields=True):
    statistics: Any
    settings: dict[str, Any]


class ModelTree(msgspec.Struct, forbid_unknown_fields=True):
    """What a file holds of a model."""

    algorithm: str
    policy: str | None
    arguments: dict[str, Any]
    observation_space: Any
    action_space: Any
    n_envs: int
    state: dict[str, Any]
    parameters: dict[str, dict[str, Any]]
    normalizer: _Normalizer | None


def model_tree(model: Any, optimizers: bool = True) -> dict[str, Any]:
    """
    :param model: One of this package's algorithms
    :param optimizers: Whether what the optimisers have gathered is part of it
    :return: All that it is, without its replay buffer and environments
    """
    names = sorted(constructor_arguments(type(model)) - GIVEN_AT_LOADING)
    groups = groups_of(type(model))
    arguments = {name: to_plain(getattr(model, settings_attribute(name)).to_dict()) for name in names if name in groups}
    # SB3 keeps one of them under another name
    others = [name for name in names if name not in groups]
    arguments |= {name: to_plain(getattr(model, name if hasattr(model, name) else f"_{name}")) for name in others}
    # What SB3 has made of it is no argument any more
    frequency = model.train_freq
    if hasattr(frequency, "unit"):
        arguments["train_freq"] = to_plain((frequency.frequency, frequency.unit.value))
    known = [name for name, policy in model.policy_aliases.items() if policy is model.policy_class]
    normalizer = model.get_vec_normalize_env()
    return {
        "algorithm": type(model).__name__,
        "policy": known[0] if known else None,
        "arguments": arguments,
        "observation_space": _space_tree(model.observation_space),
        "action_space": _space_tree(model.action_space),
        "n_envs": model.n_envs,
        "state": state_tree(model),
        "parameters": {
            name: optimizer_tree(each, optimizers) if "param_groups" in each else dict(each)
            for name, each in model.get_parameters().items()
        },
        "normalizer": None if normalizer is None else _normalizer_tree(normalizer),
    }


def build_model(
    algorithm: type[Model],
    tree: Any,
    env: Any = None,
    device: th.device | str = "auto",
    custom_objects: dict[str, Any] | None = None,
    **changes: Any,
) -> Model:
    """
    :param algorithm: Of which class the model is
    :param tree: What ``model_tree`` gave
    :param env: To train on; None: the model only acts
    :param device: Where it computes
    :param custom_objects: Arguments that are code (a schedule, a policy class as ``"policy"``): no file holds them
    :param changes: Other values of constructor arguments
    :return: The model
    :raises ValueError: If the tree is something else, is another algorithm's, does not fit ``env``, or needs code
    """
    saved = convert(tree, ModelTree, "model")
    if saved.algorithm != algorithm.__name__:
        raise ValueError(f"the file holds a {saved.algorithm[:50]}: load it with that class, not with {algorithm.__name__}")
    saved.parameters = parameters_of_0_1(saved.parameters)
    accepted = constructor_arguments(algorithm) - GIVEN_AT_LOADING
    of_0_1 = {*flat_names(algorithm), *GONE}
    changed = {name for name in changes if single_setting(algorithm, name) is None}
    unknown = set(saved.arguments) - accepted - of_0_1 | changed - accepted - {"tensorboard_log"}
    if unknown:
        raise ValueError(f"model.arguments: {sorted(unknown)} are no arguments of {algorithm.__name__}")
    given = dict(custom_objects or {})
    policy = given.pop("policy", None) or _policy_class(algorithm, saved.policy)
    for name, each in saved.arguments.items():
        if name in GONE and each != GONE[name][0]:
            warnings.warn(f"The model was made with {name}, which is no argument any more: {GONE[name][1]}")
    of_file = grouped(algorithm, _arguments(algorithm, saved.arguments, one_by_one(algorithm, {**given, **changes})))
    _check_arguments(of_file, saved.parameters)
    arguments = grouped(algorithm, of_file, {**given, **changes})
    if not 1 <= saved.n_envs <= MOST_ENVS:
        raise ValueError(f"model.n_envs: {saved.n_envs} given; accepted is 1 to {MOST_ENVS}")
    observation_space, action_space = _space(saved.observation_space), _space(saved.action_space)
    if env is not None:
        env = algorithm._wrap_env(env, 0)
        if saved.normalizer is not None:
            env = _normalized(env, saved.normalizer)
        check_for_correct_spaces(env, observation_space, action_space)
    elif saved.normalizer is not None:
        warnings.warn("The model was trained on normalised observations: give env=, which is then normalised alike")
    try:
        model = algorithm(policy=policy, env=env, device=device, _init_setup_model=False, **arguments)
        model.observation_space, model.action_space = observation_space, action_space
        model.n_envs = saved.n_envs if env is None else env.num_envs
        load_state_tree(model, saved.state)
        # Networks of one's own may need values where they are made, and are trusted
        trusted = [part for part, argument in _MADE_WITH.items() if argument in given]
        model.in_file = {**saved.parameters, **dict.fromkeys(trusted)}
        model._setup_model()
        model.in_file = None
        if model.action_noise is not None:
            check_noise(model.action_noise, model.n_envs, int(np.prod(action_space.shape)))
        raw = {name: value.cpu().numpy() for name, value in unknown_to_0_1(model.policy).items()}
        policy = saved.parameters.get("policy", {})
        if not raw.keys() & policy.keys():
            saved.parameters["policy"] = {**raw, **policy}
        parameters = fitting_parameters(model, saved.parameters)
        model.set_parameters(parameters, exact_match=True, device=model.device)
    except (TypeError, AttributeError, AssertionError, LookupError, RuntimeError, ArithmeticError, MemoryError) as error:
        own = "policy" in (custom_objects or {}) and "policy_kwargs" not in given
        hint = (
            ". A policy that looks at values where it is made needs custom_objects={'policy_kwargs': ...} too" if own else ""
        )
        raise ValueError(f"model: its arguments make no {algorithm.__name__}: {error!r}{hint}") from error
    if env is not None and saved.normalizer is not None:  # last: the environments may be somebody's who goes on with them
        restore_normalization(_normalizer_of(env), saved.normalizer.statistics)
    return model


def _policy_class(algorithm: Any, name: str | None) -> type:
    """A class may have several names, of which some are not for all spaces."""
    if name is None:
        raise ValueError("the policy is a class of one's own, which no file holds: give custom_objects={'policy': ...}")
    if name not in algorithm.policy_aliases:
        raise ValueError(f"model.policy: {name[:50]!r} given; accepted are {sorted(algorithm.policy_aliases)}")
    found: type = algorithm.policy_aliases[name]
    return found


def _arguments(algorithm: type, plain: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """Settings of groups one by one, of which those that are given are not looked at."""
    arguments, groups, single = {}, groups_of(algorithm), {}
    for name, each in plain.items():
        inside = each.get("dict") if name in groups and isinstance(each, dict) else None
        single.update({f"{name}.{key}": value for key, value in inside.items()} if isinstance(inside, dict) else {name: each})
    for name, each in single.items():
        if name in given:
            continue
        try:
            arguments[name] = from_plain(each)
        except NeededError as needed:
            raise ValueError(
                f"{name} is code ({needed}), which no file holds: give custom_objects={{{name!r}: ...}}"
            ) from None
        except ValueError as error:
            raise ValueError(f"model.arguments.{name}: {error}") from None
    return arguments


def _check_arguments(arguments: dict[str, Any], parameters: dict[str, dict[str, Any]]) -> None:
    """Those by which a small file could ask for hours."""
    of_buffer = arguments.get("replay_buffer_kwargs")
    bounded = {**(of_buffer if isinstance(of_buffer, dict) else {}), **arguments}
    groups = {group: each for group, each in arguments.items() if isinstance(each, dict)}
    bounded |= {f"{group}.{name}": value for group, each in groups.items() for name, value in each.items()}
    for name, most in MOST.items():
        value = bounded.get(name)
        value = value[0] if isinstance(value, tuple) and value else value  # with its unit
        if isinstance(value, int) and value > most:
            raise ValueError(f"model.arguments.{name}: {value} given; accepted is at most {most} in a file")
    n_arrays = sum(map(len, parameters.values()))
    for name in ("policy_kwargs", "novelty.kwargs"):
        if (longest := _longest(bounded.get(name))) > n_arrays:
            raise ValueError(f"model.arguments.{name}: {longest} layers for a file of {n_arrays} arrays")


def _longest(value: Any, name: str = "") -> int:
    """Most layers of a network among arguments."""
    if isinstance(value, dict):
        return max([0, *(_longest(each, name if name == "net_arch" else key) for key, each in value.items())])
    return len(value) if name == "net_arch" and isinstance(value, (list, tuple)) else 0


def built(model: Any, part: str, make: Callable[..., Built], *args: Any, **kwargs: Any) -> Built:
    """
    Make a part of a model; of one that is made of a file, only if the file has all that fills it.

    :param model: One of this package's algorithms
    :param part: Name of the part among the parameters
    :param make: Makes it
    :param args: Its arguments
    :param kwargs: Its arguments
    :return: The part
    :raises ValueError: If the file has other arrays
    """
    expected = None if model.in_file is None else model.in_file.get(part, {})
    return make(*args, **kwargs) if expected is None else sized_as(expected, part, make, *args, **kwargs)


def sized_as(expected: dict[str, Any], part: str, make: Callable[..., Built], *args: Any, **kwargs: Any) -> Built:
    """
    Make a part of a model, after one without memory has shown that a file has all that fills it: a small file must not ask for
    all of the memory.

    :param expected: The arrays of the file, by name
    :param part: Name of the part, for the message
    :param make: Makes it
    :param args: Its arguments
    :param kwargs: Its arguments
    :return: The part
    :raises ValueError: If the file has other arrays
    """
    with th.device("meta"), preserved_rng():
        sketch: Any = make(*args, **kwargs)
    there = {name: list(np.shape(value)) for name, value in expected.items()}
    filled = unknown_to_0_1(sketch).keys() - there.keys()
    needed = {name: list(value.shape) for name, value in sketch.state_dict().items() if name not in filled}
    if needed != there:
        different = next(name for name in sorted(needed.keys() | there.keys()) if needed.get(name) != there.get(name))
        raise ValueError(
            f"model.parameters.{part}.{different}: of shape {there.get(different)}; accepted is {needed.get(different)}"
        )
    return make(*args, **kwargs)


# ------------------------------------------------------------------ spaces


def _space_tree(space: spaces.Space) -> dict[str, Any]:
    kind = type(space).__name__
    match space:
        case spaces.Box():
            return {"kind": kind, "dtype": str(space.dtype), "low": space.low, "high": space.high}
        case spaces.Discrete():
            return {"kind": kind, "n": [int(space.n), int(space.start)]}
        case spaces.MultiDiscrete() if space.nvec.ndim == 1:
            return {"kind": kind, "n": space.nvec.tolist()}
        case spaces.MultiBinary():
            return {"kind": kind, "shape": list(space.shape), "n": [space.n] if isinstance(space.n, int) else None}
        case spaces.Dict():
            return {"kind": kind, "parts": {key: _space_tree(each) for key, each in space.spaces.items()}}
    raise TypeError(f"A space of kind {kind} cannot be exported")


def _space(tree: Any) -> Any:
    saved = convert(tree, _Space, "space")
    try:
        match saved:
            case _Space(kind="Box", low=np.ndarray() as low, high=np.ndarray() as high, dtype=str(dtype)):
                if low.shape != high.shape or dtype not in _DTYPES:
                    raise ValueError(f"bounds of shapes {low.shape} and {high.shape}, of {dtype}")
                return spaces.Box(low, high, dtype=np.dtype(dtype).type)
            case _Space(kind="Discrete", n=[n, start]):
                return spaces.Discrete(n, start=start)
            case _Space(kind="MultiDiscrete", n=[_, *_] as sizes):
                return spaces.MultiDiscrete(sizes)
            case _Space(kind="MultiBinary", shape=[_, *_] as shape) if np.prod(shape, dtype=float) < 2**31:
                return spaces.MultiBinary(shape if saved.n is None else shape[0])
            case _Space(kind="Dict", parts=dict(parts)):
                return spaces.Dict([(key, _space(each)) for key, each in parts.items()])  # a dict would be sorted
    except (AssertionError, TypeError, OverflowError, ValueError) as error:
        raise ValueError(f"space: {error}") from None
    raise ValueError(f"space: {saved.kind[:50]!r} of this form is unknown")


# ------------------------------------------------------------------ normalisation

_NORMALIZER_SETTINGS: dict[str, Any] = {
    **dict.fromkeys(("norm_obs", "norm_reward"), bool),
    **dict.fromkeys(("clip_obs", "clip_reward"), Annotated[float, msgspec.Meta(gt=0)]),
    "epsilon": Annotated[float, msgspec.Meta(ge=0)],
    "gamma": Annotated[float, msgspec.Meta(ge=0, le=1)],
    "norm_obs_keys": list[str] | None,
}


def _normalizer_tree(env: VecNormalize) -> dict[str, Any]:
    settings = {name: to_plain(getattr(env, name)) for name in _NORMALIZER_SETTINGS}
    return {"statistics": normalization(env), "settings": settings}


def _normalized(env: Any, saved: _Normalizer) -> VecEnv:
    """The environments, in a wrapper that will normalise them as those of the model were."""
    settings = {name: from_plain(value) for name, value in saved.settings.items()}
    if set(settings) != set(_NORMALIZER_SETTINGS):
        raise ValueError(f"model.normalizer: settings {sorted(settings)} given; accepted are {sorted(_NORMALIZER_SETTINGS)}")
    for name, kind in _NORMALIZER_SETTINGS.items():
        convert(settings[name], kind, f"model.normalizer.{name}")
    if unwrap_vec_normalize(env) is not None:  # there may be wrappers around it
        return env
    try:
        return VecNormalize(env, **settings)
    except (TypeError, ValueError, AssertionError, KeyError) as error:
        raise ValueError(f"model.normalizer: {error}") from None


def _normalizer_of(env: VecEnv) -> VecNormalize:
    normalizer = unwrap_vec_normalize(env)
    assert normalizer is not None
    return normalizer
