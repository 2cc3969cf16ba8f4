"""Settings and fixtures for all tests."""

import pytest
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
