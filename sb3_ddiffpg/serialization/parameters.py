"""Networks and optimisers in plain values and arrays, and what a file says of them held against those that are there."""

import inspect
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import TensorDict

from sb3_ddiffpg.serialization.codec import from_plain, to_plain
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert

# Settings of an optimiser: how a step is computed, whatever it was elsewhere
_OF_THE_MACHINE = ("fused", "foreach", "capturable")
# Of what optimisers gather
_NOT_NEGATIVE = ("step", "exp_avg_sq", "max_exp_avg_sq")
# No optimiser needs larger settings; parameters would become infinite by them in a few steps
_LARGEST_SETTING = 1e6


def optimizer_tree(state: dict[str, Any], complete: bool) -> dict[str, Any]:
    """
    :param state: What an optimiser's ``state_dict`` gave
    :param complete: Whether what it has gathered is part of it
    :return: The same in plain values and arrays
    """
    return {
        "state": {str(index): each for index, each in state["state"].items()} if complete else {},
        "groups": [{key: to_plain(value) for key, value in group.items()} for group in state["param_groups"]],
    }


def fitting_parameters(model: Any, trees: dict[str, dict[str, Any]]) -> dict[str, TensorDict]:
    """
    :param model: With the networks and optimisers that its settings make
    :param trees: What a file holds of them, by their names
    :return: The same as SB3's ``set_parameters`` wants it
    :raises ValueError: If something does not fit the model, or cannot be
    """
    expected = model.get_parameters()
    if set(trees) != set(expected):
        raise ValueError(f"model.parameters: of {sorted(trees)}, {type(model).__name__} has {sorted(expected)}")
    found: dict[str, Any] = {}
    for name, own in expected.items():
        if "param_groups" in own:
            optimizer = model
            for part in name.split("."):
                optimizer = getattr(optimizer, part)
            found[name] = _optimizer(optimizer, own, trees[name], f"model.parameters.{name}")
            continue
        if set(trees[name]) != set(own):
            raise ValueError(f"model.parameters.{name}: {sorted(set(trees[name]) ^ set(own))} are there or are missing")
        found[name] = {key: _tensor(trees[name][key], value, f"model.parameters.{name}.{key}") for key, value in own.items()}
    return found


def _tensor(array: Any, like: th.Tensor, what: str) -> th.Tensor:
    array = check_array(convert(array, np.ndarray, what), _numpy_dtype(like), list(like.shape), what)
    # Infinite is what it is made so: the logarithm of a factor of zero, a mask
    if np.isnan(array).any() or (np.isinf(array) & ~np.isinf(like.cpu().numpy())).any():
        raise ValueError(f"{what}: there are numbers that are not finite")
    return th.from_numpy(array.copy())


def _numpy_dtype(tensor: th.Tensor) -> np.dtype:
    return th.zeros((), dtype=tensor.dtype).numpy().dtype


def _optimizer(optimizer: th.optim.Optimizer, own: dict[str, Any], tree: dict[str, Any], what: str) -> dict[str, Any]:
    saved = convert(tree, dict[str, Any], what)
    states, groups = (convert(saved.get(key), kind, what) for key, kind in (("state", dict[str, Any]), ("groups", list[Any])))
    if len(groups) != len(own["param_groups"]):
        raise ValueError(f"{what}: {len(groups)} groups, the optimizer has {len(own['param_groups'])}")
    restored = []
    gathers: dict[str, dict[str, Any]] = {}
    for group, before, present in zip(groups, own["param_groups"], optimizer.param_groups, strict=True):
        values = {key: from_plain(value) for key, value in convert(group, dict[str, Any], what).items()}
        values |= {key: before[key] for key in _OF_THE_MACHINE if key in before}
        if isinstance(rate := values.get("lr"), float):
            values["lr"] = max(0.0, rate)  # below zero in older files, whose schedule went beyond the end
        if set(values) != set(before) or values["params"] != before["params"]:
            raise ValueError(f"{what}: its settings are not those of a {type(optimizer).__name__}")
        for key, value in values.items():
            if isinstance(before[key], (float, bool, tuple)) and not isinstance(value, (type(before[key]), int)):
                raise ValueError(f"{what}.{key}: {value!r} given, where {before[key]!r} was")
        gathered = _gathered_in_a_step(type(optimizer), values, present["params"], what)
        gathers.update(zip(map(str, values["params"]), gathered, strict=True))
        restored.append(values)
    state = {}
    for index, each in states.items():
        if index not in gathers:
            raise ValueError(f"{what}: {index[:20]!r} is none of its {len(gathers)} parameters")
        if (there := set(convert(each, dict[str, Any], what))) != set(gathers[index]):
            raise ValueError(f"{what}: it has gathered {sorted(there)}; accepted are {sorted(gathers[index])}")
        state[int(index)] = {key: _gathered(each[key], like, key, what) for key, like in gathers[index].items()}
    return {"state": state, "param_groups": restored}


def _gathered_in_a_step(kind: Any, values: dict[str, Any], params: list[th.Tensor], what: str) -> list[dict[str, Any]]:
    """For each parameter; which settings there may be is known by the optimiser's own constructor, and its step."""
    accepted = set(inspect.signature(kind.__init__).parameters) - {"params"}
    params = [th.zeros_like(each, requires_grad=True) for each in params]
    try:
        for value in values.values():
            if isinstance(value, (int, float, tuple)) and not all(abs(each) <= _LARGEST_SETTING for each in np.ravel(value)):
                raise ValueError(f"{str(value)[:100]} given; accepted are numbers up to {_LARGEST_SETTING:g}")
        optimizer = kind(params, **{name: value for name, value in values.items() if name in accepted})
        for each in params:
            each.grad = th.zeros_like(each)
        optimizer.step()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{what}: {error}") from None
    return [dict(optimizer.state[each]) for each in params]


def _gathered(value: Any, like: Any, key: str, what: str) -> Any:
    if isinstance(like, th.Tensor):
        found: Any = _tensor(value, like, f"{what}.{key}")
    else:  # some count in plain numbers
        found = convert(value, type(like), f"{what}.{key}")
    if key in _NOT_NEGATIVE and (found < 0 if isinstance(found, (int, float)) else bool((found < 0).any())):
        raise ValueError(f"{what}.{key}: there are numbers that are negative")
    return found
