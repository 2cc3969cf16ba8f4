"""A planner in a room with two gaps: the way round, back, to other places, and what it refuses."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import TwoEnds, fill, image_dict_space, small_model
from gymnasium import spaces
from maze_routes import polyline
from stable_baselines3 import TD3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ddiffpg.evaluation import run_episodes
from sb3_ddiffpg.planning import ModePlanner, mode_planner
from sb3_ddiffpg.planning.place_graph import RESOLUTION
from sb3_ddiffpg.planning.travels import MOST_STEPS, Senses, Travel, newest

START, GOAL = np.array([1.0, 5.0]), np.array([9.0, 5.0])
GAPS = {"low": (1.0, 3.0), "high": (7.0, 9.0)}


class TwoGaps(gym.Env):
    """A room of 10 m x 10 m, divided at x = 5 but for two gaps, some of which may be closed. An action moves up to 0.5 m."""

    mode_features = (0, 1)
    observation_space = spaces.Box(-10.0, 20.0, (3,))
    action_space = spaces.Box(-0.5, 0.5, (2,))

    def __init__(self, closed=(), ends=True):
        self.closed, self.ends = closed, ends

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.time = START.copy(), 0
        return self._observation(), {}

    def _observation(self):
        return np.array([*self.position, 0.5], dtype=np.float32)

    def step(self, action):
        aim = np.clip(self.position + action, 0.0, 10.0)
        crosses = (self.position[0] - 5.0) * (aim[0] - 5.0) <= 0
        passes = any(low < aim[1] < high for name, (low, high) in GAPS.items() if name not in self.closed)
        if passes or not crosses:
            self.position = aim
        self.time += 1
        reached = bool(np.linalg.norm(self.position - GOAL) < 0.7)
        return self._observation(), float(reached), reached and self.ends, self.time >= 250, {"is_success": reached}


def shown(*, back=True):
    """A model that has learned nothing, whose buffer holds walks through both gaps, and some back."""
    model = small_model(DummyVecEnv([TwoGaps]), mode_features=[0, 1], buffer_size=20_000)
    rng = np.random.default_rng(0)
    for y in (2.0, 8.0):
        for _ in range(15):
            corners = [START, (3.0, y), (7.0, y), GOAL]
            walks = [(corners, True)] + ([(corners[::-1], False)] if back else [])
            for points, success in walks:
                line = polyline(points, step=0.45) + rng.normal(scale=0.05, size=2)
                path = np.concatenate((line, np.full((len(line), 1), 0.5)), axis=1).astype(np.float32)
                fill_scaled(model.replay_buffer, path, success)
    return model


def fill_scaled(buffer, path, success):
    """An action of 1 is half a metre."""
    before = buffer.pos
    fill(buffer, [path], success)
    rows = np.arange(before, buffer.pos)
    buffer.actions[rows] = np.clip((path[1:] - path[:-1])[:, :2] / 0.5, -1, 1)


@pytest.fixture(scope="module", autouse=True)
def few_updates():
    """The room is simple."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mode_planner, "N_UPDATES", 400)
        yield


@pytest.fixture(scope="module")
def planner(few_updates):
    th.manual_seed(0)
    np.random.seed(0)
    return ModePlanner(shown())


def ends(agent, n=6, **kwargs):
    return run_episodes(agent, DummyVecEnv([lambda: TwoGaps(**kwargs)] * 2), n)


@pytest.mark.parametrize("closed", [(), ("low",), ("high",)])
def test_comes_to_the_goal_whichever_gap_is_closed(planner, closed):
    np.random.seed(1)
    episodes = ends(planner, closed=closed)
    assert all(each.success for each in episodes)
    for each in episodes:
        through = each.path[np.flatnonzero(np.diff(each.path[:, 0] > 5.0))[0], 1]
        assert not any(GAPS[name][0] < through < GAPS[name][1] for name in closed)


def test_a_closed_gap_is_tried_before_the_other_one(planner):
    """Nobody says which is closed: of two that are as long, it is the first for one of the two rooms."""
    lengths = [np.mean([each.length for each in ends(planner, closed=closed)]) for closed in ((), ("low",), ("high",))]
    assert lengths[0] == pytest.approx(min(lengths), abs=3) and max(lengths) > lengths[0] + 10


