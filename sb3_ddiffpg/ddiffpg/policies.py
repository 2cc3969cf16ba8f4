"""DDiffPG's policy: a diffusion actor, the modes' critics and embeddings, and the choice of a mode to act."""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_ddiffpg.ddiffpg.action_plans import ActionPlans
from sb3_ddiffpg.exploration.episode_scheduler import UNCONDITIONED
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.networks.diffusion_actor import DiffusionActor
from sb3_ddiffpg.networks.policies import TwinCriticPolicy
from sb3_ddiffpg.utils.observations import batch_size, repeated, rows_of
from sb3_ddiffpg.utils.settings import at_least

#: Actions among which the critics choose where a policy is to act without chance
DETERMINISTIC_SAMPLES = 4


class _Command(NamedTuple):
    """
    What ``predict`` is asked for: the group of each row, or one for all, how many actions are drawn for each, and the plans
    that are being followed, where actions are drawn in chunks.
    """

    groups: np.ndarray | None
    n_samples: int
    plans: ActionPlans | None = None


_NO_COMMAND = _Command(None, 1)


class DiffusionPolicy(TwinCriticPolicy):
    """
    Diffusion actor, critics of all modes with their targets, and the mode embeddings.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate of the actor
    :param net_arch: Hidden layers, a list or ``dict(pi=[...], qf=[...])``
    :param activation_fn: Activation of the denoiser
    :param critic_activation_fn: Activation of the critics
    :param features_extractor_class: Features extractor; when None, observations are flattened, and those of a dict combined
    :param features_extractor_kwargs: Its keyword arguments
    :param normalize_images: Whether images are divided by 255
    :param optimizer_class: Optimiser of actor and critics
    :param optimizer_kwargs: Its keyword arguments, without the learning rate
    :param n_modes: Number of modes M
    :param n_diffusion_steps: Number of diffusion steps T; None: a flow, see ``DDiffPG``
    :param mode_embedding_dim: Size of a mode embedding
    :param time_embedding_dim: Size of a diffusion step's embedding
    :param n_critics: Critics per group
    :param n_atoms: Atoms of the value distribution, 1 for scalar critics
    :param support: Lower and upper end of the values of the modes' critics
    :param exploration_support: The same for the exploratory critics
    :param twin_target: What the twins learn from, see ``ModeCritics``
    :param action_chunk: Steps whose actions are said at once, and judged together by the critics: fewer calls of the policy,
        and no look at what happens in between. Returns have at least so many steps
    """

    actor: DiffusionActor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.SiLU,
        critic_activation_fn: type[nn.Module] = nn.SiLU,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.AdamW,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_modes: int = 0,
        n_diffusion_steps: int | None = 5,
        mode_embedding_dim: int = 5,
        time_embedding_dim: int = 32,
        n_critics: int = 2,
        n_atoms: int = 51,
        support: tuple[float, float] = (0.0, 5.0),
        exploration_support: tuple[float, float] = (0.0, 5.0),
        twin_target: str = "lower_mean",
        action_chunk: int = 1,
    ) -> None:
        at_least(1).check("action_chunk", action_chunk)
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            actor_class=DiffusionActor,
            actor_kwargs=dict(
                activation_fn=activation_fn,
                n_diffusion_steps=n_diffusion_steps,
                mode_embedding_dim=mode_embedding_dim,
                time_embedding_dim=time_embedding_dim,
                action_chunk=action_chunk,
            ),
            net_arch=net_arch,
            critic_activation_fn=critic_activation_fn,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            n_groups=n_modes + 1,
            n_critics=n_critics,
            n_atoms=n_atoms,
            support=support,
            exploration_support=exploration_support,
            twin_target=twin_target,
            action_chunk=action_chunk,
        )
        self._constructor.update(
            activation_fn=activation_fn,
            n_diffusion_steps=n_diffusion_steps,
            mode_embedding_dim=mode_embedding_dim,
            time_embedding_dim=time_embedding_dim,
        )
        self.mode_embeddings: th.Tensor
        self.register_buffer("mode_embeddings", th.randn(n_modes + 1, mode_embedding_dim))
        self._command = _NO_COMMAND
        self._n_rows = 0  # of the latest observations

    @property
    def n_modes(self) -> int:
        """Number of modes M."""
        return self.critics.n_groups - 1

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "n_modes": self.n_modes}

    # ------------------------------------------------------------------ modes

    def inherit(self, parents: Sequence[int | None], kept: Sequence[bool], reset_output: bool = True) -> None:
        """
        Follow a re-clustering: critics, their targets, optimiser moments and embeddings of the new modes.

        :param parents: For every new mode, the old one from which it inherits, or None
        :param kept: Whether it also keeps that mode's embedding (and optimiser moments), or gets new ones
        :param reset_output: Whether a mode without parent starts with a zeroed output layer
        """
        if list(parents) == list(range(self.n_modes)) and all(kept):
            return  # the networks stay where they are
        fresh = [not keeps for keeps in kept]
        self.critics.inherit(parents, fresh, self.critics.optimizer, reset_output)
        self.critics_target.inherit(parents, fresh, None, reset_output)
        rows = [self.mode_embeddings[EXPLORATORY_GROUP]]
        for parent, keeps in zip(parents, kept, strict=True):
            known = keeps and parent is not None
            rows.append(self.mode_embeddings[parent + 1] if known else self._new_embedding(rows))  # type: ignore[operator]
        self.mode_embeddings = th.stack(rows)

    def _new_embedding(self, others: list[th.Tensor]) -> th.Tensor:
        """Of a few standard normal draws the one farthest from the other embeddings: close ones cannot be told apart."""
        candidates = th.randn(16, self.mode_embeddings.shape[1], device=self.mode_embeddings.device)
        distances = th.cdist(candidates, th.stack(others)).min(dim=1).values
        return candidates[distances.argmax()]

    def resize(self, n_modes: int) -> None:
        """
        Make room for a state dict with another number of modes.

        :param n_modes: Number of modes M
        """
        if n_modes != self.n_modes:
            self.inherit([None] * n_modes, [False] * n_modes)

    def fits_but_for_modes(self, state_dict: dict[str, th.Tensor]) -> bool:
        """
        :param state_dict: Parameters of another policy
        :return: Whether ``load_state_dict`` would take them, or will after ``resize``
        """
        own = self.state_dict()
        by_group = ("critics.", "critics_target.", "mode_embeddings")
        return set(own) == set(state_dict) and all(
            value.shape[1:] == own[name].shape[1:] if name.startswith(by_group) else value.shape == own[name].shape
            for name, value in state_dict.items()
        )

    def group_embeddings(self, groups: np.ndarray | th.Tensor) -> th.Tensor:
        """
        :param groups: Rows of the embedding table, ``UNCONDITIONED`` for the zero embedding, shape [N]
        :return: Shape [N, mode_embedding_dim]
        """
        embeddings = self.mode_embeddings
        with_none = th.cat((embeddings, embeddings.new_zeros(1, embeddings.shape[1])))  # the last row is row UNCONDITIONED
        return with_none[th.as_tensor(groups, device=embeddings.device).long()]

    def row_embeddings(self, n: int, mask_prob: float | None = None) -> th.Tensor:
        """
        :param n: Rows of each group
        :param mask_prob: Probability with which a row's embedding is masked, that of exploration never; None: none is
        :return: Embeddings of the rows of all groups, [G * n, mode_embedding_dim]
        """
        embeddings = self._embeddings_of_groups(n)
        if mask_prob is not None:
            keep = (th.rand(len(embeddings), n, 1, device=embeddings.device) >= mask_prob).to(embeddings.dtype)
            keep[EXPLORATORY_GROUP] = 1.0
            embeddings = embeddings * keep
        return embeddings.reshape(len(self.mode_embeddings) * n, -1)

    def _embeddings_of_groups(self, n: int) -> th.Tensor:
        """Of each row's group, [G, n, mode_embedding_dim]."""
        return self.mode_embeddings[:, None].expand(-1, n, -1)

    # ------------------------------------------------------------------ acting

    def state_values(self, obs: PyTorchObs, n_actions: int) -> th.Tensor:
        """
        :param obs: N observations
        :param n_actions: Actions drawn for each mode
        :return: What the best mode expects; where there is none yet, what exploration does, [N]
        """
        values = self.group_values(obs, n_actions)
        return values[1:].amax(dim=0) if self.n_modes else values[EXPLORATORY_GROUP]

    @th.no_grad()
    def group_values(self, obs: PyTorchObs, n_actions: int) -> th.Tensor:
        """
        What each group's critics expect of following that group, as the mean over actions drawn from the policy.

        :param obs: N observations
        :param n_actions: Actions drawn for each of them and each group
        :return: Shape [G, N]
        """
        n_groups = self.critics.n_groups

        of_group = repeated(obs, n_actions)
        of_all: PyTorchObs = (
            {key: th.cat([part] * n_groups) for key, part in of_group.items()}
            if isinstance(of_group, dict)
            else th.cat([of_group] * n_groups)
        )
        features = self.critic_features(of_all)  # [G, N * n_actions, F]
        embeddings = self.mode_embeddings.repeat_interleave(features.shape[1], 0)
        actions = self.actor(of_all, embeddings=embeddings).unflatten(0, features.shape[:2])
        values = self.critics.values(self.critics(features, actions)).min(dim=1).values
        return values.unflatten(1, (-1, n_actions)).mean(dim=2)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        groups, n_samples, plans = self._command
        n = self._n_rows = batch_size(observation)
        if groups is not None:
            if len(groups) not in (1, n):
                raise ValueError(f"Got modes, state or episode_start of {len(groups)} for {n} observation(s)")
            groups = np.repeat(groups, n // len(groups))
        if plans is None:
            return self._draw(observation, groups, n_samples, deterministic)
        groups = np.full(n, UNCONDITIONED) if groups is None else groups
        if len(over := plans.over(groups)):
            drawn = self._draw(rows_of(observation, over), groups[over], n_samples, deterministic)
            plans.make(over, groups[over], drawn.cpu().numpy())
        return th.as_tensor(plans.next_actions(), device=self.mode_embeddings.device)

    def _draw(self, observation: PyTorchObs, groups: np.ndarray | None, n_samples: int, deterministic: bool) -> th.Tensor:
        """Actions in [-1, 1], those of a chunk one after the other, [N, action_chunk * action_dim]."""
        if n_samples == 1:
            embeddings = None if groups is None else self.group_embeddings(groups)
            return self.actor(observation, deterministic, embeddings)
        return self.best_actions(observation, groups, n_samples, deterministic)

    def fixed_noise(self, n_samples: int) -> th.Tensor:
        """
        :param n_samples: Actions for each observation
        :return: What is denoised where a policy is to act without chance, the same at each call: nothing, and standard normal
            draws, [n_draws, n_samples, action_dim]
        """
        diffusion = self.actor.diffusion
        shape = (diffusion.n_draws, n_samples, diffusion.denoiser.action_dim)
        return _fixed_noise(shape).to(self.mode_embeddings.device)

    @th.no_grad()
    def best_actions(
        self, obs: PyTorchObs, groups: np.ndarray | None, n_samples: int, deterministic: bool = False
    ) -> th.Tensor:
        """
        Of some actions for each observation that which the critics of its group like best; of a row without group, those of
        any mode.

        :param obs: N observations
        :param groups: Rows of the embedding table, ``UNCONDITIONED`` for none, [N]; None: none in any row
        :param n_samples: Actions for each, the first of which has no noise
        :param deterministic: Whether the others always have the same noise
        :return: Actions in [-1, 1], [N, action_chunk * action_dim]
        """
        n = batch_size(obs)
        groups = np.full(n, UNCONDITIONED) if groups is None else groups
        condition = self.actor.condition(obs, self.group_embeddings(groups))
        diffusion = self.actor.diffusion
        if deterministic:
            noise = self.fixed_noise(n_samples)[:, None].expand(-1, n, -1, -1)
        else:
            shape = (diffusion.n_draws, n, n_samples, diffusion.denoiser.action_dim)
            noise = th.randn(shape, device=condition.device)
            noise[:, :, 0] = 0.0
        noise = noise.flatten(1, 2)
        actions = diffusion.sample(condition.repeat_interleave(n_samples, 0), noise=noise).unflatten(0, (n, n_samples))
        features = self.extract_features(obs, self.critic_features_extractor)
        best = actions.new_empty(n, dtype=th.long)
        different = np.unique(groups).tolist()
        for group in different:
            alike = len(different) == 1
            rows = slice(None) if alike else th.as_tensor(np.flatnonzero(groups == group), device=actions.device)
            judges = slice(group, group + 1) if group >= 0 else slice(1, None) if self.n_modes else slice(0, 1)
            repeated_features = features[rows].repeat_interleave(n_samples, 0)
            values = self.critics.values_by(judges, repeated_features, actions[rows].flatten(0, 1)).amax(dim=0)
            best[rows] = values.unflatten(0, (-1, n_samples)).argmax(dim=1)
        return actions[th.arange(n, device=actions.device), best]

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        mode: int | np.ndarray | None = None,
        group: np.ndarray | None = None,
        n_samples: int | None = None,
        among: Sequence[int] | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Actions for one observation or a batch.

        :param observation: The observation(s)
        :param state: As returned by the previous call: the mode held by every environment, and where actions are drawn in
            chunks what is left of these
        :param episode_start: Which environments begin an episode and so draw a new mode
        :param deterministic: Without noise; the same call returns the same action
        :param mode: Index of the mode to follow, one for all or one per observation. None: a mode is drawn for every
            episode (given ``state`` or ``episode_start``), else the zero embedding
        :param group: Rows of the embedding table, overrides ``mode``; for training
        :param n_samples: See ``DDiffPG.predict``
        :param among: Indices of the modes of which one is drawn for an episode; None: of all
        :return: The actions in the action space's bounds, and the state for the next call
        """
        held = None
        if group is None and mode is not None:
            held = np.atleast_1d(np.asarray(mode))
            if held.dtype.kind not in "iu" or held.ndim != 1 or held.min(initial=0) < 0:
                raise ValueError(f"mode={mode!r} is unknown; modes are numbered from 0 to {self.n_modes - 1}")
        elif group is None and (state is not None or episode_start is not None):
            held = self._draw_modes(state, episode_start, range(self.n_modes) if among is None else among)
        if held is not None:
            if held.max(initial=UNCONDITIONED) >= self.n_modes:
                raise ValueError(f"mode={held.max()} (or the one in state) is unknown; this policy has {self.n_modes} modes")
            group = np.where(held < 0, UNCONDITIONED, held + 1)
        if n_samples is None:
            n_samples = DETERMINISTIC_SAMPLES if deterministic else 1
        if not isinstance(n_samples, int | np.integer) or n_samples < 1:
            raise ValueError(f"n_samples: {n_samples!r} given; accepted are whole numbers from 1 up")
        plans = None
        if self.action_chunk > 1:
            plans = ActionPlans(self.action_chunk, None if state is None else state[1:], episode_start)
        self._command = _Command(group, int(n_samples), plans)
        try:
            actions, state = super().predict(observation, state, episode_start, deterministic)
        finally:
            self._command = _NO_COMMAND
        if held is None and plans is None:
            return actions, state
        held = np.array([UNCONDITIONED]) if held is None else held
        followed = np.repeat(held, self._n_rows // len(held))
        return actions, (followed,) if plans is None else (followed, *plans.state)

    def _draw_modes(
        self, state: tuple[np.ndarray, ...] | None, episode_start: np.ndarray | None, among: Sequence[int]
    ) -> np.ndarray:
        """The modes to follow: kept through an episode, at its start drawn uniformly of these; -1 while there is none."""
        if state is None:
            held = np.full(len(np.atleast_1d(episode_start)), UNCONDITIONED)  # type: ignore[arg-type]
            starts = np.ones(len(held), dtype=bool)
        else:
            n_parts = 1 if self.action_chunk == 1 else 1 + len(ActionPlans.PARTS)
            held = np.array(state[0]) if isinstance(state, tuple) and len(state) == n_parts else np.empty(0, dtype=object)
            if held.dtype.kind not in "iu" or held.ndim != 1:
                raise ValueError(f"state must be what the previous call of predict returned, got {state!r}")
            starts = np.zeros(len(held), dtype=bool) if episode_start is None else np.atleast_1d(episode_start).astype(bool)
            if len(starts) != len(held):
                raise ValueError(f"episode_start is given for {len(starts)} environment(s), state for {len(held)}")
        if len(among):
            held[starts] = np.asarray(among)[np.random.randint(0, len(among), size=int(starts.sum()))]
        return held


@cache
def _fixed_noise(shape: tuple[int, int, int]) -> th.Tensor:
    noise = th.randn(shape, generator=th.Generator().manual_seed(0))  # on the CPU: other devices draw otherwise
    noise[:, 0] = 0.0
    return noise


class CnnDiffusionPolicy(DiffusionPolicy):
    """``DiffusionPolicy`` for images, which go through SB3's ``NatureCNN``."""

    default_features_extractor = NatureCNN
