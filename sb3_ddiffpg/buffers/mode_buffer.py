"""Replay buffer that knows modes, and stores target actions beside every action."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ddiffpg.buffers._pickle_of_0_1 import state_of_pickle
from sb3_ddiffpg.buffers.assigned_buffer import AssignedReplayBuffer
from sb3_ddiffpg.buffers.batch import ModeBatch
from sb3_ddiffpg.buffers.hindsight import with_goals
from sb3_ddiffpg.buffers.returns import group_returns
from sb3_ddiffpg.buffers.state import buffer_state, restore_buffer
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.serialization.codec import registered
from sb3_ddiffpg.utils.settings import FLAG, SHARE, at_least

# What may be changed when a run goes on; n_path_points may not: stored paths have so many
_MODE_SETTINGS = (
    *("max_successes_per_mode", "max_failures_per_mode", "max_length_ratio", "min_direct"),
    *("compared_length", "loop_share"),
    *("new_route_share", "explore_beyond_goals", "action_chunk"),
)


@registered("sb3_ddiffpg.buffers.ModeReplayBuffer")
class ModeReplayBuffer(AssignedReplayBuffer):
    """
    An ``AssignedReplayBuffer`` from which batches of all modes are drawn.

    :param args: Of ``AssignedReplayBuffer``
    :param new_route_share: Share of the exploratory group's rows that are drawn from trajectories which reached a goal by a
        route of which a mode has not its fill
    :param explore_beyond_goals: Whether a goal does not end the exploratory group's returns
    :param action_chunk: Steps whose actions are drawn together
    :param kwargs: Of ``AssignedReplayBuffer``
    :raises ValueError: If an argument is out of its range or ``optimize_memory_usage`` is asked for
    """

    action_chunk = 1  # of pickled ones that knew of none

    def __init__(
        self,
        *args: Any,
        new_route_share: float = 0.0,
        explore_beyond_goals: bool = False,
        action_chunk: int = 1,
        **kwargs: Any,
    ) -> None:
        for gone in ("visit_cell_size", "route_share"):  # of version 0.1: the bonus's, and a constant
            kwargs.pop(gone, None)
        new_route_share = kwargs.pop("new_way_share", new_route_share)
        SHARE.check("new_route_share", new_route_share)
        FLAG.check("explore_beyond_goals", explore_beyond_goals)
        at_least(1).check("action_chunk", action_chunk)
        self.action_chunk = action_chunk
        self.new_route_share = new_route_share
        self.explore_beyond_goals = explore_beyond_goals
        super().__init__(*args, **kwargs)

    # ------------------------------------------------------------------ saving

    def state_dict(self) -> dict[str, Any] | None:
        """
        :return: All that it holds, in plain values and arrays, for ``load_state_dict``; None while that is nothing
        """
        return buffer_state(self)

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: What ``state_dict`` gave, of a buffer for the same spaces and number of environments
        :raises ValueError: If it is something else; the buffer is as before then
        """
        restore_buffer(self, state)

    def __getstate__(self) -> dict[str, Any]:
        """Only used rows are pickled."""
        return {**self.settings(), "n_modes": len(self.mode_rows), "owner": self.owner, "state": self.state_dict()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        settings, n_modes, tree = state_of_pickle(state, self.target_action_fields)
        self.__dict__.update(settings)
        self.storage_device = th.device("cpu")  # another machine may have no other
        self._settings = {*vars(self), "_settings"}
        self.reset()
        self.expect_modes(n_modes)
        self.load_state_dict(tree)
        self.owner = state["owner"]

    def adopt_settings(self, other: "ModeReplayBuffer") -> bool:
        """
        :param other: The buffer that this one, loaded from a file, takes the place of
        :return: Whether paths are compared in another way now
        """
        changed = (self.compared_length, self.loop_share) != (other.compared_length, other.loop_share)
        if changed:
            self.forget_paths()
        for name in ("success_key", *_MODE_SETTINGS):
            setattr(self, name, getattr(other, name))
        self.move_storage(other.storage_device)
        if self.success_rule.success_key != other.success_key:
            self.success_rule.success_key, self.success_rule.has_key = other.success_key, False
        return changed

    # ------------------------------------------------------------------ sampling

    def sample_modes(
        self,
        batch_size: int,
        gamma: float,
        exploration_n_steps: int,
        mode_n_steps: int,
        env: VecNormalize | None = None,
        exploration_gamma: float | None = None,
        visits_of_modes: bool = False,
        lost_value: float = 0.0,
    ) -> ModeBatch:
        """
        Draw one multimodal batch: an equal part from all transitions (exploratory group) and from each mode's own.

        :param batch_size: Number of transitions B; each of the G groups gets B // G
        :param gamma: Discount factor
        :param exploration_n_steps: Length of the exploratory group's returns; no less than ``action_chunk`` in any case
        :param mode_n_steps: Length of the modes' returns, like it
        :param env: Normalises observations and rewards when given
        :param exploration_gamma: The exploratory group's discount factor; None: gamma
        :param visits_of_modes: Whether ``visited`` is of all groups, or of the exploratory one alone
        :param lost_value: What it is worth to a mode to leave its route
        :return: The batch
        """
        n_groups = len(self.mode_rows) + 1
        n = batch_size // n_groups
        if n == 0:
            raise ValueError(f"batch_size={batch_size} is smaller than the number of groups, {n_groups}")
        active = np.array([True, *(row_set.size > 0 for row_set in self.mode_rows)])
        sets = [self.stored_rows, *(row_set if row_set.size else self.stored_rows for row_set in self.mode_rows)]
        rows = np.stack([row_set.sample(n) for row_set in sets])  # [G, n]
        if len(self.new_route_rows) and self.new_route_share:
            n_new = round(self.new_route_share * n)
            rows[EXPLORATORY_GROUP, :n_new] = np.random.choice(self.new_route_rows, n_new)
        exploration_n_steps, mode_n_steps = (max(each, self.action_chunk) for each in (exploration_n_steps, mode_n_steps))
        windows = self._windows(rows, exploration_n_steps, mode_n_steps)
        notes = self.read_notes(windows)
        goals_are_told: Any = self.goals_are_told
        relabelling = None
        if self.hindsight is not None and self.has_hindsight and n_groups > 1:
            relabelling = self.hindsight.relabel(self, rows, windows, notes)
        if relabelling is not None:
            goals_are_told = goals_are_told | relabelling.chosen[..., None]
        gammas = np.full(n_groups, gamma, dtype=np.float32)
        if exploration_gamma is not None:
            gammas[EXPLORATORY_GROUP] = exploration_gamma
        returns = group_returns(
            windows,
            notes,
            self._normalize_reward(notes["rewards"].ravel(), env).reshape(windows.shape),
            gammas,
            explore_beyond_goals=self.explore_beyond_goals,
            new_routes_pay=self.new_route_share > 0,
            goals_are_told=goals_are_told,
            lost_value=lost_value,
        )
        # What led away from the route is for the critic to judge, not for the policy to follow
        imitated = active[:, None] & ~notes["off_mode_success"][..., 0]
        imitated[EXPLORATORY_GROUP] = True
        chunks = windows[..., : self.action_chunk]
        steps = self._on_device(self.steps.tensors(rows.ravel()))
        nexts = self._on_device(self.nexts.tensors(returns.last.ravel()))
        executed = None
        if self.action_chunk > 1:
            steps, executed = self._with_later_actions(steps, chunks)
        actions = steps["actions"].view(*rows.shape, -1)
        on_route = np.where(returns.lost, -1, windows)
        return ModeBatch(
            observations=self.normalized(with_goals(self._as_observation(steps, "observations"), relabelling), env),
            actions=actions,
            target_actions=self._target_actions(steps, actions, relabelling),
            next_observations=self.normalized(with_goals(self._as_observation(nexts, "next_observations"), relabelling), env),
            rewards=self._to_device(returns.rewards.astype(np.float32)),
            discounts=self._to_device(returns.discounts.astype(np.float32)),
            active=self._to_device(active),
            imitated=self._to_device(imitated),
            new_routes=self._to_device(returns.new_routes.astype(np.float32)),
            rows=rows,
            chunks=None if self.action_chunk == 1 else chunks,
            relabelled=None if relabelling is None else relabelling.chosen,
            executed=executed,
            dormant=np.flatnonzero(~active).tolist(),
            visited=self.visited(on_route if visits_of_modes else on_route[:1, :, :exploration_n_steps]),
        )

    def _with_later_actions(self, steps: dict[str, th.Tensor], chunks: np.ndarray) -> tuple[dict[str, th.Tensor], th.Tensor]:
        """
        Steps [N, ...] whose actions, also the target ones, are those of all steps of their chunks, one after the other,
        [N, k * action_dim], and which of these there were, [G, n, k * action_dim]. Where the episode was over before, they
        are by chance: it matters not what else was to be done.
        """
        later = chunks[..., 1:].reshape(len(steps["actions"]), -1)  # [N, k - 1]
        read = self._on_device(self.steps.tensors(np.maximum(later.ravel(), 0)))
        executed = th.ones_like(steps["actions"]).repeat(1, self.action_chunk)
        executed[:, self.action_dim :] = self._to_device((later >= 0).repeat(self.action_dim, axis=-1))
        instead = 2 * th.rand_like(executed) - 1
        whole = {
            name: th.where(executed > 0, th.cat((steps[name], read[name].reshape(len(later), -1)), dim=1), instead)
            for name in ("actions", *self.target_action_fields)
        }
        return {**steps, **whole}, executed.view(*chunks.shape[:2], -1)

    def _target_actions(self, steps: dict[str, th.Tensor], actions: th.Tensor, relabelling: Any = None) -> th.Tensor:
        """Of the exploratory group, and of each mode its own, like the actions; these where none are stored."""
        stored = [steps[name].view(actions.shape) for name in self.target_action_fields]
        if not stored:
            return actions
        targets = th.cat((stored[-1][:1], stored[0][1:]))
        if relabelling is None:
            return targets
        return th.where(self._to_device(relabelling.chosen)[..., None], actions, targets)

    def store_target_actions(self, batch: ModeBatch, target_actions: th.Tensor) -> None:
        """
        Write improved target actions back.

        :param batch: As drawn by ``sample_modes``
        :param target_actions: Shape [G, n, k * action_dim]
        """
        if self.storage_device.type == "cpu":
            target_actions = target_actions.cpu()
        improved = target_actions.unflatten(2, (self.action_chunk, self.action_dim))
        chunks = batch.rows[..., None] if batch.chunks is None else batch.chunks
        kept = chunks >= 0
        if batch.relabelled is not None:  # those are for other goals
            kept[1:] &= ~batch.relabelled[1:, :, None]
        active = [mode + 1 for mode, row_set in enumerate(self.mode_rows) if row_set.size]
        for name, groups in (("exploratory_target_actions", [EXPLORATORY_GROUP]), ("target_actions", active)):
            if groups:
                chosen = np.flatnonzero(kept[groups])
                values = th.cat([improved[group] for group in groups]).flatten(0, 1)
                values = values.index_select(0, th.from_numpy(chosen).to(values.device, non_blocking=True))
                self.steps.write(name, chunks[groups].ravel()[chosen], values)
