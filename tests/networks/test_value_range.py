"""The unit of values: against a chain whose values are known by hand, and the rules by which the unit grows."""

import numpy as np
import pytest
import torch as th
from environments import copied
from scipy.signal import lfilter

from sb3_ddiffpg.buffers.returns import discounted_returns
from sb3_ddiffpg.networks.value_range import ValueRange
from sb3_ddiffpg.serialization.safetensors_tree import read, write

GAMMA, LENGTH = 0.9, 6


def true_values(rewards, end):
    """Of the states of a chain that is walked from left to right, by hand: at its end nothing, or the last state for ever."""
    value = 0.0 if end == "terminal" else rewards[-1] / (1 - GAMMA)
    values = []
    for reward in rewards[::-1]:
        value = reward + GAMMA * value
        values.append(value)
    return np.array(values[::-1])


def of_all_groups(each):
    """The explorers' group beside the modes', [2, n]."""
    return th.tensor(np.stack([np.zeros_like(each), each]), dtype=th.float64)


def learned_values(value_range, rewards, end, n_steps):
    """What a table learns from all windows of ``n_steps`` of the chain, with rewards as the critics are given them."""
    n = len(rewards)
    sums, discounts, following = [], [], []
    for state in range(n):
        steps = min(n_steps, n - state)
        sums.append(sum(GAMMA**k * rewards[state + k] for k in range(steps)))
        ends = state + steps == n and end == "terminal"
        discounts.append(0.0 if ends else GAMMA**steps)
        following.append(min(state + steps, n - 1))  # beyond a cut-off end: the last state again
    scaled = value_range.scaled(of_all_groups(np.array(sums)), of_all_groups(np.array(discounts)))[1].numpy()
    table = np.full(n, 0.5)
    for _ in range(500):
        table = scaled + np.array(discounts) * table[following]
    return table


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("kind", ["goal", "penalty", "each step costs", "mixed", "always one"])
@pytest.mark.parametrize("end", ["terminal", "cut off"])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_a_chain_is_learned_in_any_unit(unit, kind, end, n_steps):
    """``low + unit * v`` are the true values, and v lies in [0, 1]."""
    rewards = (
        unit
        * {
            "goal": np.array([0.0, 0, 0, 0, 0, 1]),
            "penalty": np.array([0.0, 0, 0, 0, 0, -1]),
            "each step costs": -np.ones(LENGTH),
            "mixed": np.array([2.0, -1, 0, 3, -2, 0.5]),
            "always one": np.ones(LENGTH),
        }[kind]
    )
    known = ValueRange(adapts=True)
    known.observe(discounted_returns(rewards, GAMMA))
    if end == "cut off":
        known.observe(true_values(rewards, end))
    table, expected = learned_values(known, rewards, end, n_steps), true_values(rewards, end)
    np.testing.assert_allclose(known.low + known.unit * table, expected, rtol=1e-9, atol=1e-9 * unit)
    np.testing.assert_allclose(known.values(table), expected, rtol=1e-9, atol=1e-9 * unit)
    assert table.min() >= -1e-9 and table.max() <= 1 + 1e-9
    assert known.low == pytest.approx(min(expected.min(), true_values(rewards, "terminal").min()))


def test_values_in_the_unit_are_the_same_whatever_the_reward_is_measured_in():
    tables = []
    for unit in (1e-3, 1.0, 1e3):
        known, rewards = ValueRange(adapts=True), unit * np.array([0.0, -1, 0, 2, 0, 1])
        known.observe(discounted_returns(rewards, GAMMA))
        tables.append(learned_values(known, rewards, "terminal", 2))
    np.testing.assert_allclose(tables[0], tables[1], rtol=1e-9)
    np.testing.assert_allclose(tables[2], tables[1], rtol=1e-9)


def test_a_larger_return_makes_a_larger_unit_and_keeps_the_order():
    known = ValueRange(adapts=True)
    assert known.unit == 1.0 and known.values(np.array([0.3])) == 0.3  # nothing was met
    known.observe(np.array([2.0, 2.0]))
    assert (known.low, known.high, known.unit) == (2.0, 2.0, 1.0)  # all alike: nothing to measure by
    known.observe(np.array([-1.0, 0.5]))
    assert (known.low, known.high, known.unit) == (-1.0, 2.0, 3.0)
    before = known.values(np.array([0.2, 0.7]))
    known.observe(np.array([7.0]))
    assert known.unit == 8.0 and np.diff(known.values(np.array([0.2, 0.7]))) > np.diff(before) > 0


