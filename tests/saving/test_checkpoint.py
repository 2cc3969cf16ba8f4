"""A run that was killed goes on from its last checkpoint, and nothing tells it from one that was not."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch as th
from environments import SMALL, KnownEnds, TwoEnds, assert_same_state, copied, merged, state_of
from filelock import FileLock
from gymnasium import spaces
from rl_zoo3 import gym_patches
from stable_baselines3.common.callbacks import (
    BaseCallback,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize
from test_resume import assert_same_buffer

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.callbacks.checkpoint import RunCheckpointCallback
from sb3_ddiffpg.common.schedules import LateLinearSchedule
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.envs.snapshots import env_snapshot, restore_env, restore_vec_env, vec_env_snapshot
from sb3_ddiffpg.saving.checkpoint import KIND, checkpoint_files
from sb3_ddiffpg.serialization.random_states import global_rng, restore_global_rng
from sb3_ddiffpg.serialization.safetensors_tree import read, write

END = 560


def known_ends(n_envs=4):
    env = VecMonitor(DummyVecEnv([KnownEnds] * n_envs))
    env.seed(3)
    return env


def model_for(env, algorithm=DDiffPG, **changes):
    own = {name: value for name, value in SMALL.items() if algorithm is DDiffPG or name in ("learning_starts", "buffer_size")}
    model = algorithm("MlpPolicy", env, **merged(own, {"seed": 0, "policy_kwargs": {"net_arch": [16]}}, changes))
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
        "measured": (str(model.bonus.grid.edges), str(model.value_range.state_dict()), model.next_review),
        "features": (str(model.resolved_features), model.features_found, model.features_settled),
        "news": (model.scheduler.news_at, model.scheduler.n_cells) if hasattr(model, "scheduler") else None,
    }


def assert_goes_on_the_same(make_env, folder, end=END, at=None, algorithm=DDiffPG, **changes):
    """Train with checkpoints; go on from some of them; everything is as in the run that made them."""
    whole = model_for(make_env(), algorithm, **changes)
    whole.learn(end, callback=RunCheckpointCallback(folder, save_freq=end // 8, keep=100))
    expected, state = outcome(whole), state_of(whole)
    files = checkpoint_files(folder)[::-1]
    assert len(files) == 9
    for path in files[:-1] if at is None else [files[i + 1] for i in at]:
        np.random.seed(99)
        th.manual_seed(99)
        model = silent(algorithm.resume(path, make_env()))
        assert model.num_timesteps < end
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


class NothingDeclared(KnownEnds):
    """Of which nobody says where modes differ, in which unit, or what a goal is worth."""

    def __init__(self):
        super().__init__()
        del self.mode_features, self.cell_size, self.novelty_cell_size
        self.observation_space = spaces.Box(-np.inf, np.inf, (5,))
        self.last = 0.0

    def _observation(self):
        speed, self.last = self.x - self.last, self.x
        return np.array([1e3 * self.x, self.steps / self.limit, 2.0, speed, self.steps % 2], dtype=np.float32)

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, 100.0 * reward - 1.0, *rest

    def state_dict(self):
        return {**super().state_dict(), "last": self.last}

    def load_state_dict(self, state):
        super().load_state_dict({name: each for name, each in state.items() if name != "last"})
        self.last = state["last"]


@pytest.mark.parametrize("algorithm", [DDiffPG, BASELINES["sac_c51"]])
def test_where_everything_follows_what_is_met(tmp_path, algorithm):
    """Ranges of values, cells, mode features and inputs are measured on the way, also between two checkpoints."""
    env = partial(DummyVecEnv, [NothingDeclared] * 4)
    critic = {} if algorithm is DDiffPG else {"critic": {"v_min": -100.0, "v_max": 100.0}}
    whole = assert_goes_on_the_same(env, tmp_path, at=(0, 2, 4, 6), algorithm=algorithm, **critic)
    assert whole.features_found and 0 in whole.resolved_features and 2 not in whole.resolved_features
    assert whole.bonus.grid.adapts and whole.next_review > END
    if algorithm is DDiffPG:
        assert whole.value_range.low < 0 < 90 < whole.value_range.high and 0 < whole.scheduler.news_at <= END
        assert whole.scheduler.n_cells > 0


def test_past_known_routes(tmp_path, monkeypatch):
    """Where an episode has come along a route after its first steps, some have at most checkpoints."""
    monkeypatch.setattr("sb3_ddiffpg.exploration.known_regions.SHARE_GONE", 0.2)
    whole = assert_goes_on_the_same(known_ends, tmp_path, exploration={"past_modes": False})
    assert (whole.replay_buffer.followed[whole.replay_buffer.stored_rows.rows[: whole.replay_buffer.size()]] >= 0).any()
    resumed = [DDiffPG.resume(path, known_ends()).bonus.routes for path in checkpoint_files(tmp_path)]
    assert sum((known.followed >= 0).any() for known in resumed) >= 2


def test_with_a_full_buffer_and_wrappers(tmp_path):
    def make_env():
        env = DummyVecEnv([lambda: Monitor(KnownEnds())] * 2)
        env.seed(1)
        return VecNormalize(env, norm_reward=False)

    whole = assert_goes_on_the_same(make_env, tmp_path, buffer_size=150, at=(1, 4, 6))
    assert whole.replay_buffer.full


class KnownGoals(KnownEnds):
    """That go on at a goal, which is told only there; from far beyond it the point returns to the middle. ``ends``: ever."""

    def __init__(self, ends=True):
        super().__init__(limit=13)
        self.ends = ends

    def _observation(self):
        return super()._observation() % 2

    def step(self, action):
        observation, reward, reached, truncated, _ = super().step(action)
        if abs(self.x) > 1.5:
            self.x = 0.0
        if not self.ends:
            self.steps %= 99
        return observation, reward, False, truncated and self.ends, {"is_success": True, "mode": "there"} if reached else {}


@pytest.mark.parametrize("ends", [True, False])
def test_past_goals_and_in_parts(tmp_path, monkeypatch, ends):
    """Where an episode has passed its goal at a checkpoint, or so long ago that the buffer has no trace of it."""
    monkeypatch.setattr("sb3_ddiffpg.exploration.known_regions.SHARE_GONE", 0.2)
    settings = {} if ends else {"buffer_size": 150, "exploration": {"past_modes": False, "fraction": 1.0}}
    whole = assert_goes_on_the_same(lambda: DummyVecEnv([lambda: KnownGoals(ends)] * 2), tmp_path, at=(1, 4, 6), **settings)
    assert whole.replay_buffer.groups.past_goals()
    resumed = [DDiffPG.resume(path, DummyVecEnv([lambda: KnownGoals(ends)] * 2)) for path in checkpoint_files(tmp_path)]
    assert sum(each.replay_buffer.success_rule.goal_steps.any() for each in resumed) >= 2
    assert (len(resumed[0].bonus._in_parts) == 2) == (not ends)


# So that what each counts makes a difference
COUNTING = {"diffusion_ql": {"average_start": 5}, "td3_c51": {"policy_delay": 2, "actor_tau": 0.1}}


@pytest.mark.parametrize("name", sorted(BASELINES))
def test_baselines(tmp_path, name):
    settings = {"learning_starts": 40, "batch_size": 32, **COUNTING.get(name, {})}
    assert_goes_on_the_same(known_ends, tmp_path, 160, (2, 3), BASELINES[name], **settings)


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
    if env_id.startswith("Franka"):
        pytest.importorskip("pybullet")
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
    assert model.num_timesteps >= 240 and list(tmp_path.glob("[!.]*")) == [kept]
    monkeypatch.undo()
    assert DDiffPG.resume(tmp_path, known_ends()).num_timesteps == steps


class HoldsAnything(TwoEnds):
    """Its state can be saved for so many steps."""

    def __init__(self, n_steps):
        super().__init__()
        self.left = n_steps

    def step(self, action):
        self.left -= 1
        return super().step(action)

    def state_dict(self):
        return {"left": object() if self.left <= 0 else self.left}

    def load_state_dict(self, state):
        self.left = state["left"]


def test_what_cannot_be_saved_is_said_before_the_first_step(tmp_path):
    model = model_for(DummyVecEnv([lambda: HoldsAnything(0)]))
    with pytest.raises(TypeError, match="left: <object object .* cannot be saved"):
        model.learn(100, callback=RunCheckpointCallback(tmp_path))
    assert model.num_timesteps == 0 and not checkpoint_files(tmp_path)
    # Nor does a file that is there already make it go unnoticed
    model = model_for(known_ends())
    model.learn(100, callback=RunCheckpointCallback(tmp_path, save_freq=50))

    class Unsayable(RunCheckpointCallback):
        def state_dict(self):
            return {"what": object()}

    with pytest.raises(TypeError, match="what: <object object .* cannot be saved"):
        model.learn(100, callback=[RunCheckpointCallback(tmp_path), Unsayable(tmp_path / "other")], reset_num_timesteps=False)


def test_what_cannot_be_saved_later_does_not_end_the_training(tmp_path):
    model = model_for(DummyVecEnv([lambda: HoldsAnything(150)]))
    with pytest.warns(UserWarning, match="No checkpoint at step 200: .*left.*The ones before stay, training goes on"):
        model.learn(300, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    assert model.num_timesteps >= 300
    assert [int(each.stem.split("_")[1]) for each in checkpoint_files(tmp_path)] == [100, 0]


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


def test_a_copy_of_ones_own_is_not_the_newest(tmp_path):
    """Letters come after digits: a copy was taken for the newest, and the run went on behind it for ever."""
    callback = RunCheckpointCallback(tmp_path, save_freq=100)
    model_for(known_ends()).learn(200, callback=callback)
    copy = shutil.copy(checkpoint_files(tmp_path)[-1], tmp_path / "checkpoint_backup.safetensors")
    newest = checkpoint_files(tmp_path)[0]
    resumed = silent(DDiffPG.resume(tmp_path, known_ends()))
    assert newest.stem == f"checkpoint_{resumed.num_timesteps:012d}"
    resumed.learn(400, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    assert Path(copy).exists() and checkpoint_files(tmp_path)[0] > newest
    with pytest.raises(ValueError, match="holds a checkpoint that is further than step"):
        silent(DDiffPG.resume(copy, known_ends())).learn(400, callback=RunCheckpointCallback(tmp_path))


@pytest.mark.parametrize("rate", [LateLinearSchedule(1e-3), lambda progress: 1e-3 * progress], ids=["late", "own"])
def test_beyond_the_end_of_a_schedule(tmp_path, rate):
    """The last rollout goes there. The rate was below zero then, and no optimiser can be made with such a one."""
    model = model_for(known_ends(), learning_rate=rate)
    model.learn(401, callback=RunCheckpointCallback(tmp_path / "run"))
    rates = [group["lr"] for group in model.actor.optimizer.param_groups + model.critics.optimizer.param_groups]
    assert model.num_timesteps == 416 and rates == [0.0, 0.0]
    model.export(tmp_path / "model", optimizers=True)
    given = {"learning_rate": rate}
    assert DDiffPG.load(tmp_path / "model", safe=True, custom_objects=given).num_timesteps == 416
    tree = read(checkpoint_files(tmp_path / "run")[0], KIND)
    tree["model"]["parameters"]["actor.optimizer"]["groups"][0]["lr"] = -1e-5  # as older ones have it
    write(tmp_path / "older", KIND, tree)
    resumed = silent(DDiffPG.resume(tmp_path / "older", known_ends(), custom_objects=given))
    assert resumed.learn(800).num_timesteps == 800


def test_as_many_environments_as_the_run_had(tmp_path):
    model_for(known_ends()).learn(40, callback=RunCheckpointCallback(tmp_path))
    with pytest.raises(ValueError, match="env: 3 environments given; accepted are 4, as many as the run has"):
        DDiffPG.resume(tmp_path, known_ends(3))


def test_callbacks_that_hold_functions(tmp_path):
    called = []
    others = ConvertCallback(lambda local, all_: called.append(1) or True)
    model_for(known_ends()).learn(100, callback=[RunCheckpointCallback(tmp_path), others])
    assert called and checkpoint_files(tmp_path)


def test_rewards_of_a_long_episode_are_many(tmp_path, monkeypatch):
    """As plain values they would come to what a file may hold of those."""

    class Forever(KnownEnds):
        def step(self, action):
            observation, *_, info = super().step(action)
            self.x, self.steps = 0.0, 0
            return observation, float(self.np_random.uniform()), False, False, info

    def make_env():
        return DummyVecEnv([lambda: Monitor(Forever())] * 4)

    env = make_env().envs[0]
    env.reset(seed=0)
    env.rewards = [0.1, 0.2]
    state = env_snapshot(env)
    state["layers"][0]["values"]["rewards"] = [0.3, 0.4, 0.5]  # as older files have them
    restore_env(env, state)
    assert env.rewards == [0.3, 0.4, 0.5]
    monkeypatch.setattr("sb3_ddiffpg.serialization.safetensors_tree._LONGEST", 30_000)
    assert_goes_on_the_same(make_env, tmp_path, end=12_000, at=[6], learning_starts=20_000, train_freq=100, buffer_size=15_000)


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


def test_a_new_run_is_refused_beside_the_checkpoints_of_another(tmp_path):
    """The longer one would be taken for the newer one."""
    first = model_for(known_ends())
    first.learn(400, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    before = {path: path.read_bytes() for path in checkpoint_files(tmp_path)}
    with pytest.raises(ValueError, match="holds checkpoints of another run .*: resume that one, or name another folder"):
        model_for(known_ends()).learn(250, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    assert {path: path.read_bytes() for path in checkpoint_files(tmp_path)} == before
    first.learn(100, reset_num_timesteps=False, callback=RunCheckpointCallback(tmp_path, save_freq=100))


def test_what_a_killed_writer_left_is_swept_away(tmp_path):
    """But not what another process is about to finish, nor other files."""
    finished = subprocess.Popen([sys.executable, "-c", ""])
    finished.wait()
    left = tmp_path / f".checkpoint_000000000100.safetensors.{finished.pid}.abc"
    own = tmp_path / f".checkpoint_000000000200.safetensors.{os.getpid()}.abc"  # in a container all have the same number
    kept = [tmp_path / f".checkpoint_000000000200.safetensors.{os.getppid()}.abc", tmp_path / f".notes.{finished.pid}.abc"]
    for path in (left, own, *kept):
        path.mkdir()
        (path / "half").write_bytes(b"half")
    model_for(known_ends()).learn(50, callback=RunCheckpointCallback(tmp_path))
    assert not left.exists() and not own.exists() and all(path.exists() for path in kept)


def test_two_trainings_do_not_share_a_folder(tmp_path):
    """From one checkpoint both would remove what the other has come to. However the first ends, the folder is free again."""
    first, second = model_for(known_ends()), model_for(known_ends())

    class Intrudes(BaseCallback):
        def _on_step(self):
            with pytest.raises(ValueError, match="another training writes its checkpoints to"):
                second.learn(50, callback=RunCheckpointCallback(tmp_path))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first.learn(100, callback=[RunCheckpointCallback(tmp_path), Intrudes()])
    with FileLock(tmp_path / ".lock", blocking=False):
        pass


def test_what_is_further_than_the_run_is_not_written_over(tmp_path):
    """Who goes on from an older checkpoint would be overtaken by the newer one at the next ``resume``."""
    model_for(known_ends()).learn(400, callback=RunCheckpointCallback(tmp_path, save_freq=100, keep=10))
    older = checkpoint_files(tmp_path)[2]
    resumed = silent(DDiffPG.resume(older, known_ends()))
    with pytest.raises(ValueError, match="holds a checkpoint that is further than step"):
        resumed.learn(400, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    steps = resumed.num_timesteps
    for path in checkpoint_files(tmp_path)[:2]:
        path.unlink()
    # Refused once, it still goes on where it was
    resumed.learn(400, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    whole = model_for(known_ends())
    whole.learn(400)
    assert steps < 400 and outcome(resumed) == outcome(whole)


def test_a_damaged_one_that_is_further_goes_first(tmp_path):
    model = model_for(known_ends())
    model.learn(400, callback=RunCheckpointCallback(tmp_path, save_freq=100, keep=3))
    newest, *others = checkpoint_files(tmp_path)
    newest.write_bytes(b"damaged")
    for path in others:  # a clock that was set back
        os.utime(path, (0, 0))
    with pytest.warns(UserWarning, match="Going on with the checkpoint before it"):
        resumed = silent(DDiffPG.resume(tmp_path, known_ends()))
    resumed.learn(400, callback=[StopAt(resumed.num_timesteps + 20), RunCheckpointCallback(tmp_path, save_freq=10, keep=2)])
    kept = checkpoint_files(tmp_path)
    assert newest not in kept and len(kept) == 2 and not any("damaged" in str(path.read_bytes()[:20]) for path in kept)
    assert int(kept[0].stem[-12:]) == resumed.num_timesteps


class StopAt(BaseCallback):
    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        return self.num_timesteps < self.step


@pytest.mark.parametrize("kind", ["link", "folder", "pipe", "gone"])
def test_what_is_no_file_is_passed_over(tmp_path, monkeypatch, kind):
    model_for(known_ends()).learn(200, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    bad = tmp_path / "checkpoint_999999999999.safetensors"
    if kind == "link":
        bad.symlink_to(tmp_path / "nowhere")
    elif kind == "folder":
        bad.mkdir()
    elif kind == "pipe":
        os.mkfifo(bad)
    else:
        files = [bad, *checkpoint_files(tmp_path)]
        monkeypatch.setattr("sb3_ddiffpg.saving.checkpoint.checkpoint_files", lambda _: files)
    with pytest.warns(UserWarning, match="Going on with the checkpoint before it"):
        resumed = silent(DDiffPG.resume(tmp_path, known_ends()))
    assert 100 <= resumed.num_timesteps
    resumed.learn(250, callback=RunCheckpointCallback(tmp_path, save_freq=100))


def test_what_cannot_be_removed_does_not_end_the_training(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("pathlib.Path.unlink", refuse)
    with pytest.warns(UserWarning, match="is not needed any more, and cannot be removed: .*not permitted"):
        model = model_for(known_ends()).learn(300, callback=RunCheckpointCallback(tmp_path, save_freq=100, keep=1))
    assert model.num_timesteps >= 300 and len(checkpoint_files(tmp_path)) > 1


def test_a_disk_that_is_full_at_the_beginning_is_told_at_once(tmp_path, monkeypatch):
    model_for(known_ends()).learn(200, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    resumed = silent(DDiffPG.resume(tmp_path, known_ends()))
    began = resumed.num_timesteps
    monkeypatch.setattr("sb3_ddiffpg.saving.checkpoint.write", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.warns(UserWarning, match=f"No checkpoint at step {began}: .*No space left"):
        resumed.learn(260, callback=RunCheckpointCallback(tmp_path, save_freq=10**6))


def test_environments_that_cannot_be_saved_are_told_at_the_beginning(tmp_path):
    with pytest.warns(UserWarning, match="a run that goes on begins new ones"):
        model_for(DummyVecEnv([TwoEnds] * 4)).learn(20, callback=RunCheckpointCallback(tmp_path))


def test_the_zoos_time_limit_is_saved_as_gymnasiums(monkeypatch):
    """The zoo replaces it in every process that imports it; a run may go on where nobody has."""
    patched = gym_patches.PatchedTimeLimit
    plain = patched.__mro__[1]
    for first, second in ((patched, plain), (plain, patched), (patched, patched)):
        env, other = first(KnownEnds(), 5), second(KnownEnds(), 5)
        for each in (env, other):
            each.reset(seed=1)
        env.step(np.ones(1))
        restore_env(other, copied(env_snapshot(env)))
        assert other._elapsed_steps == 1 and other.unwrapped.x == env.unwrapped.x
    for value in ("abc", -1, 2**70):
        tree = copied(env_snapshot(env))
        tree["layers"][0]["values"]["_elapsed_steps"] = value
        with pytest.raises(ValueError, match="_elapsed_steps"):
            restore_env(other, tree)


def test_tests_along_the_way_go_on_too(tmp_path):
    """SB3's own draws from the random states of training, and its environments have states of their own."""

    def callbacks(folder):
        tests = EvalCallback(known_ends(2), n_eval_episodes=3, eval_freq=20, deterministic=False, verbose=0)
        return [tests, RunCheckpointCallback(folder, save_freq=50, keep=20)]

    whole, asked = model_for(known_ends()), callbacks(tmp_path / "whole")
    whole.learn(400, callback=asked)
    for path in checkpoint_files(tmp_path / "whole")[1::2]:
        resumed, again = silent(DDiffPG.resume(path, known_ends())), callbacks(tmp_path / path.stem)
        resumed.learn(400, callback=again)
        assert outcome(resumed) == outcome(whole)
        assert again[0].last_mean_reward == asked[0].last_mean_reward


