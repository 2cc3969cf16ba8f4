"""What a check says of environments of which all is known by construction."""

import io
import subprocess
import sys
import warnings
from contextlib import redirect_stdout

import gymnasium as gym
import numpy as np
import pytest
from environments import AnySpaces, TwoEnds, image_dict_space
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ddiffpg import check_env
from sb3_ddiffpg.check.command import main
from sb3_ddiffpg.envs import make_vec_env

LENGTH = 10


class Script(gym.Env):
    """
    Whatever one does, it goes on for ``LENGTH`` steps. Component 2 walks away at one unit a step, to one side or the other;
    the others go to and fro.

    :param info: Of step t (from 1) of episode e (from 0)
    :param reward: The same
    :param ends: Whether episodes do
    :param unit: Of all components
    """

    def __init__(self, info=lambda t, e: {}, reward=lambda t, e: 0.0, ends=True, unit=1.0, size=5):
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.info, self.reward, self.ends, self.unit, self.episode = info, reward, ends, unit, -1

    def _seen(self):
        seen = np.full(self.observation_space.shape, (-1.0) ** self.t)
        seen[2] = self.t * self.side
        return (self.unit * seen).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.episode, self.side = 0, self.episode + 1, self.np_random.choice([-1.0, 1.0])
        return self._seen(), {}

    def step(self, action):
        self.t += 1
        args = self.t, self.episode
        return self._seen(), float(self.reward(*args)), self.ends and self.t == LENGTH, False, self.info(*args)


def check(env, steps=400, **arguments):
    return check_env(env, steps, policy_kwargs={"net_arch": [8]}, **arguments)


# ---------------------------------------------------------------------- success


def test_success_told_at_each_step():
    found = check(Script(lambda t, e: {"is_success": t == LENGTH}))
    signal = found.success
    assert (found.n_steps, found.lengths) == (400, (LENGTH,) * 40)
    assert (signal.key, signal.only_true, signal.n_steps, signal.n_mid_episode) == ("is_success", False, 400, 0)
    assert signal.n_counted == 40 and not signal.stands_in
    assert 'info["is_success"], told at each step; 40 of 40 episodes counted' in str(found)


def test_success_told_only_where_it_is_true():
    found = check(Script(lambda t, e: {"success": np.True_} if t == LENGTH and e % 4 == 0 else {}))
    assert (found.success.key, found.success.only_true, found.success.n_steps) == ("success", True, 10)
    assert 'info["success"], told only where it is True' in str(found)


def test_success_told_in_mid_episode():
    found = check(Script(lambda t, e: {"is_success": t == 5}))
    assert found.success.n_mid_episode == 40
    assert "it was True at 40 steps after which the episode went on" in str(found)


def test_no_success_told():
    """The best fifth of the returns stands in for it; a key that could be meant is named, and can be given."""
    env = Script(lambda t, e: {"arrived": bool(e % 2), "TimeLimit.truncated": False}, lambda t, e: e)
    found = check(env)
    assert found.success.key is None and found.success.stands_in and found.success.candidates == ("arrived",)
    assert found.success.n_counted == 8  # a fifth of 40, though of ever larger returns each was the best when it came
    assert "success_key='arrived'" in found.arguments()
    given = check(env, success_key="arrived")
    assert (given.success.key, given.success.stands_in, given.success.n_counted) == ("arrived", False, 20)


def test_what_is_no_truth_value_is_refused():
    with pytest.raises(ValueError, match=r"info\['is_success'\].*accepted is True or False"):
        check(Script(lambda t, e: {"is_success": [1.0, 2.0]}))


# ---------------------------------------------------------------------- rewards and ends


@pytest.mark.parametrize("scale", [1.0, -3e-3, 2e5])
def test_range_of_rewards_and_returns(scale):
    """Of a reward for each step: from the last step one of them, from the first a geometric sum."""
    found = check(Script(reward=lambda t, e: scale))
    ends = sorted([scale, scale * (1 - 0.99**LENGTH) / (1 - 0.99)])
    assert found.rewards == pytest.approx((scale, scale), rel=1e-5)
    assert found.returns == pytest.approx(ends, rel=1e-5) and found.support is None
    assert "nothing need be set: the critics' range follows the returns" in str(found)


