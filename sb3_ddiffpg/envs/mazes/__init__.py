"""Mazes for a point and an ant, with ground-truth labels of the routes."""

from sb3_ddiffpg.envs.mazes.homotopy import HomotopyTracker
from sb3_ddiffpg.envs.mazes.maze import CELL_SIZE, LISTED_ROUTES, MAZES, Cut, Maze, reduce_word

__all__ = ["CELL_SIZE", "LISTED_ROUTES", "MAZES", "Cut", "HomotopyTracker", "Maze", "reduce_word"]
