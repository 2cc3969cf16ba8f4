"""The scheduler alone: who drives which episode, with a list in place of modes."""

from collections import Counter

import numpy as np
import pytest
from environments import copied

from sb3_ddiffpg.exploration.episode_scheduler import UNCONDITIONED, EpisodeScheduler
from sb3_ddiffpg.exploration.settings import ExplorationSettings
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP
from sb3_ddiffpg.serialization.safetensors_tree import read, write


def scheduler_of(n_modes, n_envs=0, **settings):
    return EpisodeScheduler(ExplorationSettings(**settings), [None] * n_modes, n_envs)


def test_who_explores():
    scheduler = scheduler_of(2, fraction=0.7)
    assert scheduler.exploration_share(1.0) == scheduler.exploration_share(0.31) == pytest.approx(1 / 3)
    assert scheduler.exploration_share(0.29) == 0.0
    assert scheduler_of(2, share=0.6).exploration_share(0.0) == 0.6
    assert scheduler_of(2, share=lambda progress: progress / 2).exploration_share(0.4) == 0.2
    scheduler.modes = []
    assert scheduler.exploration_share(1.0) == 1.0 and {scheduler.draw(0.0) for _ in range(20)} == {EXPLORATORY_GROUP}


def test_exploration_becomes_less_where_nothing_new_has_come():
    """From when the run is ten times as long as at the last news, whatever the progress."""
    scheduler = scheduler_of(2)
    scheduler.note_news(1000, 50, born=False)  # the first places
    for progress in (1.0, 0.0):
        assert scheduler.exploration_share(progress, 10_000) == pytest.approx(1 / 3)
        assert scheduler.exploration_share(progress, 20_000) == pytest.approx(1 / 6)
        assert scheduler.exploration_share(progress, 10**6) == pytest.approx(1 / 300)
    scheduler.note_news(2000, 52, born=False)  # four in a hundred more are none
    assert (scheduler.news_at, scheduler.n_cells) == (1000, 50)
    scheduler.note_news(2500, 53, born=False)
    assert (scheduler.news_at, scheduler.n_cells) == (2500, 53)
    assert scheduler.exploration_share(0.0, 25_000) == pytest.approx(1 / 3)
    assert scheduler.exploration_share(0.0, 25_100) < 1 / 3 - 1e-3
    scheduler.note_news(76_000, 53, born=True)  # it goes on in full for what was born
    assert scheduler.news_at == 76_000 and scheduler.exploration_share(0.0, 228_000) == pytest.approx(1 / 3)
    scheduler.note_news(80_000, 20, born=False)  # cells are larger now, and fewer: no news
    assert scheduler.news_at == 76_000
    scheduler.note_news(90_000, 22, born=False)
    assert scheduler.news_at == 90_000


def test_while_there_is_no_mode_exploration_goes_on():
    """Also where no places are counted, or nothing has been noted yet: modes could not be born."""
    scheduler = scheduler_of(0)
    for step in (0, 1, 10**6):
        assert scheduler.exploration_share(0.0, step) == 1.0
    scheduler.note_news(500, 0, born=False)
    assert scheduler.news_at == 0 and scheduler.exploration_share(0.0, 10**6) == 1.0
    assert scheduler_of(0, fraction=0.5).exploration_share(0.2, 10) == 0.0  # who names a part, gets that


def test_modes_and_the_zero_embedding_take_turns():
    scheduler = scheduler_of(3)
    drawn = [scheduler.draw(0.0) for _ in range(9)]
    assert drawn == [1, 2, 3, UNCONDITIONED, 1, 2, 3, UNCONDITIONED, 1] and scheduler.n_turns == 9
    np.random.seed(0)
    counts = Counter(scheduler.draw(0.4) for _ in range(6000))
    assert counts.pop(EXPLORATORY_GROUP) / 6000 == pytest.approx(0.4, abs=0.03)
    assert counts.keys() == {1, 2, 3, UNCONDITIONED} and max(counts.values()) - min(counts.values()) <= 1


def test_who_may_hand_over():
    """Exploring episodes alone: no episode that follows a mode goes on with another one."""
    np.random.seed(0)
    scheduler = scheduler_of(2, hand_over=0.7)
    scheduler.begin_all(9000, 0.4)
    for group, share in ((EXPLORATORY_GROUP, 0.7), (UNCONDITIONED, 0.0), (1, 0.0), (2, 0.0)):
        chosen = scheduler.groups == group
        assert chosen.any() and scheduler.may_hand_over[chosen].mean() == pytest.approx(share, abs=0.03)
    np.testing.assert_array_equal(scheduler.explored, scheduler.groups == EXPLORATORY_GROUP)
    assert not scheduler.handed_over.any()


@pytest.mark.parametrize("may_hand_over", [False, True])
def test_exploring_episodes_hand_over(may_hand_over):
    np.random.seed(0)
    scheduler = scheduler_of(2, n_envs=6000)
    scheduler.groups = np.repeat([EXPLORATORY_GROUP, 1], 3000)
    scheduler.explored[:3000] = True
    scheduler.may_hand_over[:3000] = may_hand_over
    scheduler.hand_over(probability=0.2)
    left = scheduler.groups[:3000] != EXPLORATORY_GROUP
    np.testing.assert_array_equal(scheduler.handed_over[:3000], left)
    assert (scheduler.groups[3000:] == 1).all() and not scheduler.handed_over[3000:].any()
    assert left.mean() == pytest.approx(0.2 * may_hand_over, abs=0.02)
    # Nobody commanded these from their beginning
    assert {scheduler.commanded_mode(env) for env in range(3000)} == {None} and scheduler.commanded_mode(3000) == 0
    assert {scheduler.assigned_mode(env) for env in range(3000)} == {None} and scheduler.assigned_mode(3000) == 0


