"""Training that diverges is stopped, named by part, and leaves nothing behind."""

import math

import numpy as np
import pytest
import torch as th
from environments import TwoEnds, small_model
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.baselines import BASELINES, RPG, SACC51
from sb3_ddiffpg.exploration.novelty import VisitCounts
from sb3_ddiffpg.utils.divergence import DivergedError, DivergenceWatch, step_unless

ALGORITHMS = {"ddiffpg": DDiffPG, **BASELINES}


def trained(algorithm, **changes):
    settings = {"learning_starts": 40, "buffer_size": 2000, "batch_size": 32, "train_freq": 4, "seed": 0}
    env = DummyVecEnv([TwoEnds] * 4)
    model = algorithm("MlpPolicy", env, **{"policy_kwargs": {"net_arch": [16]}, **settings, **changes})
    model.set_logger(Logger(None, []))
    return model.learn(80)


def parts_of(model):
    """Name in the error -> a parameter that the part learns."""
    critics = model.critics.stacked_parameters()
    parts = {"model" if isinstance(model, RPG) else "critics": critics[0]}
    parts["actor"] = next(iter(model.actor.optimizer.param_groups[0]["params"]))
    return parts


def state_of(model):
    tensors = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    for number, optimizer in enumerate((model.actor.optimizer, model.policy.critics.optimizer)):
        for index, state in enumerate(optimizer.state_dict()["state"].values()):
            tensors |= {f"optimizer {number} {index} {key}": value.clone() for key, value in state.items()}
    return tensors


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_gradient_that_is_no_number_stops_training_and_changes_nothing_of_its_part(name, value):
    model = trained(ALGORITHMS[name])
    for part, parameter in parts_of(model).items():
        hook = parameter.register_hook(lambda gradient: th.full_like(gradient, value))
        before = parameter.detach().clone()
        with pytest.raises(DivergedError, match=f"the gradient of the (exploratory )?{part} is"):
            model.train(2, 32)  # the policy of some learns at every other update
        hook.remove()
        assert th.equal(parameter, before)
        assert all(tensor.isfinite().all() for tensor in state_of(model).values())
        model.train(1, 32)  # goes on
    if isinstance(model, RPG | SACC51):
        model.target_entropy, before = value, model.entropy_coef
        with pytest.raises(DivergedError, match="the gradient of the entropy's factor is"):
            model.train(1, 32)
        model.target_entropy = None
        assert model.entropy_coef == before
    assert model.learn(40, reset_num_timesteps=False)._n_updates > 0


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_overflow_within_an_update_is_noticed_by_that_update(name):
    """Weights so large that the critics' loss cannot be told in 32 bits."""
    model = trained(ALGORITHMS[name], critic={"n_atoms": 1})
    parameter = model.critics.stacked_parameters()[0]
    with th.no_grad():
        parameter.fill_(1e30)
    before = state_of(model)
    with pytest.raises(DivergedError, match="Training has diverged: the loss of the "):
        model.train(1, 32)
    for key, tensor in state_of(model).items():
        assert th.equal(tensor, before[key]), key


def test_an_exploding_loss_is_noticed_before_it_overflows():
    model = trained(DDiffPG, critic={"n_atoms": 1, "v_max": 5.0}, exploration={"v_max": 5.0})
    with th.no_grad():
        model.critics.biases[-1].fill_(2.5e3)  # 500 supports away: unwise, no more
    model.train(1, 32)
    with th.no_grad():
        model.critics.biases[-1].fill_(4e4)
    # Twins: 2 * 40000^2
    with pytest.raises(DivergedError, match=r"the loss of the exploratory critics is 3\.\d+e\+09"):
        model.train(1, 32)


def test_the_mode_at_fault_is_named():
    model = small_model(DummyVecEnv([TwoEnds] * 4), critic={"n_atoms": 1}).learn(600)
    assert len(model.modes) >= 2
    model.rename_mode(1, "left door")
    with th.no_grad():
        model.critics.biases[-1][2] = math.nan
    with pytest.raises(DivergedError) as caught:
        model.train(1, 32)
    named, other = "the loss of the critics of 'left door' is nan", repr(model.modes[0].name)
    assert named in str(caught.value) and f"loss of the critics of {other}" not in str(caught.value)


def test_the_replay_buffer_gets_no_target_action_that_is_no_number(monkeypatch):
    model = trained(DDiffPG)
    before = model.replay_buffer.target_actions.copy()
    monkeypatch.setitem(model.graphs, "ascent", lambda batch: batch.target_actions * math.nan)
    with pytest.raises(DivergedError, match="a target action is nan"):
        model.train(1, 32)
    np.testing.assert_array_equal(model.replay_buffer.target_actions, before)


def test_novelty_that_is_no_number_does_not_reach_its_running_scale(monkeypatch):
    model = trained(DDiffPG, novelty="rnd")
    before = {name: tensor.clone() for name, tensor in model.bonus.moments.state_dict().items()}
    weights = [parameter.detach().clone() for parameter in model.bonus.novelty_model.parameters()]
    with monkeypatch.context() as broken:
        broken.setattr(model.bonus.novelty_model, "novelty", lambda positions, _: positions[:, 0] * math.nan)
        with pytest.raises(DivergedError, match="the novelty is nan"):
            model.train(1, 32)
    assert all(th.equal(tensor, before[name]) for name, tensor in model.bonus.moments.state_dict().items())
    assert all(th.equal(now, then) for now, then in zip(model.bonus.novelty_model.parameters(), weights, strict=True))


