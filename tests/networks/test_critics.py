"""The stacked critics against single networks, the projection against the formula written out, and inheritance."""

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_ddiffpg.networks.critics import ModeCritics, project_distribution
from sb3_ddiffpg.networks.target_actions import ACTION_LIMIT, ascend


def slow_projection(probabilities, atoms, reward, discount):
    """Bellemare et al. (2017), algorithm 1, for one row, with loops and no tricks."""
    v_min, v_max, n_atoms = atoms[0], atoms[-1], len(atoms)
    step = (v_max - v_min) / (n_atoms - 1)
    projected = np.zeros(n_atoms)
    for probability, atom in zip(probabilities, atoms, strict=True):
        # the quotient can exceed the last atom by a rounding error
        position = min((np.clip(reward + discount * atom, v_min, v_max) - v_min) / step, n_atoms - 1)
        lower, upper = int(np.floor(position)), int(np.ceil(position))
        if lower == upper:
            projected[lower] += probability
        else:
            projected[lower] += probability * (upper - position)
            projected[upper] += probability * (position - lower)
    return projected


@settings(max_examples=60, deadline=None)
@given(
    n_atoms=st.integers(2, 60),
    bounds=st.tuples(st.floats(-20, 0), st.floats(0.5, 20)),
    reward=st.floats(-30, 30),
    discount=st.sampled_from([0.0, 0.5, 0.97, 1.0]),
    seed=st.integers(0, 1000),
)
def test_projection_equals_the_formula(n_atoms, bounds, reward, discount, seed):
    rng = np.random.default_rng(seed)
    probabilities = rng.dirichlet(np.ones(n_atoms))
    atoms = np.linspace(*bounds, n_atoms)
    ours = project_distribution(
        th.tensor(probabilities).view(1, 1, -1),
        th.tensor(atoms).view(1, 1, -1),
        th.tensor([[reward]], dtype=th.float64),
        th.tensor([[discount]], dtype=th.float64),
    )
    np.testing.assert_allclose(ours[0, 0].numpy(), slow_projection(probabilities, atoms, reward, discount), atol=1e-6)


def test_projection_by_hand():
    # All mass on z=1 of {0, 1, 2}; r=.5, gamma=.5 moves it to 1: nothing to split. r=.25 -> .75: 1/4 on 0, 3/4 on 1
    atoms, mass = th.tensor([[[0.0, 1.0, 2.0]]]), th.tensor([[[0.0, 1.0, 0.0]]])
    half = th.tensor([[0.5]])
    th.testing.assert_close(project_distribution(mass, atoms, half, half), mass)
    th.testing.assert_close(project_distribution(mass, atoms, half / 2, half), th.tensor([[[0.25, 0.75, 0.0]]]))


@pytest.mark.parametrize("n_atoms", [1, 11])
def test_stack_equals_single_networks(n_atoms):
    th.manual_seed(0)
    critics = ModeCritics(4, 2, [16, 8], n_groups=3, n_atoms=n_atoms)
    features, actions = th.randn(3, 5, 4), th.rand(3, 5, 2)
    logits = critics(features, actions)
    for group in range(3):
        for twin in range(2):
            hidden = th.cat((features[group], actions[group]), dim=1)
            for layer in range(3):
                hidden = hidden @ critics.weights[layer][group, twin] + critics.biases[layer][group, twin]
                hidden = th.nn.functional.silu(hidden) if layer < 2 else hidden
            th.testing.assert_close(logits[group, twin], hidden)


def test_target_is_the_distribution_of_the_lower_twin():
    th.manual_seed(0)
    critics = ModeCritics(4, 2, [16], n_groups=2, n_atoms=11, support=(0.0, 5.0), exploration_support=(-2.0, 2.0))
    th.nn.init.normal_(critics.weights[-1])
    features, actions = th.randn(2, 20, 4), th.rand(2, 20, 2)
    rewards, discounts = th.rand(2, 20), 0.9 * th.randint(0, 2, (2, 20))
    targets = critics.bellman_target(features, actions, rewards, discounts)
    logits = critics(features, actions).detach()
    for group, (low, high) in enumerate([(-2.0, 2.0), (0.0, 5.0)]):
        atoms = np.linspace(low, high, 11)
        for row in range(20):
            probabilities = logits[group, :, row].softmax(dim=-1).numpy()
            lower = probabilities[np.argmin(probabilities @ atoms)]
            expected = slow_projection(lower, atoms, rewards[group, row].item(), discounts[group, row].item())
            np.testing.assert_allclose(targets[group, row].numpy(), expected, atol=1e-5)


def test_scalar_target_is_the_clipped_minimum():
    th.manual_seed(0)
    critics = ModeCritics(4, 2, [16], n_groups=2, n_atoms=1, support=(0.0, 1.0), exploration_support=(-1.0, 1.0))
    features, actions = th.randn(2, 20, 4), th.rand(2, 20, 2)
    rewards, discounts = 2 * th.randn(2, 20), th.full((2, 20), 0.9)
    expected = rewards + 0.9 * critics(features, actions)[..., 0].min(dim=1).values
    expected = th.stack((expected[0].clamp(-1, 1), expected[1].clamp(0, 1)))[..., None]
    th.testing.assert_close(critics.bellman_target(features, actions, rewards, discounts), expected)


