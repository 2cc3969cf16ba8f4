"""Vectorised environments of other libraries, which answer few questions, or none."""

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from environments import TwoEnds, small_model
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor, VecNormalize

import sb3_ddiffpg
from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import TD3C51
from sb3_ddiffpg.envs.vec_env import WorkerVecEnv
from sb3_ddiffpg.evaluation import run_episodes
from sb3_ddiffpg.utils.vec_envs import env_attribute


class TensorVecEnv(VecEnv):
    """As those of simulators that step all environments at once: one object, which takes several indices, never one alone."""

    def __init__(self, n_envs=4):
        self.inner = DummyVecEnv([TwoEnds] * n_envs)
        self.mode_features, self.spec, self.render_mode = [0], None, None
        self.num_envs = n_envs
        super().__init__(n_envs, self.inner.observation_space, self.inner.action_space)

    def reset(self):
        return self.inner.reset()

    def step_async(self, actions):
        self.inner.step_async(actions)

    def step_wait(self):
        return self.inner.step_wait()

    def close(self):
        self.inner.close()

    def get_attr(self, attr_name, indices=None):
        return [getattr(self, attr_name)] * (self.num_envs if indices is None else len(indices))

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError("Setting attributes is not supported.")

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        raise NotImplementedError("Calling methods is not supported.")

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


class SilentVecEnv(TensorVecEnv):
    """Answers no question but the one that SB3's constructor asks."""

    def get_attr(self, attr_name, indices=None):
        if attr_name != "render_mode":
            raise NotImplementedError("Getting attributes is not supported.")
        return super().get_attr(attr_name, indices)


def test_an_index_alone_is_no_answer():
    """Or the tests below ask nothing."""
    with pytest.raises(TypeError, match="len"):
        TensorVecEnv().get_attr("mode_features", indices=0)
    with pytest.raises(NotImplementedError):
        SilentVecEnv().has_attr("mode_features")


@pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor, lambda env: VecNormalize(VecMonitor(env), norm_reward=False)])
@pytest.mark.parametrize(("make", "declared"), [(TensorVecEnv, [0]), (SilentVecEnv, None)])
def test_training_and_evaluation(make, declared, wrap, tmp_path):
    env = wrap(make())
    model = small_model(env).learn(300)
    assert model.replay_buffer.features.whole_observation == (declared is None)
    assert declared is None or model.resolved_features == declared
    assert model._n_updates > 0 and model.replay_buffer.has_success_signal
    assert len(run_episodes(model, env, 6)) == 6
    model.save(tmp_path / "model.zip")
    DDiffPG.load(tmp_path / "model.zip", env).learn(40)


@pytest.mark.parametrize("make", [TensorVecEnv, SilentVecEnv])
def test_a_baseline_trains_too(make):
    TD3C51("MlpPolicy", make(), learning_starts=20, buffer_size=500, policy_kwargs={"net_arch": [8]}).learn(60)


@pytest.mark.parametrize(
    "make",
    [DummyVecEnv, partial(SubprocVecEnv, start_method="fork"), partial(WorkerVecEnv, n_workers=1)],
    ids=["dummy", "processes", "workers"],
)
def test_what_is_there_and_what_is_not(make):
    env = make([TwoEnds])
    np.testing.assert_array_equal(env_attribute(env, "mode_features"), [0])
    assert env_attribute(env, "no_such_thing") is None and env_attribute(env, "no_such_thing", 3) == 3
    assert env.reset().shape == (1, 2)  # no process has died of the question
    env.close()


def test_no_question_is_asked_elsewhere():
    package = Path(sb3_ddiffpg.__file__).parent
    question = re.compile(
        r"(?<!def )\b(?!self\._each\b|super\(\))\w+\.(get_attr|has_attr|env_method|set_attr|env_is_wrapped)\("
    )
    asking = {str(path.relative_to(package)) for path in package.rglob("*.py") if question.search(path.read_text())}
    # Of environments to themselves: their pictures
    assert asking == {"utils/vec_envs.py", "envs/mazes/env.py", "envs/vec_env/grouped.py", "envs/vec_env/group.py"}
