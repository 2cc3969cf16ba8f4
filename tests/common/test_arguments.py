"""Settings and their groups: what they accept, how they may be given, and how version 0.1 gave them."""

import math
import re
import warnings
from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest
import torch as th
from environments import SMALL, TwoEnds, merged, small_model
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES, RPG, TD3C51
from sb3_ddiffpg.exploration.novelty import RandomNetworkDistillation, VisitCounts
from sb3_ddiffpg.exploration.settings import ExplorationSettings, NoveltySettings
from sb3_ddiffpg.modes.settings import ModeSettings
from sb3_ddiffpg.networks.settings import CriticSettings, TargetActionSettings
from sb3_ddiffpg.utils.arguments import (
    GONE,
    check_arguments,
    constructor_arguments,
    flat_names,
    grouped,
    groups_of,
    one_by_one,
    settings_attribute,
    take_settings,
)

ALGORITHMS = [DDiffPG, *BASELINES.values()]
KINDS = [CriticSettings, TargetActionSettings, NoveltySettings, ExplorationSettings, ModeSettings]

# ---------------------------------------------------------------------- what each accepts, written down by hand

INTEGERS_FROM_ONE = {
    CriticSettings: ["n_critics", "n_atoms"],
    TargetActionSettings: ["n_steps"],
    ExplorationSettings: ["n_steps"],
    ModeSettings: ["max_modes", "min_size", "trials", "max_successes", "max_failures", "embedding_dim", "n_steps"],
}
NONE_FOR_THE_ALGORITHMS = [(ExplorationSettings, "n_steps"), (ModeSettings, "n_steps")]
FLAGS = {
    NoveltySettings: ["normalize", "episodic"],
    ExplorationSettings: ["beyond_goals", "off_modes", "past_modes"],
    ModeSettings: ["reset_new_critics"],
}
SHARES = {ExplorationSettings: ["hand_over"], ModeSettings: ["mask_prob"]}
NOT_NEGATIVE = {
    CriticSettings: ["target_policy_noise", "target_noise_clip"],
    NoveltySettings: ["scale", "coef"],
    ExplorationSettings: ["new_route_coef"],
    ModeSettings: ["novelty_coef"],
}
WORDS = {
    CriticSettings: {"twin_target": ["lower_mean", "elementwise"]},
    TargetActionSettings: {"optimizer": ["adam", "normalized", "sgd"]},
    ModeSettings: {"backup_embedding": ["mode", "masked"], "linkage": ["average", "complete"]},
}
NO_NUMBERS = ["x", "1", [1], (), {}, b"1", math.nan, np.nan, np.float32("nan"), np.array([1.0, 2.0]), 1j, True, np.True_]
TOO_LARGE = [math.inf, 1e39, 10**400, np.float64(1e300)]
#: (group, setting): values that are refused, values that are not
REFUSED = {}
RIGHT = {}
for kind, names in INTEGERS_FROM_ONE.items():
    for name in names:
        none = [] if (kind, name) in NONE_FOR_THE_ALGORITHMS else [None]
        REFUSED[kind, name] = [*NO_NUMBERS, *none, 0, -1, 1.0, 1.5, np.float64(2.0), 2**63, math.inf]
        RIGHT[kind, name] = [41, np.int64(50), np.uint8(60)] if name == "max_successes" else [1, 4, np.int64(2), np.uint8(3)]
for kind, names in FLAGS.items():
    for name in names:
        REFUSED[kind, name] = ["yes", "true", "False", "True", "", 0, 1, 0.0, None, [], th.tensor(True)]
        RIGHT[kind, name] = [True, False, np.True_, np.False_]
for kind, names in SHARES.items():
    for name in names:
        REFUSED[kind, name] = [*NO_NUMBERS, *TOO_LARGE, None, -0.01, 1.01, -math.inf]
        RIGHT[kind, name] = [0, 1, 0.0, 1.0, 0.5, np.float32(0.25)]
