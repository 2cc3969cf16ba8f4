"""DIPO: a diffusion policy that imitates actions which climb the critic."""

from functools import partial
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from sb3_ddiffpg.baselines.baseline import Baseline, BaselinePolicy, names_of
from sb3_ddiffpg.buffers import ModeBatch
from sb3_ddiffpg.cuda_graphs import GraphedFunction
from sb3_ddiffpg.policies import DiffusionActor
from sb3_ddiffpg.target_actions import ascend


class DiffusionActorPolicy(BaselinePolicy):
    """
    Twin critics and a diffusion actor without mode embeddings.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate of the actor
    :param activation_fn: Activation of the denoiser
    :param n_diffusion_steps: Number of diffusion steps T
    :param time_embedding_dim: Size of a diffusion step's embedding
    :param noise_schedule: ``"cosine"`` or ``"vp"``, see ``diffusion.NOISE_SCHEDULES``
    :param kwargs: Of ``TwinCriticPolicy``
    """

    def __init__(
        self,
        observation_space: Any,
        action_space: Any,
        lr_schedule: Any,
        activation_fn: type[nn.Module] = nn.SiLU,
        n_diffusion_steps: int = 5,
        time_embedding_dim: int = 32,
        noise_schedule: str = "cosine",
        **kwargs: Any,
    ) -> None:
        actor_kwargs = dict(
            activation_fn=activation_fn,
            n_diffusion_steps=n_diffusion_steps,
            time_embedding_dim=time_embedding_dim,
            noise_schedule=noise_schedule,
        )
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            actor_class=DiffusionActor,
            actor_kwargs={**actor_kwargs, "mode_embedding_dim": 0},
            **kwargs,
        )
        self._constructor.update(actor_kwargs)


class DIPO(Baseline):
    """
    Diffusion policy for model-free online reinforcement learning (Yang et al., 2023, https://arxiv.org/abs/2305.13122): target
    actions climb the critic and return to the buffer; the policy learns to denoise them.

    The defaults are those of the DDiffPG paper's comparison (5 steps, one batch for critic and policy, no target actor) with
    DDiffPG's ascent. The original: ``n_diffusion_steps=100, actor_tau=0.005, own_policy_batch=True, total_gradient_ratio=0.3,
    n_action_gradient_steps=20, action_lr=0.03``.

    :param policy: ``"MlpPolicy"``, ``"MultiInputPolicy"`` (dict observations) or a class
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param n_diffusion_steps: Number of diffusion steps T
    :param action_lr: Step size of the ascent on target actions
    :param n_action_gradient_steps: Number of ascent steps K per update
    :param action_optimizer: See ``target_actions.ascend``
    :param total_gradient_ratio: Largest norm of a whole batch's gradient, as a multiple of the action's size; None: no limit.
        With "adam", whose steps hardly depend on the gradient's size, it changes little, in the original too
    :param own_policy_batch: Whether the policy learns from a batch of its own
    :param kwargs: Of ``Baseline`` and ``NoveltyActorCritic``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = names_of(DiffusionActorPolicy)

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: Any,
        *,
        n_diffusion_steps: int = 5,
        action_lr: float = 0.3,
        n_action_gradient_steps: int = 1,
        action_optimizer: str = "adam",
        total_gradient_ratio: float | None = None,
        own_policy_batch: bool = False,
        **kwargs: Any,
    ) -> None:
        self.n_diffusion_steps = n_diffusion_steps
        self.action_lr = action_lr
        self.n_action_gradient_steps = n_action_gradient_steps
        self.action_optimizer = action_optimizer
        self.total_gradient_ratio = total_gradient_ratio
        self.own_policy_batch = own_policy_batch
        super().__init__(policy, env, **kwargs)

    def _policy_arguments(self) -> dict[str, Any]:
        return {**super()._policy_arguments(), "n_diffusion_steps": self.n_diffusion_steps}

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.graphs["ascent"] = GraphedFunction(self._ascend, self.policy)

    def _update_actor(self, batch: ModeBatch, metrics: dict[str, list[th.Tensor]]) -> None:
        if self.own_policy_batch:
            batch = self.replay_buffer.sample_modes(batch.rows.size, self.gamma, 1, 1, env=self._vec_normalize_env)
        improved = self._improve_target_actions(batch)
        metrics["target_action_shift"].append((improved - batch.target_actions).abs().mean())
        condition = self.actor.condition(batch.observations)
        metrics["actor_loss"].append(self._step_actor(self.actor.diffusion.loss(improved.flatten(0, 1), condition)))

    def _ascend(self, batch: ModeBatch) -> th.Tensor:
        with th.no_grad():
            features = self.policy.critic_features(batch.observations)
        gradient = self.policy.critics.action_gradient(features)
        if self.total_gradient_ratio is not None:
            limit = self.total_gradient_ratio * batch.actions.shape[-1]
            gradient = partial(_limited, gradient, limit)
        return ascend(gradient, batch.target_actions, self.action_lr, self.n_action_gradient_steps, self.action_optimizer)


def _limited(gradient: Any, limit: float, actions: th.Tensor) -> th.Tensor:
    found = gradient(actions)
    return found * (limit / (found.norm() + 1e-8)).clamp(max=1.0)