def test_episodes_that_were_cut_off_would_have_gone_on_as_they_ended():
    rewards = np.array([0.0, 0.0, *[-1.0] * 20])
    # A tenth of the mean of the last ten for ever: -1 / (1 - 0.9)
    np.testing.assert_allclose(discounted_returns(rewards, 0.9, "goes on")[:20], -10.0)
    np.testing.assert_allclose(discounted_returns(rewards, 0.9, "goes on")[-1], -10.0 * 0.9**2)
    np.testing.assert_allclose(discounted_returns(rewards, 0.9)[0], -1.0)
    np.testing.assert_allclose(discounted_returns(rewards, 0.0, "goes on"), rewards[::-1])
    np.testing.assert_allclose(discounted_returns(rewards, 1.0, "goes on"), rewards[::-1].cumsum())
    np.testing.assert_array_equal(rewards[2:], -1.0)  # what was given is as it was


@pytest.mark.parametrize("gamma", [0.0, 0.9, 0.997, 1.0])
def test_returns_like_those_of_scipy_bit_for_bit(gamma):
    rewards = np.random.default_rng(0).normal(size=300).astype(np.float32)
    expected = lfilter([1.0], [1.0, -gamma], rewards[::-1].astype(np.float64))
    np.testing.assert_array_equal(discounted_returns(rewards, gamma), expected)


def test_the_explorers_have_a_unit_of_their_own():
    known = ValueRange(adapts=True, novelty_unit=4.0)
    known.observe(np.array([-2.0, 8.0]))
    rewards, discounts = th.tensor([[1.0, 2.0], [1.0, 3.0]]), th.tensor([[0.9, 0.0], [0.9, 0.0]])
    given = rewards.clone()
    # Explorers: by 4; a mode: (r - (1 - discount) * -2) / 10
    th.testing.assert_close(known.scaled(rewards, discounts), th.tensor([[0.25, 0.5], [0.12, 0.5]]))
    assert th.equal(rewards, given)
    fixed = ValueRange(adapts=False)
    fixed.observe(np.array([-2.0, 8.0]))
    assert fixed.scaled(rewards, discounts) is rewards and fixed.unit == 1.0
    np.testing.assert_array_equal(fixed.values(np.array([0.5])), [0.5])


def test_the_explorers_unit_grows_after_300_updates_of_which_many_reach_the_end():
    known = ValueRange(adapts=True, novelty_unit=2.0, most_novelty=5.0)
    for _ in range(29):
        known.observe_targets(0.03, 10)
    assert known.novelty_unit == 2.0
    known.observe_targets(0.03, 10)
    assert known.novelty_unit == 3.0
    known.observe_targets(0.03, 299)  # counted anew
    assert known.novelty_unit == 3.0
    known.observe_targets(0.0, 200)  # in the mean 0.018
    assert known.novelty_unit == 3.0
    known.observe_targets(1.0, 300)
    assert known.novelty_unit == 4.5 and known.grows
    known.observe_targets(1.0, 300)
    assert known.novelty_unit == 5.0 and not known.grows  # novelty cannot be worth more
    known.observe_targets(1.0, 300)
    assert known.novelty_unit == 5.0
    fixed = ValueRange(adapts=False, novelty_unit=2.0, most_novelty=5.0)
    fixed.observe_targets(1.0, 300)
    assert fixed.novelty_unit == 2.0 and not fixed.grows
    assert ValueRange(adapts=True, novelty_unit=2.0, most_novelty=0.5).novelty_unit == 0.5


def in_use():
    known = ValueRange(adapts=True, novelty_unit=2.0)
    known.observe(np.array([-3.0, 4.0]))
    known.observe_targets(1.0, 310)
    known.observe_targets(0.01, 120)
    return known


def test_what_was_met_is_kept(tmp_path):
    known = in_use()
    state = known.state_dict()
    write(tmp_path / "values", "values", state)
    for tree in (copied(state), read(tmp_path / "values", "values")):
        other = ValueRange(adapts=True)
        other.load_state_dict(tree)
        assert other.state_dict() == state
        for each in (known, other):
            each.load_state_dict(state)
            each.observe_targets(0.1, 200)
        assert known.state_dict() == other.state_dict() != state
    new = ValueRange(adapts=True)
    new.load_state_dict(ValueRange(adapts=True).state_dict())
    assert new.low is None and new.unit == 1.0


@pytest.mark.parametrize(
    "change",
    [
        {"novelty_unit": 0.0},
        {"novelty_unit": -1.0},
        {"novelty_unit": float("nan")},
        {"novelty_unit": float("inf")},
        {"low": float("nan")},
        {"high": float("inf")},
        {"low": None},
        {"high": None},
        {"low": 5.0},  # above the high
        {"at_top": float("nan")},
        {"at_top": -1.0},
        {"n_updates": -1},
        {"n_updates": 1.5},
        {"low": "0"},
        {"more": 1.0},
    ],
    ids=str,
)
def test_what_cannot_be_is_refused_before_anything_is_lost(change):
    known = in_use()
    before = known.state_dict()
    with pytest.raises(ValueError, match="values"):
        known.load_state_dict({**before, **change})
    assert known.state_dict() == before
    missing = {name: each for name, each in before.items() if name != next(iter(change))}
    if "more" not in change:
        with pytest.raises(ValueError, match="values"):
            known.load_state_dict(missing)
