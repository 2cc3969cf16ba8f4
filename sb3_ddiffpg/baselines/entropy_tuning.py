"""The factor of a policy's entropy, tuned so that the entropy comes to what it should be (Haarnoja et al., 2018)."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_ddiffpg.common.actor_critic import ActorCriticAlgorithm, Metrics
from sb3_ddiffpg.utils.settings import NOT_NEGATIVE, NUMBER, Accepted


class EntropyTuning(ActorCriticAlgorithm):
    """
    An algorithm whose policy has a ``log_entropy_coef``. Its own noise explores: there is no other unless ``action_noise`` is
    given.

    :param policy: See the subclass
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param entropy_learning_rate: Learning rate of the entropy's factor
    :param initial_entropy_coef: Its first value
    :param target_entropy: Entropy that it aims at; None: minus the action's size
    :param kwargs: Of the class behind this one
    """

    accepted: ClassVar[dict[str, Accepted]] = {
        **dict.fromkeys(("entropy_learning_rate", "initial_entropy_coef"), NOT_NEGATIVE),
        "target_entropy": NUMBER.or_none(),
    }

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: Any,
        *,
        entropy_learning_rate: float,
        initial_entropy_coef: float,
        target_entropy: float | None = None,
        **kwargs: Any,
    ) -> None:
        self.entropy_learning_rate = entropy_learning_rate
        self.initial_entropy_coef = initial_entropy_coef
        self.target_entropy = target_entropy
        super().__init__(policy, env, **kwargs)

    def _setup_model(self) -> None:
        no_noise = self.action_noise is None
        super()._setup_model()
        if no_noise:
            self.action_noise = None
        with th.no_grad():
            self._log_entropy_coef.fill_(float(np.log(self.initial_entropy_coef)))
        self.entropy_optimizer = th.optim.Adam([self._log_entropy_coef], lr=self.entropy_learning_rate)

    @property
    def _log_entropy_coef(self) -> th.Tensor:
        return self.policy.log_entropy_coef  # type: ignore[return-value]

    @property
    def entropy_coef(self) -> th.Tensor:
        """The factor alpha of the entropy, a scalar."""
        return self._log_entropy_coef.detach().exp()

    def _tune_entropy(self, log_probabilities: th.Tensor, metrics: Metrics) -> None:
        """
        One step of the factor's logarithm.

        :param log_probabilities: Of the policy's actions, [N]
        :param metrics: Where to note the factor
        """
        target = -float(np.prod(self.action_space.shape or (1,))) if self.target_entropy is None else self.target_entropy
        slope = -(log_probabilities.detach() + target).mean()
        self._log_entropy_coef.grad = slope  # of the loss: slope * logarithm, which is infinite for a factor of 0
        self.divergence_watch.step(["entropy's factor"], self.entropy_optimizer, slope, slope.abs(), bounded=False)
        metrics["entropy_coef"].append(self.entropy_coef)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "entropy_optimizer"], variables
