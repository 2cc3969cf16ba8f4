"""Intrinsic rewards, measures of novelty and exploration noise against hand counts, dicts, numpy and statistics."""

from collections import Counter, defaultdict
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from environments import TwoEnds, assert_same_state, fill, merged, small_model, state_of
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.exploration.known_regions import KnownCells
from sb3_ddiffpg.exploration.noise import SpreadNormalActionNoise
from sb3_ddiffpg.exploration.novelty import RandomNetworkDistillation, RunningMoments, VisitCounts, noveld_reward
from sb3_ddiffpg.modes.mode import Outcome


def test_noveld_by_hand():
    novelty, following = th.tensor([0.0, 1.0, 1.0, 2.0]), th.tensor([3.0, 1.0, 0.4, 1.0])
    # max(nov(s') - .5 nov(s), 0)
    th.testing.assert_close(noveld_reward(novelty, following, 0.5), th.tensor([3.0, 0.5, 0.0, 0.0]))
    th.testing.assert_close(noveld_reward(novelty, following, 0.0), following)


@settings(max_examples=40, deadline=None)
@given(
    sizes=st.lists(st.integers(1, 40), min_size=1, max_size=6),
    mean=st.floats(-100, 100),
    deviation=st.floats(0.01, 10),
    seed=st.integers(0, 999),
)
def test_running_moments_are_those_of_all_values(sizes, mean, deviation, seed):
    rng = np.random.default_rng(seed)
    batches = [rng.normal(mean, deviation, (size, 3)).astype(np.float32) for size in sizes]
    moments = RunningMoments(3)
    for batch in batches:
        moments.update(th.as_tensor(batch))
    values = np.concatenate(batches).astype(np.float64)
    scale = np.abs(values).max() + 1
    np.testing.assert_allclose(moments.mean, values.mean(axis=0), atol=1e-5 * scale)
    np.testing.assert_allclose(moments.var, values.var(axis=0), atol=1e-5 * scale**2)
    assert moments.count.item() == len(values)
    if len(values) > 20:
        standardised = moments.standardize(th.as_tensor(values).float()).numpy()
        np.testing.assert_allclose(standardised, (values - values.mean(axis=0)) / values.std(axis=0), atol=0.02 * scale)


def test_running_moments_with_a_limited_memory_forget():
    th.manual_seed(0)
    moments = RunningMoments(1, max_count=100)
    for _ in range(50):
        moments.update(th.randn(10, 1))
    for _ in range(100):
        moments.update(5 + 2 * th.randn(10, 1))
    assert moments.count.item() == 100
    assert moments.mean.item() == pytest.approx(5, abs=0.8) and moments.var.item() == pytest.approx(4, abs=1.5)


# ---------------------------------------------------------------------- visit counts


@pytest.mark.parametrize("cell_size", [0.1, 0.5, 3.0])
@pytest.mark.parametrize("dim", [1, 2, 4])
def test_visit_counts_are_those_of_a_dict(cell_size, dim):
    rng = np.random.default_rng(0)
    counts, expected = VisitCounts(dim, 7, cell_size=cell_size, table_size=2**22), Counter()
    # As the measure divides, in single precision: the border between two cells is where that says
    size = np.float32(cell_size)

    def cells(positions):
        return [tuple(cell) for cell in np.floor(positions / size).astype(int).tolist()]

    for _ in range(5):
        positions = rng.normal(scale=2.0, size=(30, dim)).astype(np.float32)
        counts.observe(th.as_tensor(positions))
        expected.update(cells(positions))
    queries = rng.normal(scale=2.0, size=(200, dim)).astype(np.float32)
    novelty = counts.novelty(th.as_tensor(queries), th.zeros(200, 7)).numpy()
    np.testing.assert_allclose(novelty, [(1 + expected[cell]) ** -0.5 for cell in cells(queries)], rtol=1e-6)


