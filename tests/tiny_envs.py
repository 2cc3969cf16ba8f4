"""Tiny environments. Workers import them: neither SB3 nor PyTorch is imported here."""

import os
import sys
import time
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_ddiffpg.serialization.random_states import restore_generator


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


class HangsAt(TwoEnds):
    """Never comes back from the given call."""

    def __init__(self, call=None):
        super().__init__()
        self.call = call
        self._wait("make")

    def _wait(self, call):
        if call == self.call:
            time.sleep(1000)

    def reset(self, **kwargs):
        self._wait("reset")
        return super().reset(**kwargs)

    def step(self, action):
        self._wait("step")
        return super().step(action)

    def state_dict(self):
        self._wait("state_dict")
        return {}


class Says(TwoEnds):
    """Has a "mode" in its info: by which end the episode ended, or something else."""

    def __init__(self, listed=None, what=None, **kwargs):
        super().__init__(**kwargs)
        self.what = what
        if listed is not None:
            self.listed_modes = listed

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {**info, "mode": self.what or ("left" if self.x < 0 else "right")}


class KnownEnds(TwoEnds):
    """``TwoEnds`` that can say where its episode is."""

    def state_dict(self) -> dict[str, Any]:
        return {"x": self.x, "steps": self.steps, "random": self.np_random.bit_generator.state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if not (isinstance(state["x"], float) and abs(state["x"]) < 10 and state["steps"] in range(100)):
            raise ValueError("an episode cannot be there")
        self.x, self.steps = state["x"], state["steps"]
        restore_generator(self.np_random, state["random"])


class TellsModules(gym.Wrapper):
    """Whether a module was imported where it lives."""

    def has(self, module: str) -> bool:
        return module in sys.modules


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
