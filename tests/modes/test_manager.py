"""What a user does with modes: rename, freeze, delete, filter, choose by value, and read what became of them."""

import pickle
import tracemalloc
from dataclasses import asdict

import numpy as np
import pytest
import torch as th
from environments import TwoEnds, change_settings, copied, small_model, some_observations
from hypothesis import given, settings
from hypothesis import strategies as st
from planar import belongings, planar_model, route_of, said, same, walk
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG, Mode
from sb3_ddiffpg.modes import discovery
from sb3_ddiffpg.modes.history import ModeEvent, ModeHistory, ModeState
from sb3_ddiffpg.modes.mode import Outcome
from sb3_ddiffpg.serialization.safetensors_tree import read, write

# ---------------------------------------------------------------------- names


def test_a_name_is_kept_for_life(two_routes, tmp_path):
    model = two_routes
    names = {route_of(mode): mode.name for mode in model.modes}
    assert names == {"down": "mode_0", "up": "mode_1"}
    model.rename_mode(names["up"], "over the hill")
    model.rename_mode(names["down"], "tal-2")
    walk(model, "up", 3)
    walk(model, "right", 6)
    assert said(model) == ["mode_2 born"]
    assert {mode.name: route_of(mode) for mode in model.modes} == {"over the hill": "up", "tal-2": "down", "mode_2": "right"}
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    model.rename_mode("over the hill", "mode_1")  # back to the name that it was born with
    model.rename_mode("tal-2", "over the hill")
    loaded = DDiffPG.load(tmp_path / "model", env=model.env)
    assert set(loaded.modes.names) == {"over the hill", "tal-2", "mode_2"}
    loaded.set_logger(model.logger)
    loaded.rename_mode("over the hill", "hill")
    loaded.rename_mode("hill", "hill")  # is nothing that happened
    loaded.load_replay_buffer(tmp_path / "buffer")
    walk(loaded, "down", 3)
    assert said(loaded) == [] and route_of(loaded.modes["hill"]) == "up"
    assert all(mode.n_trajectories >= 5 for mode in loaded.modes)
    loaded.predict(np.zeros(2, dtype=np.float32), mode="hill")
    assert [str(event) for event in loaded.mode_history][-2:] == ["mode_2 born", "over the hill renamed to hill"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "is no name of a mode: accepted are 1 to 24 letters"),
        ("7", "not digits alone"),
        ("a/b", "is no name"),
        (" a", "is no name"),
        ("x" * 25, "is no name"),
        ("_x", "is no name"),
        (3, "is no name"),
        ("mode_1", r"is another mode's; the modes are \['mode_0', 'mode_1'\]"),
        ("mode_5", "reserved for the mode that is born with it"),
    ],
)
def test_names_that_are_refused(two_routes, name, message):
    with pytest.raises(ValueError, match=message):
        two_routes.rename_mode("mode_0", name)
    with pytest.raises(ValueError, match="'hill' is unknown"):
        two_routes.rename_mode("hill", "valley")
    assert two_routes.modes.names == ["mode_0", "mode_1"] and len(two_routes.mode_history) == 2


# ---------------------------------------------------------------------- freezing


def merge_everything(model):
    change_settings(model, modes={"distance_threshold": 100.0})


def test_a_frozen_mode_is_not_merged(two_routes):
    model = two_routes
    model.freeze_mode("mode_1")
    before = belongings(model)["mode_1"]
    merge_everything(model)
    assert [said(model) for _ in range(4)] == [[]] * 4  # their patience is 0
    assert same(belongings(model)["mode_1"], before) and model.modes["mode_1"].frozen
    model.freeze_mode("mode_1", False)
    assert said(model) == ["mode_0 merged into mode_1"] or said(model) == []
    assert len(model.modes) == 1
    assert [event.kind for event in model.mode_history] == ["born", "born", "frozen", "released", "merged into"]


