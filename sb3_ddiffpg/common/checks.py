"""What the arguments of a model must be together, before anything is made of them."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.networks.settings import CriticSettings
from sb3_ddiffpg.utils.arguments import accepted_by


def check_each(model: Any) -> None:
    """
    :param model: One of this package's algorithms, whose arguments are set
    :raises ValueError: For the first argument that cannot work on its own, naming it
    """
    for name, accepted in accepted_by(type(model)).items():
        accepted.check(name, getattr(model, name))


def take_number_of_critics(model: Any) -> None:
    """
    Let ``policy_kwargs`` say the number of critics, as in SB3; ``critic.n_critics`` is the same.

    :param model: One of this package's algorithms, whose arguments are set
    :raises ValueError: If both say something different, or it is not accepted
    """
    own: CriticSettings = model.critic_settings
    given = model.policy_kwargs.get("n_critics", own.n_critics)
    if own.n_critics not in (given, type(own)().n_critics):
        raise ValueError(f"policy_kwargs['n_critics']={given} given beside critic.n_critics={own.n_critics}: accepted is one")
    model.critic_settings = replace(own, n_critics=given)


def check_model(model: Any, own: Iterable[str]) -> None:
    """
    :param model: One of this package's algorithms, whose arguments are set
    :param own: Arguments of its policy that follow from its own
    :raises ValueError: For the first argument that cannot work, naming it
    """
    if model.optimize_memory_usage:
        raise ValueError("optimize_memory_usage=True is not supported: trajectories do not lie in one ring")
    given = model.replay_buffer_class
    if given is not None and not (isinstance(given, type) and issubclass(given, ModeReplayBuffer)):
        name = getattr(given, "__name__", repr(given))
        raise ValueError(f"replay_buffer_class must be ModeReplayBuffer or a subclass of it, got {name}")
    overridden = {name for name in own if name in model.policy_kwargs} - {"n_critics"}
    if overridden:
        raise ValueError(f"policy_kwargs must not hold {sorted(overridden)}: {type(model).__name__}'s own arguments say these")
    space: Any = model.action_space
    if (flat := np.flatnonzero(space.low >= space.high)).size:
        raise ValueError(f"action_space: low is not below high in components {flat.tolist()}; accepted are ranges")
