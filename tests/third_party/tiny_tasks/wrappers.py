"""Wrappers that do not say of which arguments they were made."""

import gymnasium as gym
from gymnasium import spaces


class Scaled(gym.ObservationWrapper):
    """Observations in other units."""

    def __init__(self, env, factor):
        super().__init__(env)
        self.factor = factor
        self.observation_space = spaces.Box(-2.0 * factor, 2.0 * factor, (2,))

    def observation(self, observation):
        return self.factor * observation


class Halved(Scaled):
    """Without arguments of its own."""

    def __init__(self, env):
        super().__init__(env, 0.5)