def test_where_all_is_closed_it_goes_on_trying(planner):
    episodes = ends(planner, n=2, closed=("low", "high"))
    for each in episodes:
        assert not each.success and each.length == 250
        touched = each.path[each.path[:, 0] > 4.3, 1]
        assert touched.min() < 4 and touched.max() > 6  # at both


def test_what_never_moves_is_not_blocked_beyond_all_bounds(planner):
    obs, state = np.array([[*START, 0.5]], dtype=np.float32), None
    for _ in range(400):
        _, state = planner.predict(obs, state)
    assert 10 < state[0].width <= RESOLUTION and np.isfinite(state[0].penalty).all()


def test_visits_places_one_after_the_other(planner):
    agent = planner.go_to((9.0, 5.0), (1.0, 5.0), (3.0, 8.0))
    assert planner.targets is None  # the planner itself goes to goals
    env = DummyVecEnv([lambda: TwoGaps(ends=False)])
    obs, state, start, path = env.reset(), None, np.ones(1, dtype=bool), []
    for _ in range(150):
        actions, state = agent.predict(obs, state, start)
        obs, _, start, _ = env.step(actions)
        path.append(obs[0, :2])
    visited = 0
    for place in agent.targets:  # each after the one before
        near = np.flatnonzero(np.linalg.norm(np.array(path)[visited:] - place, axis=1) < 0.3)
        assert len(near)
        visited += int(near[0])
    assert visited > 40  # some 20 m at half a metre a step
    assert np.linalg.norm(np.array(path)[-20:] - agent.targets[-1], axis=1).max() < 1.0  # and stays


def test_acts_like_a_model(planner):
    obs = np.array([[1.0, 5.0, 0.5], [3.0, 2.0, 0.5]], dtype=np.float32)
    many, state = planner.predict(obs, deterministic=True)
    for i in range(2):
        one, _ = planner.predict(obs[i], deterministic=True)
        np.testing.assert_allclose(one, many[i], rtol=1e-5)
    assert many.shape == (2, 2) and np.abs(many).max() <= 0.5
    before = copy.copy(state[0])
    planner.predict(obs + 0.1, state, np.array([False, True]))
    assert state[0] == before  # what was given stays as it is
    mean, deviation = evaluate_policy(planner, DummyVecEnv([TwoGaps] * 2), 4, warn=False)
    assert (mean, deviation) == (1.0, 0.0)


def test_learns_from_practice_alone():
    """No replay buffer and no goal: it finds its way about all the same."""
    th.manual_seed(0)
    np.random.seed(0)
    env = DummyVecEnv([TwoGaps] * 4)
    model = small_model(env, mode_features=[0, 1])
    planner = ModePlanner(model)
    with pytest.raises(RuntimeError, match="practise"):
        planner.predict(env.reset())
    first = planner.practise(env, 4)
    n_places = len(planner.graph)
    for _ in range(3):
        last = planner.practise(env, 4)
    assert np.isfinite([first, last]).all() and len(planner.graph) > n_places
    if not len(planner.graph.goals):
        with pytest.raises(RuntimeError, match="go_to"):
            planner.predict(env.reset())
    far = planner.graph.positions[np.argmax(np.linalg.norm(planner.graph.positions - START / planner.scale, axis=1))]
    agent = planner.go_to(far * planner.scale)
    obs, state, closest = env.reset(), None, np.inf
    for _ in range(120):
        actions, state = agent.predict(obs, state)
        obs, *_ = env.step(actions)
        closest = min(closest, np.linalg.norm(obs[:, :2] - agent.targets[0], axis=1).min())
    assert closest < planner.graph.spacing * planner.scale[0]


def test_sees_what_the_environment_made(planner):
    """Normalised observations are turned back: the same actions."""
    normalized = VecNormalize(DummyVecEnv([TwoGaps]))
    normalized.obs_rms.mean, normalized.obs_rms.var = np.array([3.0, 4.0, 0.0]), np.array([4.0, 9.0, 1.0])
    twin = copy.copy(planner)
    twin.normalizer = normalized
    obs = np.array([[2.0, 4.0, 0.5]], dtype=np.float32)
    np.testing.assert_allclose(
        twin.predict(normalized.normalize_obs(obs), deterministic=True)[0],
        planner.predict(obs, deterministic=True)[0],
        atol=1e-5,
    )


