"""Obstacles that are drawn at each reset."""

from itertools import combinations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env as make_sb3_vec_env

from sb3_ddiffpg.envs import Maze, PointMazeEnv, PointMazeVecEnv, make_vec_env
from sb3_ddiffpg.envs.mazes.drawing import FLOOR, OBSTACLE

GAPS = [(-8, 12), (8, 12), (-8, 4), (8, 0), (-8, -4), (8, -8), (-8, -12)]


def reachable(rows, start, goal):
    """Flood fill, written out."""
    seen, stack = {start}, [start]
    while stack:
        i, j = stack.pop()
        for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if cell not in seen and rows[cell[0]][cell[1]] != "#":
                seen.add(cell)
                stack.append(cell)
    return goal in seen


def test_gap_cells_are_the_ways_past_the_islands():
    maze = Maze("V3")
    assert [tuple(maze.cell_center(cell)) for cell in maze.gap_cells] == GAPS
    assert Maze("V1").gap_cells == [(1, 2), (3, 2)]


def test_without_islands_the_passages_are_where_a_single_goal_is_cut_off():
    assert Maze("V2").gap_cells == [(3, 2), (3, 4)]  # the first steps to the west and to the east
    # All goals hang on the first three cells, and that in the middle has none of its own: behind it is another
    assert Maze(["########", "#r....g#", "####.###", "####.g.#", "######g#", "########"]).gap_cells == [(1, 5), (3, 6)]
    assert Maze(["#####", "#r.g#", "#####"]).gap_cells == [(1, 2)]
    assert Maze(["####", "#rg#", "####"]).gap_cells == []  # there is no cell between


def test_every_draw_can_be_solved_and_each_comes():
    env = PointMazeVecEnv(400, "V3", n_blocked=2)
    env.seed(0)
    env.reset()
    drawn = [info["blocked"] for info in env.reset_infos]
    assert set(drawn) == set(combinations(env.maze.gap_cells, 2)) and len(set(drawn)) == 21
    for blocked in set(drawn):
        rows = [list(row) for row in env.maze.rows]
        for i, j in blocked:
            rows[i][j] = "#"
        assert all(reachable(rows, env.maze.start_cell, goal) for goal in env.maze.goal_cells)
    # V1 has two ways: never both
    narrow = PointMazeVecEnv(50, "V1", n_blocked=1)
    narrow.reset()
    assert {info["blocked"] for info in narrow.reset_infos} == {((1, 2),), ((3, 2),)}
    with pytest.raises(ValueError, match="n_blocked: 2 given, but wherever they are, a goal cannot be reached"):
        PointMazeVecEnv(1, "V1", n_blocked=2)


def test_bodies_stop_at_their_own_obstacles_only():
    env = PointMazeVecEnv(3, "V3", n_blocked=2, start_noise=0.0)
    west = np.array([[-1.0, 0.0]] * 3)
    env.set_options([{"position": (-4, 4), "blocked": blocked} for blocked in ([(3, 2)], [], [(1, 2), (5, 2)])])
    env.reset()
    for _ in range(12):
        observations, *_ = env.step(west)
    assert observations[0, 0] > -6 and (observations[1:, 0] < -10).all()
    env.set_options([{"position": (-4, 4), "blocked": blocked} for blocked in ([], [(3, 2)], [])])
    env.reset()
    for _ in range(12):
        observations, *_ = env.step(west)
    assert observations[1, 0] > -6 and (observations[[0, 2], 0] < -10).all()


def test_many_like_single_ones_bit_for_bit():
    ours = make_vec_env("PointMazeRandom-v0", 5, seed=2, max_episode_steps=40)
    theirs = make_sb3_vec_env("PointMazeRandom-v0", 5, seed=2, env_kwargs={"max_episode_steps": 40})
    rng = np.random.default_rng(0)
    assert np.array_equal(ours.reset(), theirs.reset())
    held = rng.uniform(-1, 1, (20, 5, 2)).astype(np.float32)
    for actions in np.repeat(held, 10, axis=0):
        assert ours.venv.reset_infos == theirs.reset_infos
        for ours_part, theirs_part in zip(ours.step(actions)[:3], theirs.step(actions)[:3], strict=True):
            assert np.array_equal(ours_part, theirs_part)


def test_obstacles_are_not_observed_but_told_and_drawn():
    env = gym.make("PointMazeRandom-v0", render_mode="rgb_array")
    observation, info = env.reset(seed=0, options={"blocked": [(3, 2)]})
    assert observation.shape == (4,) and info == {"blocked": ((3, 2),)}
    image = env.render()
    at = {(x, y): tuple(image[round(180 - 10 * y), round(180 + 10 * x)]) for x, y in [(-8, 4), (-8, -4)]}
    assert at == {(-8, 4): OBSTACLE, (-8, -4): FLOOR}
    assert PointMazeEnv("V3").reset()[1] == {}


def test_no_body_begins_in_an_obstacle():
    """Start noise reaches into a gap cell; a position that is asked for is one."""
    rows = ["#######", "#..r.g#", "#.#.#.#", "#.....#", "#######"]
    env = PointMazeVecEnv(200, rows, n_blocked=1, start_noise=(4.0, 0.0))
    env.seed(0)
    env.reset()
    reach = np.array([4.4, 0.4])
    assert len({info["blocked"] for info in env.reset_infos}) > 1
    for info in env.reset_infos:
        for cell in info["blocked"]:
            assert (np.abs(env.maze.cell_center(cell)) >= 2 + reach).any()
    lone = PointMazeEnv("V3", n_blocked=2)
    gap = (3, 2)
    assert all(gap not in lone.reset(options={"position": (-8, 4)})[1]["blocked"] for _ in range(40))
    with pytest.raises(ValueError, match="but the body begins there"):
        lone.reset(options={"position": (-8, 4), "blocked": [gap]})


def test_a_hollow_island_has_no_passage():
    rows = ["########", "#r....g#", "#..#...#", "#.#.#..#", "#.###..#", "#......#", "########"]
    assert Maze(rows).gap_cells == [(1, 3), (5, 3)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"blocked": [(0, 0)]}, r"blocked \[\(0, 0\)\] given; accepted are gap cells"),
        ({"blocked": [(1, 2), (3, 2), (5, 2), (7, 2), (1, 6), (4, 6), (6, 6)]}, "no goal can be reached"),
        ({"wall": 1}, r"options: \['wall'\] given; accepted are \['blocked', 'position'\]"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        PointMazeEnv("V3", n_blocked=1).reset(options=options)
    with pytest.raises(ValueError, match=r"accepted are \['position'\]"):
        PointMazeEnv("V3").reset(options=options)