def test_elementwise_targets_are_probabilities():
    """At the end of an episode all of a distribution falls on one atom, and sums to a little more than one."""
    th.manual_seed(0)
    critics = ModeCritics(3, 2, [16], n_groups=1, n_atoms=51, twin_target="elementwise", exploration_support=(0.0, 5.0))
    features, actions = th.randn(1, 2000, 3), th.randn(1, 2000, 2)
    targets = critics.bellman_target(features, actions, th.ones(1, 2000), th.zeros(1, 2000))
    assert targets.min() >= 0 and targets.max() <= 1
    assert critics.loss(features, actions, targets).isfinite().all()


def test_elementwise_target_by_hand():
    """The authors' code: binary cross-entropy with the minimum of the two projected distributions."""
    th.manual_seed(0)
    critics = ModeCritics(3, 2, [16], n_groups=2, n_atoms=11, twin_target="elementwise")
    th.nn.init.normal_(critics.weights[-1])
    features, actions = th.randn(2, 6, 3), th.rand(2, 6, 2)
    rewards, discounts = th.rand(2, 6), th.full((2, 6), 0.9)
    twins = critics(features, actions).softmax(dim=-1)
    atoms = critics.atoms[[0, 1]][:, None, :]
    first, second = (project_distribution(twins[:, twin], atoms, rewards, discounts) for twin in range(2))
    targets = critics.bellman_target(features, actions, rewards, discounts)
    th.testing.assert_close(targets, th.minimum(first, second))
    assert (targets.sum(dim=-1) < 0.999).all()
    p, t = twins.double(), targets.double()[:, None]
    expected = -(t * p.log() + (1 - t) * (1 - p).log()).sum(dim=-1).mean(dim=2).sum(dim=1)
    th.testing.assert_close(critics.loss(features, actions, targets).double(), expected, rtol=1e-4, atol=1e-4)


def test_values_start_near_zero():
    critics = ModeCritics(4, 2, [64, 64], n_groups=3, support=(0.0, 5.0), exploration_support=(-5.0, 5.0))
    values = critics.values(critics(th.randn(3, 100, 4), th.rand(3, 100, 2)))
    assert values[0].abs().max() < 0.5
    assert values[1:].max() < 1.0 and values[1:].min() >= 0.0


@pytest.mark.parametrize("n_atoms", [51, 1])
@pytest.mark.parametrize("activation_fn", [th.nn.SiLU, th.nn.ELU, th.nn.Tanh])
def test_action_gradient_equals_finite_differences_and_ignores_the_batch(activation_fn, n_atoms):
    th.manual_seed(0)
    critics = ModeCritics(3, 2, [16, 16], n_groups=2, activation_fn=activation_fn, n_atoms=n_atoms).double()
    th.nn.init.normal_(critics.weights[-1])
    features, actions = th.randn(2, 6, 3).double(), (th.rand(2, 6, 2) - 0.5).double()

    def value(at):
        return critics.values(critics(features, at))[:, 0]

    gradient = critics.action_gradient(features)(actions)
    for dim in range(2):
        shift = th.zeros(2).double()
        shift[dim] = 1e-6
        numeric = (value(actions + shift) - value(actions - shift)) / 2e-6
        th.testing.assert_close(gradient[..., dim], numeric, rtol=1e-4, atol=1e-6)
    alone = critics.action_gradient(features[:, :1])(actions[:, :1])
    th.testing.assert_close(alone, gradient[:, :1])


@pytest.mark.parametrize("optimizer", ["sgd", "normalized", "relative", "adam"])
def test_ascent_climbs_to_the_maximum(optimizer):
    """Q(a) = -|a - a*|^2 has its maximum at a*; autograd gives the gradient."""
    best = th.tensor([[0.4, -0.7], [0.0, 0.9]])

    def gradient(actions):
        actions = actions.clone().requires_grad_()
        return th.autograd.grad(-(actions - best).pow(2).sum(), actions)[0]

    improved = ascend(gradient, th.zeros(2, 2), learning_rate=0.02, n_steps=300, optimizer=optimizer)
    assert (improved - best).abs().max() < 0.05


def test_ascent_single_steps_by_hand():
    def gradient(actions):
        return th.tensor([[3.0, -4.0]]).expand_as(actions)

    start = th.zeros(1, 2)
    th.testing.assert_close(ascend(gradient, start, 0.1, 1, "sgd"), th.tensor([[0.3, -0.4]]))
    th.testing.assert_close(ascend(gradient, start, 0.1, 1, "normalized"), th.tensor([[0.06, -0.08]]))
    th.testing.assert_close(ascend(gradient, start, 0.1, 1, "adam"), th.tensor([[0.1, -0.1]]))
    assert ascend(gradient, start, 5.0, 3, "sgd").abs().max() == pytest.approx(ACTION_LIMIT)


