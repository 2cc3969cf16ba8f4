"""Settings of the critics and of the target actions that climb them."""

from dataclasses import dataclass

from sb3_ddiffpg.networks.critics import TWIN_TARGETS
from sb3_ddiffpg.networks.target_actions import ACTION_OPTIMIZERS
from sb3_ddiffpg.utils.settings import NOT_NEGATIVE, NUMBER, POSITIVE, Settings, at_least, one_of, setting


@dataclass(frozen=True, kw_only=True)
class CriticSettings(Settings):
    """
    How values are learned.

    :param n_critics: Critics per mode, the minimum over them is used
    :param n_atoms: Atoms of the critics' value distribution (C51); 1 for scalar critics
    :param twin_target: ``"lower_mean"``: the twins learn from the distribution of the one with the lower mean;
        ``"elementwise"``: from the minimum of their distributions, atom by atom, as in the authors' code
    :param v_min: Lower end of the values that the (modes') critics represent
    :param v_max: Upper end of these. None, both: DDiffPG's follow the returns that are met, see ``ValueRange``, and the
        baselines' are 0 and 5. One of them: the other is 0 or 5
    :param target_policy_noise: Standard deviation of the noise on the actions in the Bellman target
    :param target_noise_clip: Limit of that noise
    """

    group = "critic"

    n_critics: int = setting(2, at_least(1), flat="n_critics")
    n_atoms: int = setting(51, at_least(1), flat="n_atoms")
    twin_target: str = setting("lower_mean", one_of(*TWIN_TARGETS), flat="twin_target")
    v_min: float | None = setting(None, NUMBER.or_none(), flat="v_min")
    v_max: float | None = setting(None, NUMBER.or_none(), flat="v_max")
    target_policy_noise: float = setting(0.8, NOT_NEGATIVE, flat="target_policy_noise")
    target_noise_clip: float = setting(0.2, NOT_NEGATIVE, flat="target_noise_clip")

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.support
        if not low < high:
            raise ValueError(f"critic.v_min must be less than v_max, got v_min={low}, v_max={high}")

    @property
    def adapts(self) -> bool:
        """Whether no range of values is given."""
        return self.v_min is None and self.v_max is None

    @property
    def support(self) -> tuple[float, float]:
        """Both ends of a fixed range."""
        return 0.0 if self.v_min is None else self.v_min, 5.0 if self.v_max is None else self.v_max


@dataclass(frozen=True, kw_only=True)
class TargetActionSettings(Settings):
    """
    How target actions climb the critics.

    :param learning_rate: Step size eta of the ascent
    :param n_steps: Number of ascent steps K per update
    :param optimizer: ``"adam"``, ``"normalized"``, ``"relative"`` or ``"sgd"`` (the paper's equation), see
        ``target_actions.ascend``
    """

    group = "target_action"

    learning_rate: float = setting(0.3, POSITIVE, flat="action_lr")
    n_steps: int = setting(1, at_least(1), flat="n_action_gradient_steps")
    optimizer: str = setting("adam", one_of(*ACTION_OPTIMIZERS), flat="action_optimizer")