def test_a_frozen_mode_is_not_crowded_out(two_routes):
    """By one more way than there may be modes: without the ice the smallest would go, and the frozen one is that."""
    model = two_routes
    change_settings(model, modes={"max_modes": 2})
    model.freeze_mode("mode_1")  # of 4, the other has 5
    walk(model, "right", 9)
    model.recluster()
    assert len(model.modes) == 2 and route_of(model.modes["mode_1"]) == "up"


def test_a_frozen_mode_is_not_given_up(two_routes):
    model = two_routes
    change_settings(model, modes={"trials": 5})
    model.freeze_mode("mode_0")
    for mode in model.modes:
        mode.misses = 50
    assert said(model) == ["mode_1 retired"] and model.modes.names == ["mode_0"]


@pytest.mark.parametrize("frozen", [False, True])
def test_trajectories_of_a_frozen_mode_leave_the_buffer_last(frozen):
    model = planar_model(buffer_size=600)
    walk(model, "up", 30)  # the largest group by far, from which the oldest would go
    walk(model, "down", 5)
    model.recluster()
    mode = next(mode for mode in model.modes if route_of(mode) == "up")
    model.freeze_mode(mode, frozen)
    buffer = model.replay_buffer
    walk(model, "right", 20)
    assert buffer.full
    stored = {trajectory.serial for trajectory in buffer.trajectories(True)}
    assert (set(range(30)) <= stored) == frozen


def test_a_run_goes_on_where_only_frozen_modes_fill_the_buffer():
    model = planar_model(buffer_size=200)
    walk(model, "up", 5)
    model.recluster()
    model.freeze_mode(0)
    for _ in range(10):
        walk(model, "up", 3)
        model.recluster()
    assert model.replay_buffer.full and model.modes[0].n_trajectories > 5


def test_frozen_survives_saving(two_routes, tmp_path):
    two_routes.freeze_mode("mode_1")
    two_routes.save(tmp_path / "model")
    two_routes.save_replay_buffer(tmp_path / "buffer")
    loaded = DDiffPG.load(tmp_path / "model", env=two_routes.env)
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert [mode.frozen for mode in loaded.modes] == [False, True] and loaded.replay_buffer.groups.frozen_modes == {1}


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.integers(1, 4))
def test_whatever_clusters_are_found_a_frozen_mode_stays(seed, births, max_modes):
    rng = np.random.default_rng(seed)
    n, n_old = 12, int(rng.integers(1, 4))
    modes = [Mode(i, f"mode_{i}", 0, frozen=bool(rng.random() < 0.5)) for i in range(n_old)]
    old_labels = np.concatenate((np.arange(n_old), rng.integers(-1, n_old, n - n_old)))
    labels, _ = discovery._defend(modes, rng.random((n, n)), old_labels, rng.integers(-1, 4, n), 0, max_modes)
    labels = np.unique(np.append(labels, -1), return_inverse=True)[1][:-1] - 1  # numbered without gaps
    labels = discovery._fewest(modes, old_labels, labels, max_modes)
    if not births:
        labels = discovery._without_births(modes, old_labels, labels)
    inheritance = discovery._match(modes, old_labels, labels)
    kept = {parent for parent, keeps in zip(inheritance.parents, inheritance.kept, strict=True) if keeps}
    assert {index for index, mode in enumerate(modes) if mode.frozen} <= kept


def test_names_of_any_length_can_be_logged(two_routes):
    two_routes.rename_mode(0, "a" * 24)
    two_routes.rename_mode(1, "a" * 23 + "b")
    two_routes.set_logger(configure(None, ["stdout", "log"]))
    two_routes.recluster()
    two_routes.logger.dump(0)


def test_time_goes_on_through_a_second_run(tmp_path):
    model = small_model(DummyVecEnv([TwoEnds] * 4)).learn(400).learn(200)
    assert model.num_timesteps < 250 and model.lifetime_steps == 400 + model.num_timesteps
    steps = [state.step for state in model.mode_history.states]
    assert steps == sorted(steps) and steps[-1] > 400 and sorted(model.visits.coverage) == model.visits.coverage
    model.save(tmp_path / "model")
    assert DDiffPG.load(tmp_path / "model").lifetime_steps == model.lifetime_steps


