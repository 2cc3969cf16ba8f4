"""Images through a convolution: ``"CnnPolicy"`` as in SB3."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import SMALL, WIDE, AnySpaces, TwoEnds, merged
from gymnasium import spaces
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecTransposeImage, is_vecenv_wrapped

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation import Replanner
from sb3_ddiffpg.evaluation.task import Task

IMAGES = {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 8}}


def image_env(channel_first: bool = False) -> FakeImageEnv:
    return FakeImageEnv(screen_height=40, screen_width=36, n_channels=3, discrete=False, channel_first=channel_first)


def seeing(algorithm, env, **changes):
    model = algorithm("CnnPolicy", env, **merged(SMALL, {"policy_kwargs": IMAGES, "buffer_size": 400}, changes))
    model.set_logger(Logger(None, []))
    return model


@pytest.mark.parametrize("channel_first", [False, True])
def test_a_convolution_sees_images_of_either_order(channel_first, tmp_path):
    env = image_env(channel_first)
    model = seeing(DDiffPG, env, train_freq=8).learn(240)
    assert is_vecenv_wrapped(model.get_env(), VecTransposeImage) == (not channel_first)
    assert model.observation_space.shape == (3, 40, 36)
    assert model.replay_buffer.observations.dtype == model.replay_buffer.next_observations.dtype == np.uint8
    for extractor in (model.policy.actor.features_extractor, model.policy.critic_features_extractor):
        assert type(extractor) is NatureCNN and extractor.features_dim == 8
    image = env.observation_space.sample()
    first = image if channel_first else image.transpose(2, 0, 1)
    # By hand: intensities from 0 to 1, channels first
    by_hand = model.policy.actor.features_extractor(th.as_tensor(first[None]).float() / 255)
    th.testing.assert_close(model.policy.actor.features(model.policy.obs_to_tensor(image)[0]), by_hand)
    expected, _ = model.predict(image, deterministic=True)
    np.testing.assert_array_equal(model.predict(first, deterministic=True)[0], expected)
    np.testing.assert_allclose(model.predict(np.stack([image] * 3), deterministic=True)[0], [expected] * 3, atol=1e-5)
    evaluate_policy(model, env, n_eval_episodes=2, warn=False)

    model.save(tmp_path / "model.zip")
    model.export(tmp_path / "model.safetensors")
    for path in ("model.zip", "model.safetensors"):
        loaded = DDiffPG.load(tmp_path / path, env, safe=path.endswith("safetensors"))
        np.testing.assert_array_equal(loaded.predict(image, deterministic=True)[0], expected)
        loaded.learn(48)


@pytest.mark.parametrize("algorithm", BASELINES.values(), ids=BASELINES.keys())
def test_baselines_see_images(algorithm, tmp_path):
    given = {name: value for name, value in SMALL.items() if name not in ("recluster_freq", "modes", "exploration")}
    model = algorithm("CnnPolicy", image_env(), **{**given, "policy_kwargs": IMAGES, "buffer_size": 400, "train_freq": 8})
    model.set_logger(Logger(None, []))
    untrained = [value.clone() for value in model.policy.actor.parameters()]
    model.learn(64)
    assert type(model.policy.actor.features_extractor) is NatureCNN
    assert any((new != old).any() for new, old in zip(model.policy.actor.parameters(), untrained, strict=True))
    image = image_env().observation_space.sample()
    expected, _ = model.predict(image, deterministic=True)
    model.export(tmp_path / "model.safetensors")
    loaded = algorithm.load(tmp_path / "model.safetensors", safe=True)
    assert type(loaded.policy) is type(model.policy)
    if algorithm is not BASELINES["diffusion_ql"]:  # which draws among candidates
        np.testing.assert_array_equal(loaded.predict(image, deterministic=True)[0], expected)


def test_stacked_frames_are_channels():
    env = VecFrameStack(DummyVecEnv([image_env] * 2), 4)
    model = seeing(DDiffPG, env, train_freq=8).learn(64)
    assert model.observation_space.shape == (12, 40, 36)


def test_a_convolution_needs_images():
    with pytest.raises(AssertionError, match="You should use NatureCNN only with images"):
        seeing(DDiffPG, TwoEnds())
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        seeing(DDiffPG, AnySpaces(spaces.Dict({"image": image_env().observation_space})))


def test_scaled_images_are_taken_as_they_are():
    """As in SB3: ``normalize_images=False``, and the extractor is told."""
    extractor_kwargs = {**IMAGES["features_extractor_kwargs"], "normalized_image": True}
    kwargs = {"normalize_images": False, "features_extractor_kwargs": extractor_kwargs}
    env = AnySpaces(spaces.Box(-1.0, 1.0, (1, 36, 36)))
    model = seeing(DDiffPG, env, policy_kwargs={**IMAGES, **kwargs}, train_freq=8, **WIDE).learn(64)
    assert model.replay_buffer.observations.dtype == np.float32


def test_a_replanner_sees_images_of_either_order():
    """An environment by itself has the channels last; one that is asked through ``model.env`` has them first."""
    env = image_env()
    model = seeing(DDiffPG, env)
    model.policy.resize(1)
    model.mode_manager.expect_unknown(1, 0, model.replay_buffer, model.scheduler)
    agent = Replanner(model, patience=5, tolerance=1.0, order=["mode_0"])
    image = env.observation_space.sample()
    expected = model.predict(image, mode="mode_0", deterministic=True)[0]
    for given in (image, image.transpose(2, 0, 1)):
        np.testing.assert_array_equal(agent.predict(given, deterministic=True)[0], expected)
    np.testing.assert_array_equal(agent.predict(image[None], deterministic=True)[0], expected[None])


def test_images_of_an_environment_are_those_of_the_model():
    """SB3 shows them with channels first, whatever the environment does: a report is of the same task."""
    gym.register("Seen-v0", image_env, max_episode_steps=10)
    try:
        model = seeing(DDiffPG, make_vec_env("Seen-v0", 2), train_freq=8)
        Task.of(model).check(model)
        Task.of(model, "Seen-v0").check(model)
        with pytest.raises(ValueError, match="has observations and actions"):
            Task.of(model, "Pendulum-v1").check(model)
    finally:
        del gym.registry["Seen-v0"]
