"""A run that was saved goes on as if nothing had happened; without its buffer, it still knows its modes."""

import pickle
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from environments import (
    AnySpaces,
    TwoEnds,
    assert_no_gaps,
    assert_same_state,
    change_settings,
    small_model,
    some_observations,
    state_of,
)
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG, Mode, ModeReplayBuffer
from sb3_ddiffpg.buffers.trajectory import NO_MODE


def two_ends(n_envs=4):
    return DummyVecEnv([TwoEnds] * n_envs)


def silent(model, like):
    model.set_logger(like.logger)
    return model


@pytest.fixture(params=["rnd", "counts"])
def saved(request, tmp_path):
    """A model in the middle of its run, and where it was saved with its buffer."""
    model = small_model(two_ends(), novelty=request.param, modes={"novelty_coef": 0.1})
    model.learn(330)
    assert len(model.modes) == 2 and model.replay_buffer.running.lengths.any()
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    return model, tmp_path


def contents(buffer):
    """All that the buffer knows, as plain arrays and tuples."""
    rows = np.sort(buffer.stored_rows.rows[: buffer.size()])
    names = ("observations", "next_observations", "actions", "target_actions", "exploratory_target_actions", "rewards")
    arrays = {name: getattr(buffer, name)[rows] for name in names}
    trajectories = [
        (t.serial, t.mode, t.success, t.episode_return, t.rows.tolist())
        for success in (True, False)
        for t in buffer.trajectories(success)
    ]
    return {"rows": rows, **arrays}, trajectories, [row_set.rows[: row_set.size].tolist() for row_set in buffer.mode_rows]


def assert_same_buffer(first, second):
    arrays, *rest = contents(first)
    other_arrays, *other_rest = contents(second)
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, other_arrays[name], err_msg=name)
    assert rest == other_rest


def test_next_updates_and_clusterings_are_the_same_bits(saved):
    model, folder = saved
    loaded = silent(DDiffPG.load(folder / "model", env=two_ends()), model)
    loaded.load_replay_buffer(folder / "buffer")
    outcomes = []
    for each in (model, loaded):
        set_random_seed(7)
        each.train(3, batch_size=32)
        updated = state_of(each)
        events = each.recluster()
        each.train(2, batch_size=32)
        outcomes.append((updated, events, each.modes.names, [mode.mean_length for mode in each.modes], state_of(each)))
    first, second = outcomes
    assert_same_state(first[0], second[0])
    assert first[1:4] == second[1:4]
    assert_same_state(first[4], second[4])
    assert_same_buffer(model.replay_buffer, loaded.replay_buffer)
    assert any(not th.equal(first[0][name], first[4][name]) for name in first[0])


def test_the_whole_run_goes_on_the_same(saved):
    """Environments, episodes in progress and all that drives them included."""
    model, folder = saved
    loaded = DDiffPG.load(folder / "model", env=deepcopy(model.get_env()), force_reset=False)
    loaded.load_replay_buffer(folder / "buffer", truncate_last_traj=False)
    for each in (model, loaded):
        set_random_seed(7)
        silent(each, model).learn(120, reset_num_timesteps=False)
    assert_same_state(state_of(model), state_of(loaded))
    assert_same_buffer(model.replay_buffer, loaded.replay_buffer)
    assert model.modes.names == loaded.modes.names and model.num_timesteps == loaded.num_timesteps


def test_episodes_in_progress_do_not_go_on_in_other_environments(saved):
    model, folder = saved
    loaded = silent(DDiffPG.load(folder / "model", env=two_ends()), model)
    loaded.load_replay_buffer(folder / "buffer")
    running = int(loaded.replay_buffer.running.lengths.sum())
    finished = loaded.replay_buffer.size() - running
    loaded.learn(1, reset_num_timesteps=False)
    assert loaded.replay_buffer.size() == finished + 16  # one rollout
    loaded.learn(100, reset_num_timesteps=False)
    assert_no_gaps(loaded.replay_buffer)


def test_an_older_buffer_of_the_same_model(saved):
    """Between the moment it was saved and now, the environments went on."""
    model, folder = saved
    change_settings(model, modes={"patience": 1000})
    model.learn(50, reset_num_timesteps=False)
    model.load_replay_buffer(folder / "buffer")
    model.learn(50, reset_num_timesteps=False)
    assert_no_gaps(model.replay_buffer)


def test_a_stopped_run_goes_on_without_a_gap():
    """SB3 does not store the step at which a callback stops it (its issue 2056)."""
    model = small_model(two_ends(2))
    for stop_at in (30, 62, 94):
        model.learn(200, callback=lambda _, __, at=stop_at: model.num_timesteps < at, reset_num_timesteps=False)
    model.learn(100, reset_num_timesteps=False)
    assert_no_gaps(model.replay_buffer)