# ---------------------------------------------------------------------- deleting


def test_a_deleted_mode_is_gone_and_the_others_are_as_before(two_routes):
    model = two_routes
    walk(model, "right", 6)
    model.recluster()
    before, routes = belongings(model), {mode.name: route_of(mode) for mode in model.modes}
    model.scheduler.begin_all(3, 0.0)
    names = ["mode_0", "mode_1", "mode_2"]
    model.scheduler.groups = np.array([model.modes.index(name) + 1 for name in names])  # each drives an environment
    model.delete_mode("mode_1")
    assert set(model.modes.names) == {"mode_0", "mode_2"}
    assert model.scheduler.groups.tolist() == [model.modes.index("mode_0") + 1, -1, model.modes.index("mode_2") + 1]
    after = belongings(model)
    assert all(same(after[name], before[name]) for name in after)
    assert {mode.name: route_of(mode) for mode in model.modes} == {name: routes[name] for name in after}
    assert str(model.mode_history.events[-1]) == "mode_1 deleted"
    model.train(2, 32)
    assert said(model) == []  # its trajectories do not bring it back
    walk(model, routes["mode_1"], 6)
    assert said(model) == ["mode_3 born"]  # new ones do, under a name of their own
    for mode in list(model.modes):
        model.delete_mode(mode)
    assert len(model.modes) == 0
    model.train(2, 32)
    with pytest.raises(ValueError, match="'mode_0' is unknown; there is no mode yet"):
        model.delete_mode("mode_0")


# ---------------------------------------------------------------------- history


def test_history(two_routes):
    model = two_routes
    assert [(event.step, event.kind, event.number) for event in model.mode_history] == [(0, "born", 0), (0, "born", 1)]
    model.num_timesteps = 500
    model.mode_manager.modes[0].outcomes.extend([Outcome(True, 1.0, 5), Outcome(False, 0.0, 9)])
    model.recluster()
    states = model.mode_history.states
    assert [(state.step, state.number) for state in states] == [(0, 0), (0, 1), (500, 0), (500, 1)]
    assert states[2].success_rate == 0.5 and states[2].n_trajectories == model.modes[0].n_trajectories
    assert str(model.mode_history).splitlines()[0].split() == ["0", "mode_0", "born"]
    assert "nothing has happened" in str(planar_model().mode_history)


def test_a_long_history_is_small():
    history, modes = ModeHistory(), [Mode(number, f"mode_{number}", born_at=0) for number in range(2)]
    modes[0].outcomes.append(Outcome(True, 1.0, 5))
    tracemalloc.start()
    try:
        for step in range(5_000):
            history.note(step, modes)
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held / len(history.states) < 50 and len(history.states) == 10_000
    assert ModeHistory.from_state(history.state_dict()).states[-2:-1] == history.states[-2:-1] != []


def test_a_history_that_was_pickled_as_lists():
    event, state = ModeEvent(3, "born", 0, "mode_0"), ModeState(5, 0, 4, 0.5)
    history = ModeHistory.__new__(ModeHistory)
    history.__setstate__({"events": [event], "states": [state]})
    assert history.events == [event] and history.states == [state]
    again = pickle.loads(pickle.dumps(history))
    assert again.events == [event] and again.states == [state]


def test_a_history_of_impossible_numbers_is_refused():
    state = {"step": 2**70, "number": 0, "n_trajectories": 1, "success_rate": 1.0}
    with pytest.raises(ValueError, match="history"):
        ModeHistory.from_state({"events": [], "states": [state]})
    columns = ModeHistory(states=[ModeState(5, 0, 4, 0.5)]).state_dict()["states"]
    for change in (
        {"number": np.zeros(2, int)},
        {"step": np.zeros(())},
        {"success_rate": np.zeros(1, int)},
        {"x": np.zeros(1)},
    ):
        with pytest.raises(ValueError, match="history"):
            ModeHistory.from_state({"events": [], "states": {**columns, **change}})


