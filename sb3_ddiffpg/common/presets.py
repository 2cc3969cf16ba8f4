"""Settings that are known to work, from the YAML files of the zoo."""

from pathlib import Path
from typing import Any

import torch as th
import yaml
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_ddiffpg.common.schedules import LateLinearSchedule

#: Short names: a YAML file, and an entry in it
PRESETS: dict[str, tuple[str, str]] = {
    "paper": ("ddiffpg", "paper"),
    "point": ("ddiffpg", "PointMazeV1-v0"),
    "point-large": ("ddiffpg", "PointMazeV3-v0"),
    "ant": ("ddiffpg", "AntMazeV1-v0"),
    "ant-cpu": ("ddiffpg-cpu", "AntMazeV1-v0"),
    "ant-large-cpu": ("ddiffpg-cpu", "AntMazeV3-v0"),
    "arm-cpu": ("ddiffpg-cpu", "FrankaPegInHole-v0"),
}
#: What an entry says of environments and the length of a training, not of the algorithm
ZOO_KEYS = frozenset(
    (
        *("callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs", "n_timesteps", "noise_std"),
        *("noise_type", "normalize", "vec_env_wrapper"),
    )
)


def config_file(name: str) -> Path | None:
    """
    :param name: Of a YAML file of ours: ``ddiffpg`` or ``ddiffpg-cpu``
    :return: Where it is, installed or in a checkout; None when there is none
    """
    package = Path(__file__).parents[1]
    for folder in (package, package.parent):
        if (path := folder / "zoo_hyperparams" / f"{name}.yml").is_file():
            return path
    return None


def preset(name: str) -> dict[str, Any]:
    """
    :param name: One of ``PRESETS``, or a file and an entry, such as ``"ddiffpg-cpu:AntMazeV2-v0"``
    :return: Arguments of the algorithm's constructor, without the environment
    :raises ValueError: If there is no such preset
    """
    file, _, entry = name.partition(":")
    if not entry:
        file, entry = PRESETS.get(name, ("", ""))
    path = config_file(file) if Path(file).name == file else None
    entries = {} if path is None else yaml.safe_load(path.read_text())
    if entry not in entries:
        what = f"; {path.name} has {', '.join(entries)}" if path is not None else ""
        raise ValueError(f"name={name!r} is no preset: accepted are {', '.join(PRESETS)} and 'file:environment'{what}")
    arguments = {key: value for key, value in entries[entry].items() if key not in ZOO_KEYS}
    for key in ("learning_rate", "qf_learning_rate"):
        if isinstance(rate := arguments.get(key), str):
            arguments[key] = _rate(rate)
    if isinstance(kwargs := arguments.get("policy_kwargs"), str):
        # As the zoo does; the files are ours
        arguments["policy_kwargs"] = eval(kwargs, {"__builtins__": {}, "dict": dict, "nn": nn, "th": th})
    return arguments


def _rate(text: str) -> Any:
    """A number, or ``lin_<number>`` or ``late_<number>``."""
    kind, _, number = text.rpartition("_")
    value = float(number)
    return {"": value, "lin": LinearSchedule(value, 0.0, 1.0), "late": LateLinearSchedule(value)}[kind]
