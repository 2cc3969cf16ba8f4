"""Several independently trained models taken as one: the baseline that finds several ways by being trained several times."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_ddiffpg.evaluation import evaluate_modes
from sb3_ddiffpg.mode_evaluation import ModeEvaluation


@dataclass(frozen=True)
class Member:
    """
    One model of a union.

    :param name: By which it is commanded
    """

    name: str


class Union:
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
        self._resolved_features = getattr(models[0], "_resolved_features", None)
        self.success_key = getattr(models[0], "success_key", None)

    @property
    def num_timesteps(self) -> int:
        """Environment steps that all members were trained for, together: what the union has cost."""
        return sum(model.num_timesteps for model in self.models)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        mode: str | int | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """
        :param observation: A batch of observations
        :param state: What the previous call returned: which member acts in every environment
        :param episode_start: Which environments begin an episode; members are drawn where they do
        :param deterministic: Passed to the members
        :param mode: Name or number of the member that acts; None: a drawn one
        :return: The actions and the state for the next call
        :raises ValueError: If there is no such member
        """
        first = next(iter(observation.values())) if isinstance(observation, dict) else observation
        acting = np.full(len(first), -1) if state is None else np.array(state[0])
        if mode is not None:
            names = [member.name for member in self.modes]
            if mode not in names and mode not in range(len(names)):
                raise ValueError(f"mode={mode!r} is unknown; the members are {names}")
            acting[:] = names.index(mode) if isinstance(mode, str) else mode
        else:
            starts = (acting < 0) if episode_start is None else np.asarray(episode_start, dtype=bool) | (acting < 0)
            acting[starts] = np.random.randint(len(self.models), size=int(starts.sum()))
        actions: np.ndarray | None = None
        for number in np.unique(acting):
            rows = np.flatnonzero(acting == number)
            part = {k: v[rows] for k, v in observation.items()} if isinstance(observation, dict) else observation[rows]
            chosen = self.models[number].predict(part, deterministic=deterministic)[0]
            if actions is None:
                actions = np.empty((len(first), *chosen.shape[1:]), dtype=chosen.dtype)
            actions[rows] = chosen
        assert actions is not None
        return actions, (acting,)


def evaluate_union(models: Sequence[Any], env: Any, n_episodes: int = 100, **kwargs: Any) -> ModeEvaluation:
    """
    :func:`~sb3_ddiffpg.evaluation.evaluate_modes` of a :class:`Union`: the commands are its members, and without command one
    is drawn for each episode. Compare it at the same cost: S models have cost S times the steps of one.

    :param models: SB3 models with the same spaces
    :param env: The environments, or the id of one
    :param n_episodes: Episodes for each member, and twice as many for the union
    :param kwargs: Further arguments of ``evaluate_modes``
    :return: The evaluation
    """
    return evaluate_modes(Union(models), env, n_episodes, **kwargs)
