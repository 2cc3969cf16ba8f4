"""
What a page draws of a run: modes, their history, where the run has been. Small and plain, so that a training can write it
beside its checkpoints; a file of it is data and holds no code. Needs no library for pictures.
"""

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from sb3_ddiffpg.modes.history import BIRTHS, ModeHistory

#: The file that a training writes
LIVE_FILE = "live.json"
#: Of a path, and of a curve over a run, so many points are kept
PATH_POINTS, CURVE_POINTS = 60, 200
_ENDS = ("merged into", "retired", "deleted")
_MOST_EVENTS = 2000


class MazeSketch(msgspec.Struct):
    """
    The plan of a maze.

    :param walls: Rectangles ``[x low, y low, x high, y high]``, in metres
    :param extent: Of the whole, ``[x low, x high, y low, y high]``
    :param start: ``[x, y]``
    :param goals: ``[x, y]`` of each
    """

    walls: list[list[float]]
    extent: list[float]
    start: list[float]
    goals: list[list[float]]


class ModeSketch(msgspec.Struct):
    """
    A mode as it is now; see ``modes.Mode``.

    :param number: For life
    :param name: Of the mode
    :param born_at: Environment steps
    :param n_trajectories: That train it
    :param success_rate: In training, None: not known
    :param mean_length: Of its trajectories in steps, None: not known
    :param frozen: Whether it is
    :param route: Its central path, one list of coordinates for each component
    """

    number: int
    name: str
    born_at: int
    n_trajectories: int
    success_rate: float | None
    mean_length: float | None
    frozen: bool
    route: list[list[float]]


class Life(msgspec.Struct):
    """
    From when to when a mode lived.

    :param number: Of the mode
    :param name: Its latest
    :param begin: Environment steps
    :param came: How it came
    :param end: Environment steps, None: it lives
    :param went: How it ended, None: it lives
    """

    number: int
    name: str
    begin: int
    came: str
    end: int | None = None
    went: str | None = None


class Course(msgspec.Struct):
    """
    A mode over the run, thinned.

    :param number: Of the mode
    :param step: Environment steps
    :param success: Share of successes in training then, None: not known
    :param n_trajectories: That trained it then
    """

    number: int
    step: list[int]
    success: list[float | None]
    n_trajectories: list[int]


class Sketch(msgspec.Struct):
    """
    A run, as far as it is.

    :param env: Id of the environment, empty: not known
    :param steps: Environment steps so far
    :param components: Names of the components of a path
    :param maze: Its plan, None where there is none
    :param modes: As they are now
    :param lives: Of all modes that ever were
    :param courses: Of the same
    :param events: Sentences, with the step before each
    :param coverage: Environment steps, and known cells then
    """

    env: str
    steps: int
    components: list[str]
    maze: MazeSketch | None
    modes: list[ModeSketch]
    lives: list[Life]
    courses: list[Course]
    events: list[tuple[int, str]]
    coverage: tuple[list[int], list[int]]


def thin(n: int, most: int) -> np.ndarray:
    """
    :param n: Number of points
    :param most: How many are to stay
    :return: Indices that stay, evenly spread, the first and the last among them; shape [min(n, most)]
    """
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int)) if n else np.zeros(0, dtype=int)


def columns(path: np.ndarray, most: int = PATH_POINTS) -> list[list[float]]:
    """
    :param path: Shape [N, dim]
    :param most: Points that are kept
    :return: One list for each of the first three components, in four digits of the path's span
    """
    if not path.size:
        return []
    kept = np.asarray(path, dtype=np.float64)[thin(len(path), most), :3]
    span = float(np.ptp(kept, axis=0).max()) or 1.0
    digits = int(np.clip(4 - np.ceil(np.log10(span)), 0, 9))
    return [column.round(digits).tolist() for column in kept.T]


def _maze(maze: Any) -> MazeSketch:
    """Walls side by side in a row become one rectangle. Row 0 of ``walls`` is the top one."""
    x_low, x_high, y_low, y_high = (float(edge) for edge in maze.extent)
    blocked = np.asarray(maze.walls, dtype=bool)
    height, width = (y_high - y_low) / blocked.shape[0], (x_high - x_low) / blocked.shape[1]
    walls = []
    for row, line in enumerate(blocked):
        edges = np.flatnonzero(np.diff(np.concatenate(([0], line.astype(int), [0])))).reshape(-1, 2)
        top = y_high - row * height
        walls += [[x_low + a * width, top - height, x_low + b * width, top] for a, b in edges.tolist()]
    goals = [[float(part) for part in goal] for goal in maze.goals]
    return MazeSketch(walls, [x_low, x_high, y_low, y_high], [float(part) for part in maze.start], goals)


def lives(history: ModeHistory) -> list[Life]:
    """
    :param history: Of a run
    :return: All modes of which it tells, by number
    """
    found: dict[int, Life] = {}
    for event in history:
        if event.kind in BIRTHS:
            came = " ".join(part for part in (event.kind, event.other) if part is not None)
            found[event.number] = Life(event.number, event.name, event.step, came)
        elif (life := found.get(event.number)) is not None:
            if event.kind == "renamed to" and event.other is not None:
                life.name = event.other
            elif event.kind in _ENDS:
                life.end, life.went = event.step, " ".join(part for part in (event.kind, event.other) if part is not None)
    return [found[number] for number in sorted(found)]


def _courses(history: ModeHistory) -> list[Course]:
    states: Mapping[str, np.ndarray] = history.state_dict()["states"]
    courses = []
    for number in np.unique(states["number"]).tolist():
        own = np.flatnonzero(states["number"] == number)
        own = own[thin(len(own), CURVE_POINTS)]
        success = [None if np.isnan(rate) else round(float(rate), 3) for rate in states["success_rate"][own]]
        courses.append(Course(number, states["step"][own].tolist(), success, states["n_trajectories"][own].tolist()))
    return courses


def _known(value: float) -> float | None:
    return None if np.isnan(value) else round(float(value), 3)


def sketch(model: Any, env: str, maze: Any = None) -> Sketch:
    """
    :param model: A DDiffPG, or another algorithm, which has no modes
    :param env: Id of its environment, empty: not known
    :param maze: The ``envs.Maze`` of its environment, None if it is none
    :return: What a page draws of it
    """
    history = getattr(model, "mode_history", None) or ModeHistory()
    modes = [
        ModeSketch(
            mode.number,
            mode.name,
            mode.born_at,
            mode.n_trajectories,
            _known(mode.success_rate),
            _known(mode.mean_length),
            mode.frozen,
            columns(mode.representative),
        )
        for mode in getattr(model, "modes", ())
    ]
    dim = max((len(mode.route) for mode in modes), default=2)
    names = ["x [m]", "y [m]"] if maze is not None else [f"mode feature {index}" for index in range(dim)]
    visits = getattr(model, "visits", None)
    coverage = np.array(visits.coverage if visits is not None else [], dtype=int).reshape(-1, 2)
    coverage = coverage[thin(len(coverage), CURVE_POINTS)]
    return Sketch(
        env=env,
        steps=int(getattr(model, "lifetime_steps", model.num_timesteps)),
        components=names,
        maze=None if maze is None else _maze(maze),
        modes=modes,
        lives=lives(history),
        courses=_courses(history),
        events=[(event.step, str(event)) for event in history.events[-_MOST_EVENTS:]],
        coverage=(coverage[:, 0].tolist(), coverage[:, 1].tolist()),
    )
