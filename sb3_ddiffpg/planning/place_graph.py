"""Places that episodes have been to, and the ways between them: what a planner plans on."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from sb3_ddiffpg.planning.travels import Travel
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert

#: Places along the longest side of all that is known
RESOLUTION = 25
#: A way that was only gone in the other direction is expected to take so many times as long
UNTRIED = 2.0
#: A place with nothing known around it is expected to take so much longer: there may be walls
EDGE = 3.0
# Where one gets on slowly counts this much, at most
_SLOWEST = 4.0
# A straight line leads over known places while it comes so close to them, in their size
_CLOSE = 0.75


class _State(msgspec.Struct, forbid_unknown_fields=True):
    positions: np.ndarray
    spacing: float
    edges: np.ndarray
    steps: np.ndarray
    goals: np.ndarray


class Plan:
    """
    How to come to a target from each of N places.

    :param left: Steps to expect from there, infinite where there is no way, shape [N]
    :param after: The place that follows, negative at a target and where there is no way, shape [N]
    """

    def __init__(self, left: np.ndarray, after: np.ndarray) -> None:
        self.left, self.after = left, after

    def ahead(self, place: int, n: int) -> list[int]:
        """
        :param place: Where it begins
        :param n: Number of places, at most
        :return: It, and those that follow
        """
        places = [place]
        while len(places) < n and self.after[places[-1]] >= 0:
            places.append(int(self.after[places[-1]]))
        return places


class PlaceGraph:
    """
    Places are cells of the mode features, a ``RESOLUTION``-th of all that is known along each side. Ways lead from a place to
    those that episodes have come to next, there and back, and take as long as one gets on there.

    :param positions: Mean position in each of N places, in the unit in which places are as long as wide, shape [N, dim]
    :param spacing: Length of a place's sides
    :param edges: From which place to which each way leads, shape [E, 2]
    :param steps: What to expect of each way, shape [E]
    :param goals: Where goals were reached, shape [G, dim]
    """

    def __init__(self, positions: np.ndarray, spacing: float, edges: np.ndarray, steps: np.ndarray, goals: np.ndarray) -> None:
        self.positions, self.spacing, self.edges, self.steps, self.goals = positions, spacing, edges, steps, goals
        self._tree = cKDTree(positions)
        #: The place nearest to each goal that was reached, shape [G]
        self.goal_places = self.nearest(goals) if len(goals) else np.empty(0, dtype=np.int64)

    @classmethod
    def of(cls, travels: Sequence[Travel], scale: np.ndarray) -> "PlaceGraph":
        """
        :param travels: At least one
        :param scale: What mode features are divided by, shape [dim]
        :return: The graph of where they have been
        """
        paths = [each.places / scale for each in travels]
        points = np.concatenate(paths)
        spacing = float(max(np.ptp(points, axis=0).max() / RESOLUTION, 1e-9))
        cells, place = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_inverse=True)
        place = place.ravel()
        count = np.bincount(place)
        positions = np.stack([np.bincount(place, part) / count for part in points.T], axis=1)

        # Steps, but not from the end of an episode to the beginning of the next
        first = np.setdiff1d(np.arange(len(points)), np.cumsum([len(path) for path in paths]) - 1)
        lengths = np.linalg.norm(points[first + 1] - points[first], axis=1)
        pace = max(float(lengths.mean()), 1e-9)
        # Where episodes have only ended, nobody was slow
        known = np.bincount(place[first], minlength=len(cells))
        speed = np.where(known > 0, np.bincount(place[first], lengths, len(cells)) / np.maximum(known, 1), pace)
        slowness = np.clip(pace / np.maximum(speed, 1e-9), 1.0, _SLOWEST) * (1.0 + EDGE * _unknown_sides(cells))

        crossing = first[place[first] != place[first + 1]]
        edges = np.unique(np.stack((place[crossing], place[crossing + 1]), axis=1), axis=0)
        edges, factor = _both_ways(edges)
        distances = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
        steps = factor * distances / pace * slowness[edges].mean(axis=1)
        goals = [path[-1] for each, path in zip(travels, paths, strict=True) if each.success]
        return cls(positions, spacing, edges, steps, np.array(goals).reshape(-1, points.shape[1]))

    def __len__(self) -> int:
        return len(self.positions)

    def nearest(self, positions: np.ndarray) -> np.ndarray:
        """
        :param positions: Shape [N, dim]
        :return: The place nearest to each, shape [N]
        """
        return np.asarray(self._tree.query(positions)[1])

    def around(self, position: np.ndarray, radius: float) -> np.ndarray:
        """
        :param position: Shape [dim]
        :param radius: In the unit of positions
        :return: Places no farther than that, shape [n]
        """
        return np.array(self._tree.query_ball_point(position, radius), dtype=np.int64)

    def sees(self, position: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """
        :param position: Shape [dim]
        :param targets: Shape [N, dim]
        :return: Whether the straight line to each leads over known places, shape [N]
        """
        n = 2 + int(np.ceil(2 * np.linalg.norm(targets - position, axis=1).max() / self.spacing))
        points = position + np.linspace(0, 1, n)[None, 1:, None] * (targets - position)[:, None]
        return (self._tree.query(points)[0] <= _CLOSE * self.spacing).all(axis=1)

    def plan(self, targets: np.ndarray, penalty: np.ndarray | None = None) -> Plan:
        """
        :param targets: Places to come to, any of them, shape [n]
        :param penalty: Further steps that each place is held to take, shape [N]
        :return: The way there from everywhere
        """
        if not len(targets):
            return Plan(np.full(len(self), np.inf), np.full(len(self), -1))
        steps = self.steps if penalty is None else self.steps + penalty[self.edges].mean(axis=1)
        # From the targets backwards
        backwards = csr_matrix((steps, self.edges.T[::-1]), shape=(len(self), len(self)))
        left, after, _ = dijkstra(backwards, indices=targets, min_only=True, return_predecessors=True)
        return Plan(left, after)

    def state_dict(self) -> dict[str, Any]:
        """
        :return: All of it, in plain values and arrays
        """
        return {name: getattr(self, name) for name in _State.__struct_fields__}

    @classmethod
    def from_state(cls, tree: Any, dim: int) -> "PlaceGraph":
        """
        :param tree: What ``state_dict`` gave
        :param dim: Number of mode features
        :return: The same graph
        :raises ValueError: If it is something else
        """
        state = convert(tree, _State, "planner.graph")
        n, e = len(state.positions), len(state.edges)
        check_array(state.positions, np.float64, [n, dim], "planner.graph.positions")
        check_array(state.edges, np.int64, [e, 2], "planner.graph.edges")
        check_array(state.steps, np.float64, [e], "planner.graph.steps")
        check_array(state.goals, np.float64, [None, dim], "planner.graph.goals")
        numbers = (state.positions, state.steps, state.goals, np.array(state.spacing))
        if not n or not all(np.isfinite(each).all() for each in numbers) or not state.spacing > 0 or (state.steps < 0).any():
            raise ValueError("planner.graph: accepted are places, and numbers of them that are finite and not negative")
        if e and not 0 <= state.edges.min() <= state.edges.max() < n:
            raise ValueError(f"planner.graph.edges: accepted are the places 0 to {n - 1}")
        return cls(*(getattr(state, name) for name in _State.__struct_fields__))


def _both_ways(edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ways that were gone may be gone back, for all that is known; and how much longer each is expected to take."""
    known = set(map(tuple, edges.tolist()))
    untried = np.array([(after, before) not in known for before, after in edges.tolist()], dtype=bool)
    both = np.concatenate((edges, edges[untried, ::-1]))
    return both, np.repeat((1.0, UNTRIED), (len(edges), int(untried.sum())))


def _unknown_sides(cells: np.ndarray) -> np.ndarray:
    """Share of each cell's neighbours that nobody has been to, [N]."""
    known = set(map(tuple, cells.tolist()))
    steps = np.concatenate((np.eye(cells.shape[1], dtype=int), -np.eye(cells.shape[1], dtype=int)))
    return np.array([np.mean([tuple(each) not in known for each in (cell + steps).tolist()]) for cell in cells])
