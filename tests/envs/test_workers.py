"""Environments in worker processes: as in one process, and what happens when one breaks."""

import math
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import gymnasium as gym
import numpy as np
import pytest
from environments import AnySpaces, Fragile, HangsAt, TellsModules, TwoEnds, image_dict_space, small_model
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.envs.vec_env.workers import WorkerVecEnv, _end


@pytest.fixture
def fragile():
    env = WorkerVecEnv([Fragile] * 5, n_workers=2)
    env.reset()
    yield env
    env.close()


@pytest.mark.parametrize("make", [TwoEnds, lambda: AnySpaces(image_dict_space())])
def test_like_one_process_bit_for_bit(make):
    workers, single = WorkerVecEnv([make] * 5, n_workers=2), DummyVecEnv([make] * 5)
    assert (workers.num_envs, len(workers.processes), workers.first.tolist()) == (5, 2, [0, 2, 5])
    assert (workers.observation_space, workers.action_space) == (single.observation_space, single.action_space)

    def same(ours, theirs):
        if isinstance(theirs, dict):
            assert ours.keys() == theirs.keys()
            return all(same(ours[key], theirs[key]) for key in theirs)
        return ours.dtype == theirs.dtype and np.array_equal(ours, theirs)

    for env in (workers, single):
        env.seed(3)
    rng, n_done = np.random.default_rng(0), 0
    assert same(workers.reset(), single.reset()) and workers.reset_infos == single.reset_infos
    for _ in range(40):
        actions = rng.uniform(-1, 1, (5, *workers.action_space.shape)).astype(np.float32)
        (obs, *rest, infos), (other_obs, *other_rest, other_infos) = workers.step(actions), single.step(actions)
        assert same(obs, other_obs) and all(same(a, b) for a, b in zip(rest, other_rest, strict=True))
        for info, other in zip(infos, other_infos, strict=True):
            assert info.keys() == other.keys() and info["TimeLimit.truncated"] == other["TimeLimit.truncated"]
            if "terminal_observation" in info:
                assert same(info["terminal_observation"], other["terminal_observation"])
        n_done += rest[1].sum()
    assert n_done > 5
    workers.close()


def test_attributes_and_methods(fragile):
    fragile.set_attr("tag", "x", indices=[1, 4])
    fragile.set_attr("tag", "y", indices=[0, 2, 3])
    assert fragile.get_attr("tag") == ["y", "x", "y", "y", "x"] and fragile.get_attr("tag", [4, 0]) == ["x", "y"]
    assert fragile.get_attr("tag", 1) == ["x"]
    assert fragile.has_attr("tag") and not fragile.has_attr("no_such_thing")
    assert fragile.env_is_wrapped(gym.Wrapper) == [False] * 5
    assert [observation.shape for observation, _ in fragile.env_method("reset", indices=[2, 3])] == [(2,), (2,)]
    assert fragile.get_images() == [None] * 5


@pytest.mark.parametrize("task", ["CartPole-v1", "FrankaReach-v0"])
def test_a_worker_does_without_pytorch(task):
    """With it each would take seconds to begin, and hundreds of megabytes; training asks for nothing that needs it."""
    if task.startswith("Franka"):
        pytest.importorskip("pybullet")
    spec = gym.spec(task)
    env = VecMonitor(WorkerVecEnv([lambda: TellsModules(gym.make(spec))] * 2, n_workers=1))
    if task.startswith("Franka"):
        small_model(env, learning_starts=4).learn(8)
    else:
        env.reset()
    assert env.env_is_wrapped(Monitor) == [False] * 2 and env.env_is_wrapped(gym.wrappers.OrderEnforcing) == [True] * 2
    assert env.env_method("has", "gymnasium", indices=[0]) == [True]
    assert [env.env_method("has", name, indices=[0]) for name in ("torch", "stable_baselines3")] == [[False]] * 2
    env.close()


def test_an_error_names_its_environment(fragile):
    actions = np.zeros((5, 1), dtype=np.float32)
    fragile.step(actions)
    actions[3] = 1.0
    with pytest.raises(RuntimeError, match=r"(?s)Environment 3 raised an error:.*ZeroDivisionError: broken leg"):
        fragile.step(actions)
    assert not any(process.is_alive() for process in fragile.processes)


def test_an_error_of_ones_own_kind_and_an_answer_that_cannot_be_sent():
    """The main process may not know the one's class, nor be sent the other."""

    class SimulatorError(Exception):
        pass

    class Odd(TwoEnds):
        def step(self, action):
            if action[0] > 0.99:
                raise SimulatorError("joint 3 exploded")
            return *super().step(action)[:4], {"function": lambda: 1} if action[0] < -0.99 else {}

    for action, said in (
        (1.0, r"(?s)Environment 1 raised an error:.*SimulatorError: joint 3 exploded"),
        (-1.0, r"(?s)The worker process with environments 0 to 2 raised an error:.*Can't pickle local object"),
    ):
        env = WorkerVecEnv([Odd] * 3, n_workers=1)
        env.reset()
        with pytest.raises(RuntimeError, match=said):
            env.step(np.array([[0.0], [action], [0.0]]))
        assert not any(process.is_alive() for process in env.processes)


