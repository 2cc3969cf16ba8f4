"""Environments with goals that could be others. Workers import them: neither SB3 nor PyTorch is imported here."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

NEAR = 0.5


class AnyGoal(gym.Env):
    """
    A point in the plane, and a place to go to.

    :param fixed: Whether it is always the same, but for a sensor's noise
    :param extra: What the reward has beside that of the goal
    :param dense: Whether it is the distance
    :param latches: Whether the episode ends there
    """

    def __init__(self, fixed=False, extra=0.0, dense=False, latches=False, limit=20):
        place = spaces.Box(-5.0, 5.0, (2,), np.float32)
        self.observation_space = spaces.Dict(observation=place, achieved_goal=place, desired_goal=place)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.fixed, self.extra, self.dense, self.latches, self.limit = fixed, extra, dense, latches, limit

    def compute_reward(self, achieved_goal, desired_goal, info):
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return -distance if self.dense else -(distance > NEAR).astype(np.float32)

    def _observation(self):
        here = self.position.astype(np.float32)
        return {"observation": here, "achieved_goal": here, "desired_goal": self.goal.astype(np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.steps = self.np_random.uniform(-0.1, 0.1, 2), 0
        self.goal = 2.0 + self.np_random.normal(0, 1e-4, 2) if self.fixed else self.np_random.uniform(-3, 3, 2)
        return self._observation(), {}

    def step(self, action):
        self.position = np.clip(self.position + 0.4 * action, -5, 5)
        self.steps += 1
        observation = self._observation()
        reward = float(self.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})) + self.extra
        reached = bool(np.linalg.norm(self.position - self.goal) <= NEAR)
        return observation, reward, reached and self.latches, self.steps >= self.limit, {"is_success": reached}


class NoGoals(gym.ObservationWrapper):
    """The observation alone."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = env.observation_space["observation"]

    def observation(self, observation):
        return observation["observation"]


class OneAtATime(gym.Wrapper):
    """Its reward is computed of one goal."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        return float(achieved_goal @ desired_goal)


def wrapped(wrapper):
    return wrapper(AnyGoal())
