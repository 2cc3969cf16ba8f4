"""Tiny environments, models and hand-made trajectories, shared by tests."""

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import Logger

from sb3_ddiffpg import DDiffPG, ModeReplayBuffer
from sb3_ddiffpg.exploration.bonus import ExplorationBonus
from sb3_ddiffpg.serialization.random_states import restore_generator

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


class TwoEnds(gym.Env):
    """A point on a line with a goal at either end: two ways, both found by chance within a few episodes."""

    def __init__(self, success_key: str | None = "is_success", limit: int = 8) -> None:
        self.observation_space = spaces.Box(-2.0, 2.0, (2,))
        self.action_space = spaces.Box(-1.0, 1.0, (1,))
        self.mode_features = np.array([0])
        # No test of counts need wait until so much has been seen that cells have a size
        self.cell_size = self.novelty_cell_size = 0.5
        self.success_key, self.limit = success_key, limit
        self.x, self.steps = 0.0, 0

    def _observation(self) -> np.ndarray:
        return np.array([self.x, self.steps / self.limit], dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.x, self.steps = float(self.np_random.uniform(-0.1, 0.1)), 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.x += 0.5 * float(action[0])
        self.steps += 1
        reached = abs(self.x) >= 1
        info = {} if self.success_key is None else {self.success_key: reached}
        return self._observation(), float(reached), reached, self.steps >= self.limit, info


class Fragile(TwoEnds):
    """Raises, dies or hangs, when it is told to."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        if abs(action[0]) > 0.99:
            raise ZeroDivisionError("broken leg")
        return super().step(action)

    def die(self) -> None:
        os._exit(3)

    def hang(self, seconds: float) -> None:
        time.sleep(seconds)

    def pid(self) -> int:
        return os.getpid()


class KnownEnds(TwoEnds):
    """``TwoEnds`` that can say where its episode is."""

    def state_dict(self) -> dict[str, Any]:
        return {"x": self.x, "steps": self.steps, "random": self.np_random.bit_generator.state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if not (isinstance(state["x"], float) and abs(state["x"]) < 10 and state["steps"] in range(100)):
            raise ValueError("an episode cannot be there")
        self.x, self.steps = state["x"], state["steps"]
        restore_generator(self.np_random, state["random"])


class AnySpaces(gym.Env):
    """Random observations of any space; an action is rewarded by its first component."""

    def __init__(
        self, observation_space: spaces.Space | None = None, action_space: spaces.Box | None = None, limit: int = 10
    ) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (2,)) if observation_space is None else observation_space
        self.action_space = spaces.Box(-1.0, 1.0, (2,)) if action_space is None else action_space
        self.limit, self.steps = limit, 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        assert self.action_space.contains(action)
        self.steps += 1
        return self.observation_space.sample(), float(np.ravel(action)[0]), False, self.steps >= self.limit, {}


class BreaksAt(gym.Wrapper):
    """Gives ``value`` for the ``part`` of the ``when``-th step (or reset), counted over episodes from 1, and only then."""

    def __init__(self, env: gym.Env, part: str, when: int, value: float = np.nan) -> None:
        super().__init__(env)
        self.part, self.when, self.value, self.count = part, when, value, 0

    def _breaks(self, here: bool) -> bool:
        self.count += here
        return here and self.count == self.when

    def reset(self, **kwargs: Any) -> tuple[Any, dict]:
        observation, info = self.env.reset(**kwargs)
        return (self._broken(observation) if self._breaks(self.part == "reset") else observation), info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict]:
        assert np.isfinite(action).all(), "a simulator must not be given NaN"
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._breaks(self.part != "reset"):
            if self.part == "observation":
                observation = self._broken(observation)
            else:
                reward = self.value
        return observation, reward, terminated, truncated, info

    def _broken(self, observation: np.ndarray) -> np.ndarray:
        return np.full_like(observation, self.value)


# Random rewards are no reason to warn of returns outside the critics' support
WIDE: dict[str, Any] = {"critic": {"v_min": -50.0, "v_max": 50.0}}


def image_dict_space(channel_last: bool = False) -> spaces.Dict:
    """An image, a vector and a number, as SB3's tests of dict observations use them."""
    shape = (36, 36, 1) if channel_last else (1, 36, 36)
    return spaces.Dict(
        {
            "img": spaces.Box(0, 255, shape, dtype=np.uint8),
            "vec": spaces.Box(-1.0, 1.0, (2,)),
            "discrete": spaces.Discrete(4),
        }
    )


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