def test_fixed_values_are_told():
    found = check(Script(reward=lambda t, e: 0.5), critic={"v_min": -1.0, "v_max": 7.0})
    assert found.support == (-1.0, 7.0) and "the critics hold values within -1 to 7, as given" in str(found)


def test_an_endless_environment():
    found = check(Script(reward=lambda t, e: -1.0, ends=False), steps=250)
    assert found.n_steps == 2500 and found.lengths == () and found.limit is None  # it has waited for episodes
    assert found.returns == pytest.approx((-100.0, -100.0))  # as if it went on: -1 / (1 - 0.99)
    assert "TimeLimit(env, max_episode_steps=...)" in str(found)


@pytest.mark.parametrize("registered", [False, True])
def test_a_time_limit(registered):
    if registered:
        gym.register("CheckedScript-v0", Script, max_episode_steps=7)
        env = gym.make("CheckedScript-v0")
        del gym.registry["CheckedScript-v0"]
    else:
        env = gym.wrappers.TimeLimit(Script(), 7)
    found = check(env, steps=70)
    assert found.limit == 7 and found.declared_limit and found.lengths == (7,) * 10
    assert "7 steps, as declared" in str(found)


def test_it_goes_on_until_some_episodes_have_ended():
    found = check(gym.wrappers.TimeLimit(Script(ends=False), 130), steps=100)
    assert found.lengths == (130,) * 5 and found.n_steps == 700


# ---------------------------------------------------------------------- features and cells


@pytest.mark.parametrize("unit", [1.0, 1e4, 1e-4])
def test_found_features(unit):
    """The walking component comes as many steps far as there are; one to and fro comes one of its steps far."""
    features = check(Script(unit=unit)).features
    assert features.source == "found" and features.selection.tolist() == [2] and features.names == ("2",)
    assert features.travels == pytest.approx((LENGTH,), rel=1e-4)
    assert features.others == pytest.approx({"0": 1.0, "1": 1.0, "3": 1.0, "4": 1.0}, rel=1e-4)


def test_declared_and_given_features():
    env = Script()
    env.mode_features = np.array([2, 4])
    found = check(env)
    assert found.features.source == "declared" and found.features.travels == pytest.approx((LENGTH, 1.0))
    assert "components 2, 4, declared by the environment" in str(found) and "mode_features=[2, 4]" in found.arguments()
    given = check(env, mode_features=[1])
    assert given.features.source == "given" and given.features.names == ("1",) and "component 1, as given" in str(given)


def test_few_components_are_all_taken():
    features = check(Script(size=3)).features
    assert features.source == "whole" and features.names == ("0", "1", "2") and not features.others


def test_cells_by_hand():
    """Positions -10 ... 10 without 0, in cells of 4: -12, -8, -4, 0, 4, 8."""
    found = check(Script(), mode_features=[2], novelty={"kwargs": {"cell_size": 4.0}})
    assert found.cells.edges == (4.0,) and found.cells.given and found.cells.n_seen == 6 and found.cells.complaint is None
    followed = check(Script(), mode_features=[2]).cells
    assert not followed.given and 6 < followed.n_seen <= 20


def test_cells_that_say_nothing():
    found = check(Script(), mode_features=[2], novelty={"kwargs": {"cell_size": 1e3}})
    assert "almost no step is new" in found.cells.complaint and found.cells.complaint in str(found)
    assert not any("novelty says nothing" in each for each in found.warned)  # said once
    space = spaces.Box(0, 1, (3,), np.float32)
    assert "almost every step is new" in check(AnySpaces(space), novelty={"kwargs": {"cell_size": 1e-4}}).cells.complaint


# ---------------------------------------------------------------------- spaces


class GoalEnv(AnySpaces):
    """Three entries of random numbers, as a goal environment has them."""

    def __init__(self):
        parts = {"observation": 4, "achieved_goal": 2, "desired_goal": 2}
        super().__init__(spaces.Dict({name: spaces.Box(-1, 1, (size,), np.float32) for name, size in parts.items()}))


