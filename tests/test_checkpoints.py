"""A run that was killed goes on from its last checkpoint, and nothing tells it from one that was not."""

import os
import signal
import threading
import time

import numpy as np
import pytest
import torch as th
from environments import SMALL, TwoEnds, assert_same_state, state_of
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize
from test_resume import assert_same_buffer

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.checkpoints import RunCheckpointCallback, checkpoint_files
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.rng import global_rng, restore_generator, restore_global_rng

END = 560


class KnownEnds(TwoEnds):
    """``TwoEnds`` that can say where its episode is."""

    def state_dict(self):
        return {"x": self.x, "steps": self.steps, "random": self.np_random.bit_generator.state}

    def load_state_dict(self, state):
        self.x, self.steps = state["x"], state["steps"]
        restore_generator(self.np_random, state["random"])


def known_ends(n_envs=4):
    env = VecMonitor(DummyVecEnv([KnownEnds] * n_envs))
    env.seed(3)
    return env


def model_for(env, algorithm=DDiffPG, **changes):
    own = {name: value for name, value in SMALL.items() if algorithm is DDiffPG or name in ("learning_starts", "buffer_size")}
    model = algorithm("MlpPolicy", env, **(own | {"seed": 0, "policy_kwargs": {"net_arch": [16]}} | changes))
    return silent(model)


def silent(model):
    model.set_logger(Logger(None, []))
    return model


def outcome(model):
    """All that a run has come to."""
    random = global_rng()
    return {
        "names": getattr(getattr(model, "modes", None), "names", None),
        "events": str(getattr(model, "mode_history", "")),
        "steps": model.num_timesteps,
        "updates": model._n_updates,
        "numpy": (random["numpy_key"].tolist(), random["numpy_rest"]),
        "torch": random["torch"].tolist(),
        "python": random["python"],
        "observations": np.asarray(model._last_obs).tolist(),
        "infos": [(float(each["r"]), int(each["l"])) for each in model.ep_info_buffer],
        "cells": None if model.visits is None else sorted(model.visits._counts.items()),
    }


def assert_goes_on_the_same(make_env, folder, end=END, at=None, algorithm=DDiffPG, **changes):
    """Train with checkpoints; go on from some of them; everything is as in the run that made them."""
    whole = model_for(make_env(), algorithm, **changes)
    whole.learn(end, callback=RunCheckpointCallback(folder, save_freq=end // 8, keep=100))
    expected, state = outcome(whole), state_of(whole)
    files = checkpoint_files(folder)[::-1]
    assert len(files) == 8
    for path in files[:-1] if at is None else [files[i] for i in at]:
        np.random.seed(99)
        th.manual_seed(99)
        model = silent(algorithm.resume(path, make_env()))
        assert 0 < model.num_timesteps < end
        model.learn(end)
        assert outcome(model) == expected
        assert_same_state(state_of(model), state)
        if algorithm is DDiffPG:
            assert_same_buffer(model.replay_buffer, whole.replay_buffer)
    return whole


@pytest.mark.parametrize("seed", range(5))
def test_exactly(tmp_path, seed):
    """Through the births of modes, re-clusterings and episodes in progress."""
    whole = assert_goes_on_the_same(known_ends, tmp_path, seed=seed, novelty="rnd" if seed % 2 else "counts")
    born = [event.step for event in whole.mode_history if event.kind in ("born", "split from")]
    assert len(whole.modes) == 2 and min(born) > END // 8  # so that some checkpoints lie before, some after


def test_with_a_full_buffer_and_wrappers(tmp_path):
    def make_env():
        env = DummyVecEnv([lambda: Monitor(KnownEnds())] * 2)
        env.seed(1)
        return VecNormalize(env, norm_reward=False)

    whole = assert_goes_on_the_same(make_env, tmp_path, buffer_size=150, at=(1, 4, 6))
    assert whole.replay_buffer.full


@pytest.mark.parametrize("name", sorted(BASELINES))
def test_baselines(tmp_path, name):
    assert_goes_on_the_same(known_ends, tmp_path, 160, (3,), BASELINES[name], learning_starts=40, batch_size=32)


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("PointMazeV1-v0", {"max_episode_steps": 15}),
        ("PointMazeRandom-v0", {"max_episode_steps": 15}),
        ("AntMazeRandom-v0", {"max_episode_steps": 15, "integrator": "euler"}),
        ("FrankaCabinetOpen-v0", {"max_episode_steps": 15}),
    ],
)
def test_our_environments(tmp_path, env_id, kwargs):
    made = []

    def make_env():
        made.append(make_vec_env(env_id, 3, seed=5, n_threads=2, **kwargs))
        return made[-1]

    assert_goes_on_the_same(make_env, tmp_path, 240, (1, 5), learning_starts=60, batch_size=16)
    for env in made:
        env.close()


