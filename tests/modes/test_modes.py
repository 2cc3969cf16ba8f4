"""The modes of a model: how they are commanded and shown, and that each keeps its name and belongings for life."""

import signal
from collections import Counter
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from environments import TwoEnds, change_settings, fill, small_model, some_observations
from hypothesis import given
from hypothesis import strategies as st
from planar import ROUTES, belongings, planar_model, route_of, said, same, walk
from scipy.stats import mannwhitneyu
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import Mode, ModeTable
from sb3_ddiffpg.buffers.trajectory import NO_MODE
from sb3_ddiffpg.exploration.episode_scheduler import UNCONDITIONED
from sb3_ddiffpg.modes.mode import Outcome, outclassed
from sb3_ddiffpg.networks.critics import EXPLORATORY_GROUP

# ---------------------------------------------------------------------- commanding


def test_a_commanded_mode_is_its_embedding(trained):
    observations = some_observations()
    tensor = th.as_tensor(observations, device=trained.device)
    actions = []
    for index, mode in enumerate(trained.modes):
        embedding = th.as_tensor(mode.embedding, device=trained.device).expand(len(observations), -1)
        with th.no_grad():
            expected = trained.actor(tensor, deterministic=True, embeddings=embedding).cpu().numpy()
        expected = trained.policy.unscale_action(expected)
        for command in (mode.name, index, mode, np.int64(index), [mode.name] * 10, [mode] * 10, np.full(10, index)):
            given, _ = trained.predict(observations, deterministic=True, mode=command, n_samples=1)
            np.testing.assert_array_equal(given, expected)
        actions.append(expected)
    with th.no_grad():
        zero = trained.policy.unscale_action(trained.actor(tensor, deterministic=True).cpu().numpy())
    unconditioned, state = trained.predict(observations, deterministic=True, n_samples=1)
    np.testing.assert_array_equal(unconditioned, zero)
    assert state is None
    mixed, _ = trained.predict(observations[:2], deterministic=True, mode=[trained.modes[1].name, 0], n_samples=1)
    np.testing.assert_allclose(mixed, [actions[1][0], actions[0][1]], atol=1e-4)
    assert not np.allclose(actions[0], actions[1]) and not np.allclose(actions[0], zero)


def test_one_observation(trained):
    observation = some_observations()[0]
    for arguments in ({"mode": "mode_0"}, {"episode_start": np.array([True])}, {"mode": [1]}):
        action, state = trained.predict(observation, deterministic=True, **arguments)
        assert action.shape == (1,) and state[0].shape == (1,)
        again, _ = trained.predict(observation, state=state, deterministic=True)
        np.testing.assert_array_equal(action, again)


@pytest.mark.parametrize("mode", ["mode_7", "", 2, -1, True, 0.5, "mode_0 ", ["mode_0", "no_mode"], [0, 5], np.array([3])])
def test_unknown_modes(trained, mode):
    with pytest.raises(
        ValueError, match=r"mode=.* is unknown; the modes are \['mode_\d', 'mode_\d'\] \(or an index below 2\)"
    ):
        trained.predict(some_observations(2), mode=mode)


def test_as_many_modes_as_observations(trained):
    with pytest.raises(ValueError, match=r"modes.* of 2 for 3 observation"):
        trained.predict(some_observations(3), mode=[0, 1])
    with pytest.raises(ValueError, match=r"episode_start of 4 for 3 observation"):
        trained.predict(some_observations(3), episode_start=np.ones(4, dtype=bool))


@pytest.fixture
def _all_are_drawn(monkeypatch):
    """Also modes that a short training has hardly commanded."""
    monkeypatch.setattr("sb3_ddiffpg.modes.manager.TRIED_EPISODES", 0)


@pytest.mark.usefixtures("_all_are_drawn")
def test_a_drawn_mode_is_kept_until_the_episode_ends(trained):
    np.random.seed(0)
    observations = some_observations(6)
    commanded = [trained.predict(observations, deterministic=True, mode=mode)[0] for mode in range(2)]
    starts, state, drawn = np.ones(6, dtype=bool), None, []
    for step in range(60):
        before = None if state is None else state[0].copy()
        actions, state = trained.predict(observations, state=state, episode_start=starts, deterministic=True)
        (held,) = state
        assert held.shape == (6,)
        np.testing.assert_allclose(actions, np.where(held[:, None] == 0, *commanded), atol=1e-4)
        if before is not None:
            np.testing.assert_array_equal(held[~starts], before[~starts])
        drawn += held[starts].tolist()
        starts = np.arange(6) == step % 6
    counts = Counter(drawn)
    assert counts.keys() == {0, 1} and min(counts.values()) > 0.3 * len(drawn)
    # No new episode: as before
    again, same = trained.predict(observations, state=state, deterministic=True)
    np.testing.assert_array_equal(same[0], state[0])
    assert again.shape == actions.shape


