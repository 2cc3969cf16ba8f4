"""Which mode is best in the world as it is now, found in a few trials."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.stats import binomtest
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.evaluation.environments import evaluation_environments, frozen_statistics
from sb3_ddiffpg.evaluation.rollout import run_episodes
from sb3_ddiffpg.utils.settings import at_least


@dataclass(frozen=True)
class Adaptation:
    """
    What ``adapt`` found.

    :param mode: Name of the mode to command from now on
    :param n_trials: Number of trials of each mode, by name
    :param n_successes: Number of successes among them, by name
    """

    mode: str
    n_trials: dict[str, int]
    n_successes: dict[str, int]

    @property
    def success_rate(self) -> float:
        """Share of successes of the mode that was chosen."""
        return self.n_successes[self.mode] / self.n_trials[self.mode] if self.n_trials[self.mode] else float("nan")

    def interval(self, confidence: float = 0.95) -> tuple[float, float]:
        """
        Bound the chosen mode's success (Wilson's interval). It was chosen by these very trials, which flatters it.

        :param confidence: Level, such as 0.95
        :return: Lower and upper bound; (0, 1) without a trial
        """
        if not self.n_trials[self.mode]:
            return 0.0, 1.0
        found = binomtest(self.n_successes[self.mode], self.n_trials[self.mode])
        bounds = found.proportion_ci(confidence_level=confidence, method="wilson")
        return float(bounds.low), float(bounds.high)


def adapt(model: Any, env: gym.Env | VecEnv | str, n_trials: int = 20) -> Adaptation:
    """
    Try modes in a world that may have changed, and tell which is best there. Thompson sampling decides which is tried next;
    the critics' values at the start are worth one trial of each mode, a success of the most valued, a failure of the least.

    :param model: A DDiffPG with modes
    :param env: The environment as it is now, or several of it, of which each runs an episode for a trial; or an id
    :param n_trials: Number of episodes, of all modes together
    :return: The best mode, and what was tried
    :raises ValueError: If the model has no modes, ``n_trials`` is less than 1, or the environment does not tell successes
    """
    if not len(getattr(model, "modes", ())):
        raise ValueError(f"model: a {type(model).__name__} without modes given; there is nothing to choose from")
    at_least(1).check("n_trials", n_trials)
    if not isinstance(env, VecEnv):
        with evaluation_environments(model, env, 1) as made:
            return adapt(model, made, n_trials)
    names = [mode.name for mode in model.modes]
    with frozen_statistics(env):
        values = model.mode_values(env.reset()).mean(axis=0)
    spread = np.ptp(values)
    prior = (values - values.min()) / spread if spread > 0 else np.full(len(names), 0.5)
    told = False
    wins, losses = np.zeros(len(names), dtype=int), np.zeros(len(names), dtype=int)
    while (done := int(wins.sum() + losses.sum())) < n_trials:
        tried = int(np.random.beta(1 + prior + wins, 2 - prior + losses).argmax())
        for episode in run_episodes(model, env, min(env.num_envs, n_trials - done), mode=names[tried]):
            told |= episode.success is not None
            wins[tried] += bool(episode.success)  # some speak only of successes
            losses[tried] += not episode.success
    if not told:
        raise ValueError("env: it does not say what a success is, see success_key")
    best = int(((1 + prior + wins) / (3 + wins + losses)).argmax())
    trials = dict(zip(names, (wins + losses).tolist(), strict=True))
    return Adaptation(names[best], trials, dict(zip(names, wins.tolist(), strict=True)))
