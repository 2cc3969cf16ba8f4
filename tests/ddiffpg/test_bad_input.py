"""What cannot work is refused by name; what breaks on the way stops the run and loses nothing."""

import re
import warnings
from copy import deepcopy
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import (
    SMALL,
    AnySpaces,
    BreaksAt,
    TwoEnds,
    assert_no_gaps,
    assert_same_state,
    merged,
    small_model,
    state_of,
)
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecFrameStack, VecNormalize

from sb3_ddiffpg import ClusteringCallback, DDiffPG
from sb3_ddiffpg.envs.snapshots import normalization
from sb3_ddiffpg.evaluation.rollout import run_episodes
from sb3_ddiffpg.utils.divergence import DivergedError

NUMBERS_FROM_ONE = (
    *("recluster_freq", "batch_size", "buffer_size", "critic.n_critics", "critic.n_atoms"),
    *("target_action.n_steps", "modes.max_modes", "modes.min_size"),
    *("modes.max_successes", "modes.max_failures", "modes.embedding_dim", "modes.trials"),
)
BAD_ARGUMENTS = [
    *((name, value) for name in NUMBERS_FROM_ONE for value in (0, -1, 1.5, None, "many", True)),
    *(("n_diffusion_steps", value) for value in (0, -1, 1.5, "many", True)),
    *((name, value) for name in ("learning_starts", "modes.patience") for value in (-1, 0.5, None, "x")),
    *((name, value) for name in ("gamma", "tau", "modes.mask_prob", "exploration.fraction") for value in (-0.1, 1.1, "x")),
    *((name, None) for name in ("gamma", "tau", "modes.mask_prob")),
    *(
        (name, np.nan)
        for name in (
            "gamma",
            "tau",
            "target_action.learning_rate",
            "reward_scale",
            "critic.v_min",
            "critic.v_max",
            "novelty.scale",
        )
    ),
    *(
        (name, value)
        for name in ("target_action.learning_rate", "reward_scale", "max_grad_norm", "exploration.v_max", "novelty.clip")
        for value in (0, -1.0, "x")
    ),
    *(
        (name, value)
        for name in (
            "critic.target_policy_noise",
            "critic.target_noise_clip",
            "novelty.scale",
            "novelty.coef",
            "modes.novelty_coef",
        )
        for value in (-0.1, None, "x", np.nan)
    ),
    *((name, value) for name in ("learning_rate", "qf_learning_rate") for value in (-1e-3, "lin_3e-4x", np.nan)),
    *(("exploration.gamma", value) for value in (-0.1, 1.1, "x", np.nan)),
    *(("exploration.share", value) for value in (-0.1, 1.5, "half")),
    *(("modes.distance_threshold", value) for value in (0, -1.0, "auto", np.nan)),
    *(("critic.v_min", value) for value in (5.0, 6.0, "x")),
    ("critic.v_max", -np.inf),
    ("gradient_steps", 1.5),
    ("target_action.optimizer", "adamw"),
    ("modes.backup_embedding", "none"),
    ("critic.twin_target", "mean"),
    ("modes.linkage", "ward"),
    ("novelty", "icm"),
    ("novelty", 3),
    ("novelty", int),
    *(
        (name, np.inf)
        for name in (
            "target_action.learning_rate",
            "reward_scale",
            "novelty.coef",
            "learning_rate",
            "critic.target_policy_noise",
        )
    ),
    ("modes.max_successes", 2),  # fewer than modes.min_size
    *(("policy_kwargs", {name: 2}) for name in ("n_modes", "n_atoms", "support", "mode_embedding_dim")),
    ("novelty.kwargs", {"table_size": 0}),
    ("success_key", 5),
    *((name, value) for name in ("n_steps", "modes.n_steps", "exploration.n_steps") for value in (0, -1, 1.5, "many", True)),
    ("optimize_memory_usage", True),
    ("replay_buffer_class", ReplayBuffer),
    ("replay_buffer_class", "ModeReplayBuffer"),
    *(
        (name, 1e39)
        for name in (
            "critic.v_max",
            "exploration.v_max",
            "learning_rate",
            "target_action.learning_rate",
            "reward_scale",
            "novelty.coef",
        )
    ),
    *(("gamma", value) for value in (10**400, -(10**400))),
    *(("exploration.share", share) for share in (lambda progress: np.nan, lambda progress: 2 * progress, dict, "lin_0.5")),
    *(("learning_rate", rate) for rate in (lambda progress: 1 / progress, LinearSchedule(1e-3, -1e-3, 0.5), "3e-4")),
    *(("train_freq", value) for value in ((1, "minute"), (1,), (0, "episode"), 1.5, 0, -3, True)),
    *(("mode_features", value) for value in ([2], [-1], [], [[0]], [0.5], "position", 0, lambda obs: obs.sum())),
]


