"""Going to a goal, or anywhere else, over places that are known, and another way where one is blocked."""

import copy
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_ddiffpg.buffers.features import same_selection
from sb3_ddiffpg.evaluation.acting import as_batch, normalizer_of, unnormalized
from sb3_ddiffpg.evaluation.environments import evaluation_environments
from sb3_ddiffpg.planning.place_graph import RESOLUTION, PlaceGraph, Plan
from sb3_ddiffpg.planning.practice import Wanderer
from sb3_ddiffpg.planning.travels import (
    Senses,
    Travel,
    newest,
    recorded_travels,
    stored_travels,
    travels_of_state,
    travels_state,
)
from sb3_ddiffpg.planning.waypoint_policy import WaypointPolicy
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert, read, write
from sb3_ddiffpg.utils.settings import at_least

#: Gradient steps of the waypoint policy, each time that it learns
N_UPDATES = 2000
#: A way is blocked if nothing was gained in so many times the steps that it takes to cross a place
PATIENCE = 3.0
#: A waypoint is so far ahead, at most, in places
LOOK_AHEAD = 2.0
#: Half of what is held to be blocked, in places; each further failure at the same place makes it so many times as wide
BLOCKED, WIDER = 2.0, 1.5
#: A place is visited within this distance of it, in places
ARRIVED = 0.5
#: Deviation of the noise on actions, unless they are deterministic: what stands still is shaken loose
NOISE = 0.1
# Places ahead that may become the waypoint
_MOST_AHEAD = 5
_KIND = "planner"


class _State(msgspec.Struct, forbid_unknown_fields=True):
    scale: np.ndarray
    crossing: float
    modes_lead: bool
    features: list[int] | str | None
    graph: Any
    policy: Any
    travels: Any


@dataclass(frozen=True)
class _Trip:
    """
    Where one environment is on its way. ``stage`` targets are visited; ``best`` are the fewest steps that were left so far,
    and for ``still`` steps there were not fewer. ``failed_at`` is where a way was blocked the last time, ``width`` how wide.
    While a ``mode`` drives, ``anchor`` is where it was last seen to move, and ``heading`` from where.
    """

    plan: Plan
    stage: int = 0
    penalty: np.ndarray | None = None
    best: float = np.inf
    still: int = 0
    failed_at: np.ndarray | None = None
    width: float = BLOCKED
    mode: int | None = None
    anchor: np.ndarray | None = None
    heading: np.ndarray | None = None


