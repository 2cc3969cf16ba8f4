"""The exploration bonus: what explorers, and if wanted modes, are paid for what is new to them."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import torch as th
from torch import nn

from sb3_ddiffpg.buffers.batch import ModeBatch, VisitedSteps
from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.routes import ROUTE_SHARE
from sb3_ddiffpg.buffers.trajectory import StepRecord, Trajectory
from sb3_ddiffpg.clustering.paths import extent
from sb3_ddiffpg.exploration.bonus_state import SavedEpisode, bonus_state
from sb3_ddiffpg.exploration.cells import CellGrid
from sb3_ddiffpg.exploration.episode_cells import EpisodeCells, numbers_of_cells
from sb3_ddiffpg.exploration.known_regions import NO_ROUTE, KnownCells, KnownRoute, KnownRoutes, come_along
from sb3_ddiffpg.exploration.novelty import (
    CellTable,
    RunningMoments,
    VisitCounts,
    noveld_reward,
)
from sb3_ddiffpg.exploration.recount import AT_A_TIME, count_again, places_of
from sb3_ddiffpg.exploration.settings import ExplorationSettings, NoveltySettings
from sb3_ddiffpg.exploration.visit_map import VisitMap
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.utils.divergence import DivergenceWatch

# Steps from which the cells' size is measured, at most
_SAMPLE = 20_000


class Notes(Protocol):
    """What the bonus notes of each stored step, by row: arrays of a replay buffer. Without modes there are no known routes."""

    first_visits: np.ndarray
    followed: np.ndarray
    counted: np.ndarray

    @property
    def has_modes(self) -> bool:
        """Whether the algorithm has modes."""
        ...


class ExplorationBonus:
    """
    NovelD's reward (Zhang et al., 2021) on a measure of novelty, and what it depends on: places that an episode has seen,
    places and routes that the modes know already, and a map of all visits.

    :param novelty_model: The measure, see ``novelty.NOVELTY_MEASURES``
    :param dim: Number of mode features
    :param settings: What is new, and what it is worth
    :param exploration: What explorers are not paid for where there are modes; None: there are none
    :param n_envs: Number of environments
    :param grid: Cells by which places are told apart
    :param seen_cell: Edge of the cells of a map of visits, in the unit of the mode features; None: as those
    :param build: Makes another measure, for another number of mode features; None: they will not change
    """

    def __init__(
        self,
        novelty_model: nn.Module,
        dim: int,
        settings: NoveltySettings,
        exploration: ExplorationSettings | None,
        n_envs: int,
        grid: CellGrid,
        seen_cell: float | None = None,
        build: Callable[[int], nn.Module] | None = None,
    ) -> None:
        self.dim, self.settings, self.exploration = dim, settings, exploration
        self.grid, self.seen_cell = grid, seen_cell
        #: Visits for pictures; None where there are more than three mode features, and until cells have a size
        self.visit_map: VisitMap | None = None
        self.novelty_model: Any = novelty_model
        self._build: Any = build
        self.moments = RunningMoments(1, max_count=100_000)
        self.known_cells = None if exploration is None else KnownCells()
        self._use_edges()
        self.routes = KnownRoutes(n_envs)
        self.episode_cells = EpisodeCells(n_envs)
        #: Environments whose running episodes are so long that parts of them are stored, and may be gone
        self._in_parts: set[int] = set()
        self._of_file: list[SavedEpisode] = []

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
        counts = self.routes.followed == NO_ROUTE
        if notes.has_modes:
            notes.followed[rows], notes.counted[rows] = self.routes.followed, counts
        known = self.grid.edges is not None  # else all is told again when they are, see ``review``
        notes.first_visits[rows] = self.episode_cells.observe(record, self.grid) if self.settings.episodic and known else True
        if counts.any() and (known or not isinstance(self.novelty_model, CellTable)):
            self.novelty_model.observe(th.as_tensor(positions[counts], device=self.device))
        if self.visit_map is not None:
            self.visit_map.observe(positions)
        self._in_parts.update(env for env, _ in record.parts)
        for env, _ in record.finished:
            self._forget_episode(env)

    # ------------------------------------------------------------------ cells

    @property
    def n_cells(self) -> int:
        """Number of places that are known; 0 where none are told apart."""
        if self.visit_map is not None:
            return len(self.visit_map)
        return int(self.novelty_model.counts.count_nonzero()) if isinstance(self.novelty_model, VisitCounts) else 0

    def restart(self, dim: int) -> None:
        """
        Places are told apart by other mode features from now on; what was new by the old ones says nothing.

        :param dim: Number of mode features
        """
        self.dim, self.grid, self.seen_cell, self.visit_map = dim, CellGrid(dim), None, None
        device = self.device
        if not isinstance(self.novelty_model, VisitCounts):
            self.novelty_model = self._build(dim)
        self.known_cells = None if self.exploration is None else KnownCells()
        self.routes.replace([])
        self.to(device)

    def _use_edges(self) -> None:
        """The cells' size is known: tables and map are in it."""
        edges = self.grid.edges
        if edges is None:
            return
        for table in (self.novelty_model, self.known_cells):
            if isinstance(table, CellTable):
                table.use_edges(edges)
        if self.visit_map is None and self.dim <= 3:
            self.visit_map = VisitMap(self.dim, edges if self.seen_cell is None else self.seen_cell)

    def review(self, buffer: ModeReplayBuffer, mastered: Mapping[int, int]) -> None:
        """
        Look whether the cells fit where the run has been; if they are others now, all visits are counted again.

        :param buffer: Holds the steps
        :param mastered: As for ``on_modes_changed``
        """
        if self.grid.fit(buffer.positions(buffer.nexts, "next_observations", buffer.stored_rows.spread(_SAMPLE))):
            self.recount(buffer, mastered)

    def _resize_tables(self, edges: np.ndarray) -> None:
        for table in (self.novelty_model, self.known_cells):
            if isinstance(table, CellTable):
                table.resize(edges)
        if self.visit_map is not None and len(self.visit_map) and self.seen_cell is None:
            self.visit_map.resize(edges)

    def recount(self, buffer: ModeReplayBuffer, mastered: Mapping[int, int]) -> None:
        """
        Places are told apart in another way now: count the visits of all stored steps again.

        :param buffer: Holds the steps
        :param mastered: As for ``on_modes_changed``
        """
        if self.grid.edges is None:
            return
        self._use_edges()
        self._resize_tables(self.grid.edges)
        counted = self.novelty_model if isinstance(self.novelty_model, VisitCounts) else None
        unseen = self.visit_map if self.visit_map is not None and not len(self.visit_map) else None
        count_again(buffer, self.grid, counted, unseen, first=self.settings.episodic)
        self.recall_episodes(buffer)
        self.on_modes_changed(buffer, mastered)

    def _forget_episode(self, env: int) -> None:
        self.episode_cells.seen[env].clear()
        self._in_parts.discard(env)
        self.routes.forget(env)

    def forget_episodes(self) -> None:
        """The environments were reset outside: no episode is running."""
        for env in range(self.routes.n_envs):
            self._forget_episode(env)

    def recall_episodes(self, buffer: ModeReplayBuffer) -> None:
        """
        After loading: where the running episodes have been.

        :param buffer: Holds them
        """
        self.forget_episodes()
        lengths, known = buffer.running.lengths, buffer.success_rule.steps
        episodes = [each for each in self._of_file if known[each.env] > lengths[each.env]]
        self._of_file = []
        for each in episodes:
            self.episode_cells.seen[each.env].update(each.seen.tolist())
            self._in_parts.add(each.env)
            if len(each.been) == len(self.routes.routes):
                self.routes.remember(each.env, each.been, each.followed)
        for env, seen in enumerate(self.episode_cells.seen):
            rows = buffer.running.of(env)
            if len(rows) and self.settings.episodic and self.grid.edges is not None:
                seen.update(numbers_of_cells(places_of(buffer, rows), self.grid))
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
        positions, seen = self._inputs(visited, encode)
        now, then = self.novelty_model.novelty(positions, seen).chunk(2)
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
            metrics["novelty_loss"] = self.novelty_model.update(positions.chunk(2)[1], seen.chunk(2)[1])
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

    def _inputs(self, visited: VisitedSteps, encode: Any) -> tuple[th.Tensor, th.Tensor]:
        """What the measure sees of the states before each step and then of those after it: positions and features."""
        positions = th.cat((visited.positions, visited.next_positions))
        if not getattr(self.novelty_model, "with_observation", False):
            return positions, positions
        with th.no_grad():
            return positions, th.cat([encode(each) for each in (visited.observations, visited.next_observations)])

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
            for rows in np.array_split(uncounted, -(-len(uncounted) // AT_A_TIME)):
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
        self.routes.replace(routes, sorted(self._in_parts))
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
            "edges": self.grid.edges if self.grid.adapts else None,
            "episodes": [self._episode(env) for env in sorted(self._in_parts)],
        }

    def _episode(self, env: int) -> dict[str, Any]:
        """Of which parts may be gone from the buffer: what it alone knows."""
        been, followed = self.routes.memory(env)
        return {
            "env": env,
            "seen": np.array(sorted(self.episode_cells.seen[env]), dtype=np.int64),
            "been": been,
            "followed": followed,
        }

    def acting_state(self) -> dict[str, Any]:
        """
        :return: The same without what only training needs
        """
        return {**self.state_dict(), "routes": [], "cells": [], "episodes": []}

    def load_state_dict(self, tree: Any) -> None:
        """
        :param tree: What ``state_dict`` gave
        :raises ValueError: If it is something else
        """
        state = bonus_state(tree, self.dim, 0 if self.known_cells is None else len(self.known_cells.known))
        self._of_file = [each for each in state.episodes or () if each.env < self.routes.n_envs]
        found = None if state.visits is None else VisitMap.from_state(state.visits)
        self.routes.replace([KnownRoute(each.number, each.paths, each.radius) for each in state.routes])
        if self.known_cells is not None:
            self.known_cells.by_mode = {cells.number: cells.entries for cells in state.cells}
        if "edges" not in tree and self.grid.adapts:  # of a version that counted in cells of this size
            self.grid = CellGrid(self.dim, VisitCounts.default_cell_size)
            self._use_edges()
        if state.edges is not None and len(state.edges) == self.dim:  # else of other mode features
            self.grid.adapts, self.grid.edges = True, state.edges
            self._use_edges()
        if found is not None and found.dim == self.dim:
            self.visit_map = found