def made_with(arguments):
    """A model with these beside the arguments of ``SMALL``; of a group only what is given."""
    return DDiffPG("MlpPolicy", TwoEnds(), **merged(SMALL, arguments))


@pytest.mark.parametrize(
    ("argument", "value"), BAD_ARGUMENTS, ids=[f"{name}-{i}" for i, (name, _) in enumerate(BAD_ARGUMENTS)]
)
def test_bad_arguments(argument, value):
    with pytest.raises(ValueError, match=re.escape(argument)):
        made_with({argument: value})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"batch_size": 10, "modes": {"max_modes": 10}},
            r"batch_size=10 is smaller than the number of groups.*modes.max_modes \+ 1 = 11",
        ),
        ({"n_diffusion_steps": 0}, "n_diffusion_steps must be an integer of at least 1, or be None, got 0"),
        ({"gamma": 1.1}, r"gamma must lie in \[0, 1\], got 1.1"),
        ({"modes": {"linkage": "ward"}}, r"modes.linkage must be one of \['average', .*\], got 'ward'"),
        (
            {"novelty": "icm"},
            r"novelty.measure must be one of \['rnd', 'counts'\] "
            "or a subclass of torch.nn.Module like these, got 'icm'",
        ),
        ({"critic": {"v_min": 7.0}}, r"critic.v_min must be less than v_max, got v_min=7.0, v_max=5.0"),
        ({"mode_features": [7]}, r"mode_features=\[7\] exceeds the observation's 2 components"),
        ({"novelty": {"kwargs": {"cell_size": -1.0}}}, r"novelty.kwargs\['cell_size'\] must be positive, got -1.0"),
    ],
)
def test_messages_say_what_was_given_and_what_is_accepted(arguments, message):
    with pytest.raises(ValueError, match=message):
        made_with(arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        {"policy_kwargs": {"net_arc": [16]}},
        {"novelty.kwargs": {"cellsize": 1.0}},
        {"replay_buffer_kwargs": {"capacity": 3}},
    ],
)
def test_misspelt_arguments_of_the_parts(arguments):
    (misspelt,) = next(iter(arguments.values()))
    with pytest.raises(TypeError, match=misspelt):
        made_with(arguments)


def test_mode_features_of_dict_observations():
    env = AnySpaces(spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Discrete(3)}))
    with pytest.raises(ValueError, match=r"mode_features='c' is not a key of the observation; keys: \['a', 'b'\]"):
        small_model(env, "MultiInputPolicy", mode_features="c")
    with pytest.raises(ValueError, match=r"mode_features=\[0, 3\] exceeds the observation's 3 components"):
        small_model(env, "MultiInputPolicy", mode_features=[0, 3])


def test_an_action_that_has_no_range():
    """It was not a number once the warm-up was over."""
    still = spaces.Box(np.array([-1.0, 0.5], np.float32), np.array([1.0, 0.5], np.float32))
    with pytest.raises(ValueError, match=r"action_space: low is not below high in components \[1\]; accepted are ranges"):
        small_model(AnySpaces(action_space=still))


def test_what_is_given_at_loading_is_checked_too(trained, tmp_path):
    trained.save(tmp_path / "model")
    with pytest.raises(ValueError, match="batch_size=3 is smaller"):
        DDiffPG.load(tmp_path / "model", batch_size=3)
    with pytest.raises(ValueError, match="modes.linkage must be one of"):
        DDiffPG.load(tmp_path / "model", modes={"linkage": "ward"})


