"""Critics in the training of real models: who moves, how far, and what of a gradient reaches a parameter."""

import math

import numpy as np
import pytest
import torch as th
from environments import AnySpaces, image_dict_space, small_model
from gymnasium import spaces
from planar import planar_model, said, same, walk
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.utils.divergence import DivergedError

# ---------------------------------------------------------------------- dormant modes

OPTIMIZERS = {
    "AdamW": (th.optim.AdamW, {"weight_decay": 0.1}),
    "Adam": (th.optim.Adam, {"weight_decay": 0.1}),
    "momentum": (th.optim.SGD, {"momentum": 0.9, "weight_decay": 0.01}),
}


def gathered(model):
    """By mode: its critics, and all that the optimiser has gathered for them."""
    optimizer, parameters = model.critics.optimizer, model.critics.stacked_parameters()
    moments = [
        each
        for parameter in parameters
        for each in optimizer.state[parameter].values()
        if isinstance(each, th.Tensor) and each.shape == parameter.shape
    ]
    return {
        mode.name: [each.detach()[index + 1].clone() for each in (*parameters, *moments)]
        for index, mode in enumerate(model.modes)
    }


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_modes_without_transitions_do_not_drift(name):
    """Weight decay and momentum would move them too, though nothing trains them: 500 updates, bit for bit."""
    optimizer, kwargs = OPTIMIZERS[name]
    policy = {"net_arch": [16], "optimizer_class": optimizer, "optimizer_kwargs": kwargs}
    model = planar_model(policy_kwargs=policy)
    walk(model, "up", 4)
    walk(model, "down", 5)
    assert said(model) == ["mode_0 born", "mode_1 born"]
    model._setup_learn(1)
    model.train(20, 32)  # there is something gathered
    model.replay_buffer.reset()
    model.replay_buffer.expect_modes(2)
    walk(model, "up", 4)
    assert said(model) == []  # "up" has been found again, "down" not yet
    before, exploring = gathered(model), model.critics.weights[0][0].detach().clone()
    assert len(before["mode_0"]) > len(model.critics.stacked_parameters())  # moments among them
    assert any(each.abs().sum() > 0 for each in before["mode_0"][len(model.critics.stacked_parameters()) :])
    model.train(500, 33)
    after = gathered(model)
    assert same(before["mode_0"], after["mode_0"])
    assert not any(th.equal(*each) for each in zip(before["mode_1"], after["mode_1"], strict=True))
    assert not th.equal(model.critics.weights[0][0], exploring)


def test_a_mode_that_wakes_up_is_trained_again(two_routes):
    model = two_routes
    model.replay_buffer.reset()
    model.replay_buffer.expect_modes(2)
    walk(model, "up", 4)
    model.recluster()
    model.train(5, 33)
    before = gathered(model)["mode_0"]
    walk(model, "down", 4)
    assert said(model) == []
    assert same(gathered(model)["mode_0"], before)
    model.train(1, 33)
    assert not any(th.equal(*each) for each in zip(gathered(model)["mode_0"], before, strict=True))


# ---------------------------------------------------------------------- newborn modes


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("reset_new_critics", [True, False])
def test_the_first_steps_of_a_newborn_mode_are_about_a_learning_rate_long(seed, reset_new_critics):
    """Second moments that began at zero, beside a step count of long ago, would make them up to 3.16 times as long."""
    model = planar_model(seed=seed, modes={"reset_new_critics": reset_new_critics})
    walk(model, "up", 4)
    walk(model, "down", 5)
    model.recluster()
    model._setup_learn(1)
    model.train(300, 32)
    walk(model, "right", 6)
    assert said(model) == ["mode_2 born"]
    parameters, newborn = model.critics.stacked_parameters(), model.modes.index("mode_2") + 1
    for parameter in parameters:  # the direction begins anew, the scale does not
        state = model.critics.optimizer.state[parameter]
        assert not state["exp_avg"][newborn].any() and th.equal(state["exp_avg_sq"][newborn], state["exp_avg_sq"][0])
        assert state["exp_avg"][0].any() and state["exp_avg_sq"][0].any()
    learning_rate = model.critics.optimizer.param_groups[0]["lr"]
    for _ in range(4):
        before = [parameter.detach()[newborn].clone() for parameter in parameters]
        model.train(1, 32)
        changes = [(now.detach()[newborn] - then).abs() for now, then in zip(parameters, before, strict=True)]
        moved = th.cat([change[change > 1e-9] for change in changes])
        assert len(moved) > 500 and 0.03 < moved.mean().item() / learning_rate < 1.0


