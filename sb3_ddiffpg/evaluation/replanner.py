"""Switching to another mode when the route is blocked."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ddiffpg.buffers.features import ModeFeatures
from sb3_ddiffpg.evaluation.acting import as_batch, normalizer_of, unnormalized

Observation = np.ndarray | dict[str, np.ndarray]


class Replanner:
    """
    Acts by one mode, and by the next one when the agent has not moved for some steps. What has failed in an episode is tried
    again only when everything has. It is used like a model: in ``evaluate_policy``, ``run_episodes`` and ``evaluate_modes``,
    with any number of environments.

    :param model: A trained model with modes
    :param patience: Steps without movement after which a mode has failed
    :param tolerance: Distance, in units of the features, that counts as movement. None: two mean steps of the modes' own
        routes, since a stochastic policy trembles where it is stuck; of modes that have none yet, two of the longest steps
        that were seen so far
    :param order: In which order modes are tried: ``"value"``, by the return that each mode's critics expect from where the
        agent is then; ``"return"``, by the discounted return that each had in training; or names
    :param normalizer: Statistics by which the observations are normalised; those of the model's environment when None
    :param features: What says where the agent is, see ``ModeFeatures``; the model's mode features when None
    :raises ValueError: If an argument cannot work, naming it
    """

    def __init__(
        self,
        model: Any,
        patience: int = 10,
        tolerance: float | None = None,
        order: str | Sequence[str] = "value",
        features: Any = None,
        normalizer: VecNormalize | None = None,
    ) -> None:
        if not len(getattr(model, "modes", ())):
            raise ValueError(f"model: a {type(model).__name__} without modes given; there is nothing to switch to")
        if patience < 1:
            raise ValueError(f"patience: {patience} given; accepted are whole numbers from 1 up")
        self.normalizer = normalizer_of(model, normalizer)
        self.model = model
        self.patience = patience
        self.success_key = model.success_key
        self.resolved_features = model.resolved_features if features is None else features
        self.features = ModeFeatures(model.observation_space, self.resolved_features)
        #: None: nothing has moved yet that would tell it
        self.tolerance = self._from_routes() if tolerance is None else tolerance
        self._follows = self.tolerance is None
        if self.tolerance is not None and not self.tolerance > 0:
            raise ValueError(f"tolerance: {self.tolerance} given; accepted are positive numbers")
        self.by_value = order == "value"
        if isinstance(order, str) and order not in ("return", "value"):
            raise ValueError(f"order: {order!r} given; accepted are 'return', 'value' and a list of modes")
        ranked = self._by_return() if isinstance(order, str) else [model.modes.index(name) for name in order]
        if not ranked or len(set(ranked)) < len(ranked):
            raise ValueError(f"order: {order!r} given; it must name modes, none of them twice")
        #: Indices of the modes in use, the one to begin with first
        self.ranked = np.array(ranked)
        self._numbers = [mode.number for mode in model.modes]

    def _from_routes(self) -> float | None:
        routes = [mode.representative for mode in self.model.modes if len(mode.representative) > 1]
        if not routes:  # as of modes that have learned from other goals than they were given
            return None
        return 2 * float(np.mean(np.concatenate([np.linalg.norm(np.diff(route, axis=0), axis=1) for route in routes])))

    def _by_return(self) -> list[int]:
        modes = list(self.model.modes)
        expected = np.array([np.nan_to_num(mode.expected_return, nan=mode.mean_return) for mode in modes])
        if (expected >= 0).all():  # else a longer route has already cost more
            expected = expected * self.model.gamma ** np.nan_to_num([mode.mean_length for mode in modes])
        return [int(index) for index in np.argsort(-np.nan_to_num(expected, nan=-np.inf), kind="stable")]

    def predict(
        self,
        observation: Observation,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """
        :param observation: One observation or a batch of N
        :param state: What the previous call returned: the rank of every environment's mode, where it moved last, the steps
            since then, which modes have failed, and the model's own state
        :param episode_start: Which environments begin an episode
        :param deterministic: Passed to the model
        :return: The actions and the state for the next call
        """
        if [mode.number for mode in self.model.modes] != self._numbers:
            raise RuntimeError("The model's modes are others since this Replanner was made: make another")
        batch, is_single = as_batch(self.model.observation_space, observation)
        positions = self._positions(batch)
        n = len(positions)
        if state is None:
            state, episode_start = self._fresh(n, positions), np.ones(n, dtype=bool)
        rank, anchor, still, failed = (part.copy() for part in state[:4])
        if len(rank) != n:
            raise ValueError(f"state: of {len(rank)} environment(s) given for {n} observation(s)")
        begins = np.zeros(n, dtype=bool) if episode_start is None else np.asarray(episode_start, dtype=bool).reshape(n)
        rank[begins], still[begins], failed[begins], anchor[begins] = 0, 0, False, positions[begins]

        distances = np.linalg.norm(positions - anchor, axis=1)
        if self._follows:  # the first distance from an anchor is that of one step
            steps = distances[(still == 0) & ~begins]
            self.tolerance = max([self.tolerance or 0.0, *(2 * steps)])
        moved = distances > (self.tolerance or 0.0)
        anchor[moved] = positions[moved]
        still = np.where(moved | begins, 0, still + 1)
        stuck = still >= self.patience
        failed[stuck, rank[stuck]] = True
        # When everything has failed, the other routes may be open by now
        failed[failed.all(axis=1)] = False
        if (stuck | begins).any():
            preference = self._preference(batch, n)
            preference[failed] = -np.inf
            if len(self.ranked) > 1:
                preference[stuck, rank[stuck]] = -np.inf
            rank = np.where(stuck | begins, preference.argmax(axis=1), rank)
        anchor[stuck], still[stuck] = positions[stuck], 0

        modes = self.ranked[rank]
        # What the model is in the middle of, it goes on with, unless the mode is another now
        actions, followed = self.model.predict(
            batch, state=state[4:] or None, episode_start=begins, deterministic=deterministic, mode=modes
        )
        return actions[0] if is_single else actions, (rank, anchor, still, failed, *(followed or ()))

    def _fresh(self, n: int, positions: np.ndarray) -> tuple[np.ndarray, ...]:
        still = np.zeros(n, dtype=np.int64)
        return still.copy(), positions.copy(), still, np.zeros((n, len(self.ranked)), dtype=bool)

    def _preference(self, batch: Any, n: int) -> np.ndarray:
        """The higher the sooner, [N, number of modes in use]."""
        if self.by_value:
            return self.model.mode_values(batch)[:, self.ranked].astype(float)
        return np.tile(-np.arange(len(self.ranked), dtype=float), (n, 1))

    def _positions(self, batch: Any) -> np.ndarray:
        return self.features(unnormalized(batch, self.normalizer))