def test_an_episode_hands_over_once():
    scheduler = scheduler_of(2, n_envs=300)
    scheduler.explored[:], scheduler.may_hand_over[:] = True, True
    scheduler.hand_over(probability=1.0)
    counts, before = Counter(scheduler.groups.tolist()), scheduler.groups.copy()
    assert counts == {1: 100, 2: 100, UNCONDITIONED: 100} and not scheduler.may_hand_over.any()
    scheduler.hand_over(probability=1.0)
    np.testing.assert_array_equal(scheduler.groups, before)


@pytest.mark.parametrize(
    ("group", "explored", "handed_over", "assigned", "commanded"),
    [
        (EXPLORATORY_GROUP, True, False, None, None),
        (UNCONDITIONED, False, False, None, None),
        (2, False, False, 1, 1),
        (2, True, True, None, None),  # it came there by exploring
        (2, False, True, 1, None),
    ],
)
def test_whose_episode_it_is(group, explored, handed_over, assigned, commanded):
    scheduler = scheduler_of(3, n_envs=1)
    scheduler.groups[0], scheduler.explored[0], scheduler.handed_over[0] = group, explored, handed_over
    assert (scheduler.assigned_mode(0), scheduler.commanded_mode(0)) == (assigned, commanded)


def test_a_new_episode_in_one_environment():
    scheduler = scheduler_of(1, n_envs=3)
    scheduler.groups[:], scheduler.handed_over[:], scheduler.explored[:] = 1, True, True
    scheduler.begin(1, 1.0)
    assert scheduler.groups.tolist() == [1, EXPLORATORY_GROUP, 1] and scheduler.handed_over.tolist() == [True, False, True]
    scheduler.begin(0, 0.0)
    assert scheduler.groups[0] == 1 and not scheduler.explored[0] and not scheduler.may_hand_over[0]


def test_environments_follow_their_modes():
    scheduler = scheduler_of(3, n_envs=5)
    scheduler.groups = np.array([1, 2, 3, EXPLORATORY_GROUP, UNCONDITIONED])
    scheduler.follow([2, None, 0])
    assert scheduler.groups.tolist() == [3, UNCONDITIONED, 1, EXPLORATORY_GROUP, UNCONDITIONED]
    assert scheduler.groups.dtype == np.int64


def in_use():
    np.random.seed(3)
    scheduler = scheduler_of(2, hand_over=0.5)
    scheduler.begin_all(20, 0.5)
    scheduler.hand_over(0.5)
    scheduler.note_news(700, 30, born=False)
    return scheduler


def test_what_a_scheduler_knows_is_kept(tmp_path):
    scheduler = in_use()
    state = scheduler.state_dict()
    write(tmp_path / "episodes", "episodes", state)
    for tree in (copied(state), read(tmp_path / "episodes", "episodes")):
        other = scheduler_of(2, hand_over=0.5)
        other.load_state_dict(tree, 20)
        assert str(other.state_dict()) == str(state) and other.n_turns == state["n_turns"] > 0
        followed = []
        for each in (scheduler, other):
            each.load_state_dict(copied(state), 20)
            np.random.seed(5)
            each.hand_over(0.5)
            each.begin(3, 0.5)
            followed.append(str(each.state_dict()))
        assert followed[0] == followed[1] != str(state)
        assert not np.shares_memory(other.groups, tree["groups"])


@pytest.mark.parametrize(
    ("change", "n_envs", "message"),
    [
        (lambda state: None, 19, r"episodes.groups: int64 of shape \[20\] given; accepted is int64 of shape \[19\]"),
        (lambda state: state["groups"].fill(3), 20, "there are 2 modes, groups from 3 to 3"),
        (lambda state: state["groups"].fill(-2), 20, "groups from -2"),
        (lambda state: state.update(explored=np.zeros(20)), 20, "episodes.explored"),
        (lambda state: state.update(may_hand_over=np.zeros(3, dtype=bool)), 20, "episodes.may_hand_over"),
        (lambda state: state.update(n_turns=-1), 20, "n_turns"),
        (lambda state: state.update(news_at=-1), 20, "news_at"),
        (lambda state: state.update(n_cells=0.5), 20, "n_cells"),
        (lambda state: state.pop("handed_over"), 20, "handed_over"),
        (lambda state: state.update(more=1), 20, "more"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_lost(change, n_envs, message):
    scheduler = in_use()
    before = str(scheduler.state_dict())
    state = copied(scheduler.state_dict())
    change(state)
    with pytest.raises(ValueError, match=message):
        scheduler.load_state_dict(state, n_envs)
    assert str(scheduler.state_dict()) == before


def test_a_state_of_version_0_1_has_no_news():
    state = {name: each for name, each in in_use().state_dict().items() if name not in ("news_at", "n_cells")}
    scheduler = scheduler_of(2)
    scheduler.load_state_dict(copied(state), 20)
    assert scheduler.news_at == scheduler.n_cells == 0