def outcomes(scores):
    """Commanded episodes of such returns, of which those of 1 are successes."""
    return [Outcome(score == 1, float(score), 10) for score in scores]


@pytest.mark.parametrize(
    ("best", "other", "by_success", "worse"),
    [
        ([1] * 30, [0] * 30, True, True),
        ([1] * 30, [0, 1] * 15, True, False),  # half as often: it loses half of the pairs and draws the others
        ([1] * 30, [0] * 18 + [1] * 12, True, True),
        ([1] * 3, [0] * 3, True, False),  # by chance alone in one of twenty such sixes
        ([1] * 30, [], True, True),  # nobody knows what it can do, and of the other one does
        ([1] * 30, [1] * 4, True, True),
        ([1] * 30, [1] * 5, True, False),
        ([1] * 4, [], True, False),
        ([1] * 30, [1, 1, 0, 0, 0], True, True),
        ([1] * 30, [1, 1, 1, 0, 0], True, False),
        ([5] * 30, [3] * 30, True, False),  # whoever has never succeeded is no better for its returns
        ([5] * 30, [3] * 30, False, True),
        ([0, 5] * 15, [-1, 4] * 15, False, False),  # as -140 and -160 of a pendulum, of which each is 80 more or less
        ([-7] * 80 + [3] * 30, [-9] * 80 + [3] * 30, False, False),  # what they were once does not count
    ],
)
def test_a_mode_that_is_plainly_worse_is_not_drawn(two_routes, best, other, by_success, worse):
    model = two_routes
    for index, scores in enumerate((best, other)):
        model.mode_manager.modes[index].outcomes.extend(outcomes(scores))
    model.mode_manager.success_is_told = by_success
    observations, begins = np.zeros((64, 2), dtype=np.float32), np.ones(64, dtype=bool)
    _, state = model.predict(observations, episode_start=begins)
    assert set(state[0]) == ({0} if worse else {0, 1})
    _, state = model.predict(observations, state, episode_start=begins)
    assert set(state[0]) == ({0} if worse else {0, 1})
    _, state = model.predict(observations, episode_start=begins, mode=1)
    assert set(state[0]) == {1}


@given(st.lists(st.integers(0, 3), min_size=1, max_size=40), st.lists(st.integers(0, 3), min_size=1, max_size=40))
def test_who_is_plainly_worse(first, second):
    modes = [Mode(number, f"mode_{number}", born_at=0) for number in range(2)]
    for mode, scores in zip(modes, (first, second), strict=True):
        mode.outcomes.extend(outcomes(scores))
    latest = [first[-30:], second[-30:]]
    worse = int(np.mean(latest[0]) >= np.mean(latest[1]))
    pairs = [(won > lost) + (won == lost) / 2 for won in latest[1 - worse] for lost in latest[worse]]
    chance = mannwhitneyu(latest[1 - worse], latest[worse], alternative="greater", method="asymptotic").pvalue
    assert outclassed(modes, by_success=False) == ({worse} if np.mean(pairs) > 0.75 and chance < 0.01 else set())


def test_a_commanded_mode_is_kept_too(trained):
    observations = some_observations(3)
    _, state = trained.predict(observations, mode="mode_1")
    index = trained.modes.index("mode_1")
    np.testing.assert_array_equal(state[0], [index] * 3)
    _, state = trained.predict(observations, state=state, episode_start=np.zeros(3, dtype=bool))
    np.testing.assert_array_equal(state[0], [index] * 3)


def test_a_state_of_another_model_is_noticed(trained):
    with pytest.raises(ValueError, match="2 modes"):
        trained.predict(some_observations(2), state=(np.array([0, 7]),))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mode": []}, r"mode=\[\] is unknown"),
        ({"state": ()}, "state must be what the previous call of predict returned, got"),
        ({"state": np.array([0, 1])}, "state must be what the previous call of predict returned, got"),
        ({"state": (np.array([0.5, 1.0]),)}, "state must be what the previous call of predict returned, got"),
        ({"state": (np.array([0, 1]),), "episode_start": np.ones(3, bool)}, "for 3 environment.*state for 2"),
        ({"state": (np.array([], dtype=int),)}, "of 0 for 2 observation"),
        ({"episode_start": np.ones(0, bool)}, "of 0 for 2 observation"),
    ],
)
def test_states_that_cannot_be(trained, arguments, message):
    with pytest.raises(ValueError, match=message):
        trained.predict(some_observations(2), **arguments)