def ends(model):
    """Where the representative of each mode ends: left (-1) or right (1)."""
    return {mode.name: np.sign(mode.representative[-1, 0]) for mode in model.modes}


def test_without_the_buffer_modes_wait_until_they_find_themselves_again(saved):
    model, folder = saved
    loaded = silent(DDiffPG.load(folder / "model", env=two_ends()), model)
    assert loaded.modes.names == model.modes.names and ends(loaded) == ends(model)
    for mode in (None, *model.modes.names):
        expected, _ = model.predict(some_observations(), deterministic=True, mode=mode)
        np.testing.assert_array_equal(loaded.predict(some_observations(), deterministic=True, mode=mode)[0], expected)
    # Nothing was stored yet: there is nothing to cluster, and no mode to lose
    assert loaded.recluster() == [] and loaded.modes.names == model.modes.names
    # Updates go on before the first clustering, of the exploratory group alone
    loaded.learn(12, reset_num_timesteps=False)
    assert loaded.replay_buffer.sample_modes(32, 0.9, 1, 1).active.tolist() == [True, False, False]
    assert all(th.isfinite(value).all() for value in state_of(loaded).values())
    loaded.learn(400, reset_num_timesteps=False)
    assert {name: side for name, side in ends(loaded).items() if name in model.modes.names} == ends(model)
    assert loaded.replay_buffer.sample_modes(32, 0.9, 1, 1).active.all()


def test_new_modes_of_a_resumed_run_get_names_of_their_own(saved):
    model, folder = saved
    loaded = silent(DDiffPG.load(folder / "model", env=two_ends()), model)
    taken = {f"mode_{number}" for number in range(loaded.mode_manager.next_number)}
    assert set(model.modes.names) <= taken
    # One route, twice as far as any before: nothing of the old modes
    for _ in range(4):
        for k in range(4):
            obs = np.full((4, 2), 10.0 * k, dtype=np.float32)
            loaded.replay_buffer.add(
                obs, obs + 10, np.zeros((4, 1)), np.ones(4), np.full(4, k == 3), [{"is_success": True}] * 4
            )
    loaded.recluster()
    assert all(name in taken or int(name.removeprefix("mode_")) >= len(taken) for name in loaded.modes.names)
    assert set(model.modes.names) <= set(loaded.modes.names)


@pytest.mark.parametrize("max_modes", [1, 2, 3])
def test_waiting_modes_count(max_modes, tmp_path):
    """Modes without data and new clusters together stay below ``max_modes``, for which the batch is laid out."""
    model = small_model(two_ends(), modes={"max_modes": max_modes}, batch_size=max_modes + 1)
    model.learn(330)
    n_modes = len(model.modes)
    model.save(tmp_path / "model")
    loaded = silent(DDiffPG.load(tmp_path / "model", env=two_ends()), model)
    for _ in range(10):  # two ways, both nearest to the same waiting mode
        ends = np.array([[5.0, 0.0], [40.0, 0.0]] * 2, dtype=np.float32)
        loaded.replay_buffer.add(0 * ends, ends, np.zeros((4, 1)), np.ones(4), np.ones(4, dtype=bool), [{"success": True}] * 4)
        loaded.recluster()
        assert n_modes <= len(loaded.modes) <= max_modes
    loaded.learn(100)
    assert all(th.isfinite(value).all() for value in state_of(loaded).values())


# ---------------------------------------------------------------------- what does not fit together


def other_buffers(tmp_path, run_id):
    other = small_model(two_ends())
    other.learn(40)
    other.save_replay_buffer(tmp_path / "no_modes")
    other.learn(360)
    assert len(other.modes) == 2
    other.save_replay_buffer(tmp_path / "other_modes")
    same_run = small_model(two_ends(), mode_features=[0, 1])
    same_run.run_id = run_id
    same_run.save_replay_buffer(tmp_path / "other_features")
    space = AnySpaces().observation_space
    plain = ReplayBuffer(10, space, AnySpaces().action_space)
    for name, content in (("plain", plain), ("junk", [1, 2, 3])):
        (tmp_path / f"{name}.pkl").write_bytes(pickle.dumps(content))
    return {
        "no_modes": (ValueError, "was not saved by this model: its modes are others"),
        "other_modes": (ValueError, "was not saved by this model: its modes are others"),
        "other_features": (ValueError, r"was filled with mode_features=\[0 1\], not \[0\]"),
        "plain": (ValueError, "is a ReplayBuffer, not a ModeReplayBuffer"),
        "junk": (ValueError, "is a list, not a ModeReplayBuffer"),
    }


