"""The flow against its closed form for known targets, and a distribution that it must learn."""

import pytest
import torch as th

from sb3_ddiffpg.networks.denoiser import Denoiser
from sb3_ddiffpg.networks.flow import FlowModel


def make_model(width: int = 32) -> FlowModel:
    return FlowModel(Denoiser(3, 2, 2, [width, width]))


class Exact(th.nn.Module):
    """The velocity E[z - a | x_t] where a is one of some points, equally likely, and z standard normal: Bayes' rule."""

    action_dim = 2

    def __init__(self, points: th.Tensor, times: th.Tensor) -> None:
        super().__init__()
        self.points, self.times, self.condition_in = points, times, th.nn.Identity()

    def time_table(self) -> th.Tensor:
        return self.times[:, None]

    def forward(self, x: th.Tensor, _: th.Tensor, t: th.Tensor) -> th.Tensor:
        z = (x[:, None] - (1 - t) * self.points) / t  # of each point, [N, P, 2]
        posterior = (-z.square().sum(dim=-1) / 2).softmax(dim=1)
        return (posterior[..., None] * (z - self.points)).sum(dim=1)


def test_one_point_is_reached_from_anywhere():
    model, point = make_model(), th.tensor([[0.3, -0.8]])
    model.denoiser = Exact(point, model.times)
    noise = 5 * th.randn(1, 100, 2)
    th.testing.assert_close(model.sample(th.zeros(100, 3), noise=noise), point.expand(100, 2), rtol=0, atol=1e-5)
    th.testing.assert_close(model.sample(th.zeros(1, 3), deterministic=True), point, rtol=0, atol=1e-5)


def test_two_points_are_told_apart():
    """With one step all actions would lie in the middle. By hand: the last step ends at p tanh(z p (1 - t) / t)."""
    model, point = make_model(), th.tensor([0.9, -0.9])
    model.denoiser = Exact(th.stack((point, -point)), model.times)
    noise, t = th.randn(1, 4000, 2), model.times[1]
    actions = model.sample(th.zeros(4000, 3), noise=noise)
    by_hand = point * th.tanh((noise[0] @ point) * (1 - t) / t)[:, None]
    th.testing.assert_close(actions, by_hand, rtol=0, atol=1e-5)
    assert (actions[:, 0].abs() > 0.45).float().mean() > 0.6  # one step: 0 for all


def test_learns_a_bimodal_distribution():
    """Two actions, equally likely, for one condition; one of them alone for another."""
    th.manual_seed(0)
    model, points = make_model(64), 0.9 * th.tensor([[1.0, -1.0], [-1.0, 1.0]])
    optimizer = th.optim.Adam(model.parameters(), lr=3e-3)
    both, single = th.tensor([1.0, 0.0, 0.0]), th.tensor([0.0, 1.0, 0.0])
    for _ in range(1500):
        which = th.randint(2, (256,))
        which[128:] = 0
        condition = th.cat((both.expand(128, 3), single.expand(128, 3)))
        optimizer.zero_grad()
        model.loss(points[which], condition).backward()
        optimizer.step()
    noise = th.randn(1, 4000, 2)
    learned = model.sample(both.expand(4000, 3), noise=noise)
    model.denoiser = Exact(points, model.times)
    exact = model.sample(both.expand(4000, 3), noise=noise)
    quantiles = th.tensor([0.2, 0.4, 0.6, 0.8, 0.95])
    difference = th.quantile(learned[:, 0].abs(), quantiles) - th.quantile(exact[:, 0].abs(), quantiles)
    assert difference.abs().max() < 0.1, difference
    assert 0.4 < (learned[:, 0] > 0).float().mean() < 0.6


def test_one_action_alone_is_learned_sharply():
    th.manual_seed(0)
    model = make_model(64)
    optimizer = th.optim.Adam(model.parameters(), lr=3e-3)
    for _ in range(800):
        condition = th.rand(256, 3) * 2 - 1
        optimizer.zero_grad()
        model.loss(condition[:, :2] * 0.8, condition).backward()
        optimizer.step()
    condition = th.rand(500, 3) * 2 - 1
    errors = (model.sample(condition) - condition[:, :2] * 0.8).abs()
    assert errors.mean() < 0.05


def test_the_loss_by_hand():
    """A network that says nothing: what is left is the velocity itself, of the rows that count."""
    model = make_model()
    for parameter in model.denoiser.parameters():
        th.nn.init.zeros_(parameter)
    actions, noise, steps = th.rand(8, 2) * 2 - 1, th.randn(8, 2), th.arange(8) % 2
    expected = (noise - actions).square().mean(dim=1)
    th.testing.assert_close(model.loss(actions, th.zeros(8, 3), steps=steps, noise=noise), expected.mean())
    weights = th.tensor([1.0, 1, 1, 0, 0, 0, 0, 0])
    found = model.loss(actions, th.zeros(8, 3), weights=weights, steps=steps, noise=noise)
    th.testing.assert_close(found, expected[:3].mean())


def test_the_network_sees_a_point_between_action_and_noise():
    model = make_model()
    seen = []
    model.denoiser.forward = lambda x, condition, time: seen.append(x) or th.zeros_like(x)
    actions, noise = th.rand(6, 2), th.randn(6, 2)
    for step, time in enumerate(model.times.tolist()):
        model.loss(actions, th.zeros(6, 3), steps=th.full((6,), step), noise=noise)
        th.testing.assert_close(seen[-1], (1 - time) * actions + time * noise)


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_actions_stay_in_bounds_and_repeat(scale):
    model, condition, noise = make_model(), th.randn(256, 3), scale * th.randn(1, 256, 2)
    actions = model.sample(condition, noise=noise)
    assert actions.abs().max() <= 1.0 and th.equal(actions, model.sample(condition, noise=noise))
    assert not th.equal(actions, model.sample(condition))
