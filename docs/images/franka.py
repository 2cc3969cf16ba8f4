"""Draws franka.png beside this file: ``python docs/images/franka.py`` (needs matplotlib and pybullet)."""

from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt

import sb3_ddiffpg.envs  # noqa: F401 - registers the environments

figure, axes = plt.subplots(1, 4, figsize=(14, 3.6))
for axis, name in zip(axes, ("Reach", "PegInHole", "DrawerClose", "CabinetOpen"), strict=True):
    env = gym.make(f"Franka{name}-v0", render_mode="rgb_array")
    env.reset(seed=0)
    axis.imshow(env.render())
    axis.axis("off")
    env.close()
figure.tight_layout(pad=0.3)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=80)
