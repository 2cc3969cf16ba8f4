"""A package of somebody else: importing it registers its task. Tests put its folder on ``sys.path``."""

import gymnasium as gym

gym.register("TinyEnds-v0", entry_point="tiny_tasks.task:TinyEnds")
