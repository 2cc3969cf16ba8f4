"""Complete episodes of a trained model: what each came to, and on which route."""

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_ddiffpg.buffers.features import ModeFeatures, declared_mode_features
from sb3_ddiffpg.buffers.success import GoalWatch
from sb3_ddiffpg.evaluation.environments import evaluation_environments, frozen_statistics
from sb3_ddiffpg.utils.vec_envs import env_attribute, labels_routes


@dataclass
class EpisodeResult:
    """
    One complete episode.

    :param success: Whether the goal was reached, at its last step or before; None if the environment does not say
    :param length: Number of steps, to the goal if it was reached
    :param episode_return: Sum of rewards, after the goal too
    :param label: Ground-truth mode, ``info["mode"]`` where the goal was reached or the episode ended, None if the environment
        gives none or declares no ``listed_modes``
    :param path: Mode features along these steps, terminal state included, shape [length + 1, dim]
    """

    success: bool | None
    length: int
    episode_return: float
    label: str | None
    path: np.ndarray


def run_episodes(
    model: Any, env: gym.Env | VecEnv | str, n_episodes: int, mode: str | int | None = None, deterministic: bool = False
) -> list[EpisodeResult]:
    """
    Run complete episodes. Every environment contributes its first ones, the same number (give or take one): taking
    whichever end first would favour short episodes.

    :param model: An SB3 model; if it has modes, ``mode`` commands one
    :param env: Vectorised environments, a single one, or the id of one; episodes should start where modes are to be compared
    :param n_episodes: Number of episodes
    :param mode: Mode to command; None: the model draws one for each episode, if it has modes
    :param deterministic: Passed to ``predict``
    :return: ``n_episodes`` results, ordered by environment
    :raises ValueError: If ``env`` is no environment or ``n_episodes`` no number of episodes
    """
    if not isinstance(n_episodes, (int, np.integer)) or n_episodes < 1:
        raise ValueError(f"n_episodes must be an integer of at least 1, got {n_episodes!r}")
    if not isinstance(env, VecEnv):
        with evaluation_environments(model, env, n_episodes) as made:
            return run_episodes(model, made, n_episodes, mode, deterministic)
    with frozen_statistics(env) as normalizer:
        return _run(model, env, n_episodes, mode, deterministic, normalizer)


def episode_shares(n_episodes: int, n_envs: int) -> list[int]:
    """
    :param n_episodes: Number of episodes
    :param n_envs: Number of environments
    :return: How many of the episodes each environment runs, its first ones
    """
    return [n_episodes // n_envs + (i < n_episodes % n_envs) for i in range(n_envs)]


def _run(
    model: Any, env: VecEnv, n_episodes: int, mode: str | int | None, deterministic: bool, normalizer: VecNormalize | None
) -> list[EpisodeResult]:
    share = episode_shares(n_episodes, env.num_envs)
    selection = getattr(model, "resolved_features", None)
    if selection is None and env_attribute(env, "mode_features") is not None:
        with suppress(ValueError):  # of what wrappers have made unknown: the whole observation
            selection = declared_mode_features(env)
    features = ModeFeatures(env.observation_space, selection)
    command = {} if mode is None else {"mode": mode}
    results: list[list[EpisodeResult]] = [[] for _ in range(env.num_envs)]
    watch = GoalWatch(env.num_envs, getattr(model, "success_key", None), labels_routes(env))
    watch.has_signal = knows_success(model)
    # Positions are compared in metres, whatever a normalising wrapper shows the networks
    obs, state, starts = env.reset(), None, np.ones(env.num_envs, dtype=bool)
    original = obs if normalizer is None else normalizer.get_original_obs()
    paths: list[list[np.ndarray]] = [[position] for position in features(original)]  # type: ignore[arg-type]
    returns = np.zeros(env.num_envs)
    while any(len(done) < wanted for done, wanted in zip(results, share, strict=True)):
        actions, state = model.predict(obs, state=state, episode_start=starts, deterministic=deterministic, **command)
        obs, rewards, starts, infos = env.step(actions)
        watch.observe(infos)
        returns += rewards if normalizer is None else normalizer.get_original_reward()
        positions = features(obs if normalizer is None else normalizer.get_original_obs())  # type: ignore[arg-type]
        for i in range(env.num_envs):
            if not starts[i]:
                paths[i].append(positions[i])
                continue
            terminal: Any = infos[i].get("terminal_observation")
            if terminal is not None:
                terminal = terminal if normalizer is None else normalizer.unnormalize_obs(terminal)
                is_dict = isinstance(terminal, dict)
                batch = {key: value[None] for key, value in terminal.items()} if is_dict else np.asarray(terminal)[None]
                paths[i].append(features(batch)[0])
            success, length, label = watch.so_far(i, infos[i])
            path = np.stack(paths[i][: length + 1])
            results[i].append(EpisodeResult(success, len(path) - 1, float(returns[i]), label, path))
            watch.end(i)
            paths[i], returns[i] = [positions[i]], 0.0
    found = [episode for done, wanted in zip(results, share, strict=True) for episode in done[:wanted]]
    return judged(found, watch.has_signal)


def judged(episodes: list[EpisodeResult], success_is_told: bool) -> list[EpisodeResult]:
    """
    Some environments speak of success only where there is one.

    :param episodes: Of which some may say nothing of success
    :param success_is_told: Whether others, or the training, have said what one is
    :return: The same; those that say nothing have failed, if it is told
    """
    return [replace(each, success=bool(each.success)) for each in episodes] if success_is_told else episodes


def knows_success(model: Any) -> bool:
    """
    :param model: Any model
    :return: Whether the environments of its training have said what a success is
    """
    members = getattr(model, "models", None) or [getattr(model, "model", model)]  # of an ensemble, or of a Replanner
    buffers = [getattr(each, "replay_buffer", None) for each in members]
    return any(getattr(buffer, "has_success_signal", False) for buffer in buffers)