def test_what_a_monitor_notes_may_be_anything(tmp_path):
    def make_env():
        env = DummyVecEnv([lambda: Monitor(KnownEnds(), info_keywords=("kind",))] * 4)
        env.seed(3)
        return env

    step = KnownEnds.step
    try:
        KnownEnds.step = lambda self, action: (*step(self, action)[:4], {**step(self, action)[4], "kind": "a word"})
        model = model_for(make_env())
        model.learn(200, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    finally:
        KnownEnds.step = step
    assert any(each["kind"] == "a word" for each in model.ep_info_buffer)
    resumed = DDiffPG.resume(tmp_path, make_env())
    assert [each["r"] for each in resumed.ep_info_buffer] == [each["r"] for each in model.ep_info_buffer]


def test_a_call_that_adds_steps_is_resumed_twice(tmp_path):
    model = model_for(known_ends())
    model.learn(200)
    callback = RunCheckpointCallback(tmp_path, save_freq=100, keep=10)
    model.learn(400, reset_num_timesteps=False, callback=callback)
    expected = outcome(model)
    for path in checkpoint_files(tmp_path)[::-1][:2]:
        interrupted = silent(DDiffPG.resume(path, known_ends()))
        folder = tmp_path / path.stem
        interrupted.learn(400, reset_num_timesteps=False, callback=RunCheckpointCallback(folder, save_freq=100, keep=10))
        again = silent(DDiffPG.resume(checkpoint_files(folder)[-1], known_ends()))
        assert again.num_timesteps < 600
        again.learn(400, reset_num_timesteps=False)
        assert outcome(again) == expected


def test_the_call_after_the_resumed_one_is_the_same_too(tmp_path):
    """Environments that were just made would draw the first episode's start anew."""
    model = model_for(known_ends())
    model.learn(200, callback=RunCheckpointCallback(tmp_path, save_freq=100, keep=10))
    resumed = silent(DDiffPG.resume(checkpoint_files(tmp_path)[-1], known_ends()))
    resumed.learn(200)
    outcomes = []
    for each in (model, resumed):
        set_random_seed(7)
        each.learn(100)
        outcomes.append(outcome(each))
    assert outcomes[0] == outcomes[1]
    assert_same_state(state_of(resumed), state_of(model))


@pytest.mark.parametrize("kind", ["episodes", "steps", "improvement"])
def test_what_callbacks_count_goes_on(tmp_path, kind):
    """They stop or act where they would have in an uninterrupted run."""
    acted = []

    class Notes(BaseCallback):
        def _on_step(self):
            acted.append(self.model.num_timesteps)
            return True

    def callbacks(folder):
        others = {
            "episodes": [StopTrainingOnMaxEpisodes(max_episodes=10)],
            "steps": [EveryNTimesteps(90, Notes())],
            "improvement": [
                EvalCallback(
                    known_ends(1), callback_on_new_best=Notes(), n_eval_episodes=1, eval_freq=20, verbose=0,
                    callback_after_eval=StopTrainingOnNoModelImprovement(2, min_evals=1),
                )
            ],
        }  # fmt: skip
        return [*others[kind], RunCheckpointCallback(folder, save_freq=50, keep=20)]

    whole = model_for(known_ends())
    whole.learn(400, callback=callbacks(tmp_path / "whole"))
    expected, end = list(acted), whole.num_timesteps
    files = checkpoint_files(tmp_path / "whole")[::-1]
    assert expected or end < 400
    for path in files[1:-1:2]:
        acted.clear()
        resumed = silent(DDiffPG.resume(path, known_ends()))
        began = resumed.num_timesteps
        resumed.learn(400, callback=callbacks(tmp_path / path.stem))
        assert resumed.num_timesteps == end
        assert acted == [step for step in expected if step > began]


def test_noise_of_ones_own_is_kept(tmp_path):
    class Own(NormalActionNoise):
        pass

    noise = Own(np.zeros(1), 0.1 * np.ones(1))
    model = model_for(known_ends(), action_noise=noise)
    model.learn(120, callback=RunCheckpointCallback(tmp_path, save_freq=50))
    resumed = silent(DDiffPG.resume(tmp_path, known_ends(), custom_objects={"action_noise": noise}))
    resumed.learn(150)
    assert isinstance(resumed.action_noise, VectorizedActionNoise)
    assert all(isinstance(each, Own) for each in resumed.action_noise.noises)


def test_vectorised_noise_follows_the_number_of_environments(tmp_path):
    model = model_for(known_ends(4), action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1)))
    model.learn(60)
    model.save(tmp_path / "model.zip")
    loaded = silent(DDiffPG.load(tmp_path / "model.zip", env=known_ends(2)))
    loaded.learn(60)
    assert len(loaded.action_noise.noises) == 2


