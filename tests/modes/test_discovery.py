"""Finding modes changes nothing; the manager of the modes alone carries it out, with fakes for all that follows the modes."""

from copy import deepcopy
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
from environments import copied
from gymnasium import spaces
from planar import PLANE, route_of, walk

from sb3_ddiffpg.buffers.mode_buffer import ModeReplayBuffer
from sb3_ddiffpg.buffers.trajectory import NO_MODE
from sb3_ddiffpg.modes.discovery import Counters, find_modes, retired_modes
from sb3_ddiffpg.modes.manager import ModeManager
from sb3_ddiffpg.modes.mode import modes_state
from sb3_ddiffpg.modes.settings import ModeSettings
from sb3_ddiffpg.serialization.safetensors_tree import read, write

SETTINGS = ModeSettings(min_size=3, distance_threshold=2.0, patience=2, trials=20)


class Heir:
    """In place of a policy: notes what it is told."""

    def __init__(self):
        self.told = []

    def inherit(self, parents, kept, reset_output=True):
        self.told.append((list(parents), list(kept), reset_output))


class Followers:
    """In place of the scheduler of the episodes."""

    def __init__(self):
        self.told = []

    def follow(self, new_modes):
        self.told.append(list(new_modes))


class Alone:
    """A manager of modes and a buffer in the plane, without a model."""

    def __init__(self, settings=SETTINGS):
        actions = spaces.Box(-1.0, 1.0, (2,))
        self.buffer = ModeReplayBuffer(5000, PLANE, actions, device="cpu", mode_features=[0, 1])
        self.manager, self.heir, self.followers = ModeManager(settings, [0, 1]), Heir(), Followers()
        self.step = 0

    def walk(self, route, n, success=True, part=1.0, assigned=None):
        walk(SimpleNamespace(replay_buffer=self.buffer, bonus=None), route, n, success, part)
        walked = self.buffer.trajectories(success)[-n:]
        for trajectory in walked:
            trajectory.assigned_mode = assigned
        return walked

    def recluster(self, births=True):
        self.step += 100
        return [str(each) for each in self.manager.recluster(self.buffer, self.heir, self.followers, self.step, births)]

    def merging(self, patience=2):
        """From now on all is one cluster."""
        settings = {**SETTINGS.to_dict(), "distance_threshold": 100.0, "patience": patience}
        self.manager.settings = ModeSettings(**settings)


def snapshot(alone):
    """All that a re-clustering may change; paths are only remembered."""
    buffer = alone.buffer
    stored = [*buffer.trajectories(True), *buffer.trajectories(False), *buffer.groups.retired]
    return deepcopy(
        {
            "modes": str(modes_state(alone.manager.modes)),
            "trajectories": str([{name: each for name, each in asdict(t).items() if name != "path"} for t in stored]),
            "groups": str({key: [t.serial for t in group] for key, group in buffer.groups.members.items()}),
            "rows": str([row_set.rows[: row_set.size].tolist() for row_set in buffer.mode_rows]),
            "new routes": buffer.new_route_rows.tolist(),
            "frozen": buffer.groups.frozen_modes,
            "parts": [part.dump(buffer.pos).tobytes() for part in buffer.parts],
            "told": (alone.heir.told, alone.followers.told),
            "history": alone.manager.history.state_dict()["events"],
            "next_number": alone.manager.next_number,
        }
    )


def find(alone, births=True):
    """What the next re-clustering will find, with the same random numbers."""
    state = np.random.get_state()
    manager = alone.manager
    retired = retired_modes(manager.modes, manager.settings.trials)
    found = find_modes(alone.buffer, manager.modes, manager._cluster, manager.settings, births, retired)
    np.random.set_state(state)
    return found


def two_modes():
    alone = Alone()
    alone.walk("up", 4)
    alone.walk("down", 5)
    alone.recluster()
    assert [(mode.name, route_of(mode)) for mode in alone.manager.modes] == [("mode_0", "down"), ("mode_1", "up")]
    return alone


