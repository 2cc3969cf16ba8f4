"""Constructor arguments are checked before anything is built; every message names the argument and what it accepts."""

from collections.abc import Callable
from typing import Any

import numpy as np
from torch import nn

from sb3_ddiffpg.buffers import ModeReplayBuffer
from sb3_ddiffpg.clustering import LINKAGES
from sb3_ddiffpg.critics import TWIN_TARGETS
from sb3_ddiffpg.divergence import LARGEST
from sb3_ddiffpg.intrinsic import NOVELTY_MEASURES
from sb3_ddiffpg.target_actions import ACTION_OPTIMIZERS

# Of DDiffPG, for comparison
CONTROLS = ("shuffled_embeddings", "random_clusters")


def _is_number(value: Any) -> bool:
    return _is_integer(value) or (isinstance(value, (float, np.floating)) and not np.isnan(value))


def _is_integer(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and abs(int(value)) < 2**63


def _is_share(value: Any) -> bool:
    return _is_number(value) and 0 <= value <= 1


def _is_moderate(value: Any) -> bool:
    return _is_number(value) and abs(value) < LARGEST


def _or_schedule(is_right: Callable[[Any], bool]) -> Callable[[Any], bool]:
    """The value itself, or a function of the remaining progress with such values."""

    def check(value: Any) -> bool:
        if not callable(value):
            return is_right(value)
        return all(is_right(float(value(progress))) for progress in (1.0, 0.5, 0.0))

    return check


# Beyond 1000 a parameter may become infinite in one step
_is_rate = _or_schedule(lambda value: _is_number(value) and 0 <= value <= 1000)


def _is_frequency(value: Any) -> bool:
    frequency, unit = value if isinstance(value, tuple) and len(value) == 2 else (value, "step")
    return _is_integer(frequency) and frequency >= 1 and getattr(unit, "value", unit) in ("step", "episode")


# Names of arguments, what they accept in words and as a test
RANGES: tuple[tuple[tuple[str, ...], str, Callable[[Any], bool]], ...] = (
    (
        (
            *("n_diffusion_steps", "n_action_gradient_steps", "n_critics", "n_atoms", "mode_n_steps", "exploration_n_steps"),
            *("recluster_freq", "max_modes", "min_mode_size", "max_successes_per_mode", "max_failures_per_mode"),
            *("mode_embedding_dim", "mode_trials", "batch_size", "buffer_size", "n_steps"),
            *("policy_delay", "n_candidates", "average_freq", "target_update_interval", "latent_dim"),
        ),
        "be an integer of at least 1",
        lambda value: _is_integer(value) and value >= 1,
    ),
    (
        ("learning_starts", "mode_patience", "average_start"),
        "be an integer of at least 0",
        lambda value: _is_integer(value) and value >= 0,
    ),
    (("train_freq",), "be an integer of at least 1, or a tuple of one and 'step' or 'episode'", _is_frequency),
    (("gradient_steps",), "be an integer of at least -1", lambda value: _is_integer(value) and value >= -1),
    (
        (
            *("gamma", "tau", "mode_mask_prob", "exploration_fraction", "explore_then_exploit", "switch_modes"),
            *("min_return_ratio", "gae_lambda"),
        ),
        "lie in [0, 1]",
        _is_share,
    ),
    (("exploration_gamma", "actor_tau"), "lie in [0, 1], or be None", lambda value: value is None or _is_share(value)),
    (("max_grad_norm",), "be positive", lambda value: _is_number(value) and value > 0),
    (
        ("action_lr", "reward_scale", "intrinsic_clip"),
        f"be positive and below {LARGEST:g}",
        lambda value: _is_moderate(value) and value > 0,
    ),
    (
        ("exploration_v_max",),
        f"be positive and below {LARGEST:g}, or None",
        lambda value: value is None or (_is_moderate(value) and value > 0),
    ),
    (
        (
            *("target_policy_noise", "target_noise_clip", "novelty_scale", "intrinsic_coef", "mode_intrinsic_coef"),
            *("new_way_coef", "q_coef", "bc_coef", "consistency_coef", "reward_loss_coef", "value_loss_coef"),
            *("state_loss_coef", "initial_entropy_coef", "entropy_learning_rate"),
        ),
        f"be at least 0 and below {LARGEST:g}",
        lambda value: _is_moderate(value) and value >= 0,
    ),
    (("v_min", "v_max"), f"be a number between -{LARGEST:g} and {LARGEST:g}", _is_moderate),
    (("learning_rate",), "lie in [0, 1000], or be a schedule of such numbers", _is_rate),
    (
        ("qf_learning_rate",),
        "lie in [0, 1000], be a schedule of such numbers or None",
        lambda value: value is None or _is_rate(value),
    ),
    (
        ("latent_coef",),
        f"be at least 0 and below {LARGEST:g}, or be a schedule of such numbers",
        _or_schedule(lambda value: _is_moderate(value) and value >= 0),
    ),
    (
        ("exploration_share",),
        "lie in [0, 1], be a schedule of such numbers or None",
        lambda value: value is None or _or_schedule(_is_share)(value),
    ),
    (
        ("target_entropy",),
        f"be a number between -{LARGEST:g} and {LARGEST:g}, or None",
        lambda value: value is None or _is_moderate(value),
    ),
    (
        ("n_levels",),
        "be two integers, of at least 2, in order",
        lambda value: (
            isinstance(value, (list, tuple)) and len(value) == 2 and all(map(_is_integer, value)) and 2 <= value[0] <= value[1]
        ),
    ),
    (("own_policy_batch",), "be True or False", lambda value: isinstance(value, (bool, np.bool_))),
    (
        ("distance_threshold", "total_gradient_ratio"),
        "be positive or None",
        lambda value: value is None or (_is_number(value) and value > 0),
    ),
    (("success_key",), "be a string or None", lambda value: value is None or isinstance(value, str)),
    (("action_optimizer",), f"be one of {list(ACTION_OPTIMIZERS)}", lambda value: value in ACTION_OPTIMIZERS),
    (("twin_target",), f"be one of {list(TWIN_TARGETS)}", lambda value: value in TWIN_TARGETS),
    (("backup_embedding",), "be one of ['mode', 'masked']", lambda value: value in ("mode", "masked")),
    (("control",), f"be None or one of {list(CONTROLS)}", lambda value: value is None or value in CONTROLS),
    (("linkage",), f"be one of {list(LINKAGES)}", lambda value: value in LINKAGES),
    (
        ("novelty",),
        f"be one of {list(NOVELTY_MEASURES)} or a subclass of torch.nn.Module like these",
        lambda value: value in NOVELTY_MEASURES or (isinstance(value, type) and issubclass(value, nn.Module)),
    ),
)


def check_ranges(arguments: dict[str, Any]) -> None:
    """
    :param arguments: Some of an algorithm's, by name
    :raises ValueError: For the first that cannot work, whatever the others are
    """
    for names, accepted, is_right in RANGES:
        for name in [each for each in names if each in arguments]:
            try:
                right, problem = is_right(arguments[name]), None
            except Exception as error:  # of a schedule
                right, problem = False, error
            if not right:
                why = "" if problem is None else f": {problem!r}"
                raise ValueError(f"{name} must {accepted}, got {arguments[name]!r}{why}") from problem


def check_arguments(model: Any, policy_arguments: Callable[[], dict[str, Any]]) -> None:
    """
    :param model: An algorithm whose arguments are set
    :param policy_arguments: Gives the arguments of its policy that follow from its own, where these are right
    :raises ValueError: For the first argument that cannot work
    """
    names = [name for each, *_ in RANGES for name in each if hasattr(model, name)]
    check_ranges({name: getattr(model, name) for name in names})
    if model.optimize_memory_usage:
        raise ValueError("optimize_memory_usage=True is not supported: trajectories do not lie in one ring")
    given = model.replay_buffer_class
    if given is not None and not (isinstance(given, type) and issubclass(given, ModeReplayBuffer)):
        name = getattr(given, "__name__", repr(given))
        raise ValueError(f"replay_buffer_class must be ModeReplayBuffer or a subclass of it, got {name}")
    overridden = {name for name in policy_arguments() if name in model.policy_kwargs}
    if overridden:
        raise ValueError(f"policy_kwargs must not hold {sorted(overridden)}: {type(model).__name__}'s own arguments say these")
    if not model.v_min < model.v_max:
        raise ValueError(f"v_min must be less than v_max, got v_min={model.v_min}, v_max={model.v_max}")


def check_mode_arguments(model: Any) -> None:
    """
    :param model: A DDiffPG whose arguments are set
    :raises ValueError: If its arguments on modes do not fit together
    """
    if model.n_steps != 1:
        raise ValueError(f"n_steps={model.n_steps} is not supported: use mode_n_steps and exploration_n_steps instead")
    if model.batch_size < model.max_modes + 1:
        raise ValueError(
            f"batch_size={model.batch_size} is smaller than the number of groups it may be split over: "
            f"max_modes + 1 = {model.max_modes + 1}"
        )
    if model.max_successes_per_mode < model.min_mode_size:
        raise ValueError(
            f"max_successes_per_mode={model.max_successes_per_mode} is less than min_mode_size={model.min_mode_size}: "
            "no more trajectories than that would be remembered, and no mode ever be found"
        )