def test_visit_counts_tell_the_cells_of_a_maze_apart():
    """A table of fixed size must not confuse the places of a large map, negative coordinates included."""
    counts = VisitCounts(2, 0)
    grid = th.stack(th.meshgrid(th.arange(-50.0, 50.0), th.arange(-50.0, 50.0), indexing="ij"), dim=-1).reshape(-1, 2)
    counts.observe(grid * 0.5 + 0.25)
    # As many share an entry as chance would have it: n (1 - exp(-n / size)), about
    n_shared = counts.counts[counts.counts > 1].sum().item()
    assert n_shared < 1.2 * len(grid) * (1 - np.exp(-len(grid) / len(counts.counts)))
    # The same cell has the same entry in every process
    other = VisitCounts(2, 0)
    assert other._entries(th.tensor([[0.6, -3.2]])).tolist() == counts._entries(th.tensor([[0.9, -3.4]])).tolist()


def test_tables_are_as_large_as_what_is_loaded_into_them():
    """Of a model that was made with another default."""
    saved, loaded, here = VisitCounts(2, 0, table_size=64), VisitCounts(2, 0), th.tensor([[0.1, 0.2]])
    saved.observe(here)
    loaded.load_state_dict(saved.state_dict())
    assert loaded.novelty(here, here) == saved.novelty(here, here) == 0.5**0.5
    cells, known = KnownCells(0.5), KnownCells(0.5)
    cells.known = cells.known[:64].clone()
    cells.replace({3: here})
    known.load_state_dict(cells.state_dict())
    assert known.contain(here) and known.known.sum() == 1


def test_visit_counts_have_nothing_to_learn():
    counts = VisitCounts(2, 3)
    assert counts.optimizer is None and counts.update(th.zeros(4, 2), th.zeros(4, 3)).item() == 0
    with pytest.raises(ValueError, match=r"novelty.kwargs\['cell_size'\] must be positive, got 0"):
        VisitCounts(2, 3, cell_size=0)


# ---------------------------------------------------------------------- random network distillation


@pytest.mark.parametrize("with_observation", [False, True])
def test_distillation_error_falls_where_it_was_trained_only(with_observation):
    th.manual_seed(0)
    measure = RandomNetworkDistillation(2, 3, with_observation=with_observation)
    frozen = {name: value.clone() for name, value in measure.target.state_dict().items()}
    everywhere = th.rand(2000, 2) * 20 - 10
    measure.observe(everywhere)
    seen = everywhere[everywhere[:, 0] < 0][:256]
    unseen = everywhere[everywhere[:, 0] > 3][:256]
    observations = th.randn(256, 3)
    before = [measure.novelty(positions, observations) for positions in (seen, unseen)]
    losses = [measure.update(seen, observations).item() for _ in range(300)]
    after = [measure.novelty(positions, observations) for positions in (seen, unseen)]
    assert losses[-1] < 0.05 * losses[0]
    assert after[0].mean() < 0.25 * before[0].mean() and after[1].mean() > 3 * after[0].mean()
    for name, value in measure.target.state_dict().items():
        assert th.equal(value, frozen[name])
    assert not any(parameter.requires_grad for parameter in measure.target.parameters())


def test_distillation_error_is_the_distance_of_the_networks():
    th.manual_seed(0)
    measure = RandomNetworkDistillation(1, 0, net_arch=(8, 4), n_frequencies=2)
    positions = th.tensor([[1.0], [3.0]])
    measure.observe(positions)  # mean 2, deviation 1: -1 and 1
    inputs = th.tensor([[x, *np.sin([x, 2 * x]), *np.cos([x, 2 * x])] for x in (-1.0, 1.0)], dtype=th.float32)
    expected = (measure.predictor(inputs) - measure.target(inputs)).pow(2).sum(dim=1).sqrt()
    th.testing.assert_close(measure.novelty(positions, th.zeros(2, 0)), expected.detach(), atol=1e-5, rtol=1e-4)


# ---------------------------------------------------------------------- in the algorithm


def filled_model(**changes):
    """Two environments, some modes, and more in the buffer than there are visits to any place."""
    model = small_model(DummyVecEnv([TwoEnds] * 4), **merged({"exploration": {"off_modes": False}}, changes))
    model.learn(240)
    assert len(model.modes) >= 1
    return model