@pytest.mark.parametrize("cause", ["killed", "exited"])
def test_a_dead_worker_is_reported_and_does_not_hang(fragile, cause):
    started = time.perf_counter()
    if cause == "killed":
        os.kill(fragile.processes[1].pid, signal.SIGKILL)
        with pytest.raises(RuntimeError, match=r"with environments 2 to 4 has died \(signal 9\)"):
            for _ in range(3):
                fragile.step(np.zeros((5, 1)))
    else:
        with pytest.raises(RuntimeError, match=r"with environments 0 to 1 has died \(exit code 3\)"):
            fragile.env_method("die", indices=[0])
    assert time.perf_counter() - started < 20 and not any(process.is_alive() for process in fragile.processes)


@pytest.mark.parametrize("call", [pytest.param("make", marks=pytest.mark.slow), "reset", "step", "state_dict"])
def test_an_environment_that_hangs_is_named(call):
    before = set(multiprocessing.active_children())
    make = [TwoEnds, TwoEnds, TwoEnds, TwoEnds, lambda: HangsAt(call), TwoEnds]

    def run():
        env = WorkerVecEnv(make, n_workers=2, timeout=60.0)  # to begin takes a while
        env.timeout = 2.0
        env.reset()
        env.step(np.zeros((6, 1), dtype=np.float32))
        env.state_dict()

    with pytest.raises(RuntimeError, match=rf"Environment 4 has hung: no answer for {60 if call == 'make' else 2} seconds"):
        run()
    assert set(multiprocessing.active_children()) <= before


def test_a_slow_environment_is_waited_for(fragile):
    fragile.timeout = 10.0
    fragile.env_method("hang", 2.5, indices=[3])
    fragile.timeout = 1.5
    with pytest.raises(RuntimeError, match=r"Environment 3 has hung: no answer for 1.5 seconds"):
        fragile.env_method("hang", 20, indices=[3])


def test_what_an_environment_lacks_does_no_harm(fragile):
    with pytest.raises(AttributeError, match=r"(?s)Environment 1 raised an error.*no_such_thing"):
        fragile.get_attr("no_such_thing", indices=[1, 3])
    fragile.step(np.zeros((5, 1), dtype=np.float32))
    with pytest.raises(RuntimeError, match="Environment 4 raised an error"):
        fragile.env_method("reset", options=3, no_such_argument=1, indices=[4])
    with pytest.raises(RuntimeError, match="The environments are closed"):
        fragile.step(np.zeros((5, 1), dtype=np.float32))


def test_what_nobody_heard_is_not_taken_for_the_next_answer(fragile):
    """As after an interrupt between a question and its answer."""
    single = DummyVecEnv([TwoEnds] * 5)
    for env in (fragile, single):
        env.seed(0)
        env.reset()
    fragile.step_async(np.full((5, 1), 0.5, dtype=np.float32))
    single.step(np.full((5, 1), 0.5, dtype=np.float32))
    for action in (0.1, -0.2, 0.3):
        ours, theirs = (env.step(np.full((5, 1), action, dtype=np.float32))[0] for env in (fragile, single))
        np.testing.assert_array_equal(ours, theirs)
    fragile.step_async(np.zeros((5, 1), dtype=np.float32))
    assert fragile.reset().shape == (5, 2)


def test_workers_leave_ctrl_c_to_their_parent(fragile):
    for process in fragile.processes:
        os.kill(process.pid, signal.SIGINT)
    time.sleep(0.2)
    fragile.step(np.zeros((5, 1), dtype=np.float32))


def test_an_environment_that_cannot_be_made():
    def broken():
        raise FileNotFoundError("no such robot")

    with pytest.raises(RuntimeError, match=r"(?s)Environment 3 raised an error:.*no such robot"):
        WorkerVecEnv([TwoEnds, TwoEnds, TwoEnds, broken], n_workers=2)