@pytest.mark.parametrize("mode", ["mode_0", 0.7, True, -1, 2, [[0, 1]]])
def test_the_policy_alone_knows_numbers(trained, mode):
    with pytest.raises(ValueError, match="unknown"):
        trained.policy.predict(some_observations(2), mode=mode)


@pytest.mark.usefixtures("_all_are_drawn")
def test_evaluation_with_sb3_draws_a_mode_for_each_episode(trained):
    held = []

    def watch(local_variables, _):
        held.append(local_variables["states"][0].copy())

    np.random.seed(0)
    evaluate_policy(trained, DummyVecEnv([TwoEnds] * 2), n_eval_episodes=20, callback=watch, warn=False)
    assert set(np.concatenate(held)) == {0, 1}


def test_without_modes_nothing_is_commanded():
    model = small_model(TwoEnds())
    observations = some_observations(3)
    expected, _ = model.predict(observations, deterministic=True)
    given, state = model.predict(observations, episode_start=np.ones(3, dtype=bool), deterministic=True)
    np.testing.assert_array_equal(given, expected)
    np.testing.assert_array_equal(state[0], [-1, -1, -1])
    np.testing.assert_array_equal(model.predict(observations, state=state, deterministic=True)[0], expected)
    with pytest.raises(ValueError, match="mode='mode_0' is unknown; there is no mode yet"):
        model.predict(observations, mode="mode_0")
    assert len(model.modes) == 0 and "no mode yet" in str(model.modes)


# ---------------------------------------------------------------------- the table


def test_table():
    modes = [
        Mode(3, "mode_3", born_at=100, n_trajectories=12, mean_length=21.25, mean_return=1.0),
        Mode(0, "mode_0", born_at=7, n_trajectories=4),
    ]
    modes[0].outcomes.extend(Outcome(success, 2.0 * success, 10) for success in (True, True, False, True))
    table = ModeTable(modes)
    assert len(table) == 2 and list(table) == modes and table.names == ["mode_3", "mode_0"]
    assert table["mode_0"] is table[1] is table[-1] is modes[1] and table[:1] == modes[:1]
    assert table.index("mode_0") == 1 and table.index(0) == 0
    assert "mode_0" in table and "mode_1" not in table and modes[1] in table and Mode(0, "mode_0", born_at=7) not in table
    assert table[0].success_rate == 0.75 and np.isnan(table[1].success_rate)
    assert (table[0].expected_return, table[0].expected_length) == (1.5, 10) and np.isnan(table[1].expected_return)
    lines = str(table).splitlines()
    assert [line.split()[0] for line in lines] == ["mode", "mode_3", "mode_0"]
    assert lines[1].split()[1:] == ["12", "0.75", "21.2", "1.00"] and lines[2].split()[1:3] == ["4", "-"]
    assert len({len(line) for line in lines[1:]}) == 1
    assert repr(table) == "ModeTable(['mode_3', 'mode_0'])"
    with pytest.raises(ValueError, match="'mode_9' is unknown"):
        table["mode_9"]
    modes[0].outcomes.extend([Outcome(False, 0.0, 10)] * 100)
    assert table[0].success_rate == 0.0  # of the latest 100


def test_records_are_snapshots(trained):
    """What a record says must not change under the hands of its reader, nor the policy with it."""
    record = deepcopy(trained.modes[0])
    table = trained.modes
    table[0].embedding[:] = 0.0
    np.testing.assert_array_equal(trained.modes[0].embedding, record.embedding)
    assert trained.policy.mode_embeddings[1].abs().sum() > 0


# ---------------------------------------------------------------------- re-clustering


def test_a_birth_leaves_the_others_as_they_are(two_routes):
    model = two_routes
    before = belongings(model)
    exploring = [parameter[0].detach().clone() for parameter in model.critics.stacked_parameters()]
    embedding_0 = model.policy.mode_embeddings[0].clone()
    walk(model, "right", 9)
    walk(model, "up", 3)
    assert said(model) == ["mode_2 born"]
    assert [(mode.name, route_of(mode)) for mode in model.modes] == [
        ("mode_2", "right"),
        ("mode_1", "up"),
        ("mode_0", "down"),
    ]
    after = belongings(model)
    assert all(same(before[name], after[name]) for name in before)
    for old, parameter in zip(exploring, model.critics.stacked_parameters(), strict=True):
        assert th.equal(old, parameter[0])
    assert th.equal(embedding_0, model.policy.mode_embeddings[0])
    # The newcomer: hidden layers of the exploratory critics, values near zero, an embedding of its own
    newcomer = 1
    assert th.equal(model.critics.weights[0][newcomer], model.critics.weights[0][0])
    assert model.critics.weights[-1][newcomer].abs().sum() == 0
    distances = th.cdist(model.policy.mode_embeddings, model.policy.mode_embeddings)
    assert distances[newcomer, [0, 2, 3]].min() > 0.5
    # The table
    by_name = {mode.name: mode for mode in model.modes}
    assert [by_name[name].n_trajectories for name in ("mode_0", "mode_1", "mode_2")] == [5, 7, 9]