for kind, names in NOT_NEGATIVE.items():
    for name in names:
        REFUSED[kind, name] = [*NO_NUMBERS, *TOO_LARGE, None, -1e-9, -1]
        RIGHT[kind, name] = [0, 0.0, 3, 1e6, np.float32(0.5), np.int32(2)]
for kind, of_kind in WORDS.items():
    for name, words in of_kind.items():
        REFUSED[kind, name] = ["", "Adam", words[0].upper(), words[0] + " ", None, 1, True, [words[0]], math.nan, b"mode"]
        RIGHT[kind, name] = words
POSITIVE = [*NO_NUMBERS, *TOO_LARGE, 0, 0.0, -1.0]
REFUSED |= {
    (CriticSettings, "v_min"): [*NO_NUMBERS, *TOO_LARGE, -math.inf, 5.0, 6],
    (CriticSettings, "v_max"): [*NO_NUMBERS, *TOO_LARGE, 0.0, -1],
    (TargetActionSettings, "learning_rate"): [*POSITIVE, None],
    (NoveltySettings, "measure"): ["icm", "", "RND", None, 3, int, th.nn.Linear(1, 1), ["rnd"], math.nan],
    (NoveltySettings, "kwargs"): ["cell_size", 3, [("cell_size", 1.0)], math.nan],
    (NoveltySettings, "clip"): [*POSITIVE, None],
    (ExplorationSettings, "share"): [*NO_NUMBERS, -0.1, 1.5, lambda _: math.nan, lambda left: 2 * left, dict, lambda: 0.5],
    (ExplorationSettings, "fraction"): [*NO_NUMBERS, *TOO_LARGE, -0.01, 1.01, -math.inf],
    (ExplorationSettings, "gamma"): [*NO_NUMBERS, -0.1, 1.1],
    (ExplorationSettings, "v_max"): POSITIVE,
    (ModeSettings, "distance_threshold"): [*NO_NUMBERS, 0, -1.0],
    (ModeSettings, "patience"): [*NO_NUMBERS, None, -1, 0.5],
}
RIGHT |= {
    (CriticSettings, "v_min"): [None, 0, -1e6, np.float64(-3.5), np.int16(-2)],
    (CriticSettings, "v_max"): [None, 5, 1e6, np.float64(3.5)],
    (TargetActionSettings, "learning_rate"): [1e-9, 2, np.float32(0.5)],
    (NoveltySettings, "measure"): ["rnd", "counts", VisitCounts, RandomNetworkDistillation],
    (NoveltySettings, "kwargs"): [None, {}, {"cell_size": 2.0}],
    (NoveltySettings, "clip"): [1e-9, 50, np.float32(0.5)],
    (ExplorationSettings, "share"): [None, 0, 1, 0.5, np.float64(0.25), lambda left: left],
    (ExplorationSettings, "fraction"): [None, 0, 1, 0.5, np.float32(0.25)],
    (ExplorationSettings, "gamma"): [None, 0, 1, 0.5, np.float32(0.5)],
    (ExplorationSettings, "v_max"): [None, 1, 0.5, np.float32(2.5)],
    (ModeSettings, "distance_threshold"): [None, 0.5, 60, math.inf, np.float32(0.5)],
    (ModeSettings, "patience"): [0, 3, np.int64(3)],
}
ALL = [(kind, each.name) for kind in KINDS for each in fields(kind)]


def algorithms_with(kind):
    return [each for each in ALGORITHMS if kind in groups_of(each).values()]


def made(algorithm, env=None, **arguments):
    """A small model."""
    common = {"learning_starts": 10, "buffer_size": 100, "policy_kwargs": {"net_arch": [8]}}
    return algorithm("MlpPolicy", TwoEnds() if env is None else env, **(common | arguments))


def settings_of(model):
    """All groups."""
    return {group: getattr(model, settings_attribute(group)) for group in groups_of(type(model))}


def bare(algorithm, **arguments):
    """A model of which nothing is made but its groups of settings."""
    model = algorithm.__new__(algorithm)
    take_settings(model, arguments)
    return model