@pytest.mark.parametrize("amsgrad", [False, True])
def test_a_mode_that_split_keeps_what_its_parents_steps_were_scaled_by(amsgrad):
    model = planar_model(policy_kwargs={"net_arch": [16], "optimizer_kwargs": {"amsgrad": amsgrad}})
    walk(model, "up", 6)
    model.recluster()
    model._setup_learn(1)
    model.train(5, 32)
    model.policy.inherit([0, 0], [True, False])
    for parameter in model.critics.stacked_parameters():
        state = model.critics.optimizer.state[parameter]
        for name in ("exp_avg_sq", "max_exp_avg_sq") if amsgrad else ("exp_avg_sq",):
            assert th.equal(state[name][2], state[name][1]) and state[name][2].any()
        assert state["exp_avg"][1].any() and not state["exp_avg"][2].any()


# ---------------------------------------------------------------------- features extractors that learn


class Learned(BaseFeaturesExtractor):
    """One layer."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 4)
        self.layer = nn.Linear(int(np.prod(observation_space.shape)), 4)

    def forward(self, observations):
        return self.layer(observations.flatten(1)).tanh()


WIDE = {"v_min": -50.0, "v_max": 50.0}
KINDS = {
    "learned": ("MlpPolicy", spaces.Box(-1.0, 1.0, (3,)), {"features_extractor_class": Learned}),
    "images": ("MultiInputPolicy", image_dict_space(), {}),
}


def looking(kind, algorithm=DDiffPG, **changes):
    """A model whose features extractors learn, in the midst of its training."""
    policy, space, kwargs = KINDS[kind]
    env, policy_kwargs = DummyVecEnv([lambda: AnySpaces(space)] * 2), {"net_arch": [8], **kwargs}
    settings = {"buffer_size": 300, "critic": WIDE, "policy_kwargs": policy_kwargs, "learning_starts": 30, **changes}
    if algorithm is DDiffPG:
        model = small_model(env, policy, **settings)
    else:
        model = algorithm(policy, env, **{"batch_size": 16, "seed": 0, **settings})
        model.set_logger(Logger(None, []))
    model.learn(40)
    assert any(parameter.requires_grad for parameter in model.policy.critic_features_extractor.parameters())
    return model


def norm_of(module):
    return th.cat([parameter.grad.flatten() for parameter in module.parameters()]).norm().item()


@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_of_a_features_extractor_is_clipped(kind, monkeypatch):
    """On its own: neither does it shrink the steps of critics, nor the other way round."""
    limit = 1e-4
    model = looking(kind, max_grad_norm=limit)
    optimizer, norms = model.critics.optimizer, []
    step = type(optimizer).step

    def watched(self, *args):
        if self is optimizer:
            norms.append((norm_of(model.policy.critic_features_extractor), norm_of(model.critics)))
        return step(self, *args)

    monkeypatch.setattr(type(optimizer), "step", watched)
    model.train(5, 16)
    assert len(norms) == 5
    for of_extractor, of_critics in norms:
        assert of_extractor == pytest.approx(limit, rel=0.02)
        # Each group's to the limit
        assert of_critics == pytest.approx(np.sqrt(model.critics.n_groups) * limit, rel=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_of_a_features_extractor_below_the_limit_is_as_it_is(kind):
    model = looking(kind, max_grad_norm=1e9)
    norms = []
    for _ in range(2):
        th.manual_seed(0)
        np.random.seed(0)
        batch = model.replay_buffer.sample_modes(16, model.gamma, 1, 1)
        _, given, _ = model._critic_gradients(batch, batch.rewards)
        norms.append(norm_of(model.policy.critic_features_extractor))
        assert given[-1].item() == pytest.approx(norms[-1], rel=1e-4) and len(given) == model.critics.n_groups + 1
        model.max_grad_norm = 10 * norms[-1]
    assert norms[0] == pytest.approx(norms[1], rel=1e-4)


@pytest.mark.parametrize("name", ["ddiffpg", "td3_c51", "dipo"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("kind", KINDS)
def test_a_features_extractors_gradient_that_is_no_number_is_told_before_a_parameter_takes_it(kind, value, name):
    model = looking(kind, {"ddiffpg": DDiffPG, **BASELINES}[name])
    extractor = model.policy.critic_features_extractor
    parameter = next(iter(extractor.parameters()))
    hook = parameter.register_hook(lambda gradient: th.full_like(gradient, value))
    before = {key: each.clone() for key, each in model.policy.state_dict().items()}
    with pytest.raises(DivergedError, match=f"the gradient of the critics' features extractor is (nan|{value})"):
        model.train(1, 16)
    hook.remove()
    for key, each in model.policy.state_dict().items():
        if key.startswith("critic"):
            assert th.equal(each, before[key]), key
    model.train(2, 16)  # goes on
    assert all(each.isfinite().all() for each in model.policy.state_dict().values())
    assert not th.equal(parameter, before["critic_features_extractor." + next(iter(extractor.state_dict()))])
