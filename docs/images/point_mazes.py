"""Draws point_mazes.png beside this file: ``python docs/images/point_mazes.py`` (needs matplotlib)."""

from collections import deque
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from sb3_ddiffpg.envs.mazes.drawing import draw_maze
from sb3_ddiffpg.envs.mazes.maze import MAZES, Maze, reduce_word


def shortest_route(maze: Maze, label: str) -> np.ndarray:
    """
    :param maze: the maze
    :param label: of the route wanted
    :return: centres of the cells on a shortest such route, shape (length, 2)
    """
    goal_id, wanted = label.replace("-", "").split(":")
    end = maze.goal_cells[int(goal_id)]
    queue = deque([(maze.start_cell, "", [maze.start_cell])])
    seen = {(maze.start_cell, "")}
    while queue:
        (i, j), word, cells = queue.popleft()
        if ((i, j), word) == (end, wanted):
            return np.array([maze.cell_center(cell) for cell in cells])
        for cell in [(i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)]:
            crossed = maze.crossings(maze.cell_center((i, j))[None], maze.cell_center(cell)[None])
            longer = reduce_word(word + "".join(letter for _, letter in crossed))
            # An episode ends at the first goal
            open_cell = not maze.walls[cell] and (cell == end or cell not in maze.goal_cells)
            if open_cell and len(longer) <= len(wanted) + 1 and (cell, longer) not in seen:
                seen.add((cell, longer))
                queue.append((cell, longer, [*cells, cell]))
    raise ValueError(f"label: {label!r} given, but no route of maze {maze.name} has it")


def draw(axes: plt.Axes, maze: Maze) -> None:
    """
    :param axes: to draw on
    :param maze: drawn with its cuts and its listed routes
    """
    axes.imshow(draw_maze(maze, goal_radius=1.0), extent=maze.extent)
    for cut in maze.cuts:
        axes.plot([cut.x, cut.x], [cut.y_low, cut.y_high], color="black", linestyle=":", linewidth=1)
        axes.text(cut.x + 0.3, cut.y_low + 0.3, cut.letter, fontsize=9)
    shifts = np.linspace(-0.7, 0.7, len(maze.listed_routes))
    for k, (label, shift) in enumerate(zip(maze.listed_routes, shifts, strict=True)):
        route = shortest_route(maze, label)
        # Side by side where they run together
        route[1:-1] += shift * np.array([1.0, -1.0])
        axes.plot(*route.T, color=f"C{k}", linewidth=1.8, label=label)
    axes.set_title(f"PointMaze{maze.name}-v0", fontsize=9)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=3, fontsize=7, frameon=False, handlelength=1.2)
    axes.tick_params(labelsize=7)


if __name__ == "__main__":
    figure, panels = plt.subplots(1, 4, figsize=(12, 3.6), dpi=100, layout="constrained")
    for panel, name in zip(panels, MAZES, strict=True):
        draw(panel, Maze(name))
    figure.savefig(Path(__file__).with_suffix(".png"))