def test_every_setting_is_in_these_tables():
    assert set(REFUSED) == set(RIGHT) == set(ALL)
    for algorithm in ALGORITHMS:  # whose critics may have other defaults, or accept less
        for group, kind in groups_of(algorithm).items():
            (base,) = (each for each in KINDS if each.group == group)
            assert issubclass(kind, base) and kind.names() == base.names() and kind.flat_names() == base.flat_names()


@pytest.mark.parametrize(("kind", "name"), ALL, ids=lambda each: getattr(each, "group", each))
def test_what_is_refused_is_named(kind, name):
    """As a dict, as the group itself, one by one, and when a file or a command line gives it: with group, setting, value."""
    algorithm = algorithms_with(kind)[0]
    for value in REFUSED[kind, name]:
        said = rf"{kind.group}\.{name} must"
        if name in ("v_min", "v_max") and kind is CriticSettings:  # of two limits the other one may be named first
            said += rf"|critic\.v_min must be less than v_max, got .*{name}="
        for give in (
            lambda value=value: kind(**{name: value}),
            lambda value=value: kind.of({name: value}),
            lambda value=value: replace(kind(), **{name: value}),
            lambda value=value: made(algorithm, **{kind.group: {name: value}}),
            lambda value=value: made(algorithm, **{f"{kind.group}.{name}": value}),
            lambda value=value: check_arguments(algorithm, {kind.group: {name: value}}),
            lambda value=value: check_arguments(algorithm, {f"{kind.group}.{name}": value}),
        ):
            with pytest.raises(ValueError, match=said) as refused:
                give()
            # An array's or a huge number's text may be another
            if isinstance(value, (str, bytes, bool, float)) and kind is not CriticSettings:
                assert repr(value) in str(refused.value)


@pytest.mark.parametrize(("kind", "name"), ALL, ids=lambda each: getattr(each, "group", each))
def test_what_is_accepted_is_there_as_pythons_own(kind, name):
    for value in RIGHT[kind, name]:
        for found in (kind(**{name: value}), kind.of({name: value}), kind.of(kind(**{name: value}))):
            own = getattr(found, name)
            assert own == value and not isinstance(own, np.generic)
            if isinstance(value, np.generic):
                assert type(own) in (bool, int, float) and type(own) is type(value.item())
            # and nothing else is changed
            assert found == replace(kind(), **{name: value})
            assert found.to_dict() == {**kind().to_dict(), name: own} and kind.of(found.to_dict()) == found


@pytest.mark.parametrize("kind", KINDS)
def test_groups_are_given_as_dicts_or_as_themselves(kind):
    """Both are the same model; nothing is the defaults."""
    name = next(name for name in kind.names() if len(RIGHT[kind, name]) > 1)
    value = next(value for value in RIGHT[kind, name] if value != getattr(kind(), name))
    for algorithm in algorithms_with(kind):
        attribute = settings_attribute(kind.group)
        for given_ in ({name: value}, kind(**{name: value})):
            model = made(algorithm, **{kind.group: given_})
            assert getattr(model, attribute) == kind(**{name: value}) and type(getattr(model, attribute)) is kind
        for given_ in (None, {}, kind()):
            assert getattr(made(algorithm, **{kind.group: given_}), attribute) == kind()
        assert getattr(made(algorithm), attribute) == kind()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("wrong", [3, [("v_max", 3)], True, b"counts", object()], ids=lambda value: type(value).__name__)
def test_what_is_no_group_is_refused(kind, wrong):
    algorithm = algorithms_with(kind)[0]
    with pytest.raises(ValueError, match=rf"{kind.group} must be {kind.__name__} or a dict of some of them, got "):
        made(algorithm, **{kind.group: wrong})
    other = ModeSettings() if kind is not ModeSettings else CriticSettings()
    with pytest.raises(ValueError, match=kind.group):
        made(algorithm, **{kind.group: other})


def test_a_measure_alone_stands_for_its_group():
    for measure in ("rnd", "counts", RandomNetworkDistillation):
        assert made(DDiffPG, novelty=measure).novelty_settings == NoveltySettings(measure=measure)
        assert made(TD3C51, novelty=measure).novelty_settings == NoveltySettings(measure=measure)
    with pytest.raises(ValueError, match="critic must be CriticSettings or a dict"):
        made(DDiffPG, critic="lower_mean")


