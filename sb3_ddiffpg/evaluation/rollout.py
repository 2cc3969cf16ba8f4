"""Complete episodes of a trained model: what each came to, and on which route."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_ddiffpg.buffers.features import ModeFeatures
from sb3_ddiffpg.buffers.success import read_success


@dataclass
class EpisodeResult:
    """
    One complete episode.

    :param success: Whether the goal was reached, None if the environment does not say
    :param length: Number of steps
    :param episode_return: Sum of rewards
    :param label: Ground-truth mode, ``info["mode"]`` of the last step, None if the environment gives none
    :param path: Mode features along the episode, terminal state included, shape [length + 1, dim]
    """

    success: bool | None
    length: int
    episode_return: float
    label: str | None
    path: np.ndarray


def run_episodes(
    model: Any, env: VecEnv, n_episodes: int, mode: str | int | None = None, deterministic: bool = False
) -> list[EpisodeResult]:
    """
    Run complete episodes. Every environment contributes its first ones, the same number (give or take one): taking
    whichever end first would favour short episodes.

    :param model: An SB3 model; if it has modes, ``mode`` commands one
    :param env: Vectorised environment; its episodes should start where modes are to be compared
    :param n_episodes: Number of episodes
    :param mode: Mode to command; None: the model draws one for each episode, if it has modes
    :param deterministic: Passed to ``predict``
    :return: ``n_episodes`` results, ordered by environment
    :raises ValueError: If ``env`` is not vectorised or ``n_episodes`` no number of episodes
    """
    if not isinstance(env, VecEnv):
        raise ValueError(f"env must be a VecEnv, such as sb3_ddiffpg.envs.make_vec_env makes, got {env}")
    if not isinstance(n_episodes, (int, np.integer)) or n_episodes < 1:
        raise ValueError(f"n_episodes must be an integer of at least 1, got {n_episodes!r}")
    share = np.array([n_episodes // env.num_envs + (i < n_episodes % env.num_envs) for i in range(env.num_envs)])
    selection = getattr(model, "resolved_features", None)
    if selection is None and env.has_attr("mode_features"):
        selection = env.get_attr("mode_features", indices=0)[0]
    features = ModeFeatures(env.observation_space, selection)
    command = {} if mode is None else {"mode": mode}
    results: list[list[EpisodeResult]] = [[] for _ in range(env.num_envs)]
    # Positions are compared in metres, whatever a normalising wrapper shows the networks
    normalizer = unwrap_vec_normalize(env)
    was_training = normalizer is not None and normalizer.training
    if normalizer is not None:
        normalizer.training = False  # test episodes are not what the statistics are of
    obs, state, starts = env.reset(), None, np.ones(env.num_envs, dtype=bool)
    original = obs if normalizer is None else normalizer.get_original_obs()
    paths: list[list[np.ndarray]] = [[position] for position in features(original)]  # type: ignore[arg-type]
    returns = np.zeros(env.num_envs)
    while any(len(done) < wanted for done, wanted in zip(results, share, strict=True)):
        actions, state = model.predict(obs, state=state, episode_start=starts, deterministic=deterministic, **command)
        obs, rewards, starts, infos = env.step(actions)
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
            success = read_success(infos[i], getattr(model, "success_key", None))
            episode = EpisodeResult(success, len(paths[i]) - 1, float(returns[i]), infos[i].get("mode"), np.stack(paths[i]))
            results[i].append(episode)
            paths[i], returns[i] = [positions[i]], 0.0
    if normalizer is not None:
        normalizer.training = was_training
    return [episode for done, wanted in zip(results, share, strict=True) for episode in done[:wanted]]
