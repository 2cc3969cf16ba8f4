"""The exploration bonus: what explorers, and if wanted modes, are paid for what is new to them."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import msgspec
import numpy as np
import torch as th
from torch import nn

from sb3_ddiffpg.buffers.batch import ModeBatch, VisitedSteps
from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.routes import ROUTE_SHARE
from sb3_ddiffpg.buffers.trajectory import StepRecord, Trajectory
from sb3_ddiffpg.clustering.paths import extent
from sb3_ddiffpg.exploration.known_regions import NO_ROUTE, KnownCells, KnownRoute, KnownRoutes, come_along
from sb3_ddiffpg.exploration.novelty import NOVELTY_MEASURES, RunningMoments, VisitCounts, cell_entries, noveld_reward
from sb3_ddiffpg.exploration.settings import ExplorationSettings, NoveltySettings
from sb3_ddiffpg.exploration.visit_map import VisitMap
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert
from sb3_ddiffpg.utils.divergence import DivergenceWatch

# Rows of which visits are taken back at a time
_AT_A_TIME = 50_000


class _Route(msgspec.Struct, forbid_unknown_fields=True):
    number: int
    paths: np.ndarray
    radius: float


class _Cells(msgspec.Struct, forbid_unknown_fields=True):
    number: int
    entries: np.ndarray


class _State(msgspec.Struct, forbid_unknown_fields=True):
    routes: list[_Route]
    cells: list[_Cells]
    visits: Any


class Notes(Protocol):
    """What the bonus notes of each stored step, by row: arrays of a replay buffer."""

    first_visits: np.ndarray
    followed: np.ndarray
    counted: np.ndarray


class ExplorationBonus:
    """
    NovelD's reward (Zhang et al., 2021) on a measure of novelty, and what it depends on: places that an episode has seen,
    places and routes that the modes know already, and a map of all visits.

    :param novelty_model: The measure, see ``novelty.NOVELTY_MEASURES``
    :param dim: Number of mode features
    :param settings: What is new, and what it is worth
    :param exploration: What explorers are not paid for where there are modes; None: there are none
    :param n_envs: Number of environments
    :param cell_size: Edge of the cells by which places are told apart, in the unit of the mode features
    :param visit_map: Where visits are counted for pictures; None: nowhere
    """

    def __init__(
        self,
        novelty_model: nn.Module,
        dim: int,
        settings: NoveltySettings,
        exploration: ExplorationSettings | None,
        n_envs: int,
        cell_size: float,
        visit_map: VisitMap | None = None,
    ) -> None:
        self.dim, self.settings, self.exploration = dim, settings, exploration
        self.cell_size, self.visit_map = cell_size, visit_map
        self.novelty_model: Any = novelty_model
        self.moments = RunningMoments(1, max_count=100_000)
        self.known_cells = None if exploration is None else KnownCells(cell_size)
        self.routes = KnownRoutes(n_envs)
        #: Cells that each running episode has seen
        self._seen: list[set[int]] = [set() for _ in range(n_envs)]

    def to(self, device: th.device) -> "ExplorationBonus":
        """
        :param device: Where its networks and tables are from now on
        :return: Itself
        """
        for part in (self.novelty_model, self.moments, self.known_cells):
            if part is not None:
                part.to(device)
        return self

    @property
    def device(self) -> th.device:
        """Where rewards are computed."""
        return self.moments.mean.device

    # ------------------------------------------------------------------ from steps

    def observe(self, record: StepRecord, notes: Notes) -> None:
        """
        Take note of a step of all environments.

        :param record: Of the step
        :param notes: Where to note what is remembered of it
        """
        rows, positions = record.rows, record.positions
        if self.routes.routes and record.scale is not None:  # else nothing can be compared yet
            self.routes.observe(positions / record.scale)
        followed = notes.followed[rows] = self.routes.followed.copy()
        counts = notes.counted[rows] = followed == NO_ROUTE
        notes.first_visits[rows] = self._first_visits(record) if self.settings.episodic else True
        if counts.any():
            self.novelty_model.observe(th.as_tensor(positions[counts], device=self.device))
        if self.visit_map is not None:
            self.visit_map.observe(positions)
        for env, _ in record.finished:
            self._forget_episode(env)

    def _first_visits(self, record: StepRecord) -> list[bool]:
        n_started = len(record.started)
        both = np.concatenate((record.start_positions, record.positions)) if n_started else record.positions
        cells = self._cells(both)
        for env, cell in zip(record.started.tolist(), cells[:n_started], strict=True):
            self._seen[env].add(cell)
        cells = cells[n_started:]
        first = [cell not in seen for cell, seen in zip(cells, self._seen, strict=True)]
        for cell, seen in zip(cells, self._seen, strict=True):
            seen.add(cell)
        return first

    def _cells(self, positions: np.ndarray) -> list[int]:
        """The cell of each position, as a number."""
        return cell_entries(th.from_numpy(positions), self.cell_size, 2**31).tolist() if len(positions) else []

    def _forget_episode(self, env: int) -> None:
        self._seen[env].clear()
        self.routes.forget(env)

    def forget_episodes(self) -> None:
        """The environments were reset outside: no episode is running."""
        for env in range(len(self._seen)):
            self._forget_episode(env)

    def recall_episodes(self, buffer: ModeReplayBuffer) -> None:
        """
        After loading: where the running episodes have been.

        :param buffer: Holds them
        """
        self.forget_episodes()
        for env, seen in enumerate(self._seen):
            rows = buffer.running.of(env)
            if len(rows) and self.settings.episodic:
                start = buffer.positions(buffer.steps, "observations", rows[:1])
                reached = buffer.positions(buffer.nexts, "next_observations", rows)
                seen.update(self._cells(np.concatenate((start, reached))))
        self._recall_routes(buffer)

    def _recall_routes(self, buffer: ModeReplayBuffer) -> None:
        if self.routes.routes:
            for env in np.flatnonzero(buffer.running.lengths).tolist():
                self.routes.replay(env, buffer.reached(buffer.running.of(env)))

    # ------------------------------------------------------------------ for batches

    def reward(
        self,
        visited: VisitedSteps,
        gamma: float,
        mode_gamma: float,
        watch: DivergenceWatch,
        encode: Callable[[Any], th.Tensor] | None = None,
    ) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        Discounted NovelD rewards over windows of consecutive steps, followed by one step of the novelty measure.

        :param visited: Steps of G groups of n windows
        :param gamma: Discount factor of the first group
        :param mode_gamma: Of the others
        :param watch: Looks at the novelty
        :param encode: Maps observations, not normalised, to what the networks take, for measures that see it
        :return: The rewards, [G, n], and numbers to log
        """
        settings = self.settings
        inputs = self._inputs(visited, encode)
        now, then = (self.novelty_model.novelty(*each) for each in inputs)
        reward = watch.finite("the novelty", noveld_reward(now, then, settings.scale), 0.0)
        reward = reward * self._bonus_mask(visited)
        metrics = {"intrinsic_reward": reward.mean()}
        for_modes = len(visited.present) > 1
        if settings.normalize or for_modes:
            self.moments.update(reward[:, None])
        if settings.normalize:
            # Not centred: where nothing is new, a negative reward would make it worth while to end the episode at a goal.
            # Limited: one surprising state would dominate the values for long
            scale = self.moments.var.sqrt() + 1e-8
            reward = (reward / scale).clamp(max=settings.clip)
        if self.novelty_model.optimizer is not None:
            metrics["novelty_loss"] = self.novelty_model.update(*inputs[1])
        present = visited.present
        places = th.from_numpy(np.flatnonzero(present)).to(self.device, non_blocking=True)
        rewards = reward.new_zeros(present.size).index_copy(0, places, reward).view(present.shape)
        if for_modes:
            # For a mode an ordinary place is worth nothing: staying there for ever would be worth as much as a distant goal
            ordinary = (self.moments.mean / scale).clamp(max=settings.clip) if settings.normalize else self.moments.mean
            rewards[1:] -= ordinary * th.from_numpy(present[1:]).to(self.device, non_blocking=True)
        steps = th.arange(present.shape[-1], device=self.device)
        rewards[:1] *= gamma**steps
        rewards[1:] *= mode_gamma**steps
        return settings.coef * rewards.sum(dim=-1).float(), metrics

    def _inputs(self, visited: VisitedSteps, encode: Any) -> list[tuple[th.Tensor, th.Tensor]]:
        """What the measure sees of the states before and after each step: positions and features."""
        pairs = ((visited.positions, visited.observations), (visited.next_positions, visited.next_observations))
        if not getattr(self.novelty_model, "with_observation", False):
            return [(positions, positions) for positions, _ in pairs]
        with th.no_grad():
            return [(positions, encode(observations)) for positions, observations in pairs]

    def _bonus_mask(self, visited: VisitedSteps) -> th.Tensor:
        """Where novelty is paid, of the N steps that there are."""
        pays = th.from_numpy(visited.first_visits).to(self.device, non_blocking=True)
        cells = self.known_cells if self.known_cells is not None and self.known_cells.any else None
        if not self.routes.routes and cells is None:
            return pays
        explores = np.nonzero(visited.present)[0] == EXPLORATORY_GROUP
        if self.routes.routes:
            past = th.from_numpy(explores & self.routes.include(visited.followed))
            pays = pays & ~past.to(self.device, non_blocking=True)
        if cells is not None:
            # What a mode knows is not new, or explorers would follow it to what lies beyond
            there = th.from_numpy(explores).to(self.device, non_blocking=True)
            pays = pays & ~(there & cells.contain(visited.next_positions))
        return pays

    def end_past_routes(self, batch: ModeBatch) -> ModeBatch:
        """
        What lies past a known route is worth nothing to explorers who came along it: their returns end there.

        :param batch: A batch
        :return: The same, with other discounts
        """
        if not self.routes.routes:
            return batch
        past = np.zeros(batch.visited.present.shape, dtype=bool)
        past[batch.visited.present] = self.routes.include(batch.visited.followed)
        goes_on = th.from_numpy(~past[EXPLORATORY_GROUP].any(axis=-1)).to(self.device, non_blocking=True)
        discounts = batch.discounts.clone()
        discounts[EXPLORATORY_GROUP] *= goes_on
        return batch._replace(discounts=discounts)

    # ------------------------------------------------------------------ from modes

    def on_modes_changed(self, buffer: ModeReplayBuffer, mastered: Mapping[int, int]) -> None:
        """
        From now on the places and routes are known of those modes that have mastered theirs. A mode without trajectories keeps
        its.

        :param buffer: Holds the trajectories, which belong to the modes of now
        :param mastered: Numbers of these modes by their indices
        """
        if self.exploration is None:
            return
        if len(buffer.new_route_rows):  # along a known route for long, but on to a new one
            buffer.followed[buffer.new_route_rows] = NO_ROUTE
        members = buffer.training_successes(mastered)
        if self.exploration.off_modes and self.known_cells is not None:
            self.known_cells.replace({mastered[mode]: self._places(buffer, each) for mode, each in members.items()})
        uncounted = self._watch_routes(buffer, {} if self.exploration.past_modes else members, mastered)
        if len(uncounted) and hasattr(self.novelty_model, "forget"):
            for rows in np.array_split(uncounted, -(-len(uncounted) // _AT_A_TIME)):
                self.novelty_model.forget(buffer.features.of_tensors(buffer.read_observations(rows)[1]))

    @staticmethod
    def _places(buffer: ModeReplayBuffer, members: list[Trajectory]) -> th.Tensor | None:
        """Where they go, [N, dim]."""
        if not members:
            return None
        return buffer.features.of_tensors(buffer.read_observations(np.concatenate([each.rows for each in members]))[1])

    def _watch_routes(
        self, buffer: ModeReplayBuffer, members: Mapping[int, list[Trajectory]], mastered: Mapping[int, int]
    ) -> np.ndarray:
        """
        Note from now on which steps are of episodes that have come along the route of one of these modes. The episodes that
        are here already came along it unnoticed, and are noted too: rows of those, of steps whose visits were counted.
        """
        before = {route.number: route for route in self.routes.routes}
        routes = []
        for mode, each in members.items():
            if each:
                paths = np.stack([buffer.path(trajectory) for trajectory in each])
                routes.append(KnownRoute(mastered[mode], paths, ROUTE_SHARE * extent(paths)))
            elif mastered[mode] in before:
                routes.append(before[mastered[mode]])
        unknown = [route for route in routes if route.number not in before]
        self.routes.replace(routes)
        noted = [np.empty(0, dtype=np.int32)]
        if unknown:
            # One that is a new route to a goal keeps its worth, however it began
            finished = [each.rows for each in buffer.settled_trajectories()]
            running = [buffer.running.of(env) for env in np.flatnonzero(buffer.running.lengths).tolist()]
            noted += [self._note_followed(unknown, rows, buffer) for rows in (*finished, *running)]
        self._recall_routes(buffer)
        return np.concatenate(noted)

    def _note_followed(self, routes: list[KnownRoute], rows: np.ndarray, buffer: ModeReplayBuffer) -> np.ndarray:
        """Of one episode; the rows whose visits were counted, which from now on they are not."""
        followed = come_along(routes, buffer.reached(rows))
        came = (followed != NO_ROUTE) & ~self.routes.include(buffer.followed[rows])
        buffer.followed[rows[came]] = followed[came]
        were_counted = rows[came & buffer.counted[rows]]
        buffer.counted[were_counted] = False
        return were_counted

    def forget_routes(self) -> None:
        """Paths are compared in another way now."""
        self.routes.replace([])

    # ------------------------------------------------------------------ saving

    def state_dict(self) -> dict[str, Any]:
        """
        :return: What it knows beside the parameters of ``novelty_model``, ``moments`` and ``known_cells``, in plain values and
            arrays, for ``load_state_dict``
        """
        cells = {} if self.known_cells is None else self.known_cells.by_mode
        return {
            "routes": [{"number": each.number, "paths": each.paths, "radius": each.radius} for each in self.routes.routes],
            "cells": [{"number": number, "entries": entries} for number, entries in cells.items()],
            "visits": None if self.visit_map is None else self.visit_map.state_dict(),
        }

    def acting_state(self) -> dict[str, Any]:
        """
        :return: The same without what only training needs
        """
        return {**self.state_dict(), "routes": [], "cells": []}

    def load_state_dict(self, tree: Any) -> None:
        """
        :param tree: What ``state_dict`` gave
        :raises ValueError: If it is something else
        """
        state = convert(tree, _State, "bonus")
        for each in state.routes:
            check_array(each.paths, np.float32, [None, None, self.dim], "bonus.routes")
            if not (
                0 <= each.number < 2**31 and each.paths.size and np.isfinite(each.paths).all() and 0 <= each.radius < np.inf
            ):
                raise ValueError("bonus.routes: there is a route that cannot be")
        for cells in state.cells:
            check_array(cells.entries, np.int64, [None], "bonus.cells")
            size = 0 if self.known_cells is None else len(self.known_cells.known)
            if ((cells.entries < 0) | (cells.entries >= size)).any():
                raise ValueError("bonus.cells: there is a cell that cannot be")
        self.routes.replace([KnownRoute(each.number, each.paths, each.radius) for each in state.routes])
        if self.known_cells is not None:
            self.known_cells.by_mode = {cells.number: cells.entries for cells in state.cells}
        found = None if state.visits is None else VisitMap.from_state(state.visits)
        if found is not None and found.dim == self.dim:
            self.visit_map = found


def make_bonus(
    build: Callable[..., nn.Module],
    settings: NoveltySettings,
    exploration: ExplorationSettings | None,
    dims: tuple[int, int],
    n_envs: int,
    counted_cell: float | None,
    seen_cell: float,
) -> ExplorationBonus:
    """
    :param build: Makes the measure of its class, its dimensions and its keyword arguments
    :param settings: What is new, and what it is worth
    :param exploration: See ``ExplorationBonus``
    :param dims: Number of mode features, and of features of an observation
    :param n_envs: Number of environments
    :param counted_cell: Edge of the cells in which visits are counted, unless the settings say it; None: the measure's own
    :param seen_cell: Of those in the map of visits, and of places where nothing is counted
    :return: The bonus
    :raises ValueError: If a cell has no size
    """
    arguments, measure = dict(settings.kwargs or {}), settings.measure
    if measure == "counts":
        # The environment says how far apart places are, unless the user does
        arguments = {"cell_size": counted_cell or VisitCounts.default_cell_size, **arguments}
    cell_size = arguments["cell_size"] if measure == "counts" else seen_cell
    if not cell_size > 0:
        raise ValueError(f"novelty.kwargs['cell_size'] must be positive, got {cell_size}")
    novelty_model = build(NOVELTY_MEASURES[measure] if isinstance(measure, str) else measure, *dims, **arguments)
    visit_map = VisitMap(dims[0], seen_cell) if dims[0] <= 3 else None
    return ExplorationBonus(novelty_model, dims[0], settings, exploration, n_envs, float(cell_size), visit_map)
