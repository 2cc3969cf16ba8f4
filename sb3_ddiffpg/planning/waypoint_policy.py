"""A policy that goes to a place nearby, learned from wherever episodes have gone."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import torch as th
from torch import nn

from sb3_ddiffpg.planning.travels import Travel
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert

#: Of the displacements that are seen, this quantile of their lengths is asked for
FAST = 0.9
#: The least that a step counts, as one that gets nowhere does, beside 1 for the fast ones
LEAST_WEIGHT = 4e-4
_WIDTH, _BATCH, _LEARNING_RATE = 256, 512, 1e-3
# The last part of the updates is made with a fifth of the learning rate
_FINE = 0.3


class _State(msgspec.Struct, forbid_unknown_fields=True):
    horizon: int
    pace: float
    mean: np.ndarray
    deviation: np.ndarray
    net: dict[str, np.ndarray]


class WaypointPolicy:
    """
    Learns by hindsight, as goal-conditioned supervised learning does (Ghosh et al., 2021): each step of an episode shows by
    which action to come where the episode was ``horizon`` steps later. It sees the displacement, and not where it is, so it
    walks alike everywhere. In use it is asked for displacements as long as the long ones that it has seen.

    :param n_inputs: Number of components of what it sees besides
    :param dim: Number of components of a displacement
    :param action_dim: Number of components of an action
    :param horizon: Number of steps
    """

    def __init__(self, n_inputs: int, dim: int, action_dim: int, horizon: int) -> None:
        self.n_inputs, self.dim, self.horizon = n_inputs, dim, horizon
        hidden = [nn.Linear(n_inputs + dim, _WIDTH), nn.ELU(), nn.Linear(_WIDTH, _WIDTH), nn.ELU()]
        self.net = nn.Sequential(*hidden, nn.Linear(_WIDTH, action_dim), nn.Tanh())
        self.mean, self.deviation = th.zeros(n_inputs + dim), th.ones(n_inputs + dim)
        #: Length of the displacement that is asked for
        self.pace = 0.0

    def fit(self, travels: Sequence[Travel], scale: np.ndarray, n_updates: int) -> float:
        """
        Learn from episodes.

        :param travels: Episodes of at least one step
        :param scale: What mode features are divided by, shape [dim]
        :param n_updates: Number of gradient steps
        :return: Squared error of the actions, mean of all updates
        """
        seen, moves, actions = (np.concatenate(each) for each in zip(*(self._lessons(t, scale) for t in travels), strict=True))
        lengths = np.linalg.norm(moves, axis=1)
        self.pace = float(np.quantile(lengths, FAST))
        cumulative = np.cumsum(_in_all_directions(moves, np.clip((lengths / max(self.pace, 1e-9)) ** 2, LEAST_WEIGHT, 1.0)))
        inputs = th.from_numpy(np.concatenate((seen, moves), axis=1).astype(np.float32))
        self.mean, self.deviation = inputs.mean(dim=0), inputs.std(dim=0, correction=0) + 1e-3
        inputs, wanted = (inputs - self.mean) / self.deviation, th.from_numpy(actions)
        optimizer = th.optim.Adam(self.net.parameters(), _LEARNING_RATE)
        total = 0.0
        for update in range(n_updates):
            if update == round((1 - _FINE) * n_updates):
                optimizer.param_groups[0]["lr"] = 0.2 * _LEARNING_RATE
            drawn = np.searchsorted(cumulative, cumulative[-1] * np.random.random(_BATCH), side="right")
            rows = th.from_numpy(np.minimum(drawn, len(cumulative) - 1))
            loss = nn.functional.mse_loss(self.net(inputs[rows]), wanted[rows])
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            total += loss.item()
        return total / max(n_updates, 1)

    def _lessons(self, travel: Travel, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What was seen at each step, the displacement of the next ``horizon`` steps, and the action."""
        # Of the last steps the displacement is not known, and of those before it is guessed
        n = max(len(travel) - self.horizon // 4, 1)
        now = np.arange(n)
        then = np.minimum(now + self.horizon, len(travel))
        path = travel.places / scale
        moves = (path[then] - path[now]) * (self.horizon / (then - now))[:, None]
        return travel.inputs[:n], moves, travel.actions[:n]

    def __call__(self, inputs: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """
        :param inputs: What is seen, shape [N, n_inputs]
        :param directions: To the waypoints, of any length, shape [N, dim]
        :return: Actions in [-1, 1], shape [N, action_dim]
        """
        lengths = np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
        both = np.concatenate((inputs, directions / lengths * self.pace), axis=1).astype(np.float32)
        with th.no_grad():
            return self.net((th.from_numpy(both) - self.mean) / self.deviation).numpy()

    def state_dict(self) -> dict[str, Any]:
        """
        :return: All of it, in plain values and arrays
        """
        net = {name: each.numpy() for name, each in self.net.state_dict().items()}
        statistics = {"mean": self.mean.numpy(), "deviation": self.deviation.numpy()}
        return {"horizon": self.horizon, "pace": self.pace, **statistics, "net": net}

    def load_state_dict(self, tree: Any) -> None:
        """
        :param tree: What ``state_dict`` gave, of a policy of the same sizes
        :raises ValueError: If it is something else
        """
        state = convert(tree, _State, "planner.policy")
        own = self.state_dict()
        if state.horizon < 1 or set(state.net) != set(own["net"]):
            raise ValueError("planner.policy: accepted are a horizon of at least one step and the weights of a WaypointPolicy")
        arrays = {"mean": state.mean, "deviation": state.deviation, **state.net}
        for name, array in arrays.items():
            like = own[name] if name in own else own["net"][name]
            check_array(array, np.float32, list(like.shape), f"planner.policy.{name}")
        finite = all(np.isfinite(each).all() for each in arrays.values()) and np.isfinite(state.pace)
        if not finite or not (state.deviation > 0).all():
            raise ValueError("planner.policy: accepted are finite numbers, and deviations above 0")
        self.horizon, self.pace = state.horizon, state.pace
        self.mean, self.deviation = th.from_numpy(state.mean.copy()), th.from_numpy(state.deviation.copy())
        self.net.load_state_dict({name: th.from_numpy(each.copy()) for name, each in state.net.items()})


def _in_all_directions(moves: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weights by which steps are drawn: as much for each direction, there or back along the component that changes most."""
    component = np.abs(moves).argmax(axis=1)
    direction = 2 * component + (moves[np.arange(len(moves)), component] > 0)
    mass = np.bincount(direction, weights, 2 * moves.shape[1])
    return weights / np.maximum(mass[direction], 1e-3 * mass.max())