def test_a_merge_and_a_split(two_routes):
    model = two_routes
    before = belongings(model)
    change_settings(model, modes={"distance_threshold": 100.0})
    assert said(model) == ["mode_1 merged into mode_0"]
    assert model.modes.names == ["mode_0"] and model.modes[0].n_trajectories == 9
    assert same(belongings(model)["mode_0"], before["mode_0"])
    walk(model, "right", 3)
    change_settings(model, modes={"distance_threshold": 2.0})
    # All were one mode: the largest part goes on with the name, the name of the merged one is not used again
    assert said(model) == ["mode_2 split from mode_0", "mode_3 born"]
    assert {mode.name: route_of(mode) for mode in model.modes} == {"mode_0": "down", "mode_2": "up", "mode_3": "right"}
    after = belongings(model)
    assert same(after["mode_0"], before["mode_0"])
    n_parameters = len(model.critics.stacked_parameters())
    heir, parent = after["mode_2"], after["mode_0"]
    assert same(heir[1 : 2 * n_parameters + 1], parent[1 : 2 * n_parameters + 1])  # critics and targets are copied
    assert not th.equal(heir[0], parent[0]) and all((moment == 0).all() for moment in heir[2 * n_parameters + 1 :])


def test_a_retirement(two_routes):
    model = two_routes
    walk(model, "right", 9)
    model.recluster()
    # Nobody reaches the goal by its route any more, whatever the command
    model.modes["mode_1"].misses = model.mode_settings.trials
    assert said(model) == ["mode_1 retired"]
    assert [(mode.name, route_of(mode)) for mode in model.modes] == [("mode_2", "right"), ("mode_0", "down")]
    assert all(trajectory.mode != NO_MODE for trajectory in model.replay_buffer.trajectories(True))
    assert model.replay_buffer.size() == (4 + 5 + 9) * 12  # what it leaves still serves exploration
    # It may come back, under a new name
    walk(model, "up", 4)
    assert said(model) == ["mode_3 born"]


def test_misses_are_counted_until_the_route_is_taken(two_routes):
    model, buffer = two_routes, two_routes.replay_buffer
    mode = model.modes["mode_1"]
    mode.misses = 7
    for route, commanded, success in (("up", None, True), ("down", 1, True), ("up", 1, False)):
        walk(model, route, 1, success)
        buffer.trajectories(success)[-1].assigned_mode = commanded
        assert said(model) == [] and mode.misses == 7
    walk(model, "up", 1)
    buffer.trajectories(True)[-1].assigned_mode = 1
    assert said(model) == [] and mode.misses == 0


def test_an_obedient_mode_is_not_given_up_however_rarely_it_is_clustered(two_routes):
    """More commanded episodes than trials between two clusterings; of one mode all obey, of the other none."""
    model = two_routes
    change_settings(model, modes={"trials": 20})
    for _ in range(3):
        for number in (1, 0):
            walk(model, "up", 25)
            for trajectory in model.replay_buffer.trajectories(True)[-25:]:
                trajectory.assigned_mode = number
            model.modes[f"mode_{number}"].unjudged = 25
        events = said(model)
        if events:
            break
        assert model.modes["mode_1"].misses == 0 and model.modes["mode_0"].misses == 25
    assert events == ["mode_0 retired"] and model.modes.names == ["mode_1"]


def test_a_dormant_mode_is_given_up_too(two_routes):
    model = two_routes
    model.replay_buffer.reset()
    model.replay_buffer.expect_modes(2)
    walk(model, "up", 4)
    assert said(model) == []
    model.modes["mode_0"].misses = model.mode_settings.trials
    assert said(model) == ["mode_0 retired"] and model.modes.names == ["mode_1"]


def test_the_last_modes_are_not_given_up(two_routes):
    """When none can be commanded, the policy is at fault."""
    for mode in two_routes.modes:
        mode.misses = 10_000
    assert said(two_routes) == [] and two_routes.modes.names == ["mode_0", "mode_1"]


def test_a_mode_without_a_cluster_goes_on(two_routes):
    model = two_routes
    before = belongings(model)
    change_settings(model, modes={"min_size": 5})  # it has four
    for _ in range(20):
        assert said(model) == []
    assert same(belongings(model)["mode_1"], before["mode_1"])