def test_clustering_callback():
    for wrong in (0, 1.5, "a"):
        with pytest.raises(ValueError, match="recluster_freq must be an integer of at least 1, got"):
            ClusteringCallback(wrong)


@pytest.mark.parametrize("said", [np.array([True, False]), "yes", [], {"a": 1}], ids=str)
def test_successes_that_are_no_truth_values(said):
    class Says(TwoEnds):
        def step(self, action):
            return *super().step(action)[:4], {"is_success": said}

    with pytest.raises(ValueError, match=r"info\['is_success'\]: .* given; accepted is True or False"):
        small_model(Says()).learn(100)


@pytest.mark.parametrize("rate", [np.float32(1e-3), np.float64(1e-3), np.int64(0)], ids=repr)
def test_numbers_of_numpy_are_learning_rates_too(rate):
    model = small_model(DummyVecEnv([TwoEnds] * 4), learning_rate=rate, qf_learning_rate=rate).learn(60)
    assert model.lr_schedule(0.5) == model._qf_schedule(0.5) == float(rate)


def test_a_batch_too_small_for_its_groups(trained, tmp_path):
    """Also where it only turns out later: a model with more modes than it would find itself."""
    trained.save(tmp_path / "model")
    model = DDiffPG.load(tmp_path / "model", env=DummyVecEnv([TwoEnds] * 4), modes={"max_modes": 1}, batch_size=2)
    before = deepcopy(model.policy.state_dict())
    with pytest.raises(ValueError, match="batch_size=2 is smaller than the number of groups, 3"):
        model.learn(100)
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())


def test_a_buffer_too_small_for_the_episodes(tmp_path):
    def limited():
        env = gym.wrappers.TimeLimit(TwoEnds(), max_episode_steps=300)
        env.unwrapped.spec = gym.envs.registration.EnvSpec("TwoEnds-v0", max_episode_steps=300)
        return env

    model = small_model(DummyVecEnv([limited] * 3), buffer_size=899)
    with pytest.raises(ValueError, match="buffer_size=899 is smaller than one episode of every environment: 3 x 300 steps"):
        model.learn(10)
    small_model(DummyVecEnv([limited] * 3), buffer_size=900).learn(10)
    # Before the first step, not at it
    wide = DummyVecEnv([lambda: AnySpaces(spaces.Box(-1, 1, (100_000,)))])
    with pytest.raises(ValueError, match="buffer_size=2000000000: there is not so much memory"):
        small_model(wide, buffer_size=2_000_000_000).learn(0)
    with pytest.raises(ValueError, match="buffer_size must be from 1 to 2147483647, got 3000000000"):
        small_model(wide, buffer_size=3_000_000_000)
    none = small_model(DummyVecEnv([TwoEnds] * 4), buffer_size=3, learning_starts=100)
    with pytest.raises(ValueError, match=r"buffer_size=3 transitions is too small: .* 4 environment\(s\)"):
        none.learn(100)
    none.save(tmp_path / "model")


def test_a_success_key_that_is_missing():
    """It may be told only where it is True; a misspelling of one that is there is none."""
    told = r"success_key='solved' is not in an episode's last info; its keys: \[.*'is_success'"
    model = small_model(DummyVecEnv([TwoEnds] * 2), success_key="solved")
    with pytest.warns(
        UserWarning, match=told + r".*\. Episodes count as failures .*; without success_key, 'is_success' would be"
    ):
        model.learn(100)
    assert model.replay_buffer.trajectories(True) == []
    with pytest.raises(ValueError, match=r"success_key='is_succes' .*; did you mean 'is_success'\?"):
        small_model(DummyVecEnv([TwoEnds] * 2), success_key="is_succes").learn(100)
    with pytest.warns(
        UserWarning, match="without success_key, 'success' would be it"
    ):  # a slip, where it is told only if True
        small_model(DummyVecEnv([lambda: TwoEnds(None)] * 2), success_key="succes").learn(100)


