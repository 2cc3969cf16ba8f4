"""Several independently trained models taken as one: the baseline that finds several routes by being trained several times."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.results import ModeEvaluation


@dataclass(frozen=True)
class Member:
    """
    One model of a union.

    :param name: By which it is commanded
    """

    name: str


class PolicyEnsemble:
    """
    Acts as a model whose modes are its members: one of them acts throughout an episode, the commanded or a drawn one.

    :param models: SB3 models with the same spaces, such as TD3 of several seeds
    :raises ValueError: If there is none, or their spaces differ
    """

    def __init__(self, models: Sequence[Any]) -> None:
        if not models:
            raise ValueError("models: none given; accepted is a list of SB3 models")
        for number, model in enumerate(models):
            for space in ("observation_space", "action_space"):
                if getattr(model, space) != getattr(models[0], space):
                    raise ValueError(f"models: number {number} has another {space} than the first")
        self.models = list(models)
        self.modes = [Member(f"model_{number}") for number in range(len(models))]
        self.resolved_features = getattr(models[0], "resolved_features", None)
        self.success_key = getattr(models[0], "success_key", None)

    @property
    def num_timesteps(self) -> int:
        """Environment steps that all members were trained for, together: what the union has cost."""
        return sum(model.num_timesteps for model in self.models)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[Any, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        mode: str | int | None = None,
    ) -> tuple[np.ndarray, tuple[Any, ...]]:
        """
        :param observation: A batch of observations
        :param state: What the previous call returned: which member acts in every environment, and the members' own states
        :param episode_start: Which environments begin an episode; members are drawn where they do
        :param deterministic: Passed to the members
        :param mode: Name or number of the member that acts; None: a drawn one
        :return: The actions and the state for the next call
        :raises ValueError: If there is no such member, or the observation is not a batch
        """
        n = self._batch_size(observation)
        acting, states = (np.full(n, -1), [None] * len(self.models)) if state is None else (state[0].copy(), list(state[1]))
        starts = (acting < 0) if episode_start is None else np.asarray(episode_start, dtype=bool) | (acting < 0)
        if mode is not None:
            names = [member.name for member in self.modes]
            if mode not in names and mode not in range(len(names)):
                raise ValueError(f"mode={mode!r} is unknown; the members are {names}")
            acting[:] = names.index(mode) if isinstance(mode, str) else mode
        else:
            acting[starts] = np.random.randint(len(self.models), size=int(starts.sum()))
        actions: dict[int, np.ndarray] = {}
        for number in np.unique(acting):
            # Of all environments: only the member itself knows which part of its state belongs to which
            actions[number], states[number] = self.models[number].predict(
                observation, state=states[number], episode_start=starts, deterministic=deterministic
            )
        return np.stack([actions[number][row] for row, number in enumerate(acting)]), (acting, states)

    def _batch_size(self, observation: np.ndarray | dict[str, np.ndarray]) -> int:
        space: Any = self.models[0].observation_space
        if isinstance(observation, dict):
            key = next(iter(observation))
            observation, space = observation[key], space[key]
        if np.ndim(observation) != len(space.shape) + 1:
            raise ValueError(f"observation: shape {list(np.shape(observation))} given; accepted is [N, *{list(space.shape)}]")
        return len(observation)


def evaluate_ensemble(models: Sequence[Any], env: Any, n_episodes: int = 100, **kwargs: Any) -> ModeEvaluation:
    """
    :func:`~sb3_ddiffpg.evaluation.evaluate_modes` of a :class:`PolicyEnsemble`: the commands are its members, and without
    command one is drawn for each episode. Compare it at the same cost: S models have cost S times the steps of one.

    :param models: SB3 models with the same spaces
    :param env: The environments, a single one, or the id of one
    :param n_episodes: Episodes for each member, and twice as many for the union
    :param kwargs: Further arguments of ``evaluate_modes``
    :return: The evaluation
    """
    return evaluate_modes(PolicyEnsemble(models), env, n_episodes, **kwargs)