def test_saves_and_loads(planner, tmp_path):
    planner.save(tmp_path / "planner")
    assert b"pickle" not in (tmp_path / "planner").read_bytes()
    again = ModePlanner.load(tmp_path / "planner", planner.model)
    assert planner.model.replay_buffer.size()  # which it still has
    obs = np.random.default_rng(0).uniform(0, 10, (20, 3)).astype(np.float32)
    np.testing.assert_array_equal(planner.predict(obs, deterministic=True)[0], again.predict(obs, deterministic=True)[0])
    again.practise(DummyVecEnv([TwoGaps]), 1)
    assert len(again.travels) == len(planner.travels) + 1  # from place to place; there are no modes to compare
    whole = (tmp_path / "planner").read_bytes()
    (tmp_path / "damaged").write_bytes(whole[:-8] + bytes(8))
    with pytest.raises(ValueError, match="damaged"):
        ModePlanner.load(tmp_path / "damaged", planner.model)
    with pytest.raises(ValueError, match=r"planner\.(features|.*shape)"):
        ModePlanner.load(tmp_path / "planner", small_model(DummyVecEnv([TwoEnds])))
    with pytest.raises(FileNotFoundError):
        ModePlanner.load(tmp_path / "none", planner.model)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: p.go_to(), "places"),
        (lambda p: p.go_to(1.0, 2.0), "2 finite numbers"),
        (lambda p: p.go_to((1.0, float("nan"))), "finite"),
        (lambda p: p.go_to((1.0, 5.0), (40.0, 5.0)), r"nobody has been near \[\[40"),
        (lambda p: p.predict(np.zeros((2, 3), np.float32), state=(1,)), "state"),
        (lambda p: ModePlanner(TD3("MlpPolicy", DummyVecEnv([TwoGaps]))), "TD3 given"),
        (lambda p: Senses(image_dict_space(), None), "boxes of numbers"),
    ],
)
def test_refuses(planner, call, message):
    with pytest.raises(ValueError, match=message):
        call(planner)


def test_a_dict_is_seen_without_its_goals():
    """The parts one after the other, by key; where it is and where it is to go are told by directions."""
    box = spaces.Box(-9.0, 9.0, (2,))
    senses = Senses(
        spaces.Dict({"achieved_goal": box, "desired_goal": box, "observation": spaces.Box(-9.0, 9.0, (3,))}), "achieved_goal"
    )
    batch = {
        key: np.full((1, n), value, np.float32)
        for key, n, value in (("achieved_goal", 2, 1), ("desired_goal", 2, 2), ("observation", 3, 3))
    }
    assert senses.inputs(batch).tolist() == [[3.0, 3.0, 3.0]] and senses.places(batch).tolist() == [[1.0, 1.0]]
    assert Senses(box, [0, 1]).n_inputs == 2  # nothing else is seen


def test_the_newest_are_remembered():
    def travel(n):
        return Travel(np.zeros((n, 1)), np.zeros((n + 1, 1)), np.zeros((n, 1)), True)

    travels = [travel(n) for n in (5, 4, 3)]
    assert [len(each) for each in newest(travels, 7)] == [4, 3]
    assert [len(each) for each in newest(travels, 6)] == [3]
    assert [len(each) for each in newest(travels, 1)] == [3]  # one at least
    assert newest(travels) == travels and MOST_STEPS > 12


def test_is_pickled_with_its_state(planner):
    """As for a worker, or between two steps of a robot."""
    obs = np.array([[1.0, 5.0, 0.5]], dtype=np.float32)
    _, state = planner.predict(obs)
    again = pickle.loads(pickle.dumps(state))
    first, _ = planner.predict(obs, state, deterministic=True)
    second, _ = planner.predict(obs, again, deterministic=True)
    np.testing.assert_array_equal(first, second)


class Leads:
    """The model of a planner, whose only mode goes straight on; what it asks of the model otherwise, the model says."""

    def __init__(self, model):
        self.model, self.asked = model, []

    def __getattr__(self, name):
        return getattr(self.model, name)

    def mode_values(self, observations):
        return np.tile([0.0, 1.0], (len(observations), 1))

    def predict(self, observation, state=None, episode_start=None, deterministic=False, mode=None):
        self.asked.append(np.array(mode))
        return np.tile([0.4, 0.0], (len(observation), 1)).astype(np.float32), None