class Far(TwoEnds):
    """Once, an observation of any size."""

    def __init__(self, value, dtype=np.float32):
        super().__init__()
        self.value, self.n_steps = value, 0
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), dtype)

    def step(self, action):
        self.n_steps += 1
        observation, *rest = super().step(action)
        observation = observation.astype(self.observation_space.dtype)
        return (observation if self.n_steps != 15 else np.full_like(observation, self.value)), *rest


@pytest.mark.parametrize(("value", "dtype"), [(1e25, np.float32), (1e300, np.float64), (-np.inf, np.float32)])
def test_what_does_not_fit_into_squares_of_32_bits_is_refused_with_its_environment(value, dtype):
    """Or running statistics, such as RND's scale, would never be numbers again."""
    env = DummyVecEnv([TwoEnds, lambda: Far(value, dtype)] if dtype == np.float32 else [lambda: Far(value, dtype)] * 2)
    env.observation_space = spaces.Box(-np.inf, np.inf, (2,), dtype)
    model = small_model(env, novelty="rnd", learning_starts=200)
    with pytest.raises(ValueError, match=r"next observation of environment \d is (too large|not finite)"):
        model.learn(100)
    assert all(tensor.isfinite().all() for tensor in model.bonus.novelty_model.state_dict().values())
    stored = model.replay_buffer.stored_rows.rows[: model.replay_buffer.size()]
    assert len(stored) == 28 and np.isfinite(model.replay_buffer.next_observations[stored]).all()
    if dtype == np.float32:
        model.learn(100)


def test_mode_features_that_are_no_numbers_are_refused():
    model = small_model(DummyVecEnv([TwoEnds] * 2), novelty="rnd", mode_features=lambda obs: np.log(obs[:, :1] - 5.0))
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match="mode features of environment 0 is not finite"):
        model.learn(100)
    assert model.replay_buffer.size() == 0


class Surprised(VisitCounts):
    """Finite, but not its square."""

    def novelty(self, positions, observations):
        return super().novelty(positions, observations) * 1e25


def test_novelty_too_large_for_its_running_scale_is_noticed():
    model = small_model(DummyVecEnv([TwoEnds] * 2), novelty=Surprised)
    with pytest.raises(DivergedError, match="the novelty is"):
        model.learn(100)
    assert all(tensor.isfinite().all() for tensor in model.bonus.moments.state_dict().values())


@pytest.mark.parametrize("name", ["rpg", "sac_c51"])
def test_entropy_may_be_switched_off(name):
    model = trained(BASELINES[name], initial_entropy_coef=0.0)
    assert model.entropy_coef == 0.0 and model._n_updates > 0


@pytest.mark.parametrize("optimizer", [th.optim.Adam, th.optim.AdamW, th.optim.SGD, th.optim.RMSprop])
@pytest.mark.parametrize("fused", [True, False])
def test_a_step_that_must_not_be_is_none(optimizer, fused):
    if fused and optimizer is th.optim.RMSprop:
        pytest.skip("has no fused version")
    parameters = [nn.Parameter(th.ones(3)) for _ in range(2)]
    learner, plain = (optimizer([each], lr=0.1, **({"fused": True} if fused else {})) for each in parameters)
    for bad, gradient in ((False, 1.0), (True, math.nan), (False, 2.0)):
        for parameter in parameters:
            parameter.grad = th.full((3,), gradient)
        step_unless(th.tensor(bad), learner)
        if not bad:
            plain.step()
    assert th.equal(*parameters) and not th.equal(parameters[0], th.ones(3))
    for mine, other in zip(learner.state_dict()["state"].values(), plain.state_dict()["state"].values(), strict=True):
        assert all(th.equal(mine[key], other[key]) for key in other if other[key] is not None)


def test_an_accelerator_is_not_waited_for_and_reports_later():
    watch = DivergenceWatch(th.device("cuda"), largest_loss=10.0)  # nothing is computed there
    parameter = nn.Parameter(th.ones(2))
    optimizer = th.optim.Adam([parameter], fused=True)
    for loss, moved in ((1.0, True), (11.0, False), (math.nan, False)):
        parameter.grad, before = th.ones(2), parameter.detach().clone()
        watch.step(["actor"], optimizer, th.tensor(loss), th.tensor(1.0))
        assert th.equal(parameter, before) != moved
    values = watch.finite("the novelty", th.tensor([1.0, math.inf, math.nan]), 0.0)
    assert values.tolist() == [1.0, 0.0, 0.0]
    with pytest.raises(DivergedError, match=r"the loss of the actor is nan; the novelty is nan"):
        watch.report()
    watch.report()  # said once
    watch.step(["actor"], optimizer, th.tensor(11.0), th.tensor(1.0), bounded=False)
    watch.report()