def test_modes_belong_to_their_features(tmp_path):
    small_model(DummyVecEnv([TwoEnds] * 4), mode_features=[0, 1]).learn(400).save(tmp_path / "model")
    assert DDiffPG.load(tmp_path / "model", mode_features=np.array([0, 1])).modes.names
    for other in ([0], [1, 0]):
        with pytest.raises(ValueError, match=r"mode_features=.*: the modes of this model were found in \[0, 1\]"):
            DDiffPG.load(tmp_path / "model", mode_features=other)


def test_positions_behind_a_wrapper_that_stacks_frames():
    """The newest frame counts; behind a wrapper that does who knows what, the user must say."""
    env = VecFrameStack(DummyVecEnv([TwoEnds] * 2), 3)
    model = small_model(env).learn(40)
    np.testing.assert_array_equal(model.replay_buffer.features.selection, [4])
    positions = [env.get_attr("x", i)[0] for i in range(2)]
    buffer = model.replay_buffer
    _, latest = buffer.running.latest()
    np.testing.assert_allclose(buffer.positions(buffer.nexts, "next_observations", latest)[:, 0], positions, atol=1e-6)
    (episode,) = run_episodes(model, env, 1)
    assert len(episode.path) == episode.length + 1 and (abs(episode.path[-1, 0]) >= 1) == episode.success

    class Halved(VecEnvWrapper):
        def __init__(self, venv):
            super().__init__(venv, observation_space=spaces.Box(-2.0, 2.0, (1,)))

        def reset(self):
            return self.venv.reset()[:, 1:]

        def step_wait(self):
            observations, rewards, dones, infos = self.venv.step_wait()
            for env in np.flatnonzero(dones):
                infos[env]["terminal_observation"] = infos[env]["terminal_observation"][1:]
            return observations[:, 1:], rewards, dones, infos

    with pytest.raises(ValueError, match=r"mode_features=\[0\] of its observations of shape \(2,\).* shape \(1,\): say with"):
        small_model(Halved(DummyVecEnv([TwoEnds] * 2)))
    small_model(Halved(DummyVecEnv([TwoEnds] * 2)), mode_features=[0]).learn(40)


def test_normalised_rewards_are_warned_of():
    env = VecNormalize(DummyVecEnv([TwoEnds] * 2))
    with pytest.warns(UserWarning, match="norm_reward=False leaves them in reward units"):
        small_model(env).learn(20)


def test_parameters_that_do_not_fit_change_nothing(trained):
    other = small_model(DummyVecEnv([TwoEnds] * 4), policy_kwargs={"net_arch": [32]})
    other.policy.resize(4)
    model = deepcopy(trained)
    names, sizes = model.modes.names, [rows.size for rows in model.replay_buffer.mode_rows]
    with pytest.raises(RuntimeError, match="size mismatch"):
        model.set_parameters(other.get_parameters())
    assert model.modes.names == names and [rows.size for rows in model.replay_buffer.mode_rows] == sizes


def test_optimizer_arguments_that_exclude_the_fused_one():
    for arguments in ({"foreach": True}, {"fused": False}):
        model = small_model(TwoEnds(), policy_kwargs={"net_arch": [16], "optimizer_kwargs": arguments})
        assert not model.actor.optimizer.defaults["fused"]
    assert small_model(TwoEnds()).actor.optimizer.defaults["fused"]


# ---------------------------------------------------------------------- values that are not finite


def test_a_diverged_policy_does_not_step_the_environments():
    """``BreaksAt`` refuses an action of NaN, as a simulator would crash of it."""
    model = small_model(breaking("observation", 10**9), learning_rate=1e3)
    with pytest.raises(DivergedError, match="Training has diverged: the loss of the"):
        model.learn(1000)
    with th.no_grad():
        next(model.actor.diffusion.parameters()).fill_(np.nan)
    with pytest.raises(ValueError, match=r"The policy's action \(has training diverged\?\) of environment 0 is not finite"):
        model.learn(1000)


def breaking(part, when, broken_env=1, n_envs=3, wrap=lambda env: env, value=np.nan):
    def make(env):
        return lambda: BreaksAt(TwoEnds(), part, when if env == broken_env else 10**9, value)

    return wrap(DummyVecEnv([make(env) for env in range(n_envs)]))


