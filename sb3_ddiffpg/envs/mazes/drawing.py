"""Pictures of mazes, drawn with NumPy alone."""

import numpy as np
import numpy.typing as npt

from sb3_ddiffpg.envs.mazes.maze import CELL_SIZE, FloatArray, Maze

Image = npt.NDArray[np.uint8]

PIXELS_PER_METRE = 10

WALL = (58, 64, 74)
FLOOR = (246, 244, 239)
START = (168, 203, 240)
GOAL = (92, 184, 112)
OBSTACLE = (150, 104, 66)
BODY = (214, 62, 44)
OUTLINE = (20, 20, 20)


def draw_maze(maze: Maze, goal_radius: float) -> Image:
    """
    Walls, the start cell's centre (blue square) and the goals (green discs).

    :param maze: the maze
    :param goal_radius: radius of the discs, in metres
    :return: RGB image, ``PIXELS_PER_METRE`` to a metre, shape (height, width, 3)
    """
    side = round(CELL_SIZE * PIXELS_PER_METRE)
    walls = maze.walls.repeat(side, axis=0).repeat(side, axis=1)
    image = np.where(walls[..., None], WALL, FLOOR).astype(np.uint8)
    fill_square(image, maze, maze.start, 1.0, START)
    x_min, _, _, y_max = maze.extent
    x = x_min + (np.arange(image.shape[1]) + 0.5) / PIXELS_PER_METRE
    y = y_max - (np.arange(image.shape[0]) + 0.5) / PIXELS_PER_METRE
    for goal in maze.goals:
        image[(x - goal[0]) ** 2 + (y[:, None] - goal[1]) ** 2 <= goal_radius**2] = GOAL
    return image


def draw_body(image: Image, maze: Maze, position: FloatArray, half_size: float) -> None:
    """
    Draw a square body (red, outlined) into the picture of a maze.

    :param image: made by :func:`draw_maze`, changed in place
    :param maze: the same maze
    :param position: centre (x, y) of the body
    :param half_size: half its side, in metres
    """
    fill_square(image, maze, position, half_size, OUTLINE)
    fill_square(image, maze, position, half_size - 1 / PIXELS_PER_METRE, BODY)


def fill_square(image: Image, maze: Maze, center: FloatArray, half_size: float, color: tuple[int, int, int]) -> None:
    """
    :param image: made by :func:`draw_maze`, changed in place
    :param maze: the same maze
    :param center: (x, y) of the square
    :param half_size: half its side, in metres
    :param color: red, green, blue
    """
    x, y = center[0] - maze.extent[0], maze.extent[3] - center[1]
    left, right, top, bottom = (
        round(PIXELS_PER_METRE * edge) for edge in (x - half_size, x + half_size, y - half_size, y + half_size)
    )
    image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = color