def test_environments_that_cannot_be_saved_begin_new_episodes(tmp_path):
    env = DummyVecEnv([TwoEnds] * 4)
    model_for(env).learn(200, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    with pytest.warns(UserWarning, match="new episodes begin"):
        model = silent(DDiffPG.resume(tmp_path, env))
    assert model._last_obs is None
    assert model.learn(300).num_timesteps >= 300


def test_a_broken_checkpoint_is_passed_over(tmp_path):
    model_for(known_ends()).learn(400, callback=RunCheckpointCallback(tmp_path, save_freq=100, keep=2))
    newest, before = checkpoint_files(tmp_path)
    for break_it in (
        lambda raw: raw[: len(raw) // 2],
        lambda raw: raw[:-9] + bytes([raw[-9] ^ 1]) + raw[-8:],
        lambda raw: b"",
    ):
        raw = newest.read_bytes()
        newest.write_bytes(break_it(raw))
        with pytest.warns(UserWarning, match=newest.name):
            model = DDiffPG.resume(tmp_path, known_ends())
        assert model.num_timesteps == int(before.stem.split("_")[1])
        newest.write_bytes(raw)
    for path in (newest, before):
        path.write_bytes(b"nothing")
    with pytest.warns(UserWarning, match="Going on"), pytest.raises(ValueError, match="damaged"):
        DDiffPG.resume(tmp_path, known_ends())
    with pytest.raises(FileNotFoundError, match="no such"):
        DDiffPG.resume(tmp_path / "nowhere", known_ends())


def test_a_full_disk(tmp_path, monkeypatch):
    """What was there stays, and training goes on."""
    callback = RunCheckpointCallback(tmp_path, save_freq=100, keep=1)
    model = model_for(known_ends())
    model.learn(120, callback=callback)
    (kept,), steps = checkpoint_files(tmp_path), model.num_timesteps

    def refuse(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.warns(UserWarning, match="No space left"):
        model.learn(120, callback=callback, reset_num_timesteps=False)
    assert model.num_timesteps >= 240 and list(tmp_path.iterdir()) == [kept]
    monkeypatch.undo()
    assert DDiffPG.resume(tmp_path, known_ends()).num_timesteps == steps


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_training_with_a_checkpoint(tmp_path, number):
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    model = model_for(known_ends())

    class Sends(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 200:
                signal.raise_signal(number)
            return True

    model.learn(400, callback=[Sends(), RunCheckpointCallback(tmp_path, save_freq=10_000)])
    assert {each: signal.getsignal(each) for each in before} == before
    resumed = silent(DDiffPG.resume(tmp_path, known_ends()))
    assert 200 <= resumed.num_timesteps < 220
    resumed.learn(400)
    whole = model_for(known_ends())
    whole.learn(400)
    assert outcome(resumed) == outcome(whole)


def test_a_second_interrupt_is_not_patient(tmp_path):
    model = model_for(known_ends())

    class Sends(BaseCallback):
        def _on_step(self):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            return True

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        model.learn(400, callback=[Sends(), RunCheckpointCallback(tmp_path)])
    assert signal.getsignal(signal.SIGINT) is before


def test_a_second_learn_goes_on_where_it_was(tmp_path):
    """The interrupted call is repeated as it was."""
    whole = model_for(known_ends())
    whole.learn(100)
    whole.learn(200, callback=RunCheckpointCallback(tmp_path, save_freq=90, keep=9), reset_num_timesteps=False)
    resumed = silent(DDiffPG.resume(checkpoint_files(tmp_path)[-1], known_ends()))
    assert 100 < resumed.num_timesteps < 200
    resumed.learn(200, reset_num_timesteps=False)
    assert outcome(resumed) == outcome(whole)
    resumed.learn(50, reset_num_timesteps=False)  # a call like any other
    assert 350 <= resumed.num_timesteps < 400


def test_only_the_newest_stay(tmp_path):
    model_for(known_ends()).learn(400, callback=RunCheckpointCallback(tmp_path, save_freq=50, keep=3))
    steps = [int(path.stem.split("_")[1]) for path in checkpoint_files(tmp_path)]
    assert steps == [400, 352, 304]


def test_arguments(tmp_path):
    for name in ("save_freq", "keep"):
        with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
            RunCheckpointCallback(tmp_path, **{name: 0})


def test_no_reader_sees_half_a_file(tmp_path):
    """While one is written again and again, whoever reads finds a whole one."""
    model = model_for(known_ends())
    model.learn(100)
    path = tmp_path / "model.safetensors"
    model.export(path)
    stop = threading.Event()
    seen = []

    def look():
        while not stop.is_set():
            seen.append(DDiffPG.load(path, safe=True).num_timesteps)

    thread = threading.Thread(target=look)
    thread.start()
    until = time.monotonic() + 1
    while time.monotonic() < until:
        model.export(path)
    stop.set()
    thread.join()
    assert seen and set(seen) == {model.num_timesteps}


def test_a_new_run_keeps_its_checkpoint_beside_those_of_a_longer_one(tmp_path):
    model_for(known_ends()).learn(400, callback=RunCheckpointCallback(tmp_path, save_freq=100, keep=2))
    model_for(known_ends(), seed=5).learn(250, callback=RunCheckpointCallback(tmp_path, save_freq=100, keep=2))
    assert max(int(path.stem.split("_")[1]) for path in checkpoint_files(tmp_path)) < 300


def test_a_random_state_that_numpy_would_crash_with_is_refused():
    state = global_rng()
    state["torch"] = state["torch"].numpy()
    for position in (-1, 625, 2**30):
        with pytest.raises(ValueError, match="accepted are 0 to 624"):
            restore_global_rng({**state, "numpy_rest": [position, *state["numpy_rest"][1:]]})