def eventful():
    """Something for each counter and each mark: a merge in doubt, misses, successes off their mode, failures of nobody."""
    alone = two_modes()
    down, up = alone.manager.modes
    down.misses, down.unjudged, up.misses, up.unjudged, up.doubts = 3, 4, 5, 6, 1
    alone.walk("up", 2, assigned=0)  # against orders
    alone.walk("up", 1, assigned=1)
    alone.walk("down", 2, success=False, part=0.7)
    alone.walk("up", 1, success=False, part=0.7, assigned=0)
    return alone


@pytest.mark.parametrize("births", [True, False])
@pytest.mark.parametrize("merging", [None, 1, 5])
def test_finding_modes_changes_nothing(merging, births):
    """Whether something is merged now, defended, or neither: it is for the manager to carry out."""
    alone = eventful()
    if merging is not None:
        alone.merging(patience=merging)
    alone.manager.modes[0].frozen = True
    before = snapshot(alone)
    found = find(alone, births)
    assert snapshot(alone) == before
    # And it did find something to change: who looks twice finds the same
    again = find(alone, births)
    assert again.counters == found.counters != [Counters(mode.doubts, mode.misses) for mode in alone.manager.modes]
    assert [trajectory.serial for trajectory, _ in again.off_mode] == [trajectory.serial for trajectory, _ in found.off_mode]
    assert merging == 1 or len(found.off_mode) == 2
    np.testing.assert_array_equal(again.labels, found.labels)


def test_the_manager_carries_out_what_was_found():
    alone = eventful()
    found = find(alone)
    assert found.counters == [Counters(doubts=0, misses=7), Counters(doubts=0, misses=0)]  # "up" obeyed once
    modes, kept = list(alone.manager.modes), alone.buffer.trajectories(True)
    assert alone.recluster() == []
    assert [(mode.doubts, mode.misses, mode.unjudged) for mode in modes] == [(0, 7, 0), (0, 0, 0)]
    strayed = [trajectory for trajectory, _ in found.off_mode]
    assert [trajectory.serial for trajectory in strayed] == [9, 10] and all(t.off_mode_success for t in strayed)
    buffer, names = alone.buffer, alone.manager.table.names
    assert all(t.mode == names.index("mode_0") and t in buffer.trajectories(False) for t in strayed)
    assert all(buffer.off_mode_success[t.rows].all() and buffer.off_route[t.rows].any() for t in strayed)
    assert not any(t.off_mode_success or buffer.off_route[t.rows].any() for t in kept if t not in strayed)
    for trajectory, label in [
        *zip(found.successes, found.labels, strict=True),
        *zip(found.failures, found.failure_labels, strict=True),
    ]:
        assert trajectory.mode == label
    # "down" and "up" have five each now, and keep what they have
    assert alone.heir.told[-1] == (found.matching.parents, [True, True], True)
    assert [mode.n_trajectories for mode in alone.manager.modes] == [5, 5]


@pytest.mark.parametrize("patience", [0, 1, 2, 10])
def test_doubts_are_counted_up_to_the_patience(patience):
    alone = two_modes()
    alone.merging(patience)
    up, n = alone.manager.modes[1], max(1, patience)
    for doubts in range(1, n):
        assert find(alone).counters[1].doubts == doubts
        assert alone.recluster() == [] and up.doubts == doubts
    assert alone.recluster() == ["mode_1 merged into mode_0"]


def test_births_merges_and_who_is_told():
    alone = Alone()
    assert alone.recluster() == [] and alone.heir.told == [([], [], True)] and alone.followers.told == [[]]
    alone = two_modes()
    manager = alone.manager
    assert alone.heir.told == [([None, None], [False, False], True)] and alone.followers.told == [[]]
    assert manager.numbers == [0, 1] and manager.next_number == 2 and len(manager) == 2 and len(alone.buffer.mode_rows) == 2
    assert [(event.step, str(event)) for event in manager.history] == [(100, "mode_0 born"), (100, "mode_1 born")]
    assert manager.mean_length() == pytest.approx(np.mean([mode.mean_length for mode in manager.modes]))
    alone.merging(patience=0)
    assert alone.recluster() == ["mode_1 merged into mode_0"]
    assert alone.heir.told[-1] == ([0], [True], True) and alone.followers.told[-1] == [0, None]
    manager.settings = SETTINGS
    assert alone.recluster() == ["mode_2 split from mode_0"] and manager.next_number == 3
    assert alone.heir.told[-1] == ([0, 0], [True, False], True) and alone.followers.told[-1] == [0]


