"""
Whatever comes in, there is a result or a documented error, nothing is half changed, and nothing hangs. ``fuzz.py`` runs the
same tests with inputs that a fuzzer makes, many more of them.
"""

import json
import tempfile
import warnings
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from environments import KnownEnds, TwoEnds, copied, small_model
from gymnasium import spaces
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.buffers.state import buffer_state, restore_buffer
from sb3_ddiffpg.callbacks.checkpoint import RunCheckpointCallback
from sb3_ddiffpg.clustering.dtw import dtw_distances
from sb3_ddiffpg.envs.mazes.maze import Maze
from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.experiments.suite import read_suite
from sb3_ddiffpg.modes.mode import ModeTable
from sb3_ddiffpg.saving.checkpoint import KIND, checkpoint_files
from sb3_ddiffpg.saving.model import build_model, model_tree
from sb3_ddiffpg.serialization.safetensors_tree import read, write
from sb3_ddiffpg.utils.divergence import DivergedError

MANY = settings(max_examples=40, deadline=None)


@cache
def folder() -> Path:
    return Path(tempfile.mkdtemp())


@cache
def trained() -> DDiffPG:
    return small_model(DummyVecEnv([TwoEnds] * 4)).learn(400)


@cache
def exported() -> bytes:
    trained().export(folder() / "good")
    return (folder() / "good").read_bytes()


def mutate(tree, data):
    """Put something else into a random place of a tree."""
    places = []

    def walk(node):
        entries = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else []
        for key in entries:
            places.append((node, key))
            walk(node[key])

    walk(tree)
    if not places:  # all of it was taken out before
        return
    node, key = places[data.draw(st.integers(0, len(places) - 1))]
    before = node[key]
    other = st.sampled_from([None, True, -1, 0, 10**12, 2**70, float("nan"), 1e300, "", "x", [], {}, np.zeros(3, np.float32)])
    other |= st.integers() | st.floats() | st.text(max_size=20)
    if isinstance(before, np.ndarray) and before.size:
        other |= st.sampled_from(
            [
                before.ravel()[:0],
                before.astype(np.float64),
                before[None],
                before * 0 - 1,
                np.ones_like(before),
                np.flip(before),
            ]
        )
    new = data.draw(other)
    if isinstance(node, dict) and data.draw(st.booleans()):
        node.pop(key)
    else:
        node[key] = new


@given(raw=st.binary(max_size=400), cut=st.floats(0, 1), keep=st.booleans())
@MANY
def test_a_file_of_any_bytes(raw, cut, keep):
    path, place = folder() / "any", int(cut * len(exported()))
    path.write_bytes(exported()[:place] + raw + exported()[place + len(raw) :] if keep else raw)
    try:
        tree = read(path, "model")
    except ValueError as error:
        assert str(path) in str(error)
    else:
        assert path.read_bytes() == exported() and isinstance(tree, dict)


@given(data=st.data())
@MANY
def test_a_model_with_something_else_in_it(data):
    tree = copied(model_tree(trained()))
    for _ in range(data.draw(st.integers(1, 3))):
        mutate(tree, data)
    try:
        model = build_model(DDiffPG, tree)
    except ValueError as error:
        assert str(error)
        return
    actions = model.predict(np.zeros((2, 2), dtype=np.float32))[0]
    assert actions.shape == (2, 1) and (np.abs(actions) <= 1).all()


@cache
def interrupted() -> dict:
    """A checkpoint in the midst of episodes, as it is read."""
    model = small_model(DummyVecEnv([KnownEnds] * 4), buffer_size=400)
    model.learn(300, callback=RunCheckpointCallback(folder() / "run", save_freq=100))
    return read(checkpoint_files(folder() / "run")[0], KIND)


@given(data=st.data())
@MANY
def test_a_checkpoint_with_something_else_in_it(data):
    """It is refused when it is read, or the run goes on, or training says what is wrong; no parameter takes any harm."""
    tree = copied(interrupted())
    for _ in range(data.draw(st.integers(1, 3))):
        mutate(tree, data)
    path = folder() / "changed.safetensors"
    write(path, KIND, tree)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model = DDiffPG.resume(path, DummyVecEnv([KnownEnds] * 4))
        except ValueError as error:
            assert str(error)
            return
        model.set_logger(Logger(None, []))
        for value, most in (  # longer than a test may take
            (model.batch_size, 10**4),
            (model.gradient_steps, 10),
            (model.target_action_settings.n_steps, 10),
            (model.train_freq.frequency, 10),
        ):
            assume(not isinstance(value, int) or value <= most)
        try:
            model.learn(model.num_timesteps - model._learn_began_at + 40)
        except (DivergedError, ValueError) as error:  # such as of another success_key
            assert str(error)
    for parameter in model.policy.parameters():
        assert parameter.isfinite().all()


