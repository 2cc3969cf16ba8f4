"""Settings of exploration: what is new, what it is worth, and who explores."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import nn

from sb3_ddiffpg.exploration.novelty import NOVELTY_MEASURES
from sb3_ddiffpg.utils.settings import FLAG, NOT_NEGATIVE, POSITIVE, SHARE, Accepted, Settings, at_least, setting

#: Values of explorers are expected to be worth so many places that are worth most
FIRST_PLACES = 5
Schedule = Callable[[float], float]

_MEASURE = Accepted(
    f"be one of {list(NOVELTY_MEASURES)} or a subclass of torch.nn.Module like these",
    lambda value: (
        value in NOVELTY_MEASURES if isinstance(value, str) else isinstance(value, type) and issubclass(value, nn.Module)
    ),
)
_KEYWORDS = Accepted("be a dict of keyword arguments, or be None", lambda value: value is None or isinstance(value, dict))


@dataclass(frozen=True, kw_only=True)
class NoveltySettings(Settings):
    """
    What is new, and what novelty is worth.

    :param measure: ``"rnd"``, ``"counts"``, or a class with the methods of ``RandomNetworkDistillation``
    :param kwargs: Further keyword arguments of the measure; the ``cell_size`` of ``"counts"`` is what the environment declares
        as ``novelty_cell_size``, else 0.5, if none is given
    :param scale: The factor alpha of NovelD
    :param coef: Factor c on the intrinsic reward
    :param normalize: Whether the intrinsic reward is divided by its running standard deviation
    :param clip: What one place is worth at most, in these deviations: a low limit hides a rare place behind others
    :param episodic: Whether a place pays only when it is reached for the first time in an episode (Zhang et al., 2021,
        section 3): otherwise explorers stand where fewest have been
    """

    group = "novelty"

    measure: str | type[nn.Module] = setting("counts", _MEASURE)
    kwargs: dict[str, Any] | None = setting(None, _KEYWORDS, flat="novelty_kwargs")
    scale: float = setting(0.5, NOT_NEGATIVE, flat="novelty_scale")
    coef: float = setting(0.05, NOT_NEGATIVE, flat="intrinsic_coef")
    normalize: bool = setting(True, FLAG, flat="normalize_intrinsic")
    clip: float = setting(10.0, POSITIVE, flat="intrinsic_clip")
    episodic: bool = setting(True, FLAG, flat="episodic_novelty")

    @classmethod
    def short_form(cls, given: Any) -> dict[str, Any]:
        """
        :param given: Name or class of a measure
        :return: The settings that it stands for
        :raises ValueError: If it is neither
        """
        return {"measure": given} if isinstance(given, str | type) else super().short_form(given)


@dataclass(frozen=True, kw_only=True)
class ExplorationSettings(Settings):
    """
    Who explores, and what explorers learn from.

    :param share: Share of episodes that explore, a float or a function of the remaining progress. None: ``1 / (M + 1)`` while
        exploration brings something new, then less; always 1 while there is no mode. While it is 0, no further mode is born
    :param fraction: Part of the training that explores, when ``share`` is None: of the ``horizon`` that ``learn`` was given,
        or of each call of it. None: all of it, but less where nothing new has come for long: with ``t`` the run's steps when a
        mode was born last, or another twentieth of all places was found, ``10 t / steps`` of that share, however many calls of
        ``learn`` that takes
    :param hand_over: Share of the exploring episodes that go on with a mode or the zero embedding after a random time (on
        average the modes' mean length), so that they come to a goal by a route that no mode would have taken
    :param beyond_goals: Whether a goal does not end the exploratory critics' returns: it would be the one place that explorers
        keep away from. The return then goes on with the value at the goal itself; no stored step begins there, so that nothing
        trains this value, and it follows its neighbours'
    :param off_modes: Whether explorers are paid nothing for places where the trajectories of the modes go that reach the goal
        in half of their episodes, so that another route pays where it leaves the known ones, not only where it ends
    :param past_modes: Whether what lies past such a mode's route is worth anything to an explorer that came along it. If not,
        its visits there do not count either (nor earlier ones, with ``"counts"``): what is new by another route stays new.
        That hinders routes that go on from the end of a known one
    :param new_route_coef: Factor on the environment's reward that the exploratory critics get for goals reached by routes that
        are in no mode, or in one that has not its fill of trajectories yet: a second route is worth finding where the first
        pays
    :param gamma: Discount factor of the exploratory critics; None: the modes'
    :param n_steps: Length of the exploratory critics' multi-step returns (uncorrected); None: the algorithm's ``n_steps``, or
        1 where that is None too
    :param v_max: Upper end of the values that the exploratory critics represent (the lower end is 0); None: it follows what
        they meet, up to what novelty can be worth at most, ``novelty.clip * novelty.coef / (1 - gamma)``; where ``critic`` has
        a range, it is that, or ``critic.v_max`` if that is more
    """

    group = "exploration"

    share: float | Schedule | None = setting(None, SHARE.or_schedule().or_none(), flat="exploration_share")
    fraction: float | None = setting(None, SHARE.or_none(), flat="exploration_fraction")
    hand_over: float = setting(0.5, SHARE, flat="explore_then_exploit")
    beyond_goals: bool = setting(True, FLAG, flat="explore_beyond_goals")
    off_modes: bool = setting(True, FLAG, flat="explore_off_modes")
    past_modes: bool = setting(True, FLAG, flat="explore_past_modes")
    new_route_coef: float = setting(0.0, NOT_NEGATIVE, flat="new_way_coef")
    gamma: float | None = setting(None, SHARE.or_none(), flat="exploration_gamma")
    n_steps: int | None = setting(None, at_least(1).or_none(), flat="exploration_n_steps")
    v_max: float | None = setting(None, POSITIVE.or_none(), flat="exploration_v_max")

    def novelty_range(self, novelty: NoveltySettings, mode_gamma: float) -> tuple[float, float]:
        """
        :param novelty: What novelty is worth
        :param mode_gamma: Discount factor of the modes' critics
        :return: The upper end of the exploratory critics' values, where it follows what they meet: at first and at most
        """
        # A few places at their most; a new route to a goal is worth as much to an explorer
        first = max(FIRST_PLACES * novelty.clip * novelty.coef, self.new_route_coef, 1e-6)
        most = self.v_max_beside(novelty, first, mode_gamma)
        return (first if self.v_max is None else most), most

    def gamma_beside(self, mode_gamma: float) -> float:
        """
        :param mode_gamma: Discount factor of the modes' critics
        :return: Of the exploratory ones
        """
        return mode_gamma if self.gamma is None else self.gamma

    def n_steps_beside(self, n_steps: int | None) -> int:
        """
        :param n_steps: Length of the returns of all critics, None if it was not given
        :return: Of the exploratory ones
        """
        return self.n_steps or n_steps or 1

    def v_max_beside(self, novelty: NoveltySettings, least: float, mode_gamma: float) -> float:
        """
        :param novelty: What novelty is worth
        :param least: The smallest that may be
        :param mode_gamma: Discount factor of the modes' critics
        :return: Upper end of the values of the exploratory critics
        """
        if self.v_max is not None:
            return self.v_max
        return max(least, novelty.clip * novelty.coef / max(1 - self.gamma_beside(mode_gamma), 1e-4))