@pytest.mark.parametrize(
    ("group", "misspelt", "near"),
    [
        ("critic", "n_atom", "n_atoms"),
        ("critic", "vmax", "v_max"),
        ("target_action", "learning_rat", "learning_rate"),
        ("novelty", "kwarg", "kwargs"),
        ("exploration", "fractoin", "fraction"),
        ("modes", "trails", "trials"),
    ],
)
def test_unknown_settings_of_a_group(group, misspelt, near):
    """With the one that may be meant, or all that there are; by its old name too, for that is not of the group."""
    for arguments in ({group: {misspelt: 1}}, {f"{group}.{misspelt}": 1}):
        with pytest.raises(ValueError, match=rf"{group}\['{misspelt}'\] is no setting: did you mean .*'{near}'"):
            made(DDiffPG, **arguments)
    kind = groups_of(DDiffPG)[group]
    for unlike in ("zzzzzz", 5):
        with pytest.raises(ValueError, match=re.escape(f"{group}[{unlike!r}] is no setting: accepted are {kind.names()}")):
            made(DDiffPG, **{group: {unlike: 1}})
    with pytest.raises(TypeError, match=misspelt):
        kind(**{misspelt: 1})


def test_unknown_arguments():
    for arguments, message in (
        ({"learning_rat": 1}, "DDiffPG has no argument 'learning_rat'; did you mean 'learning_rate'"),
        ({"critics": {"v_max": 1}}, "DDiffPG has no argument 'critics'; did you mean 'critic'"),
        ({"critics.v_max": 1}, "DDiffPG has no argument 'critics.v_max'"),
        ({"zzz": 1}, "DDiffPG has no argument 'zzz'$"),
    ):
        with pytest.raises(TypeError, match=message):
            made(DDiffPG, **arguments)
    # A baseline has no modes, under whatever name
    for argument in ("modes", "max_modes", "mode_trials", "modes.trials", "exploration", "exploration_share"):
        with pytest.raises(TypeError, match=f"TD3C51 has no argument '{argument}'"):
            made(TD3C51, **{argument: 1})
    for algorithm in ALGORITHMS:
        assert set(groups_of(algorithm)) <= constructor_arguments(algorithm)
        assert not constructor_arguments(algorithm) & set(flat_names(algorithm))


def test_settings_are_together():
    """What each may be alone, but not beside another."""
    with pytest.raises(ValueError, match="critic.v_min must be less than v_max, got v_min=5.0, v_max=5.0"):
        made(DDiffPG, critic={"v_min": 5.0})
    with pytest.raises(ValueError, match="modes.max_successes=3 is less than min_size=4"):
        made(DDiffPG, modes={"max_successes": 3, "min_size": 4})
    assert made(DDiffPG, critic={"v_min": 5.0, "v_max": 6.0}).critic_settings.v_min == 5.0
    with pytest.raises(ValueError, match=r"batch_size=5 is smaller than .*modes.max_modes \+ 1 = 6"):
        made(DDiffPG, batch_size=5, modes={"max_modes": 5})
    with pytest.raises(ValueError, match="critic.n_atoms must be 1, RPG's values are scalar, got 2"):
        made(RPG, critic={"n_atoms": 2})


def test_settings_do_not_change():
    """What was made of them would not follow."""
    model = made(DDiffPG)
    for group, each in settings_of(model).items():
        for name in each.names():
            with pytest.raises(FrozenInstanceError):
                setattr(each, name, getattr(each, name))
        with pytest.raises(TypeError):
            groups_of(DDiffPG)[group](1)  # by name only


# ---------------------------------------------------------------------- one by one, and as in version 0.1

