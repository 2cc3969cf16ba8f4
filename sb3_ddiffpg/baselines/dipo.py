"""DIPO: a diffusion policy that imitates actions which climb the critic."""

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import NatureCNN
from torch import nn

from sb3_ddiffpg.baselines.baseline import Baseline, BaselinePolicy, FifoReplayBuffer, names_of
from sb3_ddiffpg.buffers.batch import ModeBatch
from sb3_ddiffpg.common.actor_critic import Metrics
from sb3_ddiffpg.networks.cuda_graphs import graphed
from sb3_ddiffpg.networks.diffusion_actor import DiffusionActor
from sb3_ddiffpg.networks.settings import TargetActionSettings
from sb3_ddiffpg.networks.target_actions import climb
from sb3_ddiffpg.serialization.codec import registered
from sb3_ddiffpg.utils.settings import FLAG, POSITIVE_OR_INFINITE, Accepted, Settings, at_least


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


class CnnDiffusionActorPolicy(DiffusionActorPolicy):
    """``DiffusionActorPolicy`` for images, which go through SB3's ``NatureCNN``."""

    default_features_extractor = NatureCNN


@registered("sb3_ddiffpg.baselines.dipo.TargetActionReplayBuffer")
class TargetActionReplayBuffer(FifoReplayBuffer):
    """A ``FifoReplayBuffer`` with one target action beside each action."""

    target_action_fields = ("exploratory_target_actions",)


class DIPO(Baseline):
    """
    Diffusion policy for model-free online reinforcement learning (Yang et al., 2023, https://arxiv.org/abs/2305.13122): target
    actions climb the critic and return to the buffer; the policy learns to denoise them.

    The defaults are those of the DDiffPG paper's comparison (5 steps, one batch for critic and policy, no target actor) with
    DDiffPG's ascent. The original: ``n_diffusion_steps=100, actor_tau=0.005, own_policy_batch=True, total_gradient_ratio=0.3,
    target_action=dict(n_steps=20, learning_rate=0.03)``.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"`` (images), ``"MultiInputPolicy"`` (dict observations) or a class
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param n_diffusion_steps: Number of diffusion steps T
    :param target_action: How target actions climb the critics, see ``TargetActionSettings``
    :param total_gradient_ratio: Largest norm of a whole batch's gradient, as a multiple of the action's size; None: no limit.
        With "adam", whose steps hardly depend on the gradient's size, it changes little, in the original too
    :param own_policy_batch: Whether the policy learns from a batch of its own
    :param kwargs: Of ``Baseline`` and ``ActorCriticAlgorithm``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = names_of(DiffusionActorPolicy, CnnDiffusionActorPolicy)
    default_replay_buffer_class = TargetActionReplayBuffer
    settings_groups: ClassVar[tuple[type[Settings], ...]] = (*Baseline.settings_groups, TargetActionSettings)
    accepted: ClassVar[dict[str, Accepted]] = {
        "n_diffusion_steps": at_least(1),
        "total_gradient_ratio": POSITIVE_OR_INFINITE.or_none(),
        "own_policy_batch": FLAG,
    }
    target_action_settings: TargetActionSettings

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: Any,
        *,
        n_diffusion_steps: int = 5,
        total_gradient_ratio: float | None = None,
        own_policy_batch: bool = False,
        **kwargs: Any,
    ) -> None:
        self.n_diffusion_steps = n_diffusion_steps
        self.total_gradient_ratio = total_gradient_ratio
        self.own_policy_batch = own_policy_batch
        super().__init__(policy, env, **kwargs)

    def _setup_model(self) -> None:
        if self.replay_buffer_class is FifoReplayBuffer:  # of a file of version 0.1, when that one had target actions
            self.replay_buffer_class = None
        super()._setup_model()

    def _policy_arguments(self) -> dict[str, Any]:
        return {**super()._policy_arguments(), "n_diffusion_steps": self.n_diffusion_steps}

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.graphs["ascent"] = graphed(self._climb, self.policy)

    def _update_actor(self, batch: ModeBatch, metrics: Metrics) -> None:
        if self.own_policy_batch:
            batch = self.replay_buffer.sample_modes(batch.rows.size, self.gamma, 1, 1, env=self._vec_normalize_env)
        improved = self._improve_target_actions(batch)
        metrics["target_action_shift"].append((improved - batch.target_actions).abs().mean())
        condition = self.actor.condition(batch.observations)
        metrics["actor_loss"].append(self._step_actor(self.actor.diffusion.loss(improved.flatten(0, 1), condition)))

    def _climb(self, batch: ModeBatch) -> th.Tensor:
        ratio = self.total_gradient_ratio
        limit = None if ratio is None else ratio * batch.actions.shape[-1]
        return climb(self.policy, batch, self.target_action_settings, limit)