@given(data=st.data())
@MANY
def test_a_replay_buffer_with_something_else_in_it(data):
    buffer = trained().replay_buffer
    before = buffer_state(buffer)
    tree = copied(before)
    for _ in range(data.draw(st.integers(1, 3))):
        mutate(tree, data)
    try:
        restore_buffer(buffer, tree)
    except ValueError as error:
        assert str(error)
        assert_same(buffer_state(buffer), before)
    else:
        batch = buffer.sample_modes(32, 0.9, 3, 3)
        assert np.isfinite(batch.discounts.numpy()).all()
        restore_buffer(buffer, before)


def assert_same(first, second):
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        first, second = list(first.values()), list(second.values())
    if isinstance(first, (list, tuple)):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same(one, other)
    else:
        np.testing.assert_array_equal(first, second)


YAML = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=30),
    lambda each: st.lists(each, max_size=3) | st.dictionaries(st.text(max_size=15), each, max_size=3),
    max_leaves=6,
)
SETTINGS = st.dictionaries(
    st.sampled_from(["gamma", "n_timesteps", "n_envs", "policy_kwargs", "batch_size", "policy", "env_kwargs"])
    | st.text(max_size=9),
    YAML | st.sampled_from(["lin_3e-4", "dict(net_arch=[8])", "__import__('os').abort()", "3e-4", 0.9, 4]),
    max_size=3,
)
SUITE = {"description": "x", "tasks": {"PointMazeV1-v0": None}, "variants": {"a": {}}, "seeds": [0]}
TASKS = st.dictionaries(st.sampled_from(["PointMazeV1-v0", "AntMazeV3-v0"]) | st.text(max_size=9), SETTINGS | YAML)
VARIANT = st.fixed_dictionaries({}, optional={"settings": SETTINGS, "algo": st.just("td3_c51") | YAML, "members": YAML})
CHANGES = st.fixed_dictionaries(
    {},
    optional={
        "tasks": TASKS | YAML,
        "variants": st.dictionaries(st.text(max_size=5), VARIANT) | YAML,
        "seeds": st.lists(st.integers(), max_size=3) | YAML,
        "settings": SETTINGS | YAML,
        "tests": st.dictionaries(st.sampled_from(["n_tests", "n_episodes", "also"]), YAML) | YAML,
        "also": YAML,
        "resources": st.dictionaries(st.sampled_from(["cpus", "gpus"]), YAML) | YAML,
        "ablation": YAML,
        "members": YAML,
    },
)


@given(suite=CHANGES.map(lambda changes: yaml.safe_dump({**SUITE, **changes})) | st.text(max_size=80))
@MANY
def test_a_suite_that_says_anything(suite):
    path = folder() / "suite.yml"
    path.write_text(suite, encoding="utf-8", errors="replace")
    try:
        trials = read_suite(str(path)).trials()
    except (ValueError, TypeError) as error:
        assert str(error)
        return
    assert trials and all(not folder.is_absolute() and ".." not in folder.parts for folder in trials)


@given(
    rows=st.lists(st.text("#.rg01x", max_size=9), max_size=9)
    | st.recursive(st.sampled_from([None, 1, 0, "r", "g"]), lambda each: st.lists(each, max_size=3), max_leaves=8)
    | hnp.arrays(np.int64, hnp.array_shapes(max_dims=3, max_side=6)).map(list),
    inside=st.booleans(),
    path=hnp.arrays(np.float64, st.tuples(st.integers(0, 6), st.just(2)), elements=st.floats(-30, 30)),
)
@MANY
def test_a_maze_of_any_rows(rows, inside, path):
    if inside and rows and isinstance(rows, list) and all(isinstance(row, str) for row in rows):
        width = max(map(len, rows))
        rows = ["#" * (width + 2), *(f"#{row.ljust(width, '.')}#" for row in rows), "#" * (width + 2)]
    try:
        maze = Maze(rows)
    except ValueError as error:
        assert "maze_map" in str(error)
        return
    assert len(set(maze.listed_routes)) == len(maze.listed_routes)
    assert maze.label(path, 0).startswith("0:") if len(path) else True


