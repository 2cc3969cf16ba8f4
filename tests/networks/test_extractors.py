"""What networks see of observations: against numpy, in any unit."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from environments import AnySpaces, assert_same_state, image_dict_space, small_model, state_of
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.networks.extractors import (
    ScaledFlattenExtractor,
    StandardizedCombinedExtractor,
    StandardizedExtractor,
    adapt_extractors,
    default_extractor,
)

BOX = spaces.Box(-np.inf, np.inf, (4,))


def seen(seed=0, n=500):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(n, 4)) * [1.0, 20.0, 1e-4, 3e3] + [0.0, 5.0, 1e-3, -1e4]).astype(np.float32)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.sampled_from([1e-3, 1.0, 1e3]), min_size=4, max_size=4))
def test_mean_and_deviation_are_those_of_numpy_in_any_unit(seed, units):
    observations = seen(seed) * np.array(units, dtype=np.float32)
    extractor = StandardizedExtractor(BOX)
    small = th.from_numpy(observations[:9] / np.abs(observations).max())
    assert th.equal(extractor(small), small)  # nothing was seen
    extractor.adapt(th.from_numpy(observations))
    exact = observations.astype(np.float64)
    expected = (3**0.5 * (exact - exact.mean(axis=0)) / exact.std(axis=0, ddof=1)).clip(-10, 10)
    np.testing.assert_allclose(extractor(th.from_numpy(observations)), expected, atol=4e-2)
    out = extractor(th.from_numpy(observations)).numpy().astype(np.float64)
    np.testing.assert_allclose(out.mean(axis=0), 0.0, atol=2e-3)
    np.testing.assert_allclose(out.std(axis=0), 3**0.5, rtol=1e-2)  # as of what is spread evenly over [-3, 3]


def test_what_has_not_moved_is_measured_by_its_size():
    extractor = StandardizedExtractor(BOX)
    observations = seen()
    observations[:, 1], observations[:, 2], observations[:, 3] = -250.0, 0.0, 7e-5
    extractor.adapt(th.from_numpy(observations))
    out = extractor(th.from_numpy(observations))
    np.testing.assert_allclose(out[:, 1:], 0.0, atol=1e-3)
    observations[:, 1:] = [-500.0, 1.0, 0.0]  # by its own size, by 1 and by its own size
    np.testing.assert_allclose(extractor(th.from_numpy(observations))[0, 1:], np.array([-1.0, 1.0, -1.0]) * 3**0.5, atol=1e-5)


def test_one_broken_number_does_not_decide():
    extractor = StandardizedExtractor(BOX)
    extractor.adapt(th.from_numpy(seen()))
    out = extractor(th.tensor([[1e30, -1e30, 0.0, 0.0]]))
    assert out[0, :2].tolist() == [10.0, -10.0] and th.isfinite(out).all()


def test_a_state_of_version_0_1_leaves_the_components_as_they_are_for_good():
    """It has none of it. What is saved of it is loaded alike."""

    class Network(th.nn.Module):
        def __init__(self):
            super().__init__()
            self.features_extractor, self.layer = StandardizedExtractor(BOX), th.nn.Linear(4, 2)

    network, old = Network(), {f"layer.{name}": each for name, each in th.nn.Linear(4, 2).state_dict().items()}
    network.features_extractor.adapt(th.from_numpy(seen(1)))
    network.load_state_dict(old)
    observations = th.from_numpy(seen())
    for _ in range(2):
        adapt_extractors(network, observations)
        assert th.equal(network.features_extractor(observations[:, :1].repeat(1, 4)), observations[:, :1].repeat(1, 4))
        saved, network = deepcopy(network.state_dict()), Network()
        network.load_state_dict(saved)
    assert "features_extractor.offset" not in old  # what was given is as it was
    with pytest.raises(RuntimeError, match=r"features_extractor\.scale"):
        network.load_state_dict({name: each for name, each in saved.items() if not name.endswith("scale")})


def test_vectors_of_a_dict_are_standardised_each_by_its_own():
    space = image_dict_space()
    networks = th.nn.ModuleDict({name: StandardizedCombinedExtractor(space) for name in ("here", "there")})
    networks["there"].load_state_dict(networks["here"].state_dict())
    rng = np.random.default_rng(0)
    observations = {
        "img": th.rand(60, 1, 36, 36),
        "vec": th.from_numpy(rng.normal(5.0, 100.0, size=(60, 2)).astype(np.float32)),
        "discrete": th.nn.functional.one_hot(th.arange(60) % 4).float(),
    }
    before = networks["here"](observations).detach()
    adapt_extractors(networks, observations)
    after = networks["here"](observations).detach()
    assert th.equal(after, networks["there"](observations))  # the targets see the same
    changed = [column for column in range(before.shape[1]) if not th.equal(before[:, column], after[:, column])]
    assert len(changed) == 2  # of images and numbers without a unit nothing changes
    exact = observations["vec"].numpy().astype(np.float64)
    np.testing.assert_allclose(after[:, changed], 3**0.5 * (exact - exact.mean(0)) / exact.std(0, ddof=1), atol=1e-4)


@pytest.mark.parametrize(
    ("space", "kwargs", "kind"),
    [
        (BOX, None, StandardizedExtractor),
        (BOX, {"half_width": 1}, ScaledFlattenExtractor),
        (spaces.Box(0, 255, (36, 36, 1), np.uint8), None, FlattenExtractor),
        (spaces.Discrete(3), None, FlattenExtractor),
        (spaces.MultiBinary(3), None, FlattenExtractor),
        (image_dict_space(), None, StandardizedCombinedExtractor),
    ],
)
def test_what_has_a_unit_is_standardised(space, kwargs, kind):
    assert default_extractor(space, kwargs) is kind


def test_all_networks_of_a_model_see_what_the_run_has_met(tmp_path):
    """Those of the modes, and the targets; when it goes on, and in files."""
    rng, space = np.random.default_rng(0), spaces.Box(-1e4, 1e4, (3,))

    class Far(AnySpaces):
        def _moved(self, result):
            return (result[0] * [1e-4, 1e-1, 0.0] + [3.0, 0.0, 50.0]).astype(np.float32)

        def reset(self, **kwargs):
            result = super().reset(**kwargs)
            return self._moved(result), {}

        def step(self, action):
            result = super().step(action)
            return self._moved(result), *result[1:]

    model = small_model(Far(space), mode_features=[0]).learn(300)
    parts = [each for each in model.policy.modules() if isinstance(each, StandardizedExtractor)]
    assert len(parts) >= 3
    met = model.replay_buffer.observations[: model.replay_buffer.size()].reshape(-1, 3)
    for each in parts:
        assert th.equal(each.offset, parts[0].offset) and th.equal(each.scale, parts[0].scale)
        np.testing.assert_allclose(each.offset[:2], met.mean(axis=0)[:2], atol=0.3 * met.std(axis=0)[:2].max())
        np.testing.assert_allclose(3**0.5 / each.scale[:2], met.std(axis=0)[:2], rtol=0.2)
        np.testing.assert_allclose([each.offset[2], 3**0.5 / each.scale[2]], 50.0, rtol=1e-6)
    model.save(tmp_path / "model")
    model.export(tmp_path / "safe")
    observations = (rng.normal(size=(5, 3)) * [1.0, 1e3, 0.0] + [3.0, 0.0, 50.0]).astype(np.float32)
    for loaded in (DDiffPG.load(tmp_path / "model"), DDiffPG.load(tmp_path / "safe", safe=True)):
        th.testing.assert_close(state_of(loaded)["/policy/actor.features_extractor.scale"], parts[0].scale)
        np.testing.assert_array_equal(
            loaded.predict(observations, deterministic=True)[0], model.predict(observations, deterministic=True)[0]
        )
    assert_same_state(state_of(DDiffPG.load(tmp_path / "model")), state_of(model))