def test_relative_steps_by_hand():
    """Two groups, whose gradients are 1 and 5 long, and 30 and 10: means of 3 and of 20."""
    slopes = th.tensor([[[0.6, 0.8], [3.0, -4.0]], [[0.0, 30.0], [-10.0, 0.0]]])
    expected = th.tensor([[[0.6 / 3, 0.8 / 3], [0.6, -0.8]], [[0.0, 1.0], [-0.5, 0.0]]])
    found = ascend(lambda actions: slopes, th.zeros(2, 2, 2), 0.1, 1, "relative")
    th.testing.assert_close(found, 0.1 * expected)
    nowhere = ascend(th.zeros_like, th.full((1, 3, 2), 0.5), 0.1, 4, "relative")
    assert th.equal(nowhere, th.full((1, 3, 2), 0.5))


def test_ascent_adam_equals_torch():
    """K steps from a fresh optimiser, as torch.optim.Adam takes them on minus the value."""
    best = th.tensor([[0.4, -0.2]])
    parameter = th.nn.Parameter(th.zeros(1, 2))
    adam = th.optim.Adam([parameter], lr=0.03)
    for _ in range(7):
        adam.zero_grad()
        (parameter - best).pow(2).sum().backward()
        adam.step()
    ours = ascend(lambda actions: -2 * (actions - best), th.zeros(1, 2), 0.03, 7, "adam")
    th.testing.assert_close(ours, parameter.detach(), rtol=1e-4, atol=1e-6)


def trained(n_groups: int) -> tuple[ModeCritics, th.optim.Optimizer]:
    """A stack whose optimiser has moments."""
    critics = ModeCritics(3, 2, [8], n_groups=n_groups, n_atoms=5)
    optimizer = th.optim.AdamW(critics.parameters(), lr=1e-2)
    for _ in range(3):
        optimizer.zero_grad()
        critics(th.randn(n_groups, 4, 3), th.rand(n_groups, 4, 2)).pow(2).sum().backward()
        optimizer.step()
    return critics, optimizer


def test_inherit_moves_weights_and_moments_together():
    th.manual_seed(0)
    critics, optimizer = trained(3)
    weights = [parameter.detach().clone() for parameter in critics.parameters()]
    moments = [optimizer.state[parameter]["exp_avg"].clone() for parameter in critics.parameters()]
    # New mode 0 is old mode 1, new mode 1 split from it, new mode 2 born
    critics.inherit([1, 1, None], [False, True, True], optimizer, reset_output=False)
    assert critics.n_groups == 4
    for index, parameter in enumerate(critics.parameters()):
        assert th.equal(parameter.data, weights[index][[0, 2, 2, 0]])
        moment = optimizer.state[parameter]["exp_avg"]
        assert th.equal(moment[:2], moments[index][[0, 2]])
        assert not moment[2:].any()


def test_training_goes_on_after_inheriting_as_if_groups_were_separate():
    """The surviving group's next step is the one that it would have taken without the others' changes."""
    th.manual_seed(0)
    critics, optimizer = trained(3)
    th.manual_seed(0)
    untouched, untouched_optimizer = trained(3)
    critics.inherit([1], [False], optimizer, reset_output=True)
    features, actions = th.randn(3, 4, 3), th.rand(3, 4, 2)
    for stack, adam, rows in ((critics, optimizer, [0, 2]), (untouched, untouched_optimizer, [0, 1, 2])):
        adam.zero_grad()
        stack(features[rows], actions[rows]).pow(2).sum().backward()
        adam.step()
    for new, old in zip(critics.parameters(), untouched.parameters(), strict=True):
        th.testing.assert_close(new.data, old.data[[0, 2]])


def test_newborn_critic_copies_the_hidden_layers_and_forgets_the_output():
    critics, optimizer = trained(2)
    critics.inherit([0, None], [False, True], optimizer, reset_output=True)
    assert th.equal(critics.weights[0][2], critics.weights[0][0])
    assert not critics.weights[-1][2].any()
    values = critics.values(critics(th.randn(3, 9, 3), th.rand(3, 9, 2)))[2]
    assert values.std() < 1e-6 and values.mean() < 1.0


def test_gradients_are_clipped_group_by_group():
    critics = ModeCritics(3, 2, [8], n_groups=2, n_atoms=5)
    logits = critics(th.randn(2, 4, 3), th.rand(2, 4, 2))
    (logits[0].sum() * 1e4 + logits[1].sum() * 1e-4).backward()
    before = [parameter.grad.clone() for parameter in critics.parameters()]
    critics.clip_gradients(1.0)
    norms = th.stack([p.grad.flatten(1).norm(dim=1) for p in critics.parameters()]).norm(dim=0)
    assert norms[0] == pytest.approx(1.0, abs=1e-4)
    for parameter, gradient in zip(critics.parameters(), before, strict=True):
        th.testing.assert_close(parameter.grad[1], gradient[1])