def test_no_mode_is_born_when_exploration_is_over(two_routes):
    model = two_routes
    change_settings(model, exploration={"share": 0.0})
    model.num_timesteps = model.learning_starts
    walk(model, "right", 4)
    assert said(model) == [] and model.modes.names == ["mode_0", "mode_1"]
    assert sum(trajectory.mode == NO_MODE for trajectory in model.replay_buffer.trajectories(True)) == 4
    # A part that would split off stays where it was
    change_settings(model, modes={"distance_threshold": 100.0})
    assert said(model) == ["mode_1 merged into mode_0"]
    change_settings(model, modes={"distance_threshold": 2.0})
    assert said(model) == [] and model.modes["mode_0"].n_trajectories == 4 + 5 + 4
    change_settings(model, exploration={"share": 0.1})
    assert said(model) == ["mode_2 split from mode_0", "mode_3 split from mode_0"]
    # The first mode is always welcome
    model = planar_model(exploration={"share": 0.0})
    model.num_timesteps = model.learning_starts
    walk(model, "up", 4)
    assert said(model) == ["mode_0 born"]


def test_patience_outlasts_a_doubt(two_routes):
    model = two_routes
    before = belongings(model)
    change_settings(model, modes={"patience": 3, "distance_threshold": 100.0})
    for _ in range(2):
        assert said(model) == [] and set(model.modes.names) == {"mode_0", "mode_1"}
        assert {mode.name: mode.n_trajectories for mode in model.modes} == {"mode_0": 5, "mode_1": 4}
    assert all(same(before[name], belongings(model)[name]) for name in before)
    change_settings(model, modes={"distance_threshold": 2.0})
    assert said(model) == []  # all is well again, and the count starts anew
    change_settings(model, modes={"distance_threshold": 100.0})
    assert [said(model) for _ in range(3)] == [[], [], ["mode_1 merged into mode_0"]]


@pytest.mark.parametrize("patience", [0, 1, 2, 10])
def test_a_mode_gives_way_at_the_last_of_as_many_reclusterings_as_its_patience(two_routes, patience):
    change_settings(two_routes, modes={"patience": patience, "distance_threshold": 100.0})
    n = max(1, patience)
    assert [said(two_routes) for _ in range(n)] == [[]] * (n - 1) + [["mode_1 merged into mode_0"]]


def test_target_actions_follow_their_lineage(two_routes):
    model, buffer = two_routes, two_routes.replay_buffer
    by_route = {}
    for trajectory in buffer.trajectories(True):
        route = route_of(model.modes[trajectory.mode])
        buffer.target_actions[trajectory.rows] = by_route.setdefault(route, 0.25 * (len(by_route) + 1))
        buffer.exploratory_target_actions[trajectory.rows] = 0.9

    def improved():
        """By serial number: whether target actions are still the improved ones, and not the actions again."""
        kept = {}
        for trajectory in buffer.trajectories(True):
            values, actions = buffer.target_actions[trajectory.rows], buffer.actions[trajectory.rows]
            kept[trajectory.serial] = bool((values == values[0, 0]).all())
            assert kept[trajectory.serial] or (values == actions).all()
            assert np.all(buffer.exploratory_target_actions[trajectory.rows] == np.float32(0.9))
        return kept

    walk(model, "right", 9)
    buffer.exploratory_target_actions[:] = 0.9
    model.recluster()  # other indices, the same modes
    kept = improved()
    assert [kept[serial] for serial in range(9)] == [True] * 9
    change_settings(model, modes={"distance_threshold": 100.0})
    model.recluster()  # one mode: heir of the largest, "right"
    assert not any(improved()[serial] for serial in range(9))


def test_environments_follow_names_not_numbers(two_routes):
    model = two_routes
    indices = {mode.name: index for index, mode in enumerate(model.modes)}
    groups = [indices["mode_0"] + 1, indices["mode_1"] + 1, EXPLORATORY_GROUP, UNCONDITIONED]
    model.scheduler.groups = np.array(groups)
    walk(model, "right", 9)
    model.recluster()
    indices = {mode.name: index for index, mode in enumerate(model.modes)}
    assert indices == {"mode_2": 0, "mode_0": 1, "mode_1": 2}
    assert model.scheduler.groups.tolist() == [2, 3, EXPLORATORY_GROUP, UNCONDITIONED]
    model.modes["mode_1"].misses = model.mode_settings.trials
    assert said(model) == ["mode_1 retired"]
    assert model.scheduler.groups.tolist() == [2, UNCONDITIONED, EXPLORATORY_GROUP, UNCONDITIONED]


