"""Counting modes honestly: what each command does, and which routes an uncommanded model takes, from one fixed start."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.trajectory import NO_MODE
from sb3_ddiffpg.clustering.dtw import dtw_distances
from sb3_ddiffpg.clustering.linkage import cluster
from sb3_ddiffpg.clustering.paths import comparable_path
from sb3_ddiffpg.evaluation.environments import evaluation_environments
from sb3_ddiffpg.evaluation.results import CommandResult, ModeEvaluation, RouteResult, command_name
from sb3_ddiffpg.evaluation.rollout import EpisodeResult, judged, run_episodes
from sb3_ddiffpg.modes.settings import ModeSettings
from sb3_ddiffpg.utils.rng import preserved_rng
from sb3_ddiffpg.utils.vec_envs import env_attribute

# Of a success that is like no other
_NO_ROUTE = ""


def evaluate_modes(
    model: Any,
    env: gym.Env | VecEnv | str | None = None,
    n_episodes: int = 100,
    n_uncommanded: int | None = None,
    modes: Sequence[str] | None = None,
    listed: Sequence[str] | None = None,
    deterministic: bool = False,
    seed: int | None = None,
    **env_kwargs: Any,
) -> ModeEvaluation:
    """
    Run complete episodes under each command and without any, and count which routes they took.

    All should begin at one fixed start, or the start decides on the route. Given an id or nothing, the tasks of this package
    are made without start noise; of other environments the result says how far apart their episodes started.

    :param model: Any SB3 model. What has no modes, such as a TD3, is run without commands
    :param env: The environments, a single one, or the id of one, perhaps with the module that registers it: ``"module:id"``.
        Where the model was trained when None: with its arguments and wrappers, if it is registered. With its id it has its
        wrappers
    :param n_episodes: Episodes for each command
    :param n_uncommanded: Episodes without command; twice ``n_episodes`` when None
    :param modes: Names of the modes to command; all when None
    :param listed: Labels of the routes to find; what the environment says in ``listed_modes`` when None. Only where it
        declares these, perhaps none, is ``info["mode"]`` a label
    :param deterministic: Passed to ``predict``
    :param seed: Seeds environments and actions
    :param env_kwargs: Arguments of ``gym.make``, or a dict of them as ``env_kwargs``, if ``env`` is an id or None
    :return: The evaluation
    :raises ValueError: If an argument cannot work, naming it
    """
    known = [mode.name for mode in getattr(model, "modes", ())]
    n_uncommanded = 2 * n_episodes if n_uncommanded is None else n_uncommanded
    for argument, number in (("n_episodes", n_episodes), ("n_uncommanded", n_uncommanded)):
        if not isinstance(number, (int, np.integer)) or number < 1:
            raise ValueError(f"{argument} must be an integer of at least 1, got {number!r}")
    if isinstance(modes, str):
        raise ValueError(f"modes: {modes!r} given; accepted is a list of names")
    for name in modes or ():
        if name not in known:
            raise ValueError(f"modes: {name!r} given; the model's modes are {known}")
    if not isinstance(env, VecEnv) or env_kwargs:
        with evaluation_environments(model, env, n_episodes, seed, **env_kwargs) as made:
            return evaluate_modes(model, made, n_episodes, n_uncommanded, modes, listed, deterministic, seed)
    if seed is not None:
        with preserved_rng():
            set_random_seed(seed)
            if hasattr(env, "seed"):
                env.seed(seed)
            return evaluate_modes(model, env, n_episodes, n_uncommanded, modes, listed, deterministic)
    commands: list[str | None] = [*(known if modes is None else modes), None]
    runs = [
        run_episodes(model, env, n, mode=command, deterministic=deterministic)
        for command in commands
        for n in [n_uncommanded if command is None else n_episodes]
    ]
    told = any(episode.success is not None for run in runs for episode in run)
    runs = [judged(run, told) for run in runs]
    if listed is None:
        listed = env_attribute(env, "listed_modes") or ()
    labels, source = _labels(model, runs)
    spec = env_attribute(env, "spec")
    results = [_count(command, run, names) for command, run, names in zip(commands, runs, labels, strict=True)]
    starts = np.array([episode.path[0] for run in runs for episode in run])
    return ModeEvaluation(
        env_id=type(env).__name__ if spec is None else spec.id,
        label_source=source,
        listed=tuple(map(str, listed)),
        start_spread=float(np.linalg.norm(np.ptp(starts, axis=0))),
        uncommanded=results[-1],
        commanded=tuple(results[:-1]),
        routes=_routes(runs, labels),
        success_told=told,
        episodes={command_name(command): run for command, run in zip(commands, runs, strict=True)},
    )


def clustering_agreement(model: Any) -> float:
    """
    How well the modes of the stored trajectories agree with the environment's own labels. The clustering never saw those.

    :param model: A DDiffPG with its replay buffer
    :return: Adjusted Rand index over the goal-reached trajectories that have a mode and a label (1: the same partition, 0: as
        by chance); NaN if there are none
    """
    from sklearn.metrics import adjusted_rand_score  # of the extra "plots"

    known = [t for t in model.replay_buffer.trajectories(True) if t.mode != NO_MODE and t.label is not None]
    if not known:
        return float("nan")
    return float(adjusted_rand_score([t.label for t in known], [t.mode for t in known]))


def _labels(model: Any, runs: list[list[EpisodeResult]]) -> tuple[list[list[str | None]], str]:
    """The route of every success, None for failures, and who says so."""
    successes = [episode for run in runs for episode in run if _reached(episode)]
    if not successes or any(episode.label is not None for episode in successes):
        return [[str(episode.label) if _reached(episode) else None for episode in run] for run in runs], "environment"
    # As the model finds them, where it does
    settings = getattr(model, "mode_settings", ModeSettings())
    buffer = getattr(model, "replay_buffer", None)
    if isinstance(buffer, ModeReplayBuffer) and (buffer.size() or not buffer.standardize):
        paths = [buffer.resample(episode.path) for episode in successes]
        normalize, linkage = buffer.normalize_distances, settings.linkage
    else:
        full = [episode.path for episode in successes]
        # Of a whole observation, and of what was found in one, each component has a scale of its own
        if full[0].shape[1] > 3 or getattr(buffer, "standardize", False):
            scale = np.maximum(np.concatenate(full).std(axis=0), 1e-6)
            full = [path / scale for path in full]
        compared_length = getattr(buffer, "compared_length", None)
        paths, normalize, linkage = [comparable_path(path, arc_length=compared_length) for path in full], True, "average"
    threshold, min_size = settings.distance_threshold, 1 if len(paths) < 3 else 3
    numbers = iter(cluster(dtw_distances(paths, normalize=normalize), threshold, linkage, min_size=min_size))
    names = [[_cluster_name(next(numbers)) if _reached(episode) else None for episode in run] for run in runs]
    return names, "clustering"


def _reached(episode: EpisodeResult) -> bool:
    """Where nobody says what a success is, every complete episode counts."""
    return episode.success is not False


def _cluster_name(number: int) -> str:
    return f"cluster {number}" if number >= 0 else _NO_ROUTE


def _count(command: str | None, run: list[EpisodeResult], labels: list[str | None]) -> CommandResult:
    lengths = [episode.length for episode, label in zip(run, labels, strict=True) if label is not None]
    return CommandResult(
        mode=command,
        n_episodes=len(run),
        n_successes=len(lengths),
        mean_length=float(np.mean(lengths)) if lengths else float("nan"),
        mean_return=float(np.mean([episode.episode_return for episode in run])),
        labels=dict(Counter(label for label in labels if label).most_common()),
    )


def _routes(runs: list[list[EpisodeResult]], labels: list[list[str | None]]) -> tuple[RouteResult, ...]:
    """Most frequent first."""
    by_label: dict[str, list[EpisodeResult]] = {}
    for run, names in zip(runs, labels, strict=True):
        for episode, name in zip(run, names, strict=True):
            if name:
                by_label.setdefault(name, []).append(episode)
    routes = []
    for label, episodes in sorted(by_label.items(), key=lambda item: -len(item[1])):
        paths = [float(np.linalg.norm(np.diff(episode.path, axis=0), axis=1).sum()) for episode in episodes]
        shortest = min(paths)
        ratio = float(np.mean(paths)) / shortest if shortest > 0 else 1.0
        routes.append(RouteResult(label, len(episodes), float(np.mean([episode.length for episode in episodes])), ratio))
    return tuple(routes)
