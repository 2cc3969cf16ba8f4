"""What only a GPU can show: ``make gpu``."""

from collections import defaultdict

import numpy as np
import pytest
import torch as th
from environments import (
    WIDE,
    AnySpaces,
    TwoEnds,
    assert_same_state,
    image_dict_space,
    small_model,
    some_observations,
    state_of,
)
from stable_baselines3.common.vec_env import DummyVecEnv
from test_checkpoint import assert_goes_on_the_same, known_ends

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import DIPO, TD3C51
from sb3_ddiffpg.networks.cuda_graphs import GraphedFunction
from sb3_ddiffpg.networks.target_actions import climb

pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")


@pytest.fixture(autouse=True)
def deterministic(monkeypatch):
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    th.use_deterministic_algorithms(True)
    yield
    th.use_deterministic_algorithms(False)


def two_ends():
    env = DummyVecEnv([TwoEnds] * 4)
    env.seed(3)
    return env


def trained_on(device, steps=400, **settings):
    model = small_model(two_ends(), **{"novelty": "rnd", "gradient_steps": 4, "device": device, "seed": 0, **settings})
    model.learn(steps)
    return model


def captured(model):
    return {name: graph._graph is not None for name, graph in model.graphs.items()}


@pytest.mark.parametrize("storage", ["cpu", "auto"])
def test_graphs_change_nothing(storage):
    """Through births of modes, where the graphs are captured anew: bit for bit what single kernels compute."""
    models = []
    for enabled in (True, False):
        model = small_model(
            two_ends(),
            novelty="rnd",
            gradient_steps=4,
            device="cuda",
            seed=0,
            replay_buffer_kwargs={"storage_device": storage},
        )
        for graph in model.graphs.values():
            graph.enabled = enabled
        model.learn(400)
        assert set(captured(model).values()) == {enabled}
        assert len(model.modes) == 2
        models.append(model)
    assert_same_state(*map(state_of, models))


@pytest.mark.parametrize("algorithm", [DIPO, TD3C51])
def test_graphs_of_baselines_change_nothing(algorithm):
    models = []
    for enabled in (True, False):
        arguments = {"policy_kwargs": {"net_arch": [16]}, "learning_starts": 40, "buffer_size": 1000, "batch_size": 32}
        model = algorithm("MlpPolicy", two_ends(), seed=0, device="cuda", **arguments)
        for graph in model.graphs.values():
            graph.enabled = enabled
        model.learn(200)
        assert set(captured(model).values()) == {enabled}
        models.append(model)
    assert_same_state(*map(state_of, models))


def test_a_graph_follows_shapes_weights_and_settings():
    network = th.nn.Linear(3, 2).cuda()
    scale = [1.0]
    graphed = GraphedFunction(lambda x: network(x).detach() * scale[0], network)

    def check(x):
        th.testing.assert_close(graphed(x), network(x).detach() * scale[0])

    for n in (5, 5, 5, 7, 5, 5, 7, 7):
        check(th.randn(n, 3, device="cuda"))
    with th.no_grad():
        network.weight.mul_(2.0)  # in place
    check(th.randn(7, 3, device="cuda"))
    network.weight = th.nn.Parameter(th.randn(2, 3, device="cuda"))
    for _ in range(3):
        check(th.randn(7, 3, device="cuda"))
    scale[0] = 3.0
    graphed.clear()
    check(th.randn(7, 3, device="cuda"))


def test_a_function_that_waits_is_called_as_it_is():
    network = th.nn.Linear(3, 2).cuda()
    graphed = GraphedFunction(lambda x: x * x.sum().item(), network)
    x = th.ones(2, 3, device="cuda")
    graphed(x)
    with pytest.warns(UserWarning, match="cannot be replayed as a CUDA graph"):
        assert th.equal(graphed(x), 6 * x)
    assert th.equal(graphed(x + 1), 12 * (x + 1))
    trained_on("cuda", 200)  # the GPU is none the worse for it


def test_random_numbers_are_new_at_every_replay():
    network = th.nn.Linear(3, 2).cuda()
    graphed = GraphedFunction(lambda x: x + th.rand_like(x), network)
    x = th.zeros(1000, device="cuda")
    th.cuda.manual_seed(1)
    replayed = [graphed(x) for _ in range(5)]
    th.cuda.manual_seed(1)
    for each in replayed:
        assert th.equal(each, th.rand_like(x))


def test_an_update_never_waits():
    model = trained_on("cuda", replay_buffer_kwargs={"storage_device": "auto"})
    metrics = defaultdict(list)
    for attempt in range(3):
        th.cuda.set_sync_debug_mode("error" if attempt else "default")
        try:
            batch = model.replay_buffer.sample_modes(48, model.gamma, 3, 5)
            names = ["critics"] * model.critics.n_groups
            model._update_critics(batch, model._rewards(batch, metrics), metrics, names)
            model._update_policy(batch, model._improve_target_actions(batch))
            model._update_targets()
        finally:
            th.cuda.set_sync_debug_mode("default")


def test_a_gpu_computes_what_a_cpu_does(tmp_path):
    """One batch, one set of weights: losses, gradients and improved actions."""
    cpu = trained_on("cpu")
    cpu.save(tmp_path / "model.zip")
    gpu = DDiffPG.load(tmp_path / "model.zip", device="cuda")
    batch = cpu.replay_buffer.sample_modes(48, 0.9, 1, 1)
    there = type(batch)(*(each.cuda() if isinstance(each, th.Tensor) else each for each in batch))
    first, second = (climb(model.policy, each, model.target_action_settings) for model, each in ((cpu, batch), (gpu, there)))
    th.testing.assert_close(first, second.cpu(), rtol=1e-3, atol=1e-4)
    features = cpu.policy.critic_features(batch.observations)
    target = cpu.critics.bellman_target(features, batch.actions, batch.rewards, batch.discounts)
    loss = cpu.critics.loss(features, batch.actions, target)
    features = gpu.policy.critic_features(there.observations)
    target = gpu.critics.bellman_target(features, there.actions, there.rewards, there.discounts)
    th.testing.assert_close(loss, gpu.critics.loss(features, there.actions, target).cpu(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("safe", [False, True])
def test_trained_here_used_there(tmp_path, safe):
    model = trained_on("cuda")
    path = tmp_path / ("model.safetensors" if safe else "model.zip")
    model.export(path) if safe else model.save(path)
    loaded = DDiffPG.load(path, device="cpu", **({"safe": True} if safe else {}))
    for mode in model.modes.names:
        there = model.predict(some_observations(), deterministic=True, mode=mode)[0]
        here = loaded.predict(some_observations(), deterministic=True, mode=mode)[0]
        np.testing.assert_allclose(here, there, rtol=1e-3, atol=1e-4)


def test_resumed_exactly(tmp_path):
    assert_goes_on_the_same(known_ends, tmp_path, at=[1, 4], novelty="rnd", gradient_steps=4, device="cuda")


def test_pictures_and_dicts():
    model = DDiffPG(
        "DiffusionPolicy", DummyVecEnv([lambda: AnySpaces(image_dict_space())] * 2), learning_starts=20, batch_size=16,
        buffer_size=200, device="cuda", mode_features="vec", seed=0, **WIDE,
    )  # fmt: skip
    model.learn(60)
    assert model._n_updates > 5
