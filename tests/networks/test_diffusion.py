"""The diffusion model against diffusers' DDPM scheduler, closed forms and a distribution that it must learn."""

import numpy as np
import pytest
import torch as th
from diffusers import DDPMScheduler

from sb3_ddiffpg.networks.denoiser import Denoiser, SinusoidalEmbedding
from sb3_ddiffpg.networks.diffusion import DiffusionModel, squared_cosine_betas


def make_model(n_steps: int = 5, condition_dim: int = 3, action_dim: int = 2, width: int = 32) -> DiffusionModel:
    return DiffusionModel(Denoiser(condition_dim, action_dim, n_steps, [width, width]), n_steps)


def make_scheduler(n_steps: int) -> DDPMScheduler:
    return DDPMScheduler(
        num_train_timesteps=n_steps,
        beta_schedule="squaredcos_cap_v2",
        prediction_type="epsilon",
        clip_sample=True,
        variance_type="fixed_small",
    )


@pytest.mark.parametrize("n_steps", [1, 2, 5, 20, 100])
def test_schedule_equals_diffusers(n_steps):
    scheduler = make_scheduler(n_steps)
    np.testing.assert_allclose(squared_cosine_betas(n_steps).numpy(), scheduler.betas.numpy(), rtol=1e-5)


def test_schedule_has_the_published_values():
    # alpha-bar of T=5 from cos^2((t/T + .008) / 1.008 * pi / 2), worked out by hand
    alpha_bar = th.cumprod(1 - squared_cosine_betas(5), dim=0)
    np.testing.assert_allclose(alpha_bar.numpy(), [0.8987, 0.6475, 0.3408, 0.0940, 9.4e-5], rtol=2e-3)


@pytest.mark.parametrize("n_steps", [2, 5, 20])
def test_sampling_equals_diffusers(n_steps, monkeypatch):
    """The same denoiser and the same noise give the same actions, step for step."""
    th.manual_seed(0)
    model, scheduler = make_model(n_steps), make_scheduler(n_steps)
    condition, noise = th.randn(16, 3), th.randn(n_steps, 16, 2)
    actions = noise[0]
    denoiser = model.denoiser
    with th.no_grad():
        for t in reversed(range(n_steps)):
            epsilon = denoiser(actions, denoiser.condition_in(condition), denoiser.time_table()[t])
            # diffusers draws the noise itself: hand it ours
            step_noise = noise[n_steps - t] if t > 0 else th.zeros_like(actions)
            monkeypatch.setattr(
                "diffusers.schedulers.scheduling_ddpm.randn_tensor", lambda *args, noise=step_noise, **kwargs: noise
            )
            actions = scheduler.step(epsilon, t, actions).prev_sample
    th.testing.assert_close(model.sample(condition, noise=noise), actions, rtol=1e-4, atol=1e-5)


def test_noising_equals_diffusers():
    """The loss sees q(a_t | a_0): a denoiser that returns its input reveals the noisy action."""
    n_steps = 5
    model, scheduler = make_model(n_steps), make_scheduler(n_steps)
    actions, noise, steps = th.rand(64, 2) * 2 - 1, th.randn(64, 2), th.randint(n_steps, (64,))
    seen = []
    model.denoiser.trunk = th.nn.Identity()
    model.denoiser.action_in = th.nn.Linear(2, 2, bias=False)
    th.nn.init.eye_(model.denoiser.action_in.weight)
    model.denoiser.condition_in = th.nn.Linear(3, 2)
    model.denoiser.time_in = th.nn.Linear(32, 2)
    for parameters in (model.denoiser.condition_in.parameters(), model.denoiser.time_in.parameters()):
        for parameter in parameters:
            th.nn.init.zeros_(parameter)
    loss = model.loss(actions, th.zeros(64, 3), steps=steps, noise=noise)
    noisy = scheduler.add_noise(actions, noise, steps)
    seen.append((noisy - noise).pow(2).mean())
    th.testing.assert_close(loss, seen[0], rtol=1e-5, atol=1e-6)