def slow_first_visits(buffer, cell_size):
    """Rows whose step led to a cell where the episode had not been, its first included, one trajectory after the other."""
    first = set()
    running = [buffer.running.of(env) for env in range(buffer.n_envs)]
    finished = [each.rows for success in (True, False) for each in buffer.trajectories(success)]
    for rows in (*running, *finished, *(each.rows for each in buffer.groups.retired)):
        seen = [cell_of(buffer, buffer.observations[row : row + 1], cell_size) for row in rows[:1]]
        for row in rows:
            cell = cell_of(buffer, buffer.next_observations[row : row + 1], cell_size)
            if cell not in seen:
                seen.append(cell)
                first.add(int(row))
    return first


def cell_of(buffer, observation, cell_size):
    return tuple(int(x // cell_size) for x in buffer.features(observation)[0])


def test_first_visits():
    model = filled_model(novelty={"kwargs": {"cell_size": 0.3}})
    buffer = model.replay_buffer
    stored = buffer.stored_rows.rows[: buffer.size()]
    expected = slow_first_visits(buffer, 0.3)
    assert {int(row) for row in stored if buffer.first_visits[row]} == expected
    assert 0.2 < len(expected) / len(stored) < 0.9
    all_pay = filled_model(novelty={"episodic": False}).replay_buffer
    assert all_pay.first_visits[all_pay.stored_rows.rows[: all_pay.size()]].all()


def test_standing_where_nobody_was_pays_once():
    """An explorer that was paid for every step would stand at the place that fewest have seen."""
    for episodic, paid in ((True, 1), (False, 6)):
        model = small_model(DummyVecEnv([TwoEnds]), novelty={"episodic": episodic, "normalize": False, "scale": 0.0})
        here, place = np.zeros((1, 2), dtype=np.float32), np.ones((1, 2), dtype=np.float32)
        fill(model.replay_buffer, [np.concatenate([here, *[place] * 6])], bonus=model.bonus)
        rows = model.replay_buffer.stored_rows.rows[:6]
        assert (intrinsic_rewards(model, rows.reshape(1, 6, 1)) > 0).sum() == paid


@pytest.mark.parametrize("episodic", [True, False])
def test_coming_back_to_where_the_episode_began_pays_nothing(episodic):
    """It has been there, though it never came there by a step."""
    model = small_model(DummyVecEnv([TwoEnds]), novelty={"episodic": episodic, "normalize": False, "scale": 0.0})
    away_and_back = np.array([[0.1, 0], [0.7, 0], [0.2, 0], [0.7, 0], [1.2, 0], [0.1, 0]], dtype=np.float32)
    for _ in range(2):  # the next episode has been nowhere yet
        fill(model.replay_buffer, [away_and_back], bonus=model.bonus)
    rows = model.replay_buffer.stored_rows.rows[:10]
    expected = [True, False, False, True, False] if episodic else [True] * 5
    assert model.replay_buffer.first_visits[rows].tolist() == expected * 2
    np.testing.assert_array_equal(intrinsic_rewards(model, rows.reshape(1, 10, 1))[0] > 0, expected * 2)


def intrinsic_rewards(model, windows, metrics=None):
    """Of rows, [G, n, n_steps], -1 where there is none."""
    return model._intrinsic_rewards(model.replay_buffer.visited(windows), defaultdict(list) if metrics is None else metrics)


def seen_by_measure(model, observations):
    """What the measure sees of a batch of observations, not normalised."""
    positions = model.replay_buffer.features.of_tensors(observations)
    if not getattr(model.bonus.novelty_model, "with_observation", False):
        return positions, positions
    return positions, model.actor.features(observations).detach()


def windows_of(model, batch):
    """Rows from each of a batch on, -1 beyond the end of an episode or of its mode's route, [G, n, n_steps]."""
    of_modes = model.mode_settings.n_steps_beside(model.n_steps)
    n_steps = [model.exploration_settings.n_steps_beside(model.n_steps), *[of_modes] * (len(batch.rows) - 1)]
    windows = np.full((*batch.rows.shape, max(n_steps)), -1)
    for group, column in np.ndindex(batch.rows.shape):
        row = int(batch.rows[group, column])
        for step in range(n_steps[group]):
            if row < 0 or (group and model.replay_buffer.off_route[row]):
                break
            windows[group, column, step] = row
            row = int(model.replay_buffer.next_row[row])
    return windows


def slow_intrinsic_reward(model, window, scale=1.0, ordinary=0.0, gamma=None):
    """Discounted NovelD rewards of a window, row by row, where they are paid, less what is ordinary."""
    total = 0.0
    first = slow_first_visits(model.replay_buffer, float(model.bonus.grid.edges[0]))
    for k, row in enumerate(window[window >= 0]):
        now, then = (
            model.bonus.novelty_model.novelty(*seen_by_measure(model, th.from_numpy(obs[row : row + 1]))).item()
            for obs in (model.replay_buffer.observations, model.replay_buffer.next_observations)
        )
        reward = max(then - model.novelty_settings.scale * now, 0.0) * (int(row) in first)
        total += (gamma or model.gamma) ** k * (min(reward / scale, 10.0) - ordinary)
    return model.novelty_settings.coef * total


@pytest.mark.parametrize(
    ("novelty", "mode_coef", "exploration_gamma", "new_route_coef"),
    [
        ("rnd", 0.0, None, 0.0),
        ("counts", 0.0, None, 1.5),
        ("rnd", 0.5, None, 1.0),
        ("counts", 0.5, None, 0.0),
        ("counts", 0.5, 0.7, 1.0),
    ],
)
def test_rewards_of_a_batch(novelty, mode_coef, exploration_gamma, new_route_coef):
    model = filled_model(
        novelty={"measure": novelty, "normalize": False},
        modes={"novelty_coef": mode_coef},
        exploration={"new_route_coef": new_route_coef, "gamma": exploration_gamma, "n_steps": 3},
        reward_scale=2.0,
    )
    batch = model.replay_buffer.sample_modes(24, model.gamma, 3, 5, visits_of_modes=mode_coef > 0)
    windows = windows_of(model, batch)
    measure = deepcopy(model.bonus.novelty_model)
    given = model._rewards(batch, defaultdict(list)).cpu()
    model.bonus.novelty_model = measure  # as it was before it learned from the batch
    ordinary = model.bonus.moments.mean.item()  # modes are paid for what is more than that, also where nothing is normalised
    assert (ordinary > 0) == (mode_coef > 0)
    expected = 2.0 * batch.rewards.numpy()
    # In units of the values: a goal is worth as much beside novelty whatever it pays, and for a mode novelty as much beside it
    unit = model.value_range.unit
    assert unit == 2.0  # from nothing to a goal, scaled
    for group, column in np.ndindex(expected.shape):
        gamma = model.gamma if group else exploration_gamma
        intrinsic = slow_intrinsic_reward(model, windows[group, column], ordinary=ordinary if group else 0.0, gamma=gamma)
        if group == 0:
            # The environment's reward counts only where a goal was reached by a route that is new
            expected[group, column] = intrinsic + new_route_coef * 2.0 / unit * batch.new_routes[column].item()
        else:
            expected[group, column] += mode_coef * unit * intrinsic
    np.testing.assert_allclose(given, expected, rtol=1e-4, atol=1e-6)


def test_intrinsic_rewards_are_scaled_by_their_own_deviation():
    """
    Transitions beyond the end of a window are none, and must not enter the statistics. For modes the mean is taken off, or
    never to arrive would be worth as much as a distant goal.
    """
    model = filled_model(modes={"novelty_coef": 1.0}, exploration={"n_steps": 2})
    model.bonus.moments.load_state_dict(RunningMoments(1).state_dict())
    batch = model.replay_buffer.sample_modes(30, model.gamma, 2, 5, visits_of_modes=True)
    windows = windows_of(model, batch)
    np.testing.assert_array_equal(batch.visited.present, windows >= 0)
    present = windows[windows >= 0]
    now, then = (
        model.bonus.novelty_model.novelty(*seen_by_measure(model, obs)).numpy()
        for obs in model.replay_buffer.read_observations(present)
    )
    rewards = np.maximum(then - 0.5 * now, 0.0) * model.replay_buffer.first_visits[present]
    metrics = defaultdict(list)
    given = intrinsic_rewards(model, windows, metrics)
    assert model.bonus.moments.count.item() == len(present)
    assert model.bonus.moments.var.item() == pytest.approx(rewards.var(), rel=1e-3)
    assert metrics["intrinsic_reward"][0].item() == pytest.approx(rewards.mean(), rel=1e-4)
    scale = rewards.std() + 1e-8
    for group, column in np.ndindex(windows.shape[:2]):
        ordinary = rewards.mean() / scale if group else 0.0
        expected = slow_intrinsic_reward(model, windows[group, column], scale, ordinary)
        assert given[group, column].item() == pytest.approx(expected, rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("normalize", [True, False])
def test_an_ordinary_place_pays_a_mode_nothing(normalize):
    """Novelty that is the running mean: else a mode would live on it for ever, and never arrive."""
    model = filled_model(modes={"novelty_coef": 1.0}, novelty={"normalize": normalize, "episodic": False, "clip": 1e6})
    model.bonus.novelty_model.novelty = lambda positions, _: th.ones(len(positions))  # every place is as new as any other
    stored = model.replay_buffer.stored_rows.rows[: model.replay_buffer.size()]
    windows = np.stack([stored, stored])[:, :, None]
    # Of reward 0.5 at each step, and running statistics of long ago that say the same
    model.bonus.moments.load_state_dict({"mean": th.full((1,), 0.5), "var": th.full((1,), 1e-2), "count": th.full((1,), 1e5)})
    rewards = intrinsic_rewards(model, windows)
    assert (rewards[0] > 0).all()
    np.testing.assert_allclose(rewards[1], 0.0, atol=1e-6)


def test_visits_are_counted_once_each():
    model = small_model(DummyVecEnv([TwoEnds] * 4), learning_starts=10)
    model.learn(160)
    assert model.bonus.novelty_model.counts.sum() == 160
    expected = Counter(np.floor(model.replay_buffer.next_observations[:160, 0] / np.float32(0.5)).astype(int).tolist())
    for cell, count in expected.items():
        novelty = model.bonus.novelty_model.novelty(th.tensor([[0.5 * cell + 0.25]]), None)
        assert novelty.item() == pytest.approx((1 + count) ** -0.5)


class DistanceFromOrigin(th.nn.Module):
    """A measure of a user's own: far places are new, and it learns how far far is."""

    with_observation = True

    def __init__(self, position_dim, observation_dim, unit=1.0):
        super().__init__()
        assert position_dim == 1 and observation_dim == 2
        self.unit = unit
        self.far = th.nn.Parameter(th.ones(1))
        self.optimizer = th.optim.SGD([self.far], lr=0.1)
        self.register_buffer("n_seen", th.zeros(1))

    def observe(self, positions):
        assert positions.shape[1:] == (1,)
        self.n_seen += len(positions)

    @th.no_grad()
    def novelty(self, positions, observations):
        assert observations.shape == (len(positions), 2) and observations.abs().max() <= 1.0 + 1e-6  # what the networks see
        return positions.abs().sum(dim=1) / self.unit / self.far

    def update(self, positions, observations):
        loss = (self.far - positions.abs().mean()).pow(2).sum()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return loss.detach()


def test_a_measure_of_ones_own(tmp_path):
    seen = {"net_arch": [16], "features_extractor_kwargs": {"half_width": 1}}
    measure = {"measure": DistanceFromOrigin, "kwargs": {"unit": 2.0}}
    model = small_model(DummyVecEnv([TwoEnds] * 4), novelty=measure, policy_kwargs=seen)
    model.learn(160)
    assert isinstance(model.bonus.novelty_model, DistanceFromOrigin) and model.bonus.novelty_model.unit == 2.0
    assert model.bonus.novelty_model.n_seen.item() == 160 and model.bonus.novelty_model.far.item() != 1.0
    model.save(tmp_path / "model")
    assert_same_state(state_of(DDiffPG.load(tmp_path / "model")), state_of(model))


# ---------------------------------------------------------------------- exploration noise


def test_spread_noise_is_gaussian_with_the_deviation_of_its_episode():
    np.random.seed(0)
    noise = SpreadNormalActionNoise(3, 4, low=0.2, high=0.4)
    noise.reset()
    sigma = noise.sigma.copy()
    assert ((0.2 <= sigma) & (sigma <= 0.4)).all() and len(set(sigma)) == 3
    draws = np.stack([noise() for _ in range(5000)])
    assert draws.shape == (5000, 3, 4) and draws.dtype == np.float32
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=0.03)
    np.testing.assert_allclose(draws.std(axis=(0, 2)), sigma, rtol=0.03)
    correlation = np.corrcoef(draws.reshape(5000, 12).T) - np.eye(12)
    assert np.abs(correlation).max() < 0.06
    # Only the environment whose episode ended draws anew
    noise.reset(indices=[1])
    assert noise.sigma[1] != sigma[1] and (noise.sigma[[0, 2]] == sigma[[0, 2]]).all()


def test_spread_noise_sees_all_deviations_in_time():
    np.random.seed(0)
    noise = SpreadNormalActionNoise(1, 1)
    drawn = []
    for _ in range(2000):
        noise.reset()
        drawn.append(noise.sigma[0])
    np.testing.assert_allclose(np.quantile(drawn, [0.0, 0.25, 0.5, 0.75, 1.0]), np.linspace(0.05, 0.6, 5), atol=0.02)


@pytest.mark.parametrize(("low", "high"), [(-0.1, 0.5), (0.5, 0.1)])
def test_spread_noise_takes_an_interval(low, high):
    with pytest.raises(ValueError, match="low and high must satisfy"):
        SpreadNormalActionNoise(1, 1, low, high)


def test_each_episode_draws_its_noise():
    model = small_model(DummyVecEnv([lambda: TwoEnds(limit=4)] * 2), learning_starts=0)
    deviations = []

    def watch(local_variables, _):
        deviations.append(model.action_noise.sigma.copy())
        return True

    model.learn(120, callback=watch)
    deviations = np.array(deviations)
    changes = (np.diff(deviations, axis=0) != 0).sum(axis=0)
    episodes = model._episode_num
    assert (changes >= episodes / 4).all() and changes.sum() <= episodes


def make_able(model, able):
    """Give each mode ten commanded episodes, half of which succeed where it is able, else fewer."""
    for index, mode in enumerate(model.modes):
        mode.outcomes.clear()
        mode.outcomes.extend(Outcome(k < (5 if index in able else 4), 1.0, 5) for k in range(10))
    model.recluster()


@pytest.mark.parametrize(("off_modes", "able"), [(True, [0]), (True, []), (False, [0])])
def test_where_able_modes_go_is_not_new_to_explorers(off_modes, able):
    """Told from the trajectories themselves: explorers are paid for no cell that those of able modes reach."""
    novelty = {"kwargs": {"cell_size": 0.05}, "episodic": False, "scale": 0.0, "normalize": False}
    model = filled_model(exploration={"off_modes": off_modes}, novelty=novelty)
    make_able(model, able)
    buffer = model.replay_buffer
    known = set()
    for trajectory in buffer.trajectories(success=True):
        if trajectory.trains and trajectory.mode in able:
            known |= set(np.floor(buffer.full_path(trajectory)[1:, 0] / 0.05).astype(int).tolist())
    stored = buffer.stored_rows.rows[: buffer.size()]
    cells = np.floor(buffer.next_observations[stored, 0] / 0.05).astype(int)
    on_modes = np.isin(cells, list(known))
    assert 0.1 < on_modes.mean() < 0.95 or not able
    rewards = intrinsic_rewards(model, np.stack([stored, stored])[:, :, None])
    np.testing.assert_array_equal(rewards[0].numpy() > 0, ~on_modes if off_modes else np.ones(len(stored), bool))
    # The modes themselves go on as before: paid for what is more than ordinary, whoever knows it
    ordinary = model.novelty_settings.coef * model.bonus.moments.mean.item()
    novelty = (1 + model.bonus.novelty_model.counts[model.bonus.novelty_model._entries(positions_at(model, stored))]).rsqrt()
    np.testing.assert_allclose(rewards[1] + ordinary, model.novelty_settings.coef * novelty, rtol=1e-4)


def positions_at(model, rows):
    """Reached there."""
    return model.replay_buffer.features.of_tensors(model.replay_buffer.read_observations(rows)[1])


def test_known_cells_are_saved(tmp_path):
    model = filled_model(exploration={"off_modes": True})
    make_able(model, [0])
    assert model.bonus.known_cells.known.any()
    model.save(tmp_path / "model")
    model.export(tmp_path / "safe")
    for loaded in (DDiffPG.load(tmp_path / "model"), DDiffPG.load(tmp_path / "safe", safe=True)):
        assert th.equal(loaded.bonus.known_cells.known, model.bonus.known_cells.known)
        assert {number: entries.tolist() for number, entries in loaded.bonus.known_cells.by_mode.items()} == {
            number: entries.tolist() for number, entries in model.bonus.known_cells.by_mode.items()
        }


@pytest.mark.parametrize("with_buffer", [True, False])
def test_known_cells_outlive_the_buffer_but_not_their_mode(tmp_path, with_buffer):
    """A model that is loaded without its buffer has modes without trajectories: what they know they know still."""
    # With this seed a re-clustering without the other mode leaves all trajectories where they are
    model = filled_model(exploration={"off_modes": True}, seed=1)
    make_able(model, range(len(model.modes)))
    known, numbers = model.bonus.known_cells.known.clone(), [mode.number for mode in model.modes]
    assert len(numbers) == 2 and list(model.bonus.known_cells.by_mode) == numbers
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = DDiffPG.load(tmp_path / "model", env=DummyVecEnv([TwoEnds] * 4))
    loaded.set_logger(model.logger)
    if with_buffer:
        loaded.load_replay_buffer(tmp_path / "buffer")
    for _ in range(3):
        loaded.recluster()
        assert [mode.number for mode in loaded.modes] == numbers
        assert th.equal(loaded.bonus.known_cells.known, known) and loaded.bonus.known_cells.any
    own = [model.bonus.known_cells.by_mode[number] for number in numbers]
    loaded.delete_mode(0)
    assert loaded.bonus.known_cells.known.nonzero()[:, 0].tolist() == sorted(own[1].tolist())
    loaded.recluster()
    assert loaded.bonus.known_cells.known.nonzero()[:, 0].tolist() == sorted(own[1].tolist())
    loaded.delete_mode(0)
    assert not loaded.bonus.known_cells.known.any() and not loaded.bonus.known_cells.any


@pytest.mark.parametrize("clip", [2.0, 50.0])
def test_one_place_is_worth_no_more_than_the_limit(clip):
    fixed = {"v_min": 0.0, "v_max": 5.0}
    model = filled_model(novelty={"clip": clip, "episodic": False, "coef": 0.1}, critic=fixed)
    assert model.critics.upper[0].item() == pytest.approx(max(5.0, clip * 0.1 / (1 - model.gamma)))
    stored = model.replay_buffer.stored_rows.rows[: model.replay_buffer.size()]
    measure = model.bonus.novelty_model
    measure.counts.fill_(1e6)  # all is known
    intrinsic_rewards(model, stored[None, :, None])
    measure.counts[measure._entries(positions_at(model, stored[:1]))] = 0.0  # but one place
    reward = intrinsic_rewards(model, stored[None, :, None])
    deviation = model.bonus.moments.var.sqrt().item()
    novelty = model.novelty_settings.scale * 1e-3  # NovelD: what lies beyond less alpha times what lies before
    largest = (1.0 - novelty) / deviation
    assert reward.max().item() == pytest.approx(0.1 * min(clip, largest), rel=1e-3)
    assert largest > 2.0