def test_environments_to_go_on_in_are_asked_for(tmp_path):
    with pytest.raises(ValueError, match="env=None given; accepted are the environments"):
        DDiffPG.resume(tmp_path, None)


def test_a_random_state_that_numpy_would_crash_with_is_refused():
    state = global_rng()
    state["torch"] = state["torch"].numpy()
    for position in (-1, 625, 2**30):
        with pytest.raises(ValueError, match="accepted are 0 to 624"):
            restore_global_rng({**state, "numpy_rest": [position, *state["numpy_rest"][1:]]})


def test_a_random_state_that_torch_would_read_beyond_is_refused():
    state = global_rng()
    for left, following in ((624, 624), (0, 625), (1, 1), (625, 0), (-5, 630)):
        raw = np.array(state["torch"])
        raw[8:12] = np.array([left], dtype=np.int32).view(np.uint8)
        raw[16:24] = np.array([following], dtype=np.uint64).view(np.uint8)
        with pytest.raises(ValueError, match="random states.torch"):
            restore_global_rng({**copied(state), "torch": raw})
    for n in range(700):  # whatever it makes itself is accepted
        th.rand(n % 7)
        restore_global_rng(copied(global_rng()))


def test_runs_that_contradict_themselves_are_refused(tmp_path):
    """When they are read, not in the midst of ``learn``."""
    model_for(known_ends()).learn(200, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    path = checkpoint_files(tmp_path)[0]
    for change, said in (
        (lambda run: run["environments"]["layers"].append({"kind": "DummyVecEnv", "values": {}}), "saved with a DummyVecEnv"),
        (lambda run: run.update(noise="hello"), "noise: 'hello' is none"),
        (lambda run: run["noise"]["state"].update(low=None), "noise: it draws nothing"),
        (lambda run: run["noise"]["state"].pop("low"), "noise: it draws nothing"),
        (lambda run: run["noise"]["state"].update(shape={"tuple": [10**12, 1]}), "noise: of another shape"),
        (lambda run: run["noise"]["state"].update(high=float("nan")), "noise: "),
        (lambda run: run["noise"]["state"]["sigma"].fill(np.nan), "noise: what it draws"),
        (lambda run: run["buffer"].update(mode_rows=[np.zeros(0, np.int32)] * 20_000), "of 20000 modes, the model has"),
        (lambda run: run["episodes"].update(groups=np.zeros(7, dtype=np.int64)), "episodes.groups"),
        (lambda run: run.update(last_obs=np.zeros((4, 3), dtype=np.float32)), "last_obs"),
        (lambda run: run.update(last_obs=np.full((4, 2), np.nan, dtype=np.float32)), "last_obs"),
        (lambda run: run.update(last_episode_starts=np.zeros(9, dtype=bool)), "last_episode_starts"),
        (lambda run: run["buffer"].update(n_finished=2**70), "n_finished"),
        (lambda run: run["buffer"]["running_return"].fill(np.nan), "a number that is not finite"),
        (lambda run: run["buffer"]["parts"][-1].fill(255), "replay buffer"),
        (lambda run: run["random"].update(python=[3, [1], None]), "random states"),
    ):
        tree = read(path, KIND)
        change(tree["run"])
        write(tmp_path / "changed.safetensors", KIND, tree)
        with pytest.raises(ValueError, match=said):
            DDiffPG.resume(tmp_path / "changed.safetensors", known_ends())


def test_a_finished_run_that_is_resumed_can_be_trained_further(tmp_path):
    model_for(known_ends()).learn(200, callback=RunCheckpointCallback(tmp_path))
    resumed = silent(DDiffPG.resume(tmp_path, known_ends()))
    began = resumed.num_timesteps
    assert resumed.learn(200).num_timesteps == began  # nothing is left of it
    further = resumed.learn(100, reset_num_timesteps=False).num_timesteps
    assert further >= began + 100
    anew = resumed.learn(60).num_timesteps
    assert 60 <= anew < began and resumed.lifetime_steps == further + anew


@pytest.mark.parametrize("name", sorted(BASELINES))
def test_a_second_call_writes_to_the_same_folder(tmp_path, name):
    """Also where it counts anew."""
    model = model_for(known_ends(), BASELINES[name], learning_starts=40, batch_size=16)
    model.learn(100, callback=RunCheckpointCallback(tmp_path))
    model.learn(60, callback=RunCheckpointCallback(tmp_path))
    assert [int(path.stem[-12:]) for path in checkpoint_files(tmp_path)] == [160, 100]
    assert BASELINES[name].resume(tmp_path, known_ends()).lifetime_steps == 160


def test_test_environments_of_this_package_go_on(tmp_path):
    """A new one waits with its seeds for the first reset, which the one that was saved has had."""
    for make in (partial(make_vec_env, "PointMazeV1-v0", 2, seed=1, start_noise=0.5), partial(known_ends, 2)):
        whole, other = make(), make()
        for _ in range(2):
            whole.reset()
        restore_vec_env(other, copied(vec_env_snapshot(whole)))
        np.testing.assert_array_equal(whole.reset(), other.reset())


def test_tests_in_other_environments_do_not_end_a_run(tmp_path):
    class Shy(KnownEnds):
        def state_dict(self):
            return {**super().state_dict(), "place": self.place}

        def reset(self, **kwargs):
            self.place = 1
            return super().reset(**kwargs)

    def callbacks(tests):
        return [EvalCallback(tests, n_eval_episodes=1, eval_freq=20, verbose=0), RunCheckpointCallback(tmp_path, save_freq=50)]

    model_for(known_ends()).learn(200, callback=callbacks(DummyVecEnv([Shy])))  # asked before it was ever reset
    resumed = silent(DDiffPG.resume(tmp_path, known_ends()))
    with pytest.warns(UserWarning, match="EvalCallback tests in other environments than before"):
        resumed.learn(260, callback=callbacks(known_ends(2)))
    assert resumed.num_timesteps >= 260


def test_checkpoints_of_another_version_stay(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_ddiffpg.serialization.safetensors_tree.VERSION", 2)
    model_for(known_ends()).learn(200, callback=RunCheckpointCallback(tmp_path, save_freq=100))
    before = checkpoint_files(tmp_path)
    monkeypatch.setattr("sb3_ddiffpg.serialization.safetensors_tree.VERSION", 1)
    with pytest.raises(ValueError, match="of version '2'"):
        model_for(known_ends()).learn(50, callback=RunCheckpointCallback(tmp_path))
    assert checkpoint_files(tmp_path) == before


def test_a_folder_that_cannot_be_held_is_used_with_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr(FileLock, "acquire", lambda *_, **__: (_ for _ in ()).throw(OSError(37, "No locks available")))
    with pytest.warns(UserWarning, match="cannot be held: .*No locks available"):
        model_for(known_ends()).learn(50, callback=RunCheckpointCallback(tmp_path))
    assert checkpoint_files(tmp_path)
