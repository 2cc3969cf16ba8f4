"""Environments on a Ray cluster: as in one process, and what happens when a part of it is lost."""

import os
import signal
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from environments import AnySpaces, Fragile, TwoEnds, image_dict_space, small_model
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg.buffers.trajectory import NO_MODE
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.envs.vec_env import RayVecEnv

ray = pytest.importorskip("ray")


@pytest.fixture(scope="module", autouse=True)
def cluster():
    """Of two machines' size, on this one."""
    os.environ.setdefault("RAY_worker_niceness", "0")
    path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    ray.init(
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        configure_logging=False,
        object_store_memory=2**27,
        runtime_env={"env_vars": {"PYTHONPATH": path}},
    )
    yield
    ray.shutdown()


@pytest.fixture
def fragile():
    env = RayVecEnv([Fragile] * 5, n_workers=2, timeout=60.0)
    env.seed(1)
    env.reset()
    yield env
    env.close()


def _only_here(pid):
    if os.getpid() != pid:
        raise ValueError("no such thing here")


def same(ours, theirs):
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys()
        return all(same(ours[key], theirs[key]) for key in theirs)
    return ours.dtype == theirs.dtype and np.array_equal(ours, theirs)


# Of those that are slow each makes several processes, which import torch
IMAGES = pytest.param(lambda: AnySpaces(image_dict_space()), marks=pytest.mark.slow)


@pytest.mark.parametrize("make", [TwoEnds, IMAGES])
def test_like_one_process_bit_for_bit(make):
    actors, single = RayVecEnv([make] * 5, n_workers=2), DummyVecEnv([make] * 5)
    assert (actors.num_envs, len(actors.actors), actors.first.tolist()) == (5, 2, [0, 2, 5])
    assert (actors.observation_space, actors.action_space) == (single.observation_space, single.action_space)
    for env in (actors, single):
        env.seed(3)
    rng, n_done = np.random.default_rng(0), 0
    assert same(actors.reset(), single.reset()) and actors.reset_infos == single.reset_infos
    for _ in range(40):
        actions = rng.uniform(-0.9, 0.9, (5, *single.action_space.shape)).astype(np.float32)
        ours, theirs = actors.step(actions), single.step(actions)
        assert all(same(*pair) for pair in zip(ours[:3], theirs[:3], strict=True))
        for mine, other in zip(ours[3], theirs[3], strict=True):
            assert mine.keys() == other.keys() and (not theirs[2].any() or mine.get("is_success") == other.get("is_success"))
        n_done += theirs[2].sum()
    assert n_done > 5
    actors.close()
    actors.close()
    with pytest.raises(RuntimeError, match="The environments are closed"):
        actors.reset()


def test_a_state_goes_on_bit_for_bit():
    env = make_vec_env("PointMazeV1-v0", 3, seed=0, vec_env_cls="ray", vec_env_kwargs={"n_workers": 2})
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 3, 2)).astype(np.float32)
    env.reset()
    env.step(actions[0])
    state = env.state_dict()
    expected = [env.step(each)[0] for each in actions]
    env.load_state_dict(state)
    for each, after in zip(actions, expected, strict=True):
        np.testing.assert_array_equal(env.step(each)[0], after)
    env.close()


def test_a_group_that_is_killed_is_replaced(fragile):
    """The warning names its environments; their episodes end at that step, the others go on as if nothing had been."""
    single = DummyVecEnv([Fragile] * 5)
    single.seed(1)
    single.reset()
    actions = np.full((5, 1), 0.2, np.float32)
    for env in (fragile, single):
        before = env.step(actions)[0]
    os.kill(fragile.env_method("pid", indices=[2])[0], signal.SIGKILL)
    with pytest.warns(UserWarning, match=r"Environments 2 to 4 are lost \(.*\)\. They begin new episodes elsewhere"):
        observations, rewards, dones, infos = fragile.step(actions)
    expected = single.step(actions)
    for found, other in zip((observations, rewards, dones), expected[:3], strict=True):
        np.testing.assert_array_equal(found[:2], other[:2])
    assert dones.tolist() == [False, False, True, True, True] and (rewards[2:] == 0).all()
    for i in (2, 3, 4):
        assert infos[i]["lost"] and infos[i]["TimeLimit.truncated"]
        np.testing.assert_array_equal(infos[i]["terminal_observation"], before[i])
    assert np.abs(observations[2:, 0]).max() < 0.1 and (observations[2:, 1] == 0).all()  # new episodes
    # All of them go on
    after, _, dones, infos = fragile.step(actions)
    np.testing.assert_allclose(after[2:, 0], observations[2:, 0] + 0.1, atol=1e-6)
    assert not dones.any() and not any("lost" in info for info in infos)
    assert len({*fragile.env_method("pid")}) == 2


