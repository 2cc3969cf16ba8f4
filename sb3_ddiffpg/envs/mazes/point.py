"""A point mass in a maze."""

from sb3_ddiffpg.envs.mazes.env import MazeEnv, MazeVecEnv
from sb3_ddiffpg.envs.mazes.point_mass import PointSimulation


class PointMazeEnv(MazeEnv):
    """
    A :class:`MazeEnv` whose body is a point mass: the observation is (x, y, vx, vy) in metres and m/s, the action the
    commanded velocity in units of ``max_speed``. See :class:`~sb3_ddiffpg.envs.mazes.point_mass.PointSimulation`.
    """

    simulation_class = PointSimulation


class PointMazeVecEnv(MazeVecEnv):
    """Many :class:`PointMazeEnv`, moved by the same array operations."""

    simulation_class = PointSimulation
