"""Any environment, changed by a function of the user's at each reset."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_ddiffpg.serialization.random_states import restore_generator


class ChangedEnv(gym.Wrapper, RecordConstructorArgs):
    """
    An environment whose world a function changes before each reset, so that the first observation is already one of the
    changed world.

    An environment may keep a change over its resets, as MuJoCo's do: set a value (``world.model.opt.gravity[2] = -5``),
    do not multiply what is there. The function's random numbers are its own: with the same seed the environment draws what it
    draws unchanged. Where the environment says with ``state_dict()`` where its episode is, a run that goes on in another
    process calls the function again, with the random state of then.

    :param env: any environment
    :param change: function of the innermost environment (``env.unwrapped``) and a random generator that reset seeds; of a
        module, not a lambda, to be pickled
    :raises ValueError: if ``change`` cannot be called
    """

    def __init__(self, env: gym.Env, change: Callable[[Any, np.random.Generator], None]) -> None:
        if not callable(change):
            raise ValueError(f"change: {change!r} given; accepted is a function of an environment and a random generator")
        RecordConstructorArgs.__init__(self, change=change)
        gym.Wrapper.__init__(self, env)
        self.change = change
        self._rng = np.random.default_rng()
        self._before: dict[str, Any] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        :param seed: new seed of the environment, and of the function's random numbers
        :param options: the environment's
        :return: observation and info
        """
        if seed is not None:
            # Not the seed itself, by which the environment draws: one would follow from the other
            self._rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])
        self._apply()
        return self.env.reset(seed=seed, options=options)

    def _apply(self) -> None:
        self._before = dict(self._rng.bit_generator.state)
        self.change(self.env.unwrapped, self._rng)

    @property
    def drawn_from(self) -> dict[str, Any] | None:
        """The random state before the latest change, None if there was none. Setting it makes that change again."""
        return self._before

    @drawn_from.setter
    def drawn_from(self, state: dict[str, Any] | None) -> None:
        self._before = None
        if state is not None:
            restore_generator(self._rng, state)
            self._apply()