class ModePlanner:
    """
    Acts like a model: follows the shortest known way to a goal, and where it is blocked another one, back if need be. It is
    used in ``evaluate_policy`` and ``run_episodes``, with any number of environments.

    It knows places, the ways between them, and by a ``WaypointPolicy`` how to go them: from the episodes in the model's replay
    buffer, if it has one, and from those of ``practise``. It finds a way blocked as ``Replanner`` does, by not getting on; but
    it need not have a mode for every way around. Where practice has shown that more goals are reached so, an episode begins
    with the mode that the critics value most, and the planner takes over when that does not get on.

    A goal is any that an episode has reached; what an observation says of a desired one is not heeded, see ``go_to``.

    :param model: A DDiffPG whose mode features say where the agent is
    :param normalizer: Statistics by which observations are normalised; those of the model's environment when None
    :raises ValueError: If the model is none with mode features, observes images or lacks its normaliser
    """

    travels: list[Travel]
    scale: np.ndarray
    graph: PlaceGraph
    policy: WaypointPolicy
    #: Steps that it takes to cross a place
    crossing: float

    def __init__(self, model: Any, normalizer: VecNormalize | None = None) -> None:
        self._follow(model, normalizer)
        buffer = getattr(model, "replay_buffer", None)
        self.travels = stored_travels(buffer, self.senses) if buffer is not None and buffer.size() else []
        if self.travels:
            self._learn()

    def _follow(self, model: Any, normalizer: VecNormalize | None) -> None:
        """Be the planner of a model, without any knowledge."""
        if not hasattr(model, "resolved_features"):
            raise ValueError(
                f"model: a {type(model).__name__} given; accepted is a DDiffPG, whose mode features say where it is"
            )
        self.normalizer = normalizer_of(model, normalizer)
        self.model = model
        self.success_key, self.resolved_features = model.success_key, model.resolved_features
        self.senses = Senses(model.observation_space, self.resolved_features)
        #: Places to visit, in this order, in units of the mode features; None: any goal
        self.targets: np.ndarray | None = None
        #: Whether an episode to a goal begins with a mode
        self.modes_lead = False

    # ------------------------------------------------------------------ learning

    def practise(self, env: gym.Env | VecEnv | str, n_episodes: int = 50) -> float:
        """
        Learn from further episodes: those of the model if nothing is known yet, such that go from place to place, and once a
        goal is known those of the planner, led by modes and by itself. Modes lead from then on if that reached more goals.

        :param env: Environments as the model was trained in, or the id of one
        :param n_episodes: Number of episodes of each kind
        :return: Squared error of the waypoint policy's actions
        """
        at_least(1).check("n_episodes", n_episodes)
        if not isinstance(env, VecEnv):
            with evaluation_environments(self.model, env, n_episodes) as made:
                return self.practise(made, n_episodes)
        self._check_practice(env)
        if not self.travels:
            self._record(self.model, env, n_episodes)
            self._learn()
        self._record(Wanderer(self), env, n_episodes)
        error = self._learn()
        if self.targets is None and self._knows_goal and len(getattr(self.model, "modes", ())):
            success = {}
            for self.modes_lead in (True, False):
                success[self.modes_lead] = self._record(self, env, n_episodes)
            self.modes_lead = success[True] > success[False]
        return error

    def _check_practice(self, env: VecEnv) -> None:
        if not same_selection(self.model.resolved_features, self.resolved_features):
            raise RuntimeError("The model's mode features are others since this planner was made: make another")
        if (self.normalizer is None) != (unwrap_vec_normalize(env) is None):
            raise ValueError("env: it must be normalised if the model was trained on normalised observations, and only then")

    def _record(self, agent: Any, env: VecEnv, n_episodes: int) -> float:
        """Run episodes of an agent and remember them; the share that reached a goal."""
        recorded = recorded_travels(agent, self.model, self.senses, self.original, env, n_episodes)
        if not all(np.isfinite(part).all() for each in recorded for part in (each.inputs, each.places, each.actions)):
            raise ValueError("env: it gave observations that are not finite; nothing is learned from these episodes")
        self.travels = newest([*self.travels, *recorded])
        return float(np.mean([each.success for each in recorded]))

    @property
    def _knows_goal(self) -> bool:
        return len(self.graph.goals) > 0

    def _learn(self) -> float:
        places = np.concatenate([each.places for each in self.travels])
        deviations = places.std(axis=0).astype(np.float64)
        # Positions have one unit. What was found in an observation has one for each component
        standardize = getattr(getattr(self.model, "replay_buffer", None), "standardize", False)
        self.scale = (
            np.where(deviations > 0, deviations, 1.0) if standardize else np.full(len(deviations), deviations.max() or 1.0)
        )
        self.graph = PlaceGraph.of(self.travels, self.scale)
        paths = [each.places / self.scale for each in self.travels if each.success or not len(self.graph.goals)]
        steps = np.concatenate([np.linalg.norm(np.diff(path, axis=0), axis=1) for path in paths])
        self.crossing = float(self.graph.spacing / max(steps.mean(), 1e-9))
        if not hasattr(self, "policy"):
            horizon = max(round(LOOK_AHEAD * self.crossing), 1)
            self.policy = self._new_policy(horizon)
        error = self.policy.fit(self.travels, self.scale, N_UPDATES)
        self._plan_first()
        return error

    def _new_policy(self, horizon: int) -> WaypointPolicy:
        action_dim = get_action_dim(self.model.action_space)
        return WaypointPolicy(self.senses.n_inputs, self.senses.features.dim, action_dim, horizon)

    # ------------------------------------------------------------------ where to

    def go_to(self, *places: Sequence[float]) -> "ModePlanner":
        """
        Make an agent that visits places, one after the other in each episode, and stays at the last one.

        :param places: At least one, in units of the mode features, shape [dim] each
        :return: The agent, which knows what this planner knows
        :raises ValueError: If a place is none, or far from all that is known
        """
        self._check_ready()
        dim = self.senses.features.dim
        if not places or any(np.shape(each) != (dim,) or not np.isfinite(each).all() for each in places):
            raise ValueError(f"places: {places} given; accepted is at least one of {dim} finite numbers each")
        agent = copy.copy(self)
        agent.policy = copy.deepcopy(self.policy)  # which further practice changes
        agent.targets = np.array(places, dtype=np.float64)
        positions = agent.targets / self.scale
        far = np.linalg.norm(positions - self.graph.positions[self.graph.nearest(positions)], axis=1) > 2 * self.graph.spacing
        if far.any():
            raise ValueError(f"places: nobody has been near {agent.targets[far].tolist()}")
        agent._plan_first()
        return agent

    def _goal_places(self, stage: int) -> np.ndarray:
        if self.targets is None:
            return np.unique(self.graph.goal_places)
        return self.graph.nearest(self.targets[stage : stage + 1] / self.scale)

    def _plan_first(self) -> None:
        self._first = self.graph.plan(self._goal_places(0))
        finite = self._first.left[np.isfinite(self._first.left)]
        #: Longer than any way around
        self._detour = float(finite.max()) if len(finite) else 0.0

    def _check_ready(self) -> None:
        if not self.travels:
            raise RuntimeError("The model has no replay buffer to learn places from: call practise(env) first")

    # ------------------------------------------------------------------ acting

    def original(self, observation: Any) -> Any:
        """
        :param observation: As the model sees it
        :return: As the environment made it
        """
        return unnormalized(observation, self.normalizer)

    def act(self, original: Any, directions: np.ndarray, noise: np.ndarray | float) -> np.ndarray:
        """
        :param original: Batch of N observations, not normalised
        :param directions: Where to go from there, shape [N, dim]
        :param noise: Deviation of the noise on each environment's actions, shape [N]
        :return: Actions in [-1, 1], shape [N, action_dim]
        """
        actions = self.policy(self.senses.inputs(original), directions)
        drawn = np.reshape(noise, (-1, 1)) * np.random.standard_normal(actions.shape)
        return np.clip(actions + drawn, -1.0, 1.0).astype(np.float32)

    def predict(
        self,
        observation: Any,
        state: tuple[Any, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[Any, ...]]:
        """
        :param observation: One observation or a batch of N
        :param state: What the previous call returned: where each environment is on its way
        :param episode_start: Which environments begin an episode
        :param deterministic: Whether actions have no noise
        :return: The actions and the state for the next call
        :raises RuntimeError: If it knows no places yet, or no goal
        :raises ValueError: If the state is of another number of environments
        """
        self._check_ready()
        if self.targets is None and not self._knows_goal:
            raise RuntimeError("No episode that is known has reached a goal: go_to(place) goes elsewhere")
        batch, is_single = as_batch(self.model.observation_space, observation)
        original = self.original(batch)
        positions = self.senses.places(original) / self.scale
        n = len(positions)
        if state is not None and len(state) != n:
            raise ValueError(f"state: of {len(state)} environment(s) given for {n} observation(s)")
        begins = np.zeros(n, dtype=bool) if episode_start is None else np.array(episode_start, dtype=bool).reshape(n)
        # Also after further practice, by which places are others
        begins |= True if state is None else [len(each.plan.left) != len(self.graph) for each in state]
        trips = [_Trip(self._first) if begins[i] or state is None else state[i] for i in range(n)]
        if self.modes_lead and self.targets is None and begins.any():
            best = self.model.mode_values(batch).argmax(axis=1).tolist()
            trips = [replace(each, mode=best[i]) if begins[i] else each for i, each in enumerate(trips)]
        waypoints = np.empty_like(positions)
        for i, place in enumerate(self.graph.nearest(positions).tolist()):
            trips[i] = trip = self._led(trips[i], positions[i])
            if trip.mode is None:
                trips[i], waypoints[i] = self._next(trip, positions[i], place)
            else:
                waypoints[i] = positions[i]
        actions = self.act(original, waypoints - positions, 0.0 if deterministic else NOISE)
        actions = self.model.policy.unscale_action(actions)
        led = np.array([trip.mode is not None for trip in trips])
        if led.any():
            modes = np.array([trip.mode or 0 for trip in trips])
            actions[led] = self.model.predict(batch, episode_start=begins, deterministic=deterministic, mode=modes)[0][led]
        return actions[0] if is_single else actions, tuple(trips)

    def _led(self, trip: _Trip, position: np.ndarray) -> _Trip:
        """One more step of a trip that a mode drives, if one does, until it does not get on."""
        if trip.mode is None:
            return trip
        if trip.anchor is None or np.linalg.norm(position - trip.anchor) > 0.5 * self.graph.spacing:
            return replace(trip, anchor=position, heading=trip.anchor, still=0)
        if trip.still <= PATIENCE * self.crossing:
            return replace(trip, still=trip.still + 1)
        return self._blocked(trip, position, position - (position if trip.heading is None else trip.heading))

    def _next(self, trip: _Trip, position: np.ndarray, place: int) -> tuple[_Trip, np.ndarray]:
        """One more step of a trip, and where it goes from here."""
        graph = self.graph
        if self.targets is not None and trip.stage + 1 < len(self.targets):
            away = np.linalg.norm(self.targets[trip.stage] / self.scale - position)
            if away < ARRIVED * graph.spacing:
                trip = _Trip(graph.plan(self._goal_places(trip.stage + 1), trip.penalty), trip.stage + 1, trip.penalty)
        left = trip.plan.left[place] + np.linalg.norm(graph.positions[place] - position) / graph.spacing * self.crossing
        if left < trip.best - 0.5 * self.crossing:
            trip = replace(trip, best=left, still=0)
        else:
            trip = replace(trip, still=trip.still + 1)
        if trip.still > PATIENCE * self.crossing:
            trip = self._blocked(trip, position, graph.positions[trip.plan.ahead(place, 3)[-1]] - position)
        return trip, self._waypoint(trip, position, place)

    def _waypoint(self, trip: _Trip, position: np.ndarray, place: int) -> np.ndarray:
        """The farthest of the next places to which one can go straight, at the end the target itself."""
        graph = self.graph
        ahead = trip.plan.ahead(place, _MOST_AHEAD)
        points = graph.positions[ahead]
        if trip.plan.after[ahead[-1]] < 0:
            points = np.concatenate((points, self._target(trip.stage, points[-1])[None]))
        points = points[1:] if len(points) > 1 else points
        near = points[np.linalg.norm(points - position, axis=1) <= LOOK_AHEAD * graph.spacing]
        straight = near[graph.sees(position, near)] if len(near) else near
        return straight[-1] if len(straight) else points[0]

    def _target(self, stage: int, position: np.ndarray) -> np.ndarray:
        """Where a trip ends that has come to the place of its target: there, or amid the ends of those that reached a goal."""
        if self.targets is not None:
            return self.targets[stage] / self.scale
        close = np.linalg.norm(self.graph.goals - position, axis=1) < 1.5 * self.graph.spacing
        return self.graph.goals[close].mean(axis=0) if close.any() else position

    def _blocked(self, trip: _Trip, position: np.ndarray, into: np.ndarray) -> _Trip:
        """Go around what lies in this direction. At the same place again it was wider than thought."""
        graph = self.graph
        into = into / max(np.linalg.norm(into), 1e-9)
        again = trip.failed_at is not None and np.linalg.norm(trip.failed_at - position) < 2 * graph.spacing
        width = min(WIDER * trip.width, RESOLUTION) if again else BLOCKED  # no more than all
        found = graph.around(position + width * graph.spacing * into, width * graph.spacing)
        found = found[np.linalg.norm(graph.positions[found] - position, axis=1) > graph.spacing]
        penalty = np.zeros(len(graph)) if trip.penalty is None else trip.penalty.copy()
        penalty[found] += self._detour  # not for ever: where all is blocked, the least is tried again
        return _Trip(graph.plan(self._goal_places(trip.stage), penalty), trip.stage, penalty, failed_at=position, width=width)

    # ------------------------------------------------------------------ saving

    def save(self, path: str | os.PathLike) -> None:
        """
        Write what it knows, without the model, into a file.

        :param path: Of the file, a safetensors file without code
        :raises OSError: If it cannot be written; what was there before still is
        """
        write(Path(path), _KIND, self.state_dict())

    @classmethod
    def load(cls, path: str | os.PathLike, model: Any, normalizer: VecNormalize | None = None) -> "ModePlanner":
        """
        :param path: Of a file that ``save`` wrote
        :param model: The model of which it was
        :param normalizer: See ``ModePlanner``
        :return: A planner that knows what that one knew
        :raises ValueError: If the file is damaged, or of a model with other spaces
        """
        tree = read(Path(path), _KIND)
        planner = cls.__new__(cls)
        planner._follow(model, normalizer)  # what its replay buffer holds is not to be learned anew
        planner.load_state_dict(tree)
        return planner

    def state_dict(self) -> dict[str, Any]:
        """
        :return: What it knows, in plain values and arrays
        :raises RuntimeError: If that is nothing
        """
        self._check_ready()
        parts = {"graph": self.graph.state_dict(), "policy": self.policy.state_dict(), "travels": travels_state(self.travels)}
        settings = {"crossing": self.crossing, "modes_lead": self.modes_lead, "features": self._selection}
        return {"scale": self.scale, **settings, **parts}

    def load_state_dict(self, tree: Any) -> None:
        """
        :param tree: What ``state_dict`` gave, of a planner for the same model
        :raises ValueError: If it is something else
        """
        state = convert(tree, _State, "planner")
        if state.features != self._selection:
            raise ValueError(f"planner.features: {state.features} given; accepted are the model's, {self._selection}")
        dim = self.senses.features.dim
        scale = check_array(state.scale, np.float64, [dim], "planner.scale")
        if not (np.isfinite(scale).all() and (scale > 0).all() and 0 < state.crossing < np.inf):
            raise ValueError("planner: accepted are a positive scale and crossing")
        policy = self._new_policy(horizon=1)
        policy.load_state_dict(state.policy)
        graph = PlaceGraph.from_state(state.graph, dim)
        self.travels = travels_of_state(state.travels, self.senses.n_inputs, dim, get_action_dim(self.model.action_space))
        self.scale, self.graph, self.policy, self.crossing = scale, graph, policy, state.crossing
        self.modes_lead = state.modes_lead and len(getattr(self.model, "modes", ())) > 0
        self._plan_first()

    @property
    def _selection(self) -> list[int] | str | None:
        """Of the mode features; a callable cannot be told."""
        selection = self.senses.features.selection
        if selection is None or isinstance(selection, str):
            return selection
        return [] if callable(selection) else selection.tolist()