NUMBERS = st.floats(0.0, 1e6)
#: By group and setting: values that are accepted beside all others of these
STRATEGIES = {
    **{(kind, name): st.integers(1, 2**40) for kind, names in INTEGERS_FROM_ONE.items() for name in names},
    **{(kind, name): st.booleans() for kind, names in FLAGS.items() for name in names},
    **{(kind, name): st.floats(0.0, 1.0) for kind, names in SHARES.items() for name in names},
    **{(kind, name): NUMBERS for kind, names in NOT_NEGATIVE.items() for name in names},
    **{(kind, name): st.sampled_from(words) for kind, each in WORDS.items() for name, words in each.items()},
    (CriticSettings, "v_min"): st.floats(-1e6, -1e-3) | st.integers(-100, -1),
    (CriticSettings, "v_max"): st.floats(1e-3, 1e6) | st.integers(1, 100),
    (TargetActionSettings, "learning_rate"): st.floats(1e-6, 1e6),
    (NoveltySettings, "measure"): st.sampled_from(["rnd", "counts"]),
    (NoveltySettings, "kwargs"): st.none() | st.fixed_dictionaries({"cell_size": st.floats(0.1, 9.0)}),
    (NoveltySettings, "clip"): st.floats(1e-6, 1e6),
    (ExplorationSettings, "share"): st.none() | st.floats(0.0, 1.0),
    (ExplorationSettings, "fraction"): st.none() | st.floats(0.0, 1.0),
    (ExplorationSettings, "gamma"): st.none() | st.floats(0.0, 1.0),
    (ExplorationSettings, "v_max"): st.none() | st.floats(1e-6, 1e6),
    (ModeSettings, "distance_threshold"): st.none() | st.floats(1e-6, 1e6),
    (ModeSettings, "min_size"): st.integers(1, 30),
    (ModeSettings, "max_successes"): st.integers(30, 10**6),
    (ModeSettings, "patience"): st.integers(0, 10**6),
}
#: How version 0.1 called them, as its constructors did
OF_0_1 = {
    CriticSettings: {name: name for name in CriticSettings.names()},
    TargetActionSettings: {
        "action_lr": "learning_rate",
        "n_action_gradient_steps": "n_steps",
        "action_optimizer": "optimizer",
    },
    NoveltySettings: {
        "novelty_kwargs": "kwargs",
        "novelty_scale": "scale",
        "intrinsic_coef": "coef",
        "normalize_intrinsic": "normalize",
        "intrinsic_clip": "clip",
        "episodic_novelty": "episodic",
    },
    ExplorationSettings: {
        "exploration_share": "share",
        "exploration_fraction": "fraction",
        "explore_then_exploit": "hand_over",
        "explore_beyond_goals": "beyond_goals",
        "explore_off_modes": "off_modes",
        "explore_past_modes": "past_modes",
        "new_way_coef": "new_route_coef",
        "exploration_gamma": "gamma",
        "exploration_n_steps": "n_steps",
        "exploration_v_max": "v_max",
    },
    ModeSettings: {
        "distance_threshold": "distance_threshold",
        "linkage": "linkage",
        "max_modes": "max_modes",
        "min_mode_size": "min_size",
        "mode_patience": "patience",
        "mode_trials": "trials",
        "max_successes_per_mode": "max_successes",
        "max_failures_per_mode": "max_failures",
        "mode_embedding_dim": "embedding_dim",
        "mode_mask_prob": "mask_prob",
        "backup_embedding": "backup_embedding",
        "mode_n_steps": "n_steps",
        "mode_intrinsic_coef": "novelty_coef",
        "reset_new_critics": "reset_new_critics",
    },
}
FLAT = {old: (kind, name) for kind, names in OF_0_1.items() for old, name in names.items()}


def some_of(kind):
    """Accepted settings of a group."""
    return st.fixed_dictionaries({}, optional={name: STRATEGIES[kind, name] for name in kind.names()})


def some_settings(kinds):
    """Groups of some accepted settings."""
    return st.fixed_dictionaries({kind.group: some_of(kind) for kind in kinds})


def test_all_arguments_of_0_1_are_known():
    assert {old: (kind.group, name) for old, (kind, name) in FLAT.items()} == flat_names(DDiffPG)
    for algorithm in ALGORITHMS:
        assert flat_names(algorithm).items() <= flat_names(DDiffPG).items()


