"""Pictures of the modes during training."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.logger import Figure
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_ddiffpg.callbacks.periodic import _PeriodicCallback
from sb3_ddiffpg.evaluation.environments import vectorized
from sb3_ddiffpg.evaluation.rollout import run_episodes
from sb3_ddiffpg.utils.rng import preserved_rng
from sb3_ddiffpg.utils.vec_envs import env_attribute


class ModeFigureCallback(_PeriodicCallback):
    """
    Shows the pictures of :mod:`~sb3_ddiffpg.visualization.plots` in TensorBoard during training. Needs the extra ``plots``.

    :param figure_freq: Environment steps between two sets of pictures
    :param eval_env: Environments in which the modes' routes are run, or a single one, with one fixed start; None: no picture
        of routes
    :param n_episodes: Episodes for each mode's routes
    """

    def __init__(self, figure_freq: int = 50_000, eval_env: gym.Env | VecEnv | None = None, n_episodes: int = 5) -> None:
        super().__init__("figure_freq", figure_freq)
        # Not at the top: matplotlib is not needed to train
        from sb3_ddiffpg.visualization import figures

        self._draw: Callable[..., dict[str, Any]] = figures.draw_all
        self.eval_env, self.n_episodes = vectorized(eval_env), n_episodes

    def _on_period(self) -> None:
        with preserved_rng():
            figures = self._figures()
        for name, figure in figures.items():
            self.logger.record(f"figures/{name}", Figure(figure, close=True), exclude=("stdout", "log", "json", "csv"))
        self.logger.dump(self.num_timesteps)

    def _figures(self) -> dict[str, Any]:
        episodes = None
        model: Any = self.model
        if self.eval_env is not None and len(model.modes):
            if model.get_vec_normalize_env() is not None:
                sync_envs_normalization(self.training_env, self.eval_env)
            episodes = {name: run_episodes(model, self.eval_env, self.n_episodes, mode=name) for name in model.modes.names}
        maze = env_attribute(self.training_env, "maze")
        observation: Any = model._last_original_obs if model.get_vec_normalize_env() is not None else model._last_obs
        first = None if observation is None or isinstance(observation, dict) else np.asarray(observation)[0]
        return self._draw(model, maze, first, episodes)