def numbers(buffer):
    rows = np.sort(buffer.stored_rows.rows[: buffer.size()])
    arrays = (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards, buffer.dones)
    return [array[rows].copy() for array in arrays]


@pytest.mark.parametrize("learning_starts", [0, 1000])
@pytest.mark.parametrize(
    ("part", "when"), [("observation", 1), ("observation", 37), ("reward", 37), ("reset", 1), ("reset", 9)]
)
def test_nan_stops_the_run_and_nothing_stored_is_lost(part, when, learning_starts, tmp_path):
    model = small_model(breaking(part, when), learning_starts=learning_starts)
    last = []

    def watch(_, __):
        last[:] = numbers(model.replay_buffer) if model.replay_buffer.size() else []
        return True

    with pytest.raises(ValueError, match="environment 1 is not finite"):
        model.learn(1000, callback=watch)
    n_stored = model.replay_buffer.size()
    assert n_stored % 3 == 0 and (n_stored > 0) == (when > 1)
    if n_stored:
        # All of it is there: what was stored before the last step, and at most that step's
        stored = numbers(model.replay_buffer)
        assert len(stored[0]) - len(last[0]) in (0, 3)
        for array, before in zip(stored, last, strict=True):
            assert np.isfinite(array).all()
            np.testing.assert_array_equal(array[: len(before)], before)
    # Save what was learned; the environment, mended, goes on without a gap
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = DDiffPG.load(tmp_path / "model")
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer.size() == n_stored
    assert_same_state(state_of(loaded), state_of(model))
    model.learn(150, reset_num_timesteps=False)
    assert_no_gaps(model.replay_buffer)


@pytest.mark.parametrize("value", [np.nan, 5e18])
@pytest.mark.parametrize(
    ("part", "when", "normalized"),
    [
        ("observation", 20, {"norm_reward": False}),
        ("reward", 20, {"norm_obs": False}),
        ("reward", 20, {}),
        ("reset", 1, {"norm_reward": False}),
        ("reset", 5, {"norm_reward": False}),
    ],
)
@pytest.mark.filterwarnings("ignore:VecNormalize scales the rewards", "ignore:invalid value")
def test_what_is_refused_behind_a_normalising_wrapper(part, when, normalized, value):
    env = breaking(part, when, value=value, wrap=lambda env: VecNormalize(env, **normalized))
    model, noted = small_model(env), [deepcopy(normalization(env))]

    class Note(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            noted.append(deepcopy(normalization(env)))

    with pytest.raises(ValueError, match="environment 1 is (not finite|too large)"):
        model.learn(1000, callback=Note())
    # The wrapper had taken it in. Its statistics are those of the last rollout again, and training goes on
    np.testing.assert_equal(normalization(env), noted[-1])
    model.learn(60, reset_num_timesteps=False)


def test_the_broken_one_is_named_though_all_episodes_end_at_once():
    """VecNormalize has taken NaN into its statistics when it scales what the other environments' episodes ended with."""
    envs = [partial(BreaksAt, TwoEnds(limit=1), "reset", 4 if number == 1 else 10**9) for number in range(3)]
    model = small_model(VecNormalize(DummyVecEnv(envs), norm_reward=False))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's, of NaN
        with pytest.raises(ValueError, match="next observation of environment 1 is not finite"):
            model.learn(100)


def test_infinite_values_stop_it_too():
    class Explodes(TwoEnds):
        def _observation(self):
            return super()._observation() * (np.inf if self.steps > 2 else 1.0)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's: inf times 0
        with pytest.raises(ValueError, match="next observation of environment 0 is not finite"):
            small_model(Explodes()).learn(100)


def test_interrupted_by_hand():
    """Ctrl-C anywhere in a step: the next run begins new episodes, so that none has a gap."""

    class Interrupted(TwoEnds):
        n_steps = 0

        def step(self, action):
            type(self).n_steps += 1
            if self.n_steps == 45:
                super().step(action)
                raise KeyboardInterrupt
            return super().step(action)

    model = small_model(DummyVecEnv([Interrupted] * 2))
    with pytest.raises(KeyboardInterrupt):
        model.learn(500)
    model.learn(100, reset_num_timesteps=False)
    assert_no_gaps(model.replay_buffer)