@pytest.mark.slow
@pytest.mark.parametrize("asked", ["get_attr", "reset"])
def test_one_that_is_lost_between_two_steps(fragile, asked):
    """Whoever asks first is answered by the new one; unless all begin anew, the next step says that episodes have ended."""
    actions = np.full((5, 1), 0.2, np.float32)
    fragile.step(actions)
    os.kill(fragile.env_method("pid", indices=[0])[0], signal.SIGKILL)
    with pytest.warns(UserWarning, match="Environments 0 to 1 are lost"):
        if asked == "reset":
            fragile.reset()
        else:
            assert fragile.get_attr("limit") == [8] * 5
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, _, dones, infos = fragile.step(actions)
        assert dones.tolist() == [asked != "reset"] * 2 + [False] * 3
        assert ["lost" in info for info in infos] == dones.tolist()
        assert not fragile.step(actions)[2].any()


@pytest.mark.slow
def test_training_goes_on(fragile):
    """What was lost ends as if the time was up: no goal, and nothing after it belongs to it."""
    model = small_model(fragile, action_noise=None)
    pid = fragile.env_method("pid", indices=[4])[0]
    killed = []

    def kill(local_variables, _):
        if model.num_timesteps >= 200 and not killed:
            killed.append(os.kill(pid, signal.SIGKILL))
        return True

    fragile.step_async, known = (lambda actions: known(np.clip(actions, -0.9, 0.9))), fragile.step_async
    with pytest.warns(UserWarning, match="Environments 2 to 4 are lost"):
        model.learn(600, callback=kill)
    buffer = model.replay_buffer
    assert killed and model.num_timesteps == 600
    lost = [each for each in buffer.finished_trajectories() if not each.success and each.length < 8]
    assert len(lost) >= 1 and all(buffer.timeouts[each.rows[-1]] for each in lost)
    assert any(each.mode != NO_MODE for each in buffer.trajectories(True))


@pytest.mark.slow
def test_what_does_not_answer_is_lost_and_not_for_ever():
    env = RayVecEnv([Fragile] * 2, n_workers=1, timeout=8.0)
    env.reset()
    with pytest.warns(UserWarning, match=r"Environments 0 to 1 are lost \(GetTimeoutError"):
        with pytest.raises(
            RuntimeError, match=r"Environments 0 to 1 were lost 3 times in a row; the last time: GetTimeoutError"
        ):
            env.env_method("hang", 1000)
    assert env._closed


def test_an_error_names_the_environment(fragile):
    with pytest.raises(AttributeError, match="nonsense"):
        fragile.get_attr("nonsense")
    assert fragile.get_attr("limit") == [8] * 5
    with pytest.raises(RuntimeError, match="(?s)Environment 3 raised an error:.*broken leg"):
        fragile.step(np.array([[0.0], [0.0], [0.0], [1.0], [0.0]]))

    def broken():
        raise OSError("no licence")

    with pytest.raises(RuntimeError, match="(?s)Environment 3 raised an error:.*no licence"):
        RayVecEnv([TwoEnds, TwoEnds, TwoEnds, broken], n_workers=2)

    class Unreadable:
        def __call__(self):
            return TwoEnds()

        def __reduce__(self):
            return _only_here, (os.getpid(),)

    with pytest.raises(RuntimeError, match="(?s)Environments 0 to 0 raised an error:.*no such thing here"):
        RayVecEnv([Unreadable()])
    for wrong in ({"n_workers": 0}, {"timeout": -1.0}):
        ((name, value),) = wrong.items()
        with pytest.raises(ValueError, match=f"{name}: {value} given"):
            RayVecEnv([TwoEnds], **wrong)


def test_by_name():
    """As the others, of an environment that only this process has registered."""
    gym.register("OnRay-v0", TwoEnds, kwargs={"limit": 5})
    try:
        arguments = {"n_envs": 3, "seed": 5, "env_kwargs": {"success_key": "solved"}}
        ours = make_vec_env("OnRay-v0", vec_env_cls="ray", vec_env_kwargs={"n_workers": 2}, **arguments)
        single = make_vec_env("OnRay-v0", **arguments)
        np.testing.assert_array_equal(ours.reset(), single.reset())
        for _ in range(7):
            ours_infos, their_infos = (env.step(np.full((3, 1), 0.2, np.float32))[3] for env in (ours, single))
        assert ours.get_attr("success_key") == ["solved"] * 3
        assert [info.keys() for info in ours_infos] == [info.keys() for info in their_infos]
        ours.close()
        with pytest.raises(ValueError, match="vec_env_cls: 'rays' given; accepted are a class, and 'ray'"):
            make_vec_env("OnRay-v0", vec_env_cls="rays")
    finally:
        del gym.registry["OnRay-v0"]
