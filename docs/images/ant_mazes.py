"""Draws ant_mazes.png beside this file: ``python docs/images/ant_mazes.py`` (needs matplotlib, and EGL or OSMesa)."""

from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt

import sb3_ddiffpg.envs  # noqa: F401 - registers the environments

figure, axes = plt.subplots(1, 3, figsize=(12, 4.1))
for axis, env_id in zip(axes, ("AntMazeV3-v0", "AntMazeRandom-v0", "PointMazeRandom-v0"), strict=True):
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=3)
    env.action_space.seed(0)
    for _ in range(20 if env_id == "AntMazeV3-v0" else 0):
        env.step(env.action_space.sample())
    axis.imshow(env.render())
    axis.axis("off")
    env.close()
figure.tight_layout(pad=0.3)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=90)