@settings(max_examples=300, deadline=None)
@given(st.fixed_dictionaries({}, optional={old: STRATEGIES[place] for old, place in FLAT.items()}))
def test_what_a_warning_says_to_write_is_the_same(old):
    """Word for word, and as Python: over all arguments of version 0.1."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = settings_of(bare(DDiffPG, **old))
    expected = {kind.group: {} for kind in KINDS}
    for name, value in old.items():
        kind, setting = FLAT[name]
        expected[kind.group][setting] = value
    assert found == {kind.group: kind(**expected[kind.group]) for kind in KINDS}
    if not old:
        assert not said
        return
    (warning,) = said
    assert warning.category is FutureWarning
    text = re.fullmatch("Arguments of version 0.1: instead of (.*) write (.*)", str(warning.message))
    assert eval(f"dict({text[1]})") == old
    instead = eval(f"dict({text[2]})")
    assert instead == {group: each for group, each in expected.items() if each}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert settings_of(bare(DDiffPG, **instead)) == found


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_arguments_of_0_1_make_the_same_model(algorithm):
    """Each with its warning, exactly."""
    for old, (group, name) in flat_names(algorithm).items():
        kind = groups_of(algorithm)[group]
        if algorithm is RPG and old == "n_atoms":
            value = 1
        else:
            right = RIGHT[CriticSettings if group == "critic" else kind, name]
            value = next(each for each in right if each != getattr(kind(), name) and not isinstance(each, np.generic))
        said = f"Arguments of version 0.1: instead of {old}={value!r} write {group}=dict({name}={value!r})"
        with pytest.warns(FutureWarning, match=f"^{re.escape(said)}$"):
            model = made(algorithm, **{old: value})
        instead = made(algorithm, **{group: {name: value}})
        assert settings_of(model) == settings_of(instead)
        assert getattr(getattr(model, settings_attribute(group)), name) == value
        shapes = [{key: value.shape for key, value in each.policy.state_dict().items()} for each in (model, instead)]
        assert shapes[0] == shapes[1]


def test_a_warning_of_many_arguments():
    said = (
        "Arguments of version 0.1: instead of v_max=10, mode_trials=7, n_atoms=1, intrinsic_coef=0.2 write "
        "critic=dict(v_max=10, n_atoms=1), modes=dict(trials=7), novelty=dict(coef=0.2)"
    )
    with pytest.warns(FutureWarning, match=f"^{re.escape(said)}$") as told:
        model = made(DDiffPG, v_max=10, mode_trials=7, n_atoms=1, intrinsic_coef=0.2)
    assert len(told) == 1 and settings_of(model) == settings_of(
        made(DDiffPG, critic={"v_max": 10, "n_atoms": 1}, modes={"trials": 7}, novelty={"coef": 0.2})
    )
    # A measure was an argument of its own, and still is
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)
        made(DDiffPG, novelty="rnd")


def test_wrong_values_by_their_old_names():
    for old, (kind, name) in FLAT.items():
        for value in REFUSED[kind, name][:3]:
            with pytest.raises(ValueError, match=rf"{kind.group}\.{name} must"), pytest.warns(FutureWarning):
                made(DDiffPG, **{old: value})


@pytest.mark.parametrize("name", GONE)
def test_what_is_gone(name):
    """What did nothing still does; what did something is refused, with what there is instead."""
    default, instead = GONE[name]
    model = made(DDiffPG, **{name: default})
    assert settings_of(model) == settings_of(made(DDiffPG)) and not hasattr(model, name)
    for value in (0.3, "random_clusters"):
        with pytest.raises(TypeError, match=re.escape(f"{name}={value!r} is no argument any more: {instead}")):
            made(DDiffPG, **{name: value})


@settings(max_examples=100, deadline=None)
@given(some_settings(KINDS), some_settings(KINDS))
def test_groups_change_setting_by_setting(given_, changes):
    """In whatever form both are: ``grouped`` is the one updated by the other."""
    expected = {kind.group: kind(**{**given_[kind.group], **changes[kind.group]}) for kind in KINDS}
    flat = {place: old for old, place in FLAT.items()}
    forms = {
        "groups": lambda each: dict(each),
        "themselves": lambda each: {kind.group: kind(**each[kind.group]) for kind in KINDS},
        "one by one": lambda each: {f"{group}.{name}": value for group, some in each.items() for name, value in some.items()},
        "as in 0.1": lambda each: {
            flat.get((kind, name), f"{kind.group}.{name}"): value for kind in KINDS for name, value in each[kind.group].items()
        },
    }
    for said, form in forms.items():
        for change in ("groups", "one by one", "as in 0.1"):
            found = grouped(DDiffPG, form(given_), forms[change](changes))
            assert set(found) <= set(expected), said
            assert {kind.group: kind.of(found.get(kind.group)) for kind in KINDS} == expected, (said, change)
        # What is given one by one holds beside a group, in a constructor too
        beside = {**{group: each for group, each in given_.items() if each}, **forms["one by one"](changes)}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert settings_of(bare(DDiffPG, **beside)) == expected


@settings(max_examples=100, deadline=None)
@given(some_settings(KINDS))
def test_groups_one_by_one(given_):
    """The same settings, so that they change a group without replacing it."""
    expected = {kind.group: kind(**given_[kind.group]) for kind in KINDS}
    for form in (given_, expected):
        singly = one_by_one(DDiffPG, {**form, "gamma": 0.5})
        assert singly.pop("gamma") == 0.5 and not set(singly) & set(groups_of(DDiffPG))
        assert settings_of(bare(DDiffPG, **singly)) == expected


def test_other_arguments_are_left_alone():
    arguments = {"gamma": 0.9, "policy_kwargs": {"net_arch": [8]}, "critic": {"v_max": 3}, "learning_rate": 1e-3}
    assert grouped(DDiffPG, arguments, {"gamma": 0.5, "critic.n_atoms": 1}) == {
        **arguments,
        "gamma": 0.5,
        "critic": {"v_max": 3, "n_atoms": 1},
    }
    assert arguments["critic"] == {"v_max": 3}  # nor are these changed
    assert one_by_one(DDiffPG, arguments) == {
        **{name: value for name, value in arguments.items() if name != "critic"},
        "critic.v_max": 3,
    }
    assert one_by_one(DDiffPG, {"novelty": "rnd"}) == {"novelty.measure": "rnd"}
    assert grouped(DDiffPG, {"novelty": "rnd"}, {"novelty": {"coef": 1.0}}) == {"novelty": {"measure": "rnd", "coef": 1.0}}
    assert grouped(DDiffPG, {"novelty": {"coef": 1.0}}, {"novelty": "rnd"}) == {"novelty": {"measure": "rnd", "coef": 1.0}}


def test_dotted_names_in_a_constructor():
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)
        model = made(DDiffPG, critic={"v_min": -1.0}, **{"critic.v_max": 3, "modes.trials": 7, "novelty.measure": "rnd"})
    assert model.critic_settings == CriticSettings(v_min=-1.0, v_max=3)
    assert model.mode_settings == ModeSettings(trials=7) and model.novelty_settings == NoveltySettings(measure="rnd")
    assert model.policy.critics.upper.tolist() == [50.0, 3.0]  # of explorers clip * coef / (1 - gamma)
    assert isinstance(model.bonus.novelty_model, RandomNetworkDistillation)


# ---------------------------------------------------------------------- numbers of other arguments


def test_other_arguments_are_checked_at_once():
    check_arguments(DDiffPG, {"gamma": 0.9, "critic": {"v_max": 3}, "mode_trials": 3, "policy_kwargs": {}})
    for wrong, said in (
        ({"gamma": 1.5}, r"gamma must lie in \[0, 1\], got 1.5"),
        ({"gamma": 0.5, "batch_size": "3"}, "batch_size must be an integer of at least 1, got '3'"),
        ({"recluster_freq": 0}, "recluster_freq must be an integer of at least 1, got 0"),
        ({"mode_trials": 0}, "modes.trials must be an integer of at least 1, got 0"),
        ({"critic": {"v_maks": 3}}, r"critic\['v_maks'\] is no setting: did you mean 'v_max'"),
    ):
        with pytest.raises(ValueError, match=said):
            check_arguments(DDiffPG, wrong)


# ---------------------------------------------------------------------- files


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A model whose settings are not the defaults, and where it is saved."""
    path = tmp_path_factory.mktemp("file") / "model.zip"
    changes = {
        "critic": {"n_atoms": 11, "v_min": -2.0},
        "novelty": {"measure": "rnd", "coef": 0.2, "kwargs": {"net_arch": [8]}},
        "exploration": {"n_steps": 2, "gamma": 0.5},
        "modes": {"trials": 77, "max_failures": 9},
        "target_action": {"n_steps": 2},
    }
    model = small_model(DummyVecEnv([TwoEnds] * 2), **changes)
    model.learn(60)
    model.save(path)
    return model, path