def test_new_critics_as_the_settings_say():
    alone = Alone(ModeSettings(**{**SETTINGS.to_dict(), "reset_new_critics": False}))
    alone.walk("up", 4)
    alone.recluster()
    assert alone.heir.told == [([None], [False], False)]


def test_no_birth_but_the_first():
    alone = Alone()
    alone.walk("up", 4)
    assert alone.recluster(births=False) == ["mode_0 born"]
    alone.walk("down", 5)
    assert alone.recluster(births=False) == [] and alone.recluster(births=True) == ["mode_1 born"]


def test_what_a_user_does_with_modes():
    alone = two_modes()
    manager, buffer = alone.manager, alone.buffer
    manager.rename("mode_1", "hill", step=120)
    manager.rename("hill", "hill", step=121)  # is nothing that happened
    manager.freeze("hill", True, 130, buffer)
    manager.freeze("hill", True, 131, buffer)
    assert buffer.groups.frozen_modes == {1} and manager.modes[1].frozen
    with pytest.raises(ValueError, match="is another mode's"):
        manager.rename("mode_0", "hill", step=140)
    manager.delete("mode_0", 150, buffer, alone.heir, alone.followers)
    assert (
        manager.table.names == ["hill"] and alone.followers.told[-1] == [None, 0] and alone.heir.told[-1][:2] == ([1], [True])
    )
    assert buffer.groups.frozen_modes == {0} and len(buffer.mode_rows) == 1 and len(buffer.groups.retired) == 5
    assert {trajectory.mode for trajectory in buffer.trajectories(True)} == {0}
    assert [(event.step, str(event)) for event in manager.history][2:] == [
        (120, "mode_1 renamed to hill"),
        (130, "hill frozen"),
        (150, "mode_0 deleted"),
    ]
    manager.freeze("hill", False, 160, buffer)
    assert buffer.groups.frozen_modes == set() and str(manager.history.events[-1]) == "hill released"


def test_outcomes_make_a_mode_able():
    alone = two_modes()
    manager = alone.manager
    assert manager.mastered() == {}
    (reached,), (failed,) = alone.walk("up", 1), alone.walk("up", 1, success=False)
    for trajectory in (reached, failed, failed):
        manager.note_outcome(1, trajectory)
    up = manager.modes[1]
    assert up.success_rate == pytest.approx(1 / 3) and up.unjudged == 3 and manager.mastered() == {}
    manager.note_outcome(1, reached)
    assert manager.mastered() == {1: 1} and up.unjudged == 4 and manager.modes[0].unjudged == 0
    # One of the best returns, but no goal
    manager.note_outcome(1, reached, stands_in=True)
    assert up.success_rate == pytest.approx(2 / 5) and up.outcomes[-1].episode_return == reached.episode_return


def test_unknown_modes_wait_under_new_names():
    alone = two_modes()
    manager, buffer = alone.manager, alone.buffer
    manager.expect_unknown(3, 500, buffer, alone.followers)
    assert manager.table.names == ["mode_2", "mode_3", "mode_4"] and manager.next_number == 5
    assert [mode.born_at for mode in manager.modes] == [500] * 3 and alone.followers.told[-1] == [None, None]
    assert len(buffer.mode_rows) == 3 and all(t.mode == NO_MODE for t in buffer.trajectories(True))
    assert manager.mean_length() is None


