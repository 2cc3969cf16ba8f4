"""Settings of the modes: how they are found, kept and trained."""

from dataclasses import dataclass

from sb3_ddiffpg.clustering.linkage import LINKAGES
from sb3_ddiffpg.utils.settings import (
    FLAG,
    NOT_NEGATIVE,
    POSITIVE_OR_INFINITE,
    SHARE,
    Settings,
    at_least,
    one_of,
    setting,
)


@dataclass(frozen=True, kw_only=True)
class ModeSettings(Settings):
    """
    How modes are found, kept and trained.

    :param distance_threshold: Distance (in units of the mode features) above which two groups of trajectories are different
        modes; None: an automatic rule
    :param linkage: Linkage of the hierarchical clustering, as in ``scipy.cluster.hierarchy.linkage``
    :param max_modes: Most modes at a time; 1 turns clustering off
    :param min_size: Fewest goal-reached trajectories that make a mode
    :param patience: Re-clusterings in a row that must find a mode within another before it is merged
    :param trials: Commanded training episodes in a row that must miss a mode's route before it is retired
    :param max_successes: Newest goal-reached trajectories that train a mode
    :param max_failures: Newest failed trajectories that train a mode
    :param embedding_dim: Size of a mode embedding
    :param mask_prob: Probability p with which a mode's embedding is masked when the policy is trained
    :param backup_embedding: What the policy in a mode's Bellman target is conditioned on: ``"mode"``, its own embedding, or
        ``"masked"``, the same embedding masked as in the policy's training
    :param n_steps: Length of the multi-step returns of the modes' critics (uncorrected); None: the algorithm's ``n_steps``,
        or 5 where that is None too
    :param novelty_coef: Factor on the intrinsic reward that is added to the modes' rewards
    :param reset_new_critics: Whether the critics of a mode without parent start with a zeroed output layer, or are plain
        copies of the exploratory ones
    """

    group = "modes"

    distance_threshold: float | None = setting(None, POSITIVE_OR_INFINITE.or_none(), flat="distance_threshold")
    linkage: str = setting("average", one_of(*LINKAGES), flat="linkage")
    max_modes: int = setting(10, at_least(1), flat="max_modes")
    min_size: int = setting(5, at_least(1), flat="min_mode_size")
    patience: int = setting(10, at_least(0), flat="mode_patience")
    trials: int = setting(200, at_least(1), flat="mode_trials")
    max_successes: int = setting(40, at_least(1), flat="max_successes_per_mode")
    max_failures: int = setting(20, at_least(1), flat="max_failures_per_mode")
    embedding_dim: int = setting(5, at_least(1), flat="mode_embedding_dim")
    mask_prob: float = setting(0.5, SHARE, flat="mode_mask_prob")
    backup_embedding: str = setting("mode", one_of("mode", "masked"), flat="backup_embedding")
    n_steps: int | None = setting(None, at_least(1).or_none(), flat="mode_n_steps")
    novelty_coef: float = setting(0.0, NOT_NEGATIVE, flat="mode_intrinsic_coef")
    reset_new_critics: bool = setting(True, FLAG, flat="reset_new_critics")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_successes < self.min_size:
            raise ValueError(
                f"modes.max_successes={self.max_successes} is less than min_size={self.min_size}: no more trajectories than "
                "that would be remembered, and no mode ever be found"
            )

    def n_steps_beside(self, n_steps: int | None) -> int:
        """
        :param n_steps: Length of the returns of all critics, None if it was not given
        :return: Of the modes' critics
        """
        return self.n_steps or n_steps or 5