def test_failures_go_to_the_nearest_mode(two_routes):
    model, buffer = two_routes, two_routes.replay_buffer
    walk(model, "up", 3, success=False, part=0.7)
    walk(model, "down", 2, success=False, part=0.8)
    assert said(model) == []
    owners = [model.modes[trajectory.mode].name for trajectory in buffer.trajectories(success=False)]
    assert owners == ["mode_1"] * 3 + ["mode_0"] * 2
    for index, mode in enumerate(model.modes):
        trajectories = [t for success in (True, False) for t in buffer.trajectories(success) if t.mode == index]
        rows = buffer.mode_rows[index]
        assert sorted(rows.rows[: rows.size]) == sorted(np.concatenate([t.rows for t in trajectories]))
        assert mode.n_trajectories == sum(t.success for t in trajectories)


def test_statistics_and_representative(two_routes):
    model, buffer = two_routes, two_routes.replay_buffer
    for index, mode in enumerate(model.modes):
        members = [t for t in buffer.trajectories(True) if t.mode == index]
        assert mode.mean_length == np.mean([t.length for t in members])
        assert mode.mean_return == pytest.approx(np.mean([t.episode_return for t in members]))
        distances = buffer.success_distances(members).mean(axis=1)
        np.testing.assert_array_equal(mode.representative, buffer.full_path(members[distances.argmin()]))


