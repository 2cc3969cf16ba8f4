"""Settings and fixtures for all tests."""

import os

import pytest

# With a GPU at hand "auto" would mean it, and these tests ask for the same bits; what needs one is in test_accelerator.py
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")

import torch as th

# Small networks and two test processes: more threads than one only get into each other's way
th.set_num_threads(1)


@pytest.fixture(scope="session")
def trained():
    """A model with two modes; not to be changed."""
    from environments import TwoEnds, small_model
    from stable_baselines3.common.vec_env import DummyVecEnv

    model = small_model(DummyVecEnv([TwoEnds] * 4), novelty="rnd", gradient_steps=4)
    model.learn(400)
    assert len(model.modes) == 2
    return model


@pytest.fixture
def two_routes():
    """Up and down are modes, and their critics were trained a little."""
    from planar import planar_model, route_of, said, walk

    model = planar_model()
    walk(model, "up", 4)
    walk(model, "down", 5)
    assert said(model) == ["mode_0 born", "mode_1 born"]
    model._setup_learn(1)
    model.train(5, 32)
    names = {route_of(mode): mode.name for mode in model.modes}
    assert names == {"down": "mode_0", "up": "mode_1"}  # the larger one first
    return model