def test_a_file_holds_the_history_of_a_long_run(tmp_path):
    """Twenty modes at each of 15,000 re-clusterings."""
    history = ModeHistory(states=(ModeState(step, number, 100, 0.123456789) for step in range(15_000) for number in range(20)))
    write(tmp_path / "history", "history", history.state_dict())
    assert ModeHistory.from_state(read(tmp_path / "history", "history")).states[::997] == history.states[::997]


def test_a_history_of_an_older_file():
    """Which has a list of records."""
    states = [ModeState(5, 0, 4, 0.5), ModeState(6, 1, 2, float("nan"))]
    old = ModeHistory.from_state({"events": [], "states": [asdict(state) for state in states]})
    new = ModeHistory.from_state(copied(old.state_dict()))
    assert str(old.states) == str(new.states) == str(states)


# ---------------------------------------------------------------------- choosing


def slow_value(model, observation, mode, n_actions):
    """One observation, one mode and one action at a time."""
    policy, values = model.policy, []
    for _ in range(n_actions):
        action, _ = policy.predict(observation, mode=mode)
        tensor = th.as_tensor(observation, device=model.device)[None]
        scaled = th.as_tensor(policy.scale_action(action), device=model.device)[None]
        group = [tensor] * policy.critics.n_groups
        logits = policy.critics(policy.critic_features(th.cat(group)), scaled.expand(policy.critics.n_groups, 1, -1))
        values.append(policy.critics.values(logits)[mode + 1].min().item())
    return np.mean(values)


def test_values_are_those_of_each_modes_own_critics(trained):
    observations = some_observations(4)
    th.manual_seed(0)
    values = trained.mode_values(observations, n_actions=400)
    assert values.shape == (4, len(trained.modes)) and trained.mode_values(observations[0]).shape == (len(trained.modes),)
    expected = [[slow_value(trained, obs, mode, 400) for mode in range(len(trained.modes))] for obs in observations]
    np.testing.assert_allclose(values, expected, atol=0.1 * np.ptp(expected) + 1e-3)
    best = trained.best_mode(observations, n_actions=400)
    clear = np.abs(np.diff(np.sort(expected, axis=1)[:, -2:])).ravel() > 0.2 * np.ptp(expected)
    assert clear.any()
    for name, row, is_clear in zip(best, expected, clear, strict=True):
        assert name == trained.modes[int(np.argmax(row))].name or not is_clear
    assert trained.best_mode(observations[0]) in trained.modes.names


def test_without_modes_nothing_is_chosen(trained):
    model = planar_model()
    for method in (model.best_mode, model.mode_values):
        with pytest.raises(ValueError, match="no mode yet"):
            method(np.zeros(2, dtype=np.float32))
    with pytest.raises(ValueError, match="n_actions must be at least 1, got 0"):
        trained.mode_values(some_observations(1), n_actions=0)


def test_exploration_is_never_what_a_trained_model_does(trained, monkeypatch):
    """Of all ways to ask for an action."""
    used = []
    actor = trained.policy.actor
    forward = type(actor).forward

    def spy(self, obs, deterministic=False, embeddings=None):
        used.append(embeddings)
        return forward(self, obs, deterministic, embeddings)

    monkeypatch.setattr(type(actor), "forward", spy)
    observations = some_observations(8)
    trained.predict(observations)
    trained.predict(observations, mode=0)
    trained.predict(observations, episode_start=np.ones(8, dtype=bool))
    exploring = trained.policy.mode_embeddings[0]
    assert len(used) == 3 and used[0] is None
    assert not any((embeddings == exploring).all(dim=-1).any() for embeddings in used[1:])


def test_a_model_in_use_is_not_changed_by_asking(two_routes):
    before = belongings(two_routes)
    two_routes.best_mode(np.zeros((3, 2), dtype=np.float32))
    assert all(same(after, before[name]) for name, after in belongings(two_routes).items())
    assert isinstance(two_routes.env, DummyVecEnv)