def test_a_buffer_that_does_not_fit_is_refused_and_the_old_one_stays(trained, tmp_path):
    trained.save(tmp_path / "model")
    model = DDiffPG.load(tmp_path / "model", env=two_ends())
    before = model.replay_buffer
    for name, (error, message) in other_buffers(tmp_path, model.run_id).items():
        with pytest.raises(error, match=message):
            model.load_replay_buffer(tmp_path / name)
        assert model.replay_buffer is before
    with pytest.raises(FileNotFoundError):
        model.load_replay_buffer(tmp_path / "nothing")
    assert model.replay_buffer is before


def test_a_model_without_modes_takes_any_buffer(trained, tmp_path):
    trained.save_replay_buffer(tmp_path / "buffer")
    model = small_model(two_ends())
    model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.size() > 0 and not model.replay_buffer.mode_rows
    model.recluster()
    assert len(model.modes) == 2


def test_the_settings_of_the_model_stay(trained, tmp_path):
    trained.save(tmp_path / "model")
    trained.save_replay_buffer(tmp_path / "buffer")
    model = DDiffPG.load(tmp_path / "model", env=two_ends(), modes={"max_successes": 4}, success_key="nowhere")
    silent(model, trained)
    model.load_replay_buffer(tmp_path / "buffer")
    model.recluster()
    assert [mode.n_trajectories for mode in model.modes] == [4, 4]
    with pytest.warns(UserWarning, match="success_key='nowhere'"):
        model.learn(100, reset_num_timesteps=False)


def test_trajectories_follow_their_modes(saved):
    """The buffer was saved later than the model: by then the modes had other numbers, and one more was known."""
    model, folder = saved
    route = {mode.name: np.sign(mode.representative[-1, 0]) for mode in model.modes}
    later = DDiffPG.load(folder / "model", env=two_ends())
    later.load_replay_buffer(folder / "buffer")
    improved = later.replay_buffer.target_actions.copy()
    later.mode_manager.modes = [later.mode_manager.modes[1], Mode(9, "mode_9", born_at=7), later.mode_manager.modes[0]]
    later.replay_buffer.follow_modes([2, 0], [mode.number for mode in later.mode_manager.modes])
    strayed = later.replay_buffer.trajectories(False)[-1]
    strayed.assigned_mode = 9
    later.save_replay_buffer(folder / "later")
    loaded = DDiffPG.load(folder / "model", env=two_ends())
    loaded.load_replay_buffer(folder / "later")
    buffer = loaded.replay_buffer
    assert len(buffer.mode_rows) == 2 and all(rows.size for rows in buffer.mode_rows)
    for trajectory in buffer.trajectories(True):
        if trajectory.mode != NO_MODE:
            assert np.sign(buffer.full_path(trajectory)[-1, 0]) == route[loaded.modes[trajectory.mode].name]
    np.testing.assert_array_equal(buffer.target_actions, improved)
    # The next mode is not taken for the one whose name only the file knows
    assert 9 not in {t.assigned_mode for success in (True, False) for t in buffer.trajectories(success)}
    assert loaded.mode_manager.next_number == 10


def test_a_buffer_for_another_number_of_environments_is_refused(trained, tmp_path):
    trained.save(tmp_path / "model")
    trained.save_replay_buffer(tmp_path / "buffer")
    model = DDiffPG.load(tmp_path / "model", env=two_ends(3))
    model.load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=r"replay buffer was made for 4 environment\(s\), got 3"):
        model.learn(10)


# ---------------------------------------------------------------------- parameters in place


def test_parameters_of_a_model_with_more_modes(trained):
    model = small_model(two_ends(), novelty="rnd")
    model.set_parameters(trained.get_parameters())
    assert_same_state(state_of(model), state_of(trained))
    assert len(model.modes) == 2 and len(set(model.modes.names)) == 2
    for index in range(2):
        expected, _ = trained.predict(some_observations(), deterministic=True, mode=index)
        np.testing.assert_array_equal(model.predict(some_observations(), deterministic=True, mode=index)[0], expected)
    assert "mode" in str(model.modes)
    model.learn(400)
    assert isinstance(model.replay_buffer, ModeReplayBuffer) and len(model.replay_buffer.mode_rows) == len(model.modes) >= 2


def test_parameters_of_a_model_with_fewer_modes(trained, tmp_path):
    untrained = small_model(two_ends(), novelty="rnd")
    model = small_model(two_ends(), novelty="rnd")
    model.learn(400)
    assert len(model.modes) >= 2
    n_stored = model.replay_buffer.size()
    untrained.save(tmp_path / "untrained")
    model.set_parameters(tmp_path / "untrained")
    assert len(model.modes) == 0 and model.replay_buffer.size() == n_stored
    assert_same_state(state_of(model), state_of(untrained))
    # Its trajectories are clustered anew; a name is never used twice
    old = set(f"mode_{number}" for number in range(model.mode_manager.next_number))
    model.learn(100, reset_num_timesteps=False)
    assert len(model.modes) >= 1 and not old & set(model.modes.names)