def test_an_interrupt_waits_until_all_follow_the_clustering(two_routes, monkeypatch):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job is born without
    model = two_routes
    walk(model, "right", 9)
    inherit = model.policy.inherit

    def interrupted(*args):
        signal.raise_signal(signal.SIGINT)
        inherit(*args)

    monkeypatch.setattr(model.policy, "inherit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.recluster()
    monkeypatch.undo()
    assert len(model.modes) == model.policy.n_modes == len(model.replay_buffer.mode_rows) == 3
    assert all(len(mode.representative) and mode.n_trajectories for mode in model.modes)
    model.train(1, 32)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_max_modes():
    model = planar_model(modes={"max_modes": 2})
    for route in ROUTES:
        walk(model, route, 4)
    model.recluster()
    assert len(model.modes) == 2
    # 1 turns clustering off: whatever reaches the goal is the one mode
    model = planar_model(modes={"max_modes": 1})
    walk(model, "up", 2)
    assert said(model) == []  # too few
    walk(model, "right", 1)
    assert said(model) == ["mode_0 born"] and model.modes[0].n_trajectories == 3
    walk(model, "down", 4)
    assert said(model) == [] and model.modes.names == ["mode_0"] and model.modes[0].n_trajectories == 7


@pytest.mark.slow
def test_thousands_of_successes():
    """Five thousand at once, by three routes: who owns which is right, and nothing is lost."""
    fast = {"n_path_points": 12}
    modes = {"distance_threshold": None, "max_successes": 3000, "min_size": 5}
    model = planar_model(modes=modes, buffer_size=100_000, replay_buffer_kwargs=fast)
    counts = {"up": 2700, "down": 2000, "right": 300}
    for route, count in counts.items():
        walk(model, route, count)
    assert said(model) == ["mode_0 born", "mode_1 born", "mode_2 born"]
    assert {route_of(mode): mode.n_trajectories for mode in model.modes} == counts
    assert len(model.replay_buffer.trajectories(True)) == 5000


def test_too_few_successes_change_nothing(two_routes):
    model = two_routes
    change_settings(model, modes={"min_size": 30})
    before = belongings(model)
    assert said(model) == [] and model.modes.names == ["mode_0", "mode_1"]
    assert all(same(before[name], belongings(model)[name]) for name in before)
    empty = planar_model()
    assert said(empty) == [] and len(empty.modes) == 0
    walk(empty, "up", 2, success=False)
    assert said(empty) == [] and len(empty.modes) == 0


def test_an_off_mode_success_is_a_failure_of_the_mode_it_was_told_to_follow(two_routes):
    model, buffer = two_routes, two_routes.replay_buffer
    walk(model, "up", 2)
    strayed, obedient = buffer.trajectories(True)[-2:]
    strayed.assigned_mode, obedient.assigned_mode = 0, 1
    assert said(model) == []
    indices = {mode.name: index for index, mode in enumerate(model.modes)}
    assert strayed.off_mode_success and strayed.mode == indices["mode_0"] and strayed in buffer.trajectories(success=False)
    assert (
        not obedient.off_mode_success and obedient.mode == indices["mode_1"] and obedient in buffer.trajectories(success=True)
    )
    # It begins at the common start and then leads away from the route down
    off_route = buffer.off_route[strayed.rows]
    assert not off_route[0] and off_route[3:].all() and not buffer.off_route[obedient.rows].any()
    assert said(model) == [] and strayed.mode == {mode.name: i for i, mode in enumerate(model.modes)}["mode_0"]


def test_a_route_that_was_found_against_orders_is_a_mode(two_routes):
    """All of its trajectories were told to follow another mode: as off-mode successes they would leave it without any."""
    model, buffer = two_routes, two_routes.replay_buffer
    walk(model, "right", 4)
    discoverers = buffer.trajectories(True)[-4:]
    for trajectory in discoverers:
        trajectory.assigned_mode = 0
    assert said(model) == ["mode_2 born"]
    assert model.modes["mode_2"].n_trajectories == 4 and not any(trajectory.off_mode_success for trajectory in discoverers)
    # From now on it is known, and who takes it against orders strays
    walk(model, "right", 1)
    (strayed,) = buffer.trajectories(True)[-1:]
    strayed.assigned_mode = 0
    walk(model, "right", 1)
    buffer.trajectories(True)[-1].assigned_mode = 77  # a mode that has ended
    fill(buffer, [np.linspace((0, 0), (-6, 6), 7, dtype=np.float32)])  # an outlier
    assert said(model) == [] and strayed.off_mode_success
    assert [trajectory for trajectory in buffer.trajectories(False) if trajectory.off_mode_success] == [strayed]


def test_what_was_off_the_route_of_a_mode_that_has_ended(two_routes):
    """It is a success like any other again; and failures go to the mode that is nearest now."""
    model, buffer = two_routes, two_routes.replay_buffer
    walk(model, "up", 3)
    walk(model, "up", 2, success=False, part=0.7)
    strayed, failed = buffer.trajectories(True)[-3:], buffer.trajectories(False)[-2:]
    for trajectory in (*strayed, *failed):
        trajectory.assigned_mode = 0
    assert said(model) == []
    down = model.modes.index("mode_0")
    assert all(t.mode == down for t in (*strayed, *failed)) and all(t.off_mode_success for t in strayed)
    model.modes["mode_0"].misses = model.mode_settings.trials
    assert said(model) == ["mode_0 retired"] and model.modes.names == ["mode_1"]
    assert not any(t.off_mode_success or buffer.off_route[t.rows].any() for t in strayed)
    assert all(t in buffer.trajectories(True) and t.mode == 0 for t in strayed) and model.modes[0].n_trajectories == 7
    assert all(t.mode == 0 for t in failed)


def test_a_mode_is_shown_the_newest_failures(two_routes):
    """Successes off its route among them, in order of finishing."""
    model, buffer = two_routes, two_routes.replay_buffer
    buffer.max_failures_per_mode = 4
    for _ in range(3):
        walk(model, "up", 1, success=False, part=0.7)
        walk(model, "down", 1)
        buffer.trajectories(True)[-1].assigned_mode = 1
    newest = buffer.trajectories(False)[-2:], buffer.trajectories(True)[-2:]
    model.recluster()
    up = model.modes.index("mode_1")
    assert {t.serial for t in buffer.trajectories(False) if t.mode == up} == {t.serial for part in newest for t in part}


def test_what_a_dormant_mode_finds_is_its_own(two_routes):
    """As after loading a model without its buffer; "up" has been found again, "down" not yet."""
    model = two_routes
    model.replay_buffer.reset()
    model.replay_buffer.expect_modes(2)
    walk(model, "up", 4)
    assert said(model) == [] and {mode.name: route_of(mode) for mode in model.modes} == {
        "mode_0": "down",
        "mode_1": "up",
    }
    walk(model, "up", 6)
    assert said(model) == [] and model.modes["mode_1"].n_trajectories == 10
    walk(model, "down", 3)
    assert said(model) == []
    assert {mode.name: mode.n_trajectories for mode in model.modes} == {"mode_0": 3, "mode_1": 10}
    assert {mode.name: route_of(mode) for mode in model.modes} == {"mode_0": "down", "mode_1": "up"}


# ---------------------------------------------------------------------- who drives which episode


def test_rotation_and_exploration_share(two_routes):
    model = two_routes
    np.random.seed(0)

    def shares(progress_remaining, n=3000):
        model._current_progress_remaining = progress_remaining
        counts = Counter(model.scheduler.draw(model._exploration_share()) for _ in range(n))
        exploring = counts.pop(EXPLORATORY_GROUP, 0)
        if counts:
            # The modes and the zero embedding take turns
            assert counts.keys() == {UNCONDITIONED, 1, 2} and max(counts.values()) - min(counts.values()) <= 1
        return exploring / n

    model.num_timesteps = model.learning_starts
    change_settings(model, exploration={"fraction": 0.7})
    assert shares(1.0) == pytest.approx(1 / 3, abs=0.04) and shares(0.31) == pytest.approx(1 / 3, abs=0.04)
    assert shares(0.29) == 0.0  # after the fraction
    change_settings(model, exploration={"share": 0.6})
    assert shares(0.0) == pytest.approx(0.6, abs=0.04)
    change_settings(model, exploration={"share": lambda progress_remaining: progress_remaining / 2})
    assert shares(1.0) == pytest.approx(0.5, abs=0.04) and shares(0.2) == pytest.approx(0.1, abs=0.03)
    model.mode_manager.modes = []
    assert shares(0.0) == 1.0  # nothing but exploration is left


@pytest.mark.parametrize("explored", [False, True])
def test_a_trajectory_belongs_to_the_mode_that_was_followed_last(two_routes, explored):
    model, scheduler = two_routes, two_routes.scheduler
    scheduler.groups[:], scheduler.handed_over[:], scheduler.explored[:] = 2, True, explored
    model._last_obs = model._last_original_obs = model.env.reset()
    n_outcomes = len(model.modes[1].outcomes)
    action, reward = np.zeros((1, *model.action_space.shape), dtype=np.float32), np.zeros(1)
    model._store_transition(model.replay_buffer, action, model._last_obs, reward, np.ones(1, dtype=bool), [{}])
    (trajectory,) = model.replay_buffer.trajectories(False)
    assert trajectory.assigned_mode == (None if explored else model.modes[1].number)
    assert len(model.modes[1].outcomes) == n_outcomes and not scheduler.handed_over.any()


def test_exploring_episodes_take_as_long_as_a_mode(two_routes):
    model, asked = two_routes, []
    model.scheduler.hand_over = lambda probability: asked.append(probability)
    model._sample_action(learning_starts=0)
    mean_length = np.mean([mode.mean_length for mode in model.modes])
    assert asked == [pytest.approx(1 / mean_length)]


@pytest.mark.parametrize("hand_over", [0.0, 0.5, 1.0])
def test_success_rates_are_those_of_commanded_episodes(hand_over):
    """Counted by hand while the model trains: episodes that followed one mode from their beginning."""
    model = small_model(DummyVecEnv([TwoEnds] * 3), exploration={"share": 0.4, "hand_over": hand_over})
    followed, outcomes = [[] for _ in range(3)], {}

    def watch(local_variables, _):
        names = {index + 1: mode.name for index, mode in enumerate(model.modes)}
        warm_up = model.num_timesteps - 3 < model.learning_starts
        for env in range(3):
            group = int(model.scheduler.groups[env])
            began_exploring = warm_up or model.scheduler.handed_over[env]
            followed[env].append("nobody" if began_exploring else names.get(group, group))
            if local_variables["dones"][env]:
                if len(set(followed[env])) == 1 and followed[env][0] in names.values():
                    success = bool(local_variables["infos"][env]["is_success"])
                    outcome = Outcome(success, float(success), len(followed[env]))
                    outcomes.setdefault(followed[env][0], []).append(outcome)
                followed[env].clear()
        return True

    model.learn(700, callback=watch)
    assert len(model.modes) >= 2 and sum(len(rates) for rates in outcomes.values()) > 20
    for mode in model.modes:
        assert list(mode.outcomes) == outcomes.get(mode.name, [])[-100:]


@pytest.mark.parametrize("gone", [{"switch_modes": 0.5}, {"min_return_ratio": 0.39}])
def test_what_no_model_does_any_more_is_told(gone):
    """No episode that follows a mode goes on with another one; no mode is left out because it returns too little."""
    with pytest.raises(TypeError, match=f"{next(iter(gone))}=.* is no argument any more: "):
        small_model(TwoEnds(), **gone)
    small_model(TwoEnds(), **dict.fromkeys(gone, 0.0))  # which was the default


def test_random_actions_are_nobodys_doing():
    model = small_model(DummyVecEnv([TwoEnds] * 3), learning_starts=400, recluster_freq=2)
    model.learn(390)
    assert len(model.modes) >= 1 and not any(mode.outcomes for mode in model.modes)
    assert not any(t.assigned_mode for success in (True, False) for t in model.replay_buffer.trajectories(success))


def test_a_second_run_explores_again():
    model = small_model(
        DummyVecEnv([TwoEnds] * 8), learning_starts=0, exploration={"share": lambda remaining: float(remaining > 0.5)}
    )
    model.learn(400)
    assert len(model.modes) >= 1 and (model.scheduler.groups != EXPLORATORY_GROUP).all()
    model._setup_learn(400)
    assert (model.scheduler.groups == EXPLORATORY_GROUP).all()