def test_a_goal_environment():
    found = check(GoalEnv())
    assert found.policy == "MultiInputPolicy" and found.features.source == "achieved_goal"
    assert found.features.names == ("achieved_goal[0]", "achieved_goal[1]")
    assert found.relabels is False and "so each episode learns from its own" in str(found)  # it has no compute_reward
    assert "mode_features='achieved_goal'" in found.arguments()
    assert 'the key "achieved_goal", the achieved_goal of a goal environment' in str(found)


@pytest.mark.parametrize("space", [spaces.Box(0, 255, (3, 36, 36), np.uint8), image_dict_space()], ids=["image", "dict"])
def test_images(space):
    found = check(AnySpaces(space), steps=220)
    assert "(an image)" in found.spaces[0] and found.n_steps == 220 and found.lengths == (10,) * 22
    assert found.policy == "MultiInputPolicy" if isinstance(space, spaces.Dict) else found.policy in ("MlpPolicy", "CnnPolicy")


@pytest.mark.parametrize(
    ("space", "said"),
    [
        (spaces.Discrete(3), "Discrete"),
        (spaces.Box(-np.inf, np.inf, (2,), np.float32), "finite"),
        (spaces.Box(np.array([0.0, 1.0]), np.array([1.0, 1.0]), dtype=np.float64), "low is not below high"),
    ],
    ids=["discrete", "infinite", "empty"],
)
def test_actions_that_cannot_work(space, said):
    with pytest.raises(ValueError, match=said):
        check(AnySpaces(action_space=space))


def test_what_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="(?i)reward.*(nan|finite)"):
        check(Script(reward=lambda t, e: np.nan))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (dict(env=3), "env: 3 given"),
        (dict(env="NoSuchThing-v0"), "NoSuchThing"),
        (dict(env=TwoEnds(), steps=0), "steps: 0 given"),
        (dict(env=TwoEnds(), env_kwargs={"limit": 3}), "env_kwargs"),
        (dict(env=TwoEnds(), gamma=2.0), "gamma"),
    ],
)
def test_arguments_that_cannot_work(given, said):
    with pytest.raises(ValueError, match=said):
        check_env(**given)


# ---------------------------------------------------------------------- what else is told


def test_wrappers_that_change_observations():
    env = gym.wrappers.RescaleObservation(gym.wrappers.TimeLimit(TwoEnds(), 5), np.float32(-1), np.float32(1))
    found = check(VecNormalize(DummyVecEnv([lambda: env]), norm_reward=False), steps=50)
    assert found.wrappers == ("RescaleObservation", "VecNormalize")
    assert check(TwoEnds(), steps=50).wrappers == ()


def test_labels_of_routes():
    env = Script(lambda t, e: {"is_success": True, "mode": "AB"[e % 2]})
    env.listed_modes = ("A", "B", "C")
    found = check(env)
    assert found.listed == ("A", "B", "C") and found.labels == {"A": 20, "B": 20}
    assert "not labelled" in str(check(TwoEnds(), steps=50))


def test_the_checker_of_sb3_is_asked():
    found = check(AnySpaces(action_space=spaces.Box(0, 2, (1,), np.float32)), steps=50)
    assert any("symmetric" in each for each in found.warned)


def test_nothing_else_is_changed():
    """Neither random states nor warnings of others."""
    before = np.random.get_state()[1].copy()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(Script(reward=lambda t, e: 1e9), steps=50)
    np.testing.assert_array_equal(np.random.get_state()[1], before)


@pytest.mark.parametrize("by_id", [False, True])
def test_the_lines_train(by_id):
    env = "PointMazeV1-v0" if by_id else TwoEnds()
    found = check_env(env, 200, env_kwargs={"start_noise": 0.0} if by_id else None, batch_size=32, gamma=0.9)
    assert "learn(100_000)" in found.code and found.code in str(found).replace("\n    ", "\n")
    names = {} if by_id else {"env": env}
    with redirect_stdout(io.StringIO()):
        exec(found.code.replace("100_000", "40"), names)
    model = names["model"]
    assert model.num_timesteps == 40 and (model.n_envs, model.batch_size, model.gamma) == (8 if by_id else 1, 32, 0.9)


# ---------------------------------------------------------------------- the command


