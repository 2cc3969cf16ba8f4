"""What follows where a run has been, so that no unit and no feature need be said before: it is measured now and then."""

from typing import Any

import numpy as np
from stable_baselines3.common.preprocessing import is_image_space

from sb3_ddiffpg.buffers.feature_choice import MOST_FEATURES, choose_features
from sb3_ddiffpg.buffers.features import ModeFeatures, declared_mode_features
from sb3_ddiffpg.buffers.trajectory import Trajectory

# It is measured again when the run is so many times as long
REVIEW_AGAIN = 1.25
# What networks see is measured from so many steps, all over the run; which features go far from the latest so many
REVIEWED_STEPS, EPISODES_STEPS = 4096, 20_000


def features_of(model: Any) -> Any:
    """
    :param model: One of this package's algorithms, perhaps without environments
    :return: In which features its modes differ: as the user says, else as the environment does, else as was found before; None
        if nobody does
    """
    if model.mode_features is not None:
        return model.mode_features
    declared = None if model.env is None else declared_mode_features(model.env)
    known = model.env is None or model.features_found
    return model.resolved_features if declared is None and known else declared


def review_scales(model: Any) -> None:
    """
    If it is time, let inputs of the networks, mode features and cells follow where the run has been.

    :param model: One of this package's algorithms
    """
    steps, buffer = model.lifetime_steps, model.replay_buffer
    if steps < model.next_review:
        return
    model.next_review = int(REVIEW_AGAIN * steps) + 1
    seen = buffer.read_observations(buffer.stored_rows.spread(REVIEWED_STEPS))[0]
    model.policy.adapt_inputs(buffer.normalized(seen, model._vec_normalize_env))
    if not model.features_found and may_choose(model):
        _choose(model, buffer.episodes(), ())
    if buffer.review_scale():
        model.bonus.forget_routes()
    model.bonus.review(buffer, _mastered(model))


def may_choose(model: Any) -> bool:
    """
    :param model: One of this package's algorithms
    :return: Whether neither user nor environment says where modes differ, and the observation is larger than need be
    """
    space = model.observation_space
    nobody = model.mode_features is None and (model.resolved_features is None or model.features_found)
    return nobody and not is_image_space(space) and ModeFeatures(space).dim > MOST_FEATURES


def settle_features(model: Any) -> None:
    """
    When enough episodes have reached the goal for a mode, these say where they part. It is asked once.

    :param model: One of this package's algorithms with modes
    """
    buffer = model.replay_buffer
    if model.features_settled or len(model.mode_manager) or not may_choose(model):
        return
    successes = buffer.trajectories(success=True)
    if len(successes) >= model.mode_settings.min_size:
        model.features_settled = True
        _choose(model, buffer.episodes(), successes)


def _choose(model: Any, episodes: list[np.ndarray], successes: list[Trajectory] | tuple[()]) -> None:
    buffer = model.replay_buffer
    whole = ModeFeatures(model.observation_space)

    def path(rows: np.ndarray) -> np.ndarray:
        observations, next_observations = (buffer.read_observations(each)[k] for k, each in enumerate((rows, rows[-1:])))
        return np.concatenate([whole.of_tensors(each).cpu().numpy() for each in (observations, next_observations)])

    some, total = [], 0
    for rows in episodes[::-1]:  # the latest
        if len(rows) and total < EPISODES_STEPS:
            some.append(path(rows))
            total += len(rows)
    chosen = choose_features(some, [path(each.rows) for each in successes])
    if not len(chosen) or (model.features_found and np.array_equal(chosen, model.resolved_features)):
        return
    _use_features(model, chosen)
    model.features_found = True
    if model.verbose >= 1:
        why = "goal-reached episodes part" if len(successes) else "episodes go farthest"
        print(
            f"[features] step {model.num_timesteps}: mode_features={chosen.tolist()}, along which {why}; "
            "sb3_ddiffpg.common.scales.use_features takes others"
        )


def use_features(model: Any, selection: Any) -> None:
    """
    From now on modes differ, and places are told apart, in these features. What was learned stays, modes keep their
    trajectories, and visits are counted again.

    :param model: One of this package's algorithms
    :param selection: As for ``mode_features``
    :raises ValueError: If it does not fit the observations
    """
    _use_features(model, selection)
    model.mode_features, model.features_found = selection, False


def _use_features(model: Any, selection: Any) -> None:
    buffer = model.replay_buffer
    buffer.use_features(selection)
    model.resolved_features = selection
    if (manager := getattr(model, "mode_manager", None)) is not None:
        manager.use_features(selection, buffer.features.dim)
    model.bonus.restart(buffer.features.dim)
    model.bonus.review(buffer, _mastered(model))


def _mastered(model: Any) -> dict[int, int]:
    manager = getattr(model, "mode_manager", None)
    return {} if manager is None else manager.mastered()