def test_a_file_keeps_all_settings(file):
    model, path = file
    loaded = DDiffPG.load(path)
    assert settings_of(loaded) == settings_of(model)
    assert loaded.critic_settings.n_atoms == 11 and loaded.mode_settings.trials == 77


@pytest.mark.parametrize(
    "given_",
    [{"critic": {"v_max": 3}}, {"critic.v_max": 3}, {"v_max": 3}, {"critic": CriticSettings(n_atoms=11, v_min=-2.0, v_max=3)}],
    ids=["dict", "dotted", "flat", "settings"],
)
def test_loading_changes_only_what_is_given(file, given_):
    model, path = file
    env = DummyVecEnv([TwoEnds] * 2)
    loaded = DDiffPG.load(path, env=env, **given_)
    expected = settings_of(model)
    expected["critic"] = replace(expected["critic"], v_max=3)
    assert settings_of(loaded) == expected
    assert not {"critic", "critic.v_max", "v_max"} & set(vars(loaded))
    assert (loaded.gamma, loaded.batch_size) == (model.gamma, model.batch_size)
    # Its critics follow: explorers' values reach from 0 to clip * coef / (1 - gamma), or to v_max if that is more
    assert [each.policy.critics.upper.tolist() for each in (model, loaded)] == [[5.0, 5.0], [4.0, 3.0]]
    loaded.learn(20, reset_num_timesteps=False)


