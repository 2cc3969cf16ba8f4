"""Groups of settings check themselves where they are made, and say which one is wrong."""

from dataclasses import FrozenInstanceError, fields

import numpy as np
import pytest
from environments import TwoEnds

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.exploration.settings import ExplorationSettings, NoveltySettings
from sb3_ddiffpg.modes.settings import ModeSettings
from sb3_ddiffpg.networks.settings import CriticSettings
from sb3_ddiffpg.utils.arguments import accepted_by
from sb3_ddiffpg.utils.settings import FLAG, Settings

ALGORITHMS = {"ddiffpg": DDiffPG, **BASELINES}
FLAGS = [
    (name, kind, each.name)
    for name, algorithm in ALGORITHMS.items()
    for kind in algorithm.settings_groups
    for each in fields(kind)
    if each.metadata["accepted"] is FLAG or isinstance(each.default, bool)
]


def test_flags_are_found():
    """Of version 0.1 whatever was no empty text counted as True."""
    assert {(kind.group, flag) for name, kind, flag in FLAGS if name == "ddiffpg"} == {
        *(("novelty", flag) for flag in ("normalize", "episodic")),
        *(("exploration", flag) for flag in ("beyond_goals", "off_modes", "past_modes")),
        ("modes", "reset_new_critics"),
    }


@pytest.mark.parametrize("value", ["False", "", 0, 1.0, None])
@pytest.mark.parametrize(("name", "kind", "flag"), FLAGS)
def test_flags_are_true_or_false(name, kind, flag, value):
    with pytest.raises(ValueError, match=f"{kind.group}.{flag} must be True or False, got {value!r}"):
        kind(**{flag: value})
    with pytest.raises(ValueError, match=f"{kind.group}.{flag} must be True or False"):
        ALGORITHMS[name]("MlpPolicy", TwoEnds(), **{kind.group: {flag: value}})
    for true in (True, False, np.bool_(True)):
        assert getattr(kind(**{flag: true}), flag) is bool(true)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_flags_of_no_group(name):
    for flag, accepted in accepted_by(ALGORITHMS[name]).items():
        if accepted is FLAG:
            with pytest.raises(ValueError, match=f"{flag} must be True or False, got 'False'"):
                ALGORITHMS[name]("MlpPolicy", TwoEnds(), **{flag: "False"})


@pytest.mark.parametrize("name", ALGORITHMS)
def test_whatever_is_no_value_of_a_setting_is_refused_by_its_name(name):
    for kind in ALGORITHMS[name].settings_groups:
        for each in fields(kind):
            for value in (float("nan"), "nonsense", object(), [1]):
                with pytest.raises(ValueError, match=f"{kind.group}.{each.name} must "):
                    kind(**{each.name: value})


def test_some_of_a_group():
    settings = CriticSettings.of({"v_max": 10})
    assert settings == CriticSettings(v_max=10) and settings.v_max == 10 and settings.n_atoms == 51
    assert CriticSettings.of({"n_atoms": 1}, settings) == CriticSettings(v_max=10, n_atoms=1)
    assert CriticSettings.of(None, settings) is settings and CriticSettings.of(settings) is settings
    assert CriticSettings.of(settings.to_dict()) == settings and CriticSettings.of(None) == CriticSettings()
    assert NoveltySettings.of("rnd") == NoveltySettings(measure="rnd")
    with pytest.raises(FrozenInstanceError):
        settings.v_max = 5


def test_numbers_of_numpy_become_pythons():
    settings = ModeSettings(max_modes=np.int64(3), mask_prob=np.float32(0.5))
    assert type(settings.max_modes) is int and type(settings.mask_prob) is float


@pytest.mark.parametrize(
    ("kind", "given", "message"),
    [
        (CriticSettings, {"vmax": 3}, r"critic\['vmax'\] is no setting: did you mean .*'v_max'"),
        (CriticSettings, {"xyz": 3}, r"critic\['xyz'\] is no setting: accepted are \['n_critics', "),
        (CriticSettings, 3, "critic must be CriticSettings or a dict of some of them, got 3"),
        (NoveltySettings, "nothing", r"novelty.measure must be one of \['rnd', 'counts'\] or a subclass"),
        (NoveltySettings, {"kwargs": [1]}, "novelty.kwargs must be a dict of keyword arguments, or be None"),
        (CriticSettings, {"v_min": 5.0}, "critic.v_min must be less than v_max, got v_min=5.0, v_max=5.0"),
        (ModeSettings, {"max_successes": 4}, "modes.max_successes=4 is less than min_size=5"),
        (ExplorationSettings, {"share": lambda progress: 2 * progress}, r"exploration.share must lie in \[0, 1\]"),
        (ExplorationSettings, {"share": lambda progress: 1 / 0}, "exploration.share must .*ZeroDivisionError"),
    ],
)
def test_groups_that_cannot_be(kind, given, message):
    with pytest.raises(ValueError, match=message):
        kind.of(given)


def test_flat_names_are_of_one_setting_each():
    for algorithm in ALGORITHMS.values():
        flat = [flat for kind in algorithm.settings_groups for flat in kind.flat_names()]
        assert len(flat) == len(set(flat)) and all(issubclass(kind, Settings) for kind in algorithm.settings_groups)