PATHS = hnp.arrays(
    st.sampled_from([np.float64, np.float32]),
    st.tuples(st.integers(0, 5), st.integers(0, 12), st.integers(0, 3)),
    elements=st.floats(width=32) | st.sampled_from([0.0, 1.0]),
)


@given(paths=PATHS)
@MANY
def test_trajectories_of_any_numbers(paths):
    try:
        distances = dtw_distances(paths)
    except ValueError as error:
        assert str(error)
        return
    assert distances.shape == (len(paths),) * 2
    np.testing.assert_array_equal(distances, distances.T)
    assert (distances >= 0).all() and not np.diag(distances).any()


@given(name=st.text(max_size=30) | st.from_regex(r"[\w .+-]{0,25}") | YAML)
@MANY
def test_a_mode_of_any_name(name):
    model = trained()
    before = [(mode.name, mode.number) for mode in model.modes]
    try:
        model.rename_mode(0, name)
    except ValueError as error:
        assert "name=" in str(error) and [(mode.name, mode.number) for mode in model.modes] == before
        return
    assert ModeTable(model.modes).index(name) == 0 and len(model.predict(np.zeros((3, 2)), mode=name)[0]) == 3
    tree = model_tree(model)
    assert build_model(DDiffPG, copied(tree)).modes[0].name == name
    assert (folder() / name).parent == folder()  # also good for a file
    model.rename_mode(0, before[0][0])
    model.mode_history.events.clear()  # which would hold all the names that a fuzzer tries


BOUNDS = st.floats(width=32) | st.sampled_from([-1.0, 0.0, 1.0, np.inf, -np.inf])
BOXES = st.builds(
    lambda low, high, shape, dtype: (low, high, shape, dtype),
    *(BOUNDS, BOUNDS),
    st.lists(st.integers(0, 3), max_size=3).map(tuple),
    st.sampled_from([np.float32, np.float64, np.int8, np.uint8]),
)


def box(arguments):
    low, high, shape, dtype = arguments
    return spaces.Box(low, high, shape, dtype=dtype)


class Constant(gym.Env):
    """An environment of any spaces in which nothing happens."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


OTHERS = st.one_of(
    st.integers(1, 5).map(spaces.Discrete),
    st.lists(st.integers(1, 4), min_size=1, max_size=3).map(spaces.MultiDiscrete),
    st.integers(1, 4).map(spaces.MultiBinary),
    st.just(spaces.Text(3)),
    st.just(spaces.Graph(spaces.Box(0, 1), None)),
)


@given(observation=BOXES | OTHERS, action=BOXES | OTHERS, nested=st.sampled_from(["no", "dict", "tuple", "empty"]))
@MANY
def test_any_spaces(observation, action, nested):
    try:
        observation, action = (box(each) if isinstance(each, tuple) else each for each in (observation, action))
    except Exception:
        return  # gymnasium's own refusal
    if nested != "no":
        parts = {} if nested == "empty" else {"a": observation, "b": spaces.Box(0, 1, (2,))}
        observation = spaces.Tuple(tuple(parts.values())) if nested == "tuple" else spaces.Dict(parts)
    policy = "MultiInputPolicy" if isinstance(observation, spaces.Dict) else "MlpPolicy"
    env = Constant(observation, action)
    try:
        model = DDiffPG(policy, env, policy_kwargs={"net_arch": [4]}, buffer_size=50, learning_starts=2, batch_size=4)
        model.learn(4)
    except (ValueError, TypeError, NotImplementedError, AssertionError) as error:
        assert str(error)


@given(data=st.data())
@MANY
def test_an_evaluation_with_something_else_in_it(data):
    path = folder() / "evaluation.json"
    tree = json.loads(evaluated())
    mutate(tree, data)
    path.write_text(json.dumps(tree, default=str))
    try:
        found = ModeEvaluation.load(path)
    except ValueError as error:
        assert str(error)
        return
    assert found.commanded_modes >= 0 and found.expected_modes() >= 0


def test_an_evaluation_of_more_episodes_than_can_be_counted():
    path, tree = folder() / "evaluation.json", json.loads(evaluated())
    tree["commanded"][0]["n_episodes"] = 2**70
    path.write_text(json.dumps(tree))
    with pytest.raises(ValueError, match="episodes; accepted are up to"):
        ModeEvaluation.load(path)


@cache
def evaluated() -> str:
    evaluation = evaluate_modes(trained(), DummyVecEnv([TwoEnds] * 2), n_episodes=3)
    evaluation.save(folder() / "evaluation.json")
    return (folder() / "evaluation.json").read_text()