def test_loading_with_two_changes(file, tmp_path):
    model, path = file
    loaded = DDiffPG.load(path, critic={"v_max": 3}, modes={"trials": 5}, **{"novelty.coef": 0.7})
    expected = settings_of(model)
    expected["critic"] = replace(expected["critic"], v_max=3)
    expected["modes"] = replace(expected["modes"], trials=5)
    expected["novelty"] = replace(expected["novelty"], coef=0.7)
    assert settings_of(loaded) == expected
    assert loaded.mode_manager.settings is loaded.mode_settings and loaded.bonus.settings is loaded.novelty_settings
    loaded.save(tmp_path / "again")
    assert settings_of(DDiffPG.load(tmp_path / "again")) == expected


def test_loading_with_what_cannot_be(file):
    _, path = file
    for given_, said in (
        ({"critic": {"v_max": -3}}, "critic.v_min must be less than v_max"),
        ({"critic": {"v_maks": 3}}, r"critic\['v_maks'\] is no setting: did you mean 'v_max'"),
        ({"modes": {"trials": "x"}}, "modes.trials must be an integer of at least 1, got 'x'"),
        ({"modes.trials": 0}, "modes.trials must be an integer of at least 1, got 0"),
        ({"mode_trials": math.nan}, "modes.trials must be an integer of at least 1, got nan"),
        ({"critic": 5}, "critic must be CriticSettings or a dict"),
    ):
        with pytest.raises(ValueError, match=said):
            DDiffPG.load(path, **given_)


def test_what_is_merged_here_is_what_the_package_groups():
    """The tests' own helper against the package's."""
    changes = {"modes": {"trials": 3}, "novelty": "rnd", "gamma": 0.5}
    assert merged(SMALL, changes) == grouped(DDiffPG, SMALL, changes)