def test_a_script_without_guard_is_told(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import gymnasium\nfrom sb3_ddiffpg.envs.workers import WorkerVecEnv\n"
        "WorkerVecEnv([lambda: gymnasium.make('CartPole-v1')] * 2, n_workers=1)\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "must do so under `if __name__ == '__main__':`" in done.stderr.splitlines()[-1]


def test_training_in_workers():
    env = WorkerVecEnv([TwoEnds] * 4, n_workers=2)
    model = small_model(env).learn(400)
    assert len(model.modes) == 2
    env.close()
    env.close()  # twice does no harm


def test_bad_arguments():
    with pytest.raises(ValueError, match="n_workers: 0"):
        WorkerVecEnv([TwoEnds], n_workers=0)
    for timeout in (0, -1.0, math.nan):
        with pytest.raises(ValueError, match=f"timeout: {timeout} given"):
            WorkerVecEnv([TwoEnds], timeout=timeout)


def test_an_arm_under_a_users_own_id():
    pytest.importorskip("pybullet")
    gym.register("MyReach-v0", entry_point="sb3_ddiffpg.envs.franka.tasks:FrankaReach", max_episode_steps=7)
    for n_envs in (1, 2):
        env = make_vec_env("MyReach-v0", n_envs, n_threads=2)
        assert env.reset().shape == (n_envs, 6) and env.get_attr("spec")[0].max_episode_steps == 7
        env.close()
    del gym.registry["MyReach-v0"]
    with pytest.raises(ValueError, match="n_envs: 0 given"):
        make_vec_env("FrankaReach-v0", 0)


def test_franka_in_workers():
    pytest.importorskip("pybullet")
    ours = make_vec_env("FrankaDrawerClose-v0", 4, seed=1, n_threads=2, max_episode_steps=6)
    assert isinstance(ours.venv, WorkerVecEnv) and len(ours.venv.processes) == 2
    single = DummyVecEnv([lambda: gym.make("FrankaDrawerClose-v0", max_episode_steps=6)] * 4)
    single.seed(1)
    np.testing.assert_array_equal(ours.reset(), single.reset())
    rng = np.random.default_rng(0)
    for _ in range(15):
        actions = rng.uniform(-1, 1, (4, 7)).astype(np.float32)
        for part, other in zip(ours.step(actions)[:3], single.step(actions)[:3], strict=True):
            np.testing.assert_array_equal(part, other)
    assert ours.render_mode is None and make_vec_env("FrankaReach-v0").render_mode is None
    assert ours.get_attr("spec", 0)[0].id == "FrankaDrawerClose-v0"
    assert ours.get_attr("mode_features", 2)[0].tolist() == [6, 7, 8, 9]
    ours.close()
    single.close()


def test_in_one_process_too_it_is_said_where(monkeypatch):
    gym.register("Fragile-v0", Fragile)
    try:
        env = make_vec_env("Fragile-v0", 4, seed=0)
        env.reset()
        with pytest.raises(ZeroDivisionError) as raised:
            env.step(np.array([[0.0], [0.0], [1.0], [0.0]]))
        assert raised.value.__notes__ == ["Raised by environment 2"]
        monkeypatch.setattr(Fragile, "reset", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError) as raised:
            env.reset()
        assert raised.value.__notes__ == ["Raised by environment 0"]
    finally:
        del gym.registry["Fragile-v0"]


def test_an_interrupted_close_leaves_nobody_behind():
    class Sleeper:
        alive = True

        def join(self, timeout=None):
            if timeout is not None:
                raise KeyboardInterrupt

        def is_alive(self):
            return self.alive

        def kill(self):
            self.alive = False

    sleepers = [Sleeper(), Sleeper()]
    with pytest.raises(KeyboardInterrupt):
        _end([], sleepers)
    assert not any(each.alive for each in sleepers)


SCRIPT = """
import sys
from tiny_envs import TwoEnds

if __name__ == "__main__":  # the workers read this file too
    from sb3_ddiffpg.envs.vec_env.workers import WorkerVecEnv

    env = WorkerVecEnv([TwoEnds] * 4, n_workers=2)
    if len(sys.argv) > 1:
        from environments import small_model
        from stable_baselines3.common.callbacks import BaseCallback
        from sb3_ddiffpg.callbacks.checkpoint import RunCheckpointCallback

        class Tells(BaseCallback):
            def _on_step(self):
                if self.num_timesteps == 40:
                    print("running", flush=True)
                return True

        small_model(env).learn(10**6, callback=[Tells(), RunCheckpointCallback(sys.argv[1], save_freq=10**6)])
        print("saved", flush=True)
"""


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "script.py"
    path.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([os.path.dirname(os.path.dirname(__file__)), *sys.path])}

    def start(*arguments):
        command = [sys.executable, path, *arguments]
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, start_new_session=True)

    return start


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_to_all_processes_ends_the_training_with_a_checkpoint(script, tmp_path, number):
    """As systemd, Slurm and ``timeout`` send it."""
    process = script(tmp_path / "run")
    assert process.stdout.readline() == "running\n"
    os.killpg(process.pid, number)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0 and output.endswith("saved\n")
    assert max(int(path.stem[-12:]) for path in (tmp_path / "run").glob("checkpoint_*")) >= 40


def test_workers_that_nobody_closed_end_with_the_process(script):
    assert script().wait(60) == 0
