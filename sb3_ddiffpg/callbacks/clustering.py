"""When to re-cluster, and what is said of it."""

from stable_baselines3.common.callbacks import BaseCallback

from sb3_ddiffpg.modes.history import ModeEvent
from sb3_ddiffpg.utils.nested_callbacks import nested_callbacks


class ClusteringCallback(BaseCallback):
    """
    Re-clusters the goal-reached trajectories every few rollouts, if an episode has ended since the time before, and says what
    became of the modes. ``DDiffPG.learn`` installs one by itself; pass one's own (or a subclass) to replace it.

    The rollouts are counted by the model, so that a resumed run keeps the rhythm.

    :param recluster_freq: Rollouts between two re-clusterings; the model's own setting when None
    :param verbose: 1 prints a line when modes were born, split, merged or retired; the model's verbosity when None
    """

    def __init__(self, recluster_freq: int | None = None, verbose: int | None = None) -> None:
        super().__init__(0 if verbose is None else verbose)
        if recluster_freq is not None and not (isinstance(recluster_freq, int) and recluster_freq >= 1):
            raise ValueError(f"recluster_freq must be an integer of at least 1, got {recluster_freq!r}")
        self.recluster_freq = recluster_freq
        self._inherit_verbosity = verbose is None

    def _init_callback(self) -> None:
        if self._inherit_verbosity:
            self.verbose = self.model.verbose

    def _on_rollout_end(self) -> None:
        # Not _on_step: SB3 calls that one before the transition is stored
        model = self.model
        model.n_rollouts += 1  # type: ignore[attr-defined]
        frequency = self.recluster_freq or model.recluster_freq  # type: ignore[attr-defined]
        # The same trajectories would tell nothing new, and a mode that they put in doubt would be doubted again and again
        has_news = model.replay_buffer.n_finished != model.mode_manager.n_judged  # type: ignore[attr-defined]
        if model.n_rollouts % frequency == 0 and has_news:  # type: ignore[attr-defined]
            self.on_recluster(model.recluster())  # type: ignore[attr-defined]

    def on_recluster(self, events: list[ModeEvent]) -> None:
        """
        :param events: One entry for every mode that was born, split, merged or retired
        """
        if events and self.verbose >= 1:
            print(f"[modes] step {self.num_timesteps}: {'; '.join(map(str, events))} -> {len(self.model.modes)} mode(s)")  # type: ignore[attr-defined]

    def _on_step(self) -> bool:
        return True


def contains_clustering(callback: BaseCallback) -> bool:
    """
    :param callback: A callback, perhaps with others inside
    :return: Whether one of them is a ``ClusteringCallback``
    """
    return any(isinstance(each, ClusteringCallback) for each in nested_callbacks(callback))
