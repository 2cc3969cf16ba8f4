"""What the baselines share: one group of critics, a first-in-first-out buffer, and a target actor for those that have one."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from sb3_ddiffpg.buffers.batch import ModeBatch
from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.trajectory import Trajectory
from sb3_ddiffpg.common.actor_critic import ActorCriticAlgorithm, Metrics
from sb3_ddiffpg.exploration.known_regions import NO_ROUTE
from sb3_ddiffpg.networks.policies import Actor, TwinCriticPolicy, average_networks
from sb3_ddiffpg.serialization.codec import registered
from sb3_ddiffpg.utils.settings import SHARE, Accepted


@registered("sb3_ddiffpg.baselines.baseline.FifoReplayBuffer")
class FifoReplayBuffer(ModeReplayBuffer):
    """A ``ModeReplayBuffer`` without modes and target actions: the trajectory that ended first is the first to go."""

    target_action_fields: tuple[str, ...] = ()
    constant_notes: ClassVar[dict[str, Any]] = {
        **{"off_mode_success": False, "off_route": False, "route_novelty": 0.0},
        **{"followed": NO_ROUTE, "counted": True},
    }

    def _insert(self, trajectory: Trajectory) -> None:
        self.groups.retired.append(trajectory)


class BaselinePolicy(TwinCriticPolicy):
    """
    A ``TwinCriticPolicy`` with a target actor. A subclass says of which class the actors are.

    :param args: Observation space, action space and learning rate
    :param kwargs: Of ``TwinCriticPolicy``
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        optimizer, self.actor.optimizer = self.actor.optimizer, None
        self.actor_target = copy.deepcopy(self.actor)
        self.actor.optimizer = optimizer
        self.actor_target.set_training_mode(False)
        self.actor_target.requires_grad_(False)


class MlpActorPolicy(BaselinePolicy):
    """
    A ``BaselinePolicy`` whose actor is one network. A subclass says of which class.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate of the actor
    :param activation_fn: Activation of the actor
    :param kwargs: Of ``TwinCriticPolicy``
    """

    actor_class: ClassVar[type[Actor]]

    def __init__(
        self,
        observation_space: Any,
        action_space: Any,
        lr_schedule: Any,
        activation_fn: type[nn.Module] = nn.ELU,
        **kwargs: Any,
    ) -> None:
        actor_kwargs = dict(activation_fn=activation_fn)
        super().__init__(observation_space, action_space, lr_schedule, self.actor_class, actor_kwargs, **kwargs)
        self._constructor.update(actor_kwargs)


def names_of(policy_class: type[BasePolicy], for_images: type[BasePolicy] | None = None) -> dict[str, type[BasePolicy]]:
    """
    :param policy_class: A baseline's policy, which takes any observations
    :param for_images: The same with a convolution, if there is one
    :return: SB3's names for them
    """
    names = dict.fromkeys(("MlpPolicy", "MultiInputPolicy"), policy_class)
    return names if for_images is None else {**names, "CnnPolicy": for_images}


class Baseline(ActorCriticAlgorithm):
    """
    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"`` (images), ``"MultiInputPolicy"`` (dict observations) or a class
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param actor_tau: Soft update coefficient of a target actor, which acts in the Bellman target; None: the actor itself does
    :param kwargs: Of ``ActorCriticAlgorithm``
    """

    default_replay_buffer_class = FifoReplayBuffer
    accepted: ClassVar[dict[str, Accepted]] = {"actor_tau": SHARE.or_none()}
    target_networks: ClassVar[dict[str, str]] = {**ActorCriticAlgorithm.target_networks, "actor_target": "actor"}
    policy: BaselinePolicy

    def __init__(self, policy: str | type[BasePolicy], env: Any, *, actor_tau: float | None = None, **kwargs: Any) -> None:
        self.actor_tau = actor_tau
        super().__init__(policy, env, **kwargs)

    def _next_actions(self, batch: ModeBatch) -> tuple[th.Tensor, th.Tensor | float]:
        return self._target_actor()(batch.next_observations), 0.0

    def _target_actor(self) -> Any:
        return self.actor if self.actor_tau is None else self.policy.actor_target

    def _update_targets(self) -> None:
        super()._update_targets()
        if self.actor_tau is not None:
            self._average_actor(self.actor_tau)

    @contextmanager
    def _updates(self, gradient_steps: int) -> Iterator[Metrics]:
        with super()._updates(gradient_steps) as metrics:
            yield metrics
        if self.actor_tau is None:  # it may be given when the model goes on
            average_networks([self.actor], [self.policy.actor_target], 1.0)

    def _average_actor(self, tau: float) -> None:
        """Let the target actor follow the actor."""
        average_networks([self.actor], [self.policy.actor_target], tau)

    def _step_actor(self, loss: th.Tensor) -> th.Tensor:
        """One step of the actor's optimiser; gives the loss back."""
        self.actor.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = th.nn.utils.clip_grad_norm_(self.actor.parameters(), self.max_grad_norm)
        self.divergence_watch.step(["actor"], self.actor.optimizer, loss, norm)
        return loss.detach()

    def _values(self, batch: ModeBatch, actions: th.Tensor) -> th.Tensor:
        """Values of actions [n, action_dim] by each critic, [C, n]; the critics' weights are constants."""
        with th.no_grad():
            features = self.policy.critic_features(batch.observations)
        critics = self.policy.critics
        return critics.values(critics(features, actions[None], frozen=True))[0]
