"""Tiny models and hand-made trajectories, shared by tests, and the environments of ``tiny_envs``."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger
from tiny_envs import (  # noqa: F401 - handed on
    AnySpaces,
    BreaksAt,
    Fragile,
    HangsAt,
    KnownEnds,
    Says,
    TellsModules,
    TwoEnds,
    image_dict_space,
)

from sb3_ddiffpg import DDiffPG, ModeReplayBuffer
from sb3_ddiffpg.exploration.bonus import ExplorationBonus

SMALL: dict[str, Any] = {
    "learning_starts": 40,
    "buffer_size": 2000,
    "batch_size": 32,
    "train_freq": 4,
    "recluster_freq": 5,
    "seed": 0,
    "modes": {"min_size": 3, "distance_threshold": 0.5},
    "exploration": {"fraction": 1.0},
    "policy_kwargs": {"net_arch": [16]},
}
GROUPS = [kind.group for kind in DDiffPG.settings_groups]


def merged(*arguments: dict[str, Any]) -> dict[str, Any]:
    """Arguments, of which the later ones hold; of a group of settings, setting by setting."""
    found: dict[str, Any] = {}
    for each in arguments:
        for name, value in each.items():
            if name in GROUPS and not isinstance(value, dict):  # such as ``novelty="rnd"``
                value = {"measure": value}
            found[name] = {**found.get(name, {}), **value} if name in GROUPS else value
    return found


def small_model(env: Any, policy: str = "MlpPolicy", **changes: Any) -> DDiffPG:
    """A model that learns little, but fast, and writes no logs."""
    model = DDiffPG(policy, env, **merged(SMALL, changes))
    model.set_logger(Logger(None, []))
    return model


def change_settings(model: Any, **groups: dict[str, Any]) -> None:
    """Some settings are different from now on: for the model, and for its parts, which hold them too."""
    for group, changes in groups.items():
        attribute = f"{group.removesuffix('s')}_settings"
        setattr(model, attribute, replace(getattr(model, attribute), **changes))
    model.bonus.settings = model.novelty_settings
    model.bonus.exploration = model.scheduler.settings = model.exploration_settings
    model.mode_manager.settings = model.mode_settings


# Random rewards are no reason to warn of returns outside the critics' support
WIDE: dict[str, Any] = {"critic": {"v_min": -50.0, "v_max": 50.0}}


def fill(
    buffer: ModeReplayBuffer,
    paths: Sequence[np.ndarray],
    success: bool | None = True,
    reward: float = 1.0,
    bonus: ExplorationBonus | None = None,
) -> None:
    """
    One environment walks along each path (an array [length + 1, dim]) and ends there, with the reward at the end. The bonus
    sees each step, if there is one. No step says whether there was a success where that is None.
    """
    for path in paths:
        for k in range(len(path) - 1):
            last = k == len(path) - 2
            action = np.clip(path[k + 1] - path[k], -1, 1)[None, : buffer.action_dim]
            infos = [{} if success is None else {"is_success": success and last}]
            record = buffer.add(path[k][None], path[k + 1][None], action, np.array([reward * last]), np.array([last]), infos)
            if bonus is not None:
                bonus.observe(record, buffer)


def some_observations(n: int = 10) -> np.ndarray:
    """Inside the observation space of ``TwoEnds``."""
    return np.random.default_rng(0).uniform(-1, 1, (n, 2)).astype(np.float32)


def state_of(model: DDiffPG) -> dict[str, th.Tensor]:
    """Every tensor that a model's parameters hold, by name."""
    flat: dict[str, th.Tensor] = {}

    def walk(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, child in value.items():
                walk(f"{name}/{key}", child)
        elif isinstance(value, list):
            for key, child in enumerate(value):
                walk(f"{name}/{key}", child)
        elif isinstance(value, th.Tensor):
            flat[name] = value.detach().cpu().clone()

    walk("", model.get_parameters())
    return flat


def assert_same_state(first: dict[str, th.Tensor], second: dict[str, th.Tensor]) -> None:
    """Bit for bit."""
    assert first.keys() == second.keys()
    for name in first:
        assert th.equal(first[name], second[name]), name


def assert_no_gaps(buffer: ModeReplayBuffer) -> None:
    """Every trajectory of ``TwoEnds`` is one whole episode, the running ones included."""
    finished = [trajectory.rows for success in (True, False) for trajectory in buffer.trajectories(success)]
    running = [buffer.running.of(env) for env in np.flatnonzero(buffer.running.lengths).tolist()]
    for rows in (*finished, *running):
        np.testing.assert_array_equal(buffer.observations[rows[1:]], buffer.next_observations[rows[:-1]])
        assert buffer.observations[rows[0], 1] == 0.0  # the time within the episode
    assert all(buffer.dones[rows[-1]] and not buffer.dones[rows[:-1]].any() for rows in finished)


def copied(node: Any) -> Any:
    """A tree as a file holds it, in lists and dicts that may be changed."""
    if isinstance(node, dict):
        return {key: copied(each) for key, each in node.items()}
    if isinstance(node, (list, tuple)):
        return [copied(each) for each in node]
    if isinstance(node, th.Tensor):
        node = node.detach().numpy()
    return node.copy() if isinstance(node, np.ndarray) else node