def test_a_mode_leads_until_it_does_not_get_on(planner):
    """Straight on is the wall between the gaps: there the planner takes over, and goes round."""
    agent = copy.copy(planner)
    agent.model, agent.modes_lead = Leads(planner.model), True
    np.random.seed(0)
    (episode,) = run_episodes(agent, DummyVecEnv([TwoGaps]), 1)
    assert episode.success
    assert all(mode.tolist() == [1] for mode in agent.model.asked)  # the one of more value
    led = len(agent.model.asked)
    at_the_wall = int(np.argmax(episode.path[:, 0] > 4.5))
    assert at_the_wall < led < episode.length
    np.testing.assert_allclose(episode.path[: at_the_wall + 1, 1], START[1])
    assert planner.go_to(GOAL).modes_lead is False


@pytest.mark.parametrize(("led", "alone", "leads"), [(0.9, 1.0, False), (1.0, 1.0, False), (1.0, 0.9, True)])
@pytest.mark.parametrize("n_modes", [0, 2])
def test_modes_lead_where_more_goals_are_reached_so(planner, led, alone, leads, n_modes, monkeypatch):
    """Practised from place to place, led by modes, and alone; without modes there is nothing to compare."""
    agent = copy.copy(planner)
    agent.policy, agent.model = copy.deepcopy(planner.policy), Leads(planner.model)
    agent.model.modes = [None] * n_modes
    record, asked = ModePlanner._record, []

    def told(self, by, env, n_episodes):
        record(self, by, env, n_episodes)
        asked.append(self.modes_lead)
        return {1: 0.0, 2: led, 3: alone}[len(asked)]

    monkeypatch.setattr(ModePlanner, "_record", told)
    np.random.seed(0)
    agent.practise(DummyVecEnv([TwoGaps]), 2)
    assert agent.modes_lead is (leads and n_modes > 0) and asked == ([False, True, False] if n_modes else [False])


class Breaks(TwoGaps):
    """Not finite from the fifth step on."""

    def step(self, action):
        obs, *rest = super().step(action)
        return obs * (np.nan if self.time > 4 else 1), *rest


def test_nothing_is_learned_from_what_is_not_finite(planner):
    agent, n = copy.copy(planner), len(planner.travels)
    with pytest.raises(ValueError, match="finite"):
        agent.practise(DummyVecEnv([Breaks]), 1)
    assert len(agent.travels) == n
    agent.predict(np.array([[*START, 0.5]], dtype=np.float32))


def test_far_away_costs_no_more(planner):
    """Lines that are longer than one goes straight are not looked along."""
    for away in (1e3, 1e9):
        actions, _ = planner.predict(np.array([[away, away, 0.5]], dtype=np.float32), deterministic=True)
        assert np.isfinite(actions).all()


def test_agents_keep_what_they_know(planner):
    """Further practice, of the planner or of an agent, is that one's alone. Where an agent was on its way it begins anew."""
    mine = copy.copy(planner)
    mine.policy = copy.deepcopy(planner.policy)
    agent, obs = mine.go_to(GOAL), np.array([[3.0, 2.0, 0.5]], dtype=np.float32)
    before, state = agent.predict(obs, deterministic=True)
    starts = np.zeros(1, dtype=bool)
    mine.practise(DummyVecEnv([TwoGaps]), 1)
    np.testing.assert_array_equal(agent.predict(obs, deterministic=True)[0], before)
    mine.predict(obs, state, starts)
    assert not starts.any()  # what was given stays as it is


def test_an_environment_that_is_not_the_models_is_refused(planner):
    normalized = VecNormalize(DummyVecEnv([TwoGaps]))
    with pytest.raises(ValueError, match="normalised"):
        planner.practise(normalized, 1)
    other = copy.copy(planner)
    other.resolved_features = [1, 2]
    with pytest.raises(RuntimeError, match="features"):
        other.practise(DummyVecEnv([TwoGaps]), 1)
    for n in (0, True, 2.5):
        with pytest.raises(ValueError, match="n_episodes"):
            planner.practise(DummyVecEnv([TwoGaps]), n)


def test_a_file_of_other_features_is_refused(planner, tmp_path):
    planner.save(tmp_path / "planner")
    other = small_model(DummyVecEnv([TwoGaps]), mode_features=[1, 2])
    with pytest.raises(ValueError, match=r"features: \[0, 1\] given; accepted are the model's, \[1, 2\]"):
        ModePlanner.load(tmp_path / "planner", other)
