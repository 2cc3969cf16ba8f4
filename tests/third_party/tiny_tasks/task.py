"""A line with a goal at either end."""

from typing import ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class TinyEnds(gym.Env):
    """Both goals are found by chance within a few episodes."""

    metadata: ClassVar[dict] = {"render_modes": ["rgb_array"]}

    def __init__(self, limit=8, render_mode=None):
        self.observation_space = spaces.Box(-2.0, 2.0, (2,))
        self.action_space = spaces.Box(-1.0, 1.0, (1,))
        self.limit, self.render_mode = limit, render_mode

    def _observation(self):
        return np.array([self.x, self.steps / self.limit], dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = float(self.np_random.uniform(-0.1, 0.1)), 0
        return self._observation(), {}

    def step(self, action):
        self.x += 0.5 * float(action[0])
        self.steps += 1
        reached = abs(self.x) >= 1
        return self._observation(), float(reached), reached, self.steps >= self.limit, {"is_success": reached}
