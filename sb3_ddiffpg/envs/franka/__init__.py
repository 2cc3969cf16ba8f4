"""Manipulation with a Franka Panda arm (pybullet), each task with several routes."""
