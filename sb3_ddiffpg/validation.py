"""Constructor arguments are checked before anything is built; every message names the argument and what it accepts."""

from typing import Any

import numpy as np

from sb3_ddiffpg.buffers import ModeReplayBuffer
from sb3_ddiffpg.clustering import LINKAGES
from sb3_ddiffpg.intrinsic import NOVELTY_MEASURES
from sb3_ddiffpg.target_actions import ACTION_OPTIMIZERS

AT_LEAST_ONE = (
    *("n_diffusion_steps", "n_action_gradient_steps", "n_critics", "n_atoms", "mode_n_steps", "exploration_n_steps"),
    *("recluster_freq", "max_modes", "min_mode_size", "max_successes_per_mode", "max_failures_per_mode"),
    *("mode_embedding_dim", "batch_size", "buffer_size"),
)
SHARES = ("gamma", "tau", "mode_mask_prob", "exploration_fraction")
POSITIVE = ("action_lr", "reward_scale", "max_grad_norm", "exploration_v_max")
CHOICES = {"action_optimizer": ACTION_OPTIMIZERS, "backup_embedding": ("mode", "masked"), "linkage": LINKAGES}


def check_arguments(model: Any) -> None:
    """
    :param model: A DDiffPG whose arguments are set
    :raises ValueError: For the first argument that cannot work
    """
    _check_ranges(model)
    if model.mode_patience < 0:
        raise ValueError(f"mode_patience must not be negative, got {model.mode_patience!r}")
    if model.n_steps != 1:
        raise ValueError(f"n_steps={model.n_steps} is not supported: use mode_n_steps and exploration_n_steps instead")
    if model.optimize_memory_usage:
        raise ValueError("optimize_memory_usage=True is not supported: trajectories do not lie in one ring")
    buffer_class = model.replay_buffer_class
    if buffer_class is not None and not issubclass(buffer_class, ModeReplayBuffer):
        raise ValueError(f"replay_buffer_class must be ModeReplayBuffer or a subclass of it, got {buffer_class.__name__}")
    if model.batch_size < model.max_modes + 1:
        raise ValueError(
            f"batch_size={model.batch_size} is smaller than the number of groups it may be split over: "
            f"max_modes + 1 = {model.max_modes + 1}"
        )
    if isinstance(model.novelty, str) and model.novelty not in NOVELTY_MEASURES:
        raise ValueError(f"novelty must be one of {list(NOVELTY_MEASURES)} or a class, got {model.novelty!r}")
    if not model.v_min < model.v_max:
        raise ValueError(f"v_min must be less than v_max, got v_min={model.v_min}, v_max={model.v_max}")


def _check_ranges(model: Any) -> None:
    for name in AT_LEAST_ONE:
        value = getattr(model, name)
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
    for name in SHARES:
        if not 0 <= getattr(model, name) <= 1:
            raise ValueError(f"{name} must lie in [0, 1], got {getattr(model, name)!r}")
    for name in POSITIVE:
        if not getattr(model, name) > 0:
            raise ValueError(f"{name} must be positive, got {getattr(model, name)!r}")
    if model.distance_threshold is not None and not model.distance_threshold > 0:
        raise ValueError(f"distance_threshold must be positive or None, got {model.distance_threshold!r}")
    for name, choices in CHOICES.items():
        if getattr(model, name) not in choices:
            raise ValueError(f"{name} must be one of {list(choices)}, got {getattr(model, name)!r}")
