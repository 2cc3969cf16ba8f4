"""Graphs where there is no GPU; what only one can show is in ``test_accelerator.py``."""

import pytest
import torch as th
from environments import TwoEnds, small_model
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg.networks.cuda_graphs import GraphedFunction, graphed


@pytest.mark.parametrize("make", [GraphedFunction, graphed])
def test_on_a_cpu_the_function_is_just_called(make):
    network, given = th.nn.Linear(3, 2), []

    def function(*arguments):
        given.append(arguments)
        return network(arguments[0])

    called, x, y = make(function, network), th.ones(4, 3), th.zeros(2)
    for n_calls in range(1, 4):  # with the same shapes, which on a GPU would be captured
        assert th.equal(called(x, y), network(x)) and len(given) == n_calls
        assert given[-1][0] is x and given[-1][1] is y  # no copies
    assert make is GraphedFunction or called is function


def test_a_model_on_a_cpu_captures_nothing():
    model = small_model(DummyVecEnv([TwoEnds] * 4), gradient_steps=4, device="cpu").learn(200)
    assert set(model.graphs) == {"critics", "ascent", "policy"}
    assert all(getattr(each, "_graph", None) is None for each in model.graphs.values())
