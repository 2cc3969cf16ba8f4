"""A model in the plane that is told which routes its environment took, shared by tests."""

import numpy as np
import torch as th
from environments import AnySpaces, fill, merged, small_model
from gymnasium import spaces
from maze_routes import polyline

# Three ways of the same length to three places
ROUTES = {"up": [(0, 0), (0, 6), (6, 6)], "down": [(0, 0), (0, -6), (6, -6)], "right": [(0, 0), (12, 0)]}
PLANE = spaces.Box(-20.0, 20.0, (2,))


def planar_model(**changes):
    settings = {"mode_features": [0, 1], "buffer_size": 5000, "modes": {"distance_threshold": 2.0, "patience": 0}}
    if "kwargs" not in changes.get("novelty", {}):
        settings["novelty"] = {"kwargs": {"cell_size": 0.5}}
    return small_model(AnySpaces(PLANE), **merged(settings, changes))


def walk(model, route, n, success=True, part=1.0, reward=1.0):
    """The model's environment takes a route n times (or fails on the way, or says nothing of it)."""
    rng = np.random.default_rng(len(model.replay_buffer.trajectories(True)))
    for _ in range(n):
        line = polyline(ROUTES[route], step=1.0) + rng.uniform(-0.3, 0.3, 2)
        line = line[: int(part * len(line))] + rng.normal(scale=0.1, size=(int(part * len(line)), 2))
        fill(model.replay_buffer, [line.astype(np.float32)], success, reward, bonus=model.bonus)


def said(model):
    """What a re-clustering did."""
    return [str(event) for event in model.recluster()]


def route_of(mode):
    end = mode.representative[-1]
    return min(ROUTES, key=lambda route: np.abs(ROUTES[route][-1] - end).sum())


def belongings(model):
    """By name: embedding, critics, their targets and moments."""
    critics = model.critics
    state = {}
    for index, mode in enumerate(model.modes):
        weights = [parameter[index + 1].detach().clone() for parameter in critics.stacked_parameters()]
        targets = [p[index + 1].detach().clone() for p in model.policy.critics_target.stacked_parameters()]
        moments = [critics.optimizer.state[p]["exp_avg"][index + 1].clone() for p in critics.stacked_parameters()]
        state[mode.name] = [th.as_tensor(mode.embedding), *weights, *targets, *moments]
    return state


def same(first, second):
    return all(th.equal(a, b) for a, b in zip(first, second, strict=True))