def test_what_a_manager_knows_is_kept(tmp_path):
    alone = eventful()
    alone.recluster()
    manager = alone.manager
    manager.rename("mode_1", "hill", step=120)
    manager.freeze("hill", True, 130, alone.buffer)
    manager.note_outcome(manager.table.index("hill"), alone.buffer.trajectories(True)[0])
    state = manager.state_dict()
    write(tmp_path / "modes", "modes", state)
    for known in (copied(state), read(tmp_path / "modes", "modes")):
        other = ModeManager(SETTINGS, [0, 1])
        other.load_state_dict(known)
        assert str(other.state_dict()) == str(state) and str(other.history) == str(manager.history)
        assert other.table.names == manager.table.names and other.table["hill"].frozen and other.next_number == 2
        assert str(other.table) == str(manager.table)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.update(next_number=1), "one has a number that is not below 1"),
        (lambda state: state.update(next_number=-1), "next_number"),
        (lambda state: state["modes"][0].update(name="mode_1"), "reserved for the mode that is born with it"),
        (lambda state: state["modes"][0].update(number=1, name="hill"), "two have the same number"),
        (lambda state: state["modes"][0].update(doubts=-1), "doubts"),
        (lambda state: state["modes"][0]["representative"].fill(np.nan), "not finite"),
        (lambda state: state.pop("history"), "history"),
        (lambda state: state.update(more=1), "more"),
    ],
)
def test_what_cannot_be_is_refused(change, message):
    state = copied(two_modes().manager.state_dict())
    change(state)
    with pytest.raises(ValueError, match=message):
        ModeManager(SETTINGS).load_state_dict(state)


# ---------------------------------------------------------------------- nobody tells a success


def dense(alone, *returns, route="up"):
    """Episodes along a route, of which only the return is known."""
    for each in returns:
        walk(SimpleNamespace(replay_buffer=alone.buffer, bonus=None), route, 1, None, reward=each)


def test_the_best_episode_so_far_is_a_mode():
    """However unlike the others: what a dense reward says is learned from at once. A single goal-reached one is none."""
    alone = Alone()
    dense(alone, 3.0)
    assert alone.recluster() == []  # beside nothing it is not the best
    dense(alone, 1.0, 2.0, route="down")
    assert alone.recluster() == ["mode_0 born"]
    assert [route_of(mode) for mode in alone.manager.modes] == ["up"]
    assert alone.buffer.mode_rows[0].size == alone.buffer.size()
    told = Alone()
    told.walk("up", 1)
    assert told.recluster() == [] and told.buffer.has_success_signal


def test_a_mode_that_the_best_have_left_behind_ends():
    """Commanded in vain as often as makes a mode, and without an episode among the best: unless it is the last, or kept."""
    alone = Alone()
    dense(alone, *[8.0] * 5)
    dense(alone, *[9.0] * 5, route="down")
    dense(alone, *[1.0] * 50, route="right")
    alone.recluster()
    assert sorted(route_of(mode) for mode in alone.manager.modes) == ["down", "up"]
    up = next(mode for mode in alone.manager.modes if route_of(mode) == "up")
    dense(alone, *[9.0] * 20, route="down")
    up.misses = SETTINGS.min_size - 1
    alone.recluster()
    assert up in alone.manager.modes  # it may yet
    up.misses, up.frozen = SETTINGS.min_size, True
    alone.recluster()
    assert up in alone.manager.modes
    up.frozen = False
    assert alone.recluster() == [f"{up.name} retired"]
    # The last one goes on, wherever the best go now
    (last,) = alone.manager.modes
    last.misses = 10 * SETTINGS.min_size
    dense(alone, *[20.0] * 30, route="right")
    assert alone.recluster() == [] and route_of(last) == "right"


def test_what_was_learned_before_the_first_success_is_not_lost():
    """Modes of the best returns wait until successes make a mode: the one that these are nearest to is it, the others end."""
    alone = Alone()
    dense(alone, *[9.0] * 5)
    dense(alone, *[9.0] * 5, route="down")
    dense(alone, *[1.0] * 50, route="right")
    alone.recluster()
    by_route = {route_of(mode): mode for mode in alone.manager.modes}
    assert by_route.keys() == {"up", "down"}
    alone.walk("down", SETTINGS.min_size - 1)
    assert alone.buffer.has_success_signal and len(alone.buffer.unfounded_modes) == 2
    assert alone.recluster() == []
    assert len(alone.manager) == 2 and alone.buffer.learns_from_all
    trained = [row_set.size for row_set in alone.buffer.mode_rows]
    assert min(trained) > 0
    alone.walk("down", 1)
    assert alone.recluster() == [f"{by_route['up'].name} retired"]
    assert alone.manager.modes == [by_route["down"]] and by_route["down"].n_trajectories == SETTINGS.min_size
    assert not alone.buffer.unfounded_modes and not alone.buffer.learns_from_all