def test_first_layer_in_three_parts_equals_one_layer():
    """Splitting the first layer is bookkeeping: the product with the concatenated input is the same."""
    denoiser = Denoiser(3, 2, 5, [16, 8])
    actions, condition, steps = th.randn(10, 2), th.randn(10, 3), th.randint(5, (10,))
    embedded = denoiser.time_mlp(steps)
    weight = th.cat((denoiser.time_in.weight, denoiser.condition_in.weight, denoiser.action_in.weight), dim=1)
    whole = th.nn.functional.linear(th.cat((embedded, condition, actions), dim=1), weight, denoiser.condition_in.bias)
    split = denoiser(actions, denoiser.condition_in(condition), denoiser.time_table()[steps])
    th.testing.assert_close(split, denoiser.trunk(whole))


def test_weights_mask_rows():
    th.manual_seed(1)
    model = make_model()
    actions, condition, steps, noise = th.rand(8, 2), th.randn(8, 3), th.randint(5, (8,)), th.randn(8, 2)
    weights = th.tensor([1.0] * 5 + [0.0] * 3)
    masked = model.loss(actions, condition, weights=weights, steps=steps, noise=noise)
    th.testing.assert_close(masked, model.loss(actions[:5], condition[:5], steps=steps[:5], noise=noise[:5]))


def test_deterministic_sampling_repeats_and_ignores_the_row():
    model = make_model()
    condition = th.randn(1, 3).expand(6, 3)
    actions = model.sample(condition, deterministic=True)
    assert th.equal(actions, model.sample(condition, deterministic=True))
    th.testing.assert_close(actions, actions[:1].expand(6, 2), rtol=0, atol=1e-6)


def test_samples_are_bounded_and_the_last_step_adds_no_noise():
    model = make_model()
    condition, noise = th.randn(256, 3), 10 * th.randn(5, 256, 2)
    assert model.sample(condition, noise=noise).abs().max() <= 1.0


def test_learns_a_bimodal_distribution():
    """Two actions, equally likely, for one condition; one of them alone for another."""
    th.manual_seed(0)
    model = make_model(width=64)
    optimizer = th.optim.Adam(model.parameters(), lr=3e-3)
    both, single = th.tensor([1.0, 0.0, 0.0]), th.tensor([0.0, 1.0, 0.0])
    for _ in range(1500):
        sign = th.randint(0, 2, (256, 1)) * 2.0 - 1.0
        sign[128:] = 1.0
        condition = th.cat((both.expand(128, 3), single.expand(128, 3)))
        optimizer.zero_grad()
        model.loss(0.5 * sign * th.tensor([1.0, -1.0]), condition).backward()
        optimizer.step()
    # Five steps blur the two points a little: as much as with the exact denoiser, E[a | a_t] = a tanh(<a, a_t> ...)
    betas = squared_cosine_betas(5)
    alpha_bar = th.cumprod(1 - betas, dim=0)
    point, exact = 0.5 * th.tensor([1.0, -1.0], dtype=th.float64), th.randn(4000, 2, dtype=th.float64)
    for t in reversed(range(5)):
        previous = alpha_bar[t - 1] if t else th.tensor(1.0)
        x0 = point * th.tanh((exact @ point) * alpha_bar[t].sqrt() / (1 - alpha_bar[t]))[:, None]
        mean = betas[t] * previous.sqrt() * x0 + (1 - betas[t]).sqrt() * (1 - previous) * exact
        sigma = (betas[t] * (1 - previous) / (1 - alpha_bar[t])).sqrt()
        exact = mean / (1 - alpha_bar[t]) + sigma * th.randn_like(exact)
    learned = model.sample(both.expand(4000, 3))
    quantiles = th.tensor([0.2, 0.4, 0.6, 0.8, 0.95])
    difference = th.quantile(learned[:, 0].abs(), quantiles) - th.quantile(exact[:, 0].abs().float(), quantiles)
    assert difference.abs().max() < 0.1, difference
    assert 0.4 < (learned[:, 0] > 0).float().mean() < 0.6
    assert (model.sample(single.expand(1000, 3))[:, 0] > 0).float().mean() > 0.97


def test_sinusoidal_embedding_by_hand():
    embedding = SinusoidalEmbedding(4)(th.tensor([2]))
    expected = [np.sin(2), np.sin(2e-4), np.cos(2), np.cos(2e-4)]
    np.testing.assert_allclose(embedding[0].numpy(), expected, rtol=1e-5)


@pytest.mark.parametrize("dim", [0, 2, 5])
def test_bad_time_embedding_dim(dim):
    with pytest.raises(ValueError, match="time_embedding_dim"):
        SinusoidalEmbedding(dim)