def test_the_command_prints_the_page(capsys):
    main(["PointMazeV1-v0", "--steps", "300", "--env-kwargs", "start_noise:0", "--hyperparams", "mode_features:[0]"])
    page = capsys.readouterr().out
    assert page.startswith("PointMazeV1-v0 can be trained on.") and "component 0, as given" in page
    assert 'make_vec_env("PointMazeV1-v0", n_envs=8, seed=0, start_noise=0)' in page


def test_the_command_fails_with_what_is_wrong():
    with pytest.raises(SystemExit) as error:
        main(["CartPole-v1", "--steps", "50"])
    assert str(error.value).startswith("CartPole-v1 cannot be trained on: ") and "Discrete" in str(error.value)
    with pytest.raises(SystemExit, match="--gym-packages: 'no_such_module' cannot be imported"):
        main(["CartPole-v1", "--gym-packages", "no_such_module"])


def test_values_of_options_are_python(capsys):
    with pytest.raises(SystemExit) as error:
        main(["PointMazeV1-v0", "--env-kwargs", "maze_map:V3"])
    assert error.value.code == 2 and "accepted is NAME:VALUE" in capsys.readouterr().err


def test_from_a_checkout():
    """With the exit status of a command."""
    command = [sys.executable, "-m", "sb3_ddiffpg.check", "CartPole-v1", "--steps", "50"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and "CartPole-v1 cannot be trained on" in done.stderr and not done.stdout


# ---------------------------------------------------------------------- what a stranger would paste


def test_values_are_suggested_only_where_a_success_has_shown_its_worth():
    """Before that the largest return that was met would cut off all that is to come."""
    reached = check(Script(lambda t, e: {"is_success": t == LENGTH}, lambda t, e: -1.0 + 5.0 * (t == LENGTH)))
    missed = check(Script(lambda t, e: {"is_success": False}, lambda t, e: -1.0))
    told = [[each for each in found.arguments() if each.startswith("critic")] for found in (reached, missed)]
    assert len(told[0]) == 1 and told[1] == []


def test_a_misspelt_key_is_not_handed_on():
    env = Script(lambda t, e: {"reached": False, "TimeLimit.truncated": False})
    with pytest.raises(ValueError, match="success_key='reachd' is not in .*did you mean 'reached'"):
        check(env, success_key="reachd")
    other = check(env, success_key="solved")
    assert "info['solved'], which was asked for" in str(other) and "info also has reached" in str(other)
    assert "solved" not in other.code and "success_key='reached'" in other.arguments()
    kept = check(Script(lambda t, e: {"reached": False}), success_key="reached")
    assert "success_key='reached'" in kept.code


def test_no_two_pixels_are_suggested():
    image = spaces.Box(0, 255, (36, 36, 3), np.uint8)
    assert not any(each.startswith("mode_features") for each in check(AnySpaces(image), steps=50).arguments())


def test_ranges_of_several_components():
    different = AnySpaces(spaces.Box(np.array([-1, -5], np.float32), np.array([1, 5], np.float32)))
    assert "(2,) numbers in [-5, 5] (the widest of different ranges)" in str(check(different, steps=50))


class Reward(GoalEnv):
    """A goal environment as one should be."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.linalg.norm(np.asarray(achieved_goal) - desired_goal, axis=-1)


def test_a_goal_environment_behind_a_time_limit_is_not_complained_of(capsys):
    """SB3's checker asks the outermost wrapper, which does not know."""
    name = "CheckedGoal-v0"
    gym.register(name, Reward, max_episode_steps=20)
    try:
        assert not any("env_checker" in each for each in check(name, steps=50).warned)
        assert "GoalEnv" not in capsys.readouterr().out
    finally:
        gym.registry.pop(name)


def test_an_id_that_nobody_has_registered():
    """As a package's own or a stranger's: the latter needs its module."""
    for ask in (check_env, make_vec_env):
        with pytest.raises((ValueError, gym.error.Error)) as caught:
            ask("NoSuchRoom-v0")
        said = " ".join([str(caught.value), *getattr(caught.value, "__notes__", ())])
        assert '"module:NoSuchRoom-v0"' in said and "{}" not in said
