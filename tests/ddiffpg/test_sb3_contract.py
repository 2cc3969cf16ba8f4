"""What SB3's own tests ask of an off-policy algorithm such as TD3, asked of DDiffPG."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import (
    SMALL,
    WIDE,
    AnySpaces,
    TwoEnds,
    assert_same_state,
    image_dict_space,
    small_model,
    some_observations,
    state_of,
)
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_ddiffpg import ClusteringCallback, DDiffPG, ModeReplayBuffer

# ---------------------------------------------------------------------- acting


@pytest.mark.parametrize(
    ("low", "high", "shape", "dtype"),
    [
        (-1.0, 1.0, (1,), np.float32),
        (-2.0, 2.0, (1,), np.float32),
        (-0.3, 5.0, (3,), np.float32),
        (2.0, 3.0, (2, 2), np.float32),
        (-1.5, 0.5, (2,), np.float64),
    ],
)
def test_action_spaces(low, high, shape, dtype):
    space = spaces.Box(low, high, shape, dtype=dtype)
    env = AnySpaces(action_space=space)  # asserts that it is given actions of its space
    model = small_model(env, learning_starts=10, **WIDE).learn(40)
    obs = env.observation_space.sample()
    for deterministic in (True, False):
        action, _ = model.predict(obs, deterministic=deterministic)
        assert action.shape == shape and action.dtype == dtype and space.contains(action)
        batch, _ = model.predict(np.stack([obs] * 5), deterministic=deterministic)
        assert batch.shape == (5, *shape) and batch.dtype == dtype
    # A far-out observation leads to the bounds, not beyond
    far, _ = model.predict(1e6 * np.random.default_rng(0).normal(size=(200, 2)).astype(np.float32))
    assert all(space.contains(action) for action in far)
    assert model.replay_buffer.actions[: model.replay_buffer.pos].min() < -0.5
    assert np.abs(model.replay_buffer.actions).max() <= 1


def test_predict_shapes_repeatability_and_independence(trained):
    observations = some_observations()
    batch, state = trained.predict(observations, deterministic=True)
    assert state is None
    np.testing.assert_array_equal(trained.predict(observations, deterministic=True)[0], batch)
    single = np.stack([trained.predict(observation, deterministic=True)[0] for observation in observations])
    np.testing.assert_allclose(single, batch, atol=1e-4)
    assert not np.array_equal(trained.predict(observations)[0], trained.predict(observations)[0])
    single, _ = trained.predict(observations, deterministic=True, n_samples=1)
    np.testing.assert_array_equal(trained.policy.actor.predict(observations, deterministic=True)[0], single)
    assert not trained.policy.training


def test_mixing_gym_and_vec_env_is_noticed(trained):
    for arguments in ({}, {"mode": 0}):
        with pytest.raises(ValueError, match="mixing Gym API"):
            trained.predict((some_observations(1)[0], {}), **arguments)


def test_discrete_actions_and_unbounded_actions_are_refused():
    for space in (spaces.Discrete(3), spaces.MultiBinary(2), spaces.MultiDiscrete([2, 2])):
        env = AnySpaces()
        env.action_space = space
        with pytest.raises(AssertionError, match="only supports .*Box.* as action spaces"):
            DDiffPG("MlpPolicy", env)
    with pytest.raises(AssertionError, match="finite lower and upper bound"):
        DDiffPG("MlpPolicy", AnySpaces(action_space=spaces.Box(-np.inf, np.inf, (2,))))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(5),
        spaces.MultiDiscrete([4, 3]),
        spaces.MultiBinary(8),
        spaces.MultiBinary((3, 2)),
        spaces.Box(-1.0, 1.0, (2, 3)),
        spaces.Box(-1.0, 1.0, (2,), dtype=np.float64),
        spaces.Box(0, 255, (8, 8, 1), dtype=np.uint8),
    ],
    ids=str,
)
def test_observation_spaces(space, tmp_path):
    space.seed(0)
    novelty = {"measure": "rnd", "kwargs": {"with_observation": True}}
    model = small_model(AnySpaces(space, limit=5), modes={"min_size": 1}, novelty=novelty, **WIDE)
    model.learn(100)
    assert len(model.modes) >= 1
    evaluate_policy(model, AnySpaces(space), n_eval_episodes=2, warn=False)
    model.save(tmp_path / "model")
    obs = model.env.reset()
    expected, _ = model.predict(obs, deterministic=True)
    np.testing.assert_array_equal(DDiffPG.load(tmp_path / "model").predict(obs, deterministic=True)[0], expected)


def test_images_through_a_convolution():
    env = FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False)
    policy_kwargs = {"net_arch": [16], "features_extractor_class": NatureCNN, "features_extractor_kwargs": {"features_dim": 8}}
    model = small_model(env, policy_kwargs=policy_kwargs, buffer_size=250, gradient_steps=1, train_freq=8).learn(80)
    assert model.get_env().observation_space.shape == (1, 40, 40)  # channels first
    action, _ = model.predict(env.observation_space.sample())
    assert env.action_space.contains(action)


@pytest.mark.parametrize("channel_last", [False, True])
def test_dict_observations(channel_last, tmp_path):
    env = AnySpaces(image_dict_space(channel_last))
    policy_kwargs = {"net_arch": [16], "features_extractor_kwargs": {"cnn_output_dim": 8}}
    model = small_model(env, "MultiInputPolicy", policy_kwargs=policy_kwargs, buffer_size=250, train_freq=4, **WIDE)
    model.learn(100)
    evaluate_policy(model, env, n_eval_episodes=2, warn=False)
    obs = model.get_env().reset()
    expected, _ = model.predict(obs, deterministic=True)
    model.save(tmp_path / "model")
    np.testing.assert_array_equal(DDiffPG.load(tmp_path / "model").predict(obs, deterministic=True)[0], expected)
    single, _ = model.predict({key: value[0] for key, value in obs.items()}, deterministic=True)
    np.testing.assert_allclose(single, expected[0], atol=1e-4)


def test_dict_observations_need_their_policy():
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        DDiffPG("MlpPolicy", AnySpaces(image_dict_space()))
    with pytest.raises(ValueError, match="Policy NoSuchPolicy unknown"):
        DDiffPG("NoSuchPolicy", TwoEnds())


def test_a_dict_of_one_vector_is_that_vector():
    """The same numbers whether an observation comes as a dict or flat."""
    env = AnySpaces(spaces.Dict({"vec": spaces.Box(-1.0, 1.0, (2,))}))
    from_dict = small_model(env, "MultiInputPolicy", **WIDE)

    def state_as_flat():
        """The one extractor has the names of the only one."""
        return {name.replace("extractors.vec.", ""): value for name, value in state_of(from_dict).items()}

    untrained = state_as_flat()
    from_dict.learn(80)
    from_vector = small_model(FlattenObservation(env), **WIDE)
    assert_same_state(untrained, state_of(from_vector))
    from_vector.learn(80)
    assert_same_state(state_as_flat(), state_of(from_vector))
    expected, _ = from_vector.predict(some_observations(), deterministic=True)
    np.testing.assert_array_equal(from_dict.predict({"vec": some_observations()}, deterministic=True)[0], expected)


def test_goal_environments_cluster_on_the_achieved_goal():
    box = spaces.Box(-1.0, 1.0, (3,))
    space = spaces.Dict({"observation": spaces.Box(-1.0, 1.0, (5,)), "achieved_goal": box, "desired_goal": box})
    model = small_model(AnySpaces(space), "MultiInputPolicy", **WIDE).learn(50)
    assert model.replay_buffer.features.selection == "achieved_goal" and model.replay_buffer.features.dim == 3


# ---------------------------------------------------------------------- callbacks


def test_callbacks(tmp_path):
    model = small_model(TwoEnds(), learning_starts=20)
    stop_on_best = StopTrainingOnRewardThreshold(reward_threshold=10.0)
    evaluation = EvalCallback(
        Monitor(TwoEnds()),
        callback_on_new_best=stop_on_best,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        eval_freq=30,
        n_eval_episodes=2,
        verbose=0,
    )
    checkpoint = CheckpointCallback(40, str(tmp_path), save_replay_buffer=True)
    on_event = CheckpointCallback(1, str(tmp_path), name_prefix="event")
    model.learn(60, callback=CallbackList([checkpoint, evaluation, EveryNTimesteps(30, on_event)]))
    files = {path.name for path in tmp_path.iterdir()}
    assert {"best_model.zip", "evaluations.npz", "rl_model_40_steps.zip", "event_30_steps.zip"} <= files
    assert "rl_model_replay_buffer_40_steps.pkl" in files
    DDiffPG.load(tmp_path / "best_model", env=TwoEnds()).learn(20)
    model.learn(20, callback=None)
    model.learn(20, callback=[checkpoint, evaluation])
    model.learn(20, callback=[])
    model.learn(20, callback=lambda _locals, _globals: True)
    assert model.num_timesteps == 20
    # None of it stays in the model
    assert not any(isinstance(value, BaseCallback) for value in vars(model).values())


def test_stopping(tmp_path):
    model = small_model(TwoEnds())
    model.learn(500, callback=StopTrainingOnMaxEpisodes(max_episodes=3))
    assert model.num_timesteps <= 3 * 8
    model.learn(500, callback=lambda _locals, _globals: _locals["self"].num_timesteps < 30)
    assert model.num_timesteps == 30


class Events(BaseCallback):
    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_training_start(self):
        self.seen.append("start")
        assert {"total_timesteps", "callback"} <= self.locals.keys()

    def _on_rollout_start(self):
        self.seen.append("rollout_start")

    def _on_step(self):
        self.seen.append("step")
        assert {"new_obs", "rewards", "dones", "infos", "actions"} <= self.locals.keys()
        return True

    def _on_rollout_end(self):
        self.seen.append("rollout_end")

    def _on_training_end(self):
        self.seen.append("end")


def test_every_callback_is_called_once_for_every_event():
    events, child = Events(), Events()
    small_model(TwoEnds(), train_freq=1).learn(6, callback=[events, CallbackList([child])])
    assert events.seen == child.seen == ["start", *["rollout_start", "step", "rollout_end"] * 6, "end"]


class Reports(ClusteringCallback):
    def __init__(self, recluster_freq=None):
        super().__init__(recluster_freq)
        self.at = []

    def on_recluster(self, events):
        self.at.append((self.num_timesteps, len(self.model.modes)))


@pytest.mark.parametrize("nested", [False, True])
def test_own_clustering_callback_replaces_the_built_in_one(nested):
    own, rollouts = Reports(15), Events()
    model = small_model(DummyVecEnv([TwoEnds] * 2), train_freq=1, recluster_freq=5)
    model.learn(100, callback=[CallbackList([own]) if nested else own, rollouts])
    assert [step for step, _ in own.at] == [30, 60, 90] and model.n_rollouts == 50
    # The count of rollouts is the model's: a second run keeps the rhythm
    model.learn(20, callback=own, reset_num_timesteps=False)
    assert [step for step, _ in own.at] == [30, 60, 90, 120]


def test_nothing_is_clustered_twice():
    """One environment, episodes of up to 8 steps: only where one has ended since the time before."""
    ends, own = [], Reports(3)

    class Watch(BaseCallback):
        def _on_step(self):
            if self.locals["dones"].any():
                ends.append(self.num_timesteps)
            return True

    model = small_model(TwoEnds(), train_freq=1, learning_starts=10_000)
    model.learn(200, callback=[own, Watch()])
    times = [0, *range(3, 201, 3)]
    expected = [now for before, now in pairwise(times) if any(before < end <= now for end in ends)]
    assert [step for step, _ in own.at] == expected and len(expected) < len(times) - 10
    # That it was is known after saving too
    state = model.mode_manager.state_dict()
    assert state["n_judged"] == model.replay_buffer.n_finished
    other = small_model(TwoEnds())
    other.mode_manager.load_state_dict(state)
    assert other.mode_manager.n_judged == state["n_judged"]
    # Asked for, it is done
    model.recluster()


def test_built_in_clustering_runs_first_and_says_what_happened(capsys):
    numbers = []

    class Watch(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            numbers.append(len(self.model.modes))

    model = small_model(DummyVecEnv([TwoEnds] * 4), train_freq=1, recluster_freq=20, modes={"min_size": 1}, verbose=1)
    model.learn(80, callback=Watch())
    assert numbers == [0] * 19 + [len(model.modes)] and len(model.modes) >= 1
    events = "; ".join(f"{mode.name} born" for mode in model.modes)
    assert f"[modes] step 80: {events} -> {len(model.modes)} mode(s)" in capsys.readouterr().out


def test_progress_bar():
    small_model(TwoEnds()).learn(20, progress_bar=True)


# ---------------------------------------------------------------------- learning


def rewards_of_a_run(seed, **changes):
    model = small_model(DummyVecEnv([TwoEnds] * 2), seed=seed, **changes)
    model.learn(120)
    rewards, lengths = evaluate_policy(model, model.get_env(), n_eval_episodes=3, return_episode_rewards=True, warn=False)
    return rewards, lengths, state_of(model), model.modes.names


@pytest.mark.parametrize("novelty", ["rnd", "counts"])
def test_the_same_seed_gives_the_same_run(novelty):
    first, second = (rewards_of_a_run(3, novelty=novelty) for _ in range(2))
    assert first[:2] == second[:2] and first[3] == second[3]
    assert_same_state(first[2], second[2])
    other = rewards_of_a_run(4, novelty=novelty)
    assert not th.equal(other[2]["/policy/mode_embeddings"][0], first[2]["/policy/mode_embeddings"][0])


@pytest.mark.parametrize(
    ("arguments", "updates"),
    [
        ({"train_freq": 4, "gradient_steps": 2}, 2 * 15),
        ({"train_freq": (5, "step"), "gradient_steps": -1}, 60),
        ({"train_freq": (2, "episode"), "gradient_steps": 1}, None),
        ({"gradient_steps": 0}, 0),
    ],
)
def test_train_freq_and_gradient_steps(arguments, updates):
    env = AnySpaces(limit=10)
    model = small_model(env, learning_starts=0, **arguments, **WIDE).learn(60)
    assert model._n_updates == (3 if updates is None else updates)
    assert model.num_timesteps == 60


def test_episodic_training_takes_one_environment():
    with pytest.raises(AssertionError, match="one env when doing episodic training"):
        small_model(DummyVecEnv([TwoEnds] * 2), train_freq=(1, "episode")).learn(10)
    with pytest.raises(ValueError, match="train_freq"):
        small_model(TwoEnds(), train_freq=(1, "minute"))


@pytest.mark.parametrize("n_envs", [2, 64])
def test_many_environments(n_envs):
    model = small_model(make_vec_env(TwoEnds, n_envs), gradient_steps=-1, train_freq=1, learning_starts=4 * n_envs - 1)
    model.learn(4 * n_envs)
    assert model._n_updates == n_envs  # as many updates as transitions
    trajectories = [t for success in (True, False) for t in model.replay_buffer.trajectories(success)]
    running = model.replay_buffer.running.lengths.sum()
    assert sum(t.length for t in trajectories) + running == model.replay_buffer.size() == 4 * n_envs


def test_processes():
    """Asking a worker for an attribute that its environment does not have would kill it."""
    env = SubprocVecEnv([AnySpaces, AnySpaces], start_method="fork")
    model = small_model(env, **WIDE).learn(60)
    assert model.replay_buffer.features.whole_observation
    env.close()


@pytest.mark.parametrize(
    "net_arch", [[4], [4, 4], {"pi": [8], "qf": [4, 4]}, {"pi": [4, 4, 4], "qf": [8]}, dict(qf=[4], pi=[4])]
)
def test_network_architectures(net_arch):
    model = small_model(TwoEnds(), policy_kwargs={"net_arch": net_arch}, learning_starts=10).learn(20)
    actor = net_arch if isinstance(net_arch, list) else net_arch["pi"]
    critic = net_arch if isinstance(net_arch, list) else net_arch["qf"]
    assert [weight.shape[3] for weight in model.critics.weights[:-1]] == critic
    widths = [layer.out_features for layer in model.actor.diffusion.denoiser.trunk if isinstance(layer, th.nn.Linear)]
    assert widths == [*actor[1:], 1] and model.actor.diffusion.denoiser.action_in.out_features == actor[0]


@pytest.mark.parametrize("net_arch", [[0], [4, -1], {"pi": [4, 0], "qf": [4]}, {"pi": [4], "qf": [0]}])
def test_layers_without_units_are_refused(net_arch):
    with pytest.raises(ValueError, match="net_arch.*hidden layers of at least one unit each"):
        small_model(TwoEnds(), policy_kwargs={"net_arch": net_arch})


@pytest.mark.parametrize("net_arch", [[], {"pi": [], "qf": [4]}, {"pi": [4], "qf": []}])
def test_networks_without_hidden_layers(net_arch, tmp_path):
    """Linear ones, as in SB3: by a product with one matrix."""
    model = small_model(DummyVecEnv([TwoEnds] * 4), policy_kwargs={"net_arch": net_arch}, batch_size=600).learn(250)
    critics, denoiser, actor_arch = model.critics, model.actor.diffusion.denoiser, model.actor.net_arch
    features, actions = th.randn(critics.n_groups, 200, 2), th.rand(critics.n_groups, 200, 1, requires_grad=True)
    if not actor_arch:
        assert len(denoiser.trunk) == 0
        parts = [layer.weight for layer in (denoiser.condition_in, denoiser.action_in)]
        condition, noisy, times = th.randn(5, parts[0].shape[1]), th.randn(5, 1), denoiser.time_table()
        by_hand = th.cat((condition, noisy), dim=1) @ th.cat(parts, dim=1).T + denoiser.condition_in.bias + times
        th.testing.assert_close(denoiser(noisy, denoiser.condition_in(condition), times), by_hand)
    if len(critics.weights) == 1:
        inputs = th.cat((features, actions), dim=2)
        by_hand = th.einsum("gni,gcia->gcna", inputs, critics.weights[0]) + critics.biases[0]
        th.testing.assert_close(critics(features, actions), by_hand)
    # The ascent's gradient by autograd
    (expected,) = th.autograd.grad(critics.values(critics(features, actions))[:, 0].sum(), actions)
    th.testing.assert_close(critics.action_gradient(features)(actions.detach()), expected, atol=1e-5, rtol=1e-4)
    model.export(tmp_path / "model.safetensors")
    loaded = DDiffPG.load(tmp_path / "model.safetensors", safe=True)
    expected, _ = model.predict(some_observations(), deterministic=True)
    np.testing.assert_array_equal(loaded.predict(some_observations(), deterministic=True)[0], expected)


@pytest.mark.parametrize("n_critics", [1, 3])
def test_the_number_of_critics_as_sb3_takes_it(n_critics, tmp_path):
    kwargs = {"net_arch": [4], "n_critics": n_critics}
    model = small_model(TwoEnds(), policy_kwargs=kwargs).learn(60)
    assert model.critics.n_critics == model.critic_settings.n_critics == n_critics
    model.save(tmp_path / "model.zip")
    model.export(tmp_path / "model.safetensors")
    loaded = (
        DDiffPG.load(tmp_path / "model.zip", policy_kwargs=kwargs),
        DDiffPG.load(tmp_path / "model.safetensors", safe=True),
    )
    assert all(each.critics.n_critics == n_critics for each in loaded)
    with pytest.raises(ValueError, match=r"policy_kwargs\['n_critics'\]=4 given beside critic.n_critics=5"):
        small_model(TwoEnds(), policy_kwargs={"n_critics": 4}, critic={"n_critics": 5})
    with pytest.raises(ValueError, match="n_critics must be an integer of at least 1"):
        small_model(TwoEnds(), policy_kwargs={"n_critics": 0})


@pytest.mark.parametrize("name", [None, "mine"])
def test_logs_have_the_algorithms_name(name, tmp_path):
    model = DDiffPG("MlpPolicy", TwoEnds(), tensorboard_log=str(tmp_path), **SMALL)
    model.learn(8, **({} if name is None else {"tb_log_name": name}))
    assert [path.name for path in tmp_path.iterdir()] == [f"{name or 'DDiffPG'}_1"]


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.0}},
        {"optimizer_class": th.optim.Adam, "optimizer_kwargs": {"amsgrad": True}},
        {"optimizer_class": th.optim.SGD, "optimizer_kwargs": {"momentum": 0.9}},
        {"optimizer_class": RMSpropTFLike, "optimizer_kwargs": {"eps": 1e-5}},
        {"activation_fn": th.nn.Tanh, "critic_activation_fn": th.nn.ELU},
    ],
    ids=str,
)
def test_optimisers_and_activations(policy_kwargs, tmp_path):
    env = DummyVecEnv([TwoEnds] * 4)
    model = small_model(env, policy_kwargs={"net_arch": [8], **policy_kwargs}).learn(250)
    assert len(model.modes) >= 1
    model.save(tmp_path / "model")
    model.export(tmp_path / "exported", optimizers=True)
    own = {"policy_kwargs": model.policy_kwargs}
    for loaded in (
        DDiffPG.load(tmp_path / "model", env=env),
        DDiffPG.load(tmp_path / "exported", env=env, safe=True, custom_objects=own),
    ):
        assert_same_state(state_of(loaded), state_of(model))
        loaded.learn(8)


@pytest.mark.parametrize(
    "make_noise",
    [
        lambda: NormalActionNoise(np.zeros(1), 0.1 * np.ones(1)),
        lambda: OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.1 * np.ones(1)),
    ],
)
@pytest.mark.parametrize("n_envs", [1, 3])
def test_action_noise(make_noise, n_envs, tmp_path):
    env = DummyVecEnv([TwoEnds] * n_envs)
    small_model(env, action_noise=make_noise(), learning_starts=0).learn(30).save(tmp_path / "model")
    DDiffPG.load(tmp_path / "model", env=env).learn(12)


class NormAndDropout(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, get_flattened_obs_dim(observation_space))
        self.batch_norm = th.nn.BatchNorm1d(self.features_dim)
        self.dropout = th.nn.Dropout(0.5)

    def forward(self, observations):
        return self.dropout(self.batch_norm(observations.flatten(1)))


def with_norm_and_dropout(**changes):
    return small_model(TwoEnds(), policy_kwargs={"net_arch": [16], "features_extractor_class": NormAndDropout}, **changes)


def norm_statistics(model):
    """Bias and running mean of the actor's, the critics' and the target's batch norm."""
    policy = model.policy
    extractors = (
        policy.actor.features_extractor,
        policy.critic_features_extractor,
        policy.critic_features_extractor_target,
    )
    return [(e.batch_norm.bias.detach().clone(), e.batch_norm.running_mean.clone()) for e in extractors]


def test_training_moves_batch_norm_and_the_target_follows():
    model = with_norm_and_dropout(learning_starts=0, tau=0.0)
    before = norm_statistics(model)
    model.learn(60)
    actor, critic, target = norm_statistics(model)
    for was, now in zip(before[:2], (actor, critic), strict=True):
        assert not th.isclose(was[0], now[0]).any() and not th.isclose(was[1], now[1]).any()
    # tau=0: the target's parameters stay; running statistics are always copied
    assert th.equal(before[2][0], target[0]) and th.equal(critic[1], target[1])


def test_acting_does_not_move_batch_norm():
    model = with_norm_and_dropout(learning_starts=5, gradient_steps=0)
    before = norm_statistics(model)
    model.learn(40)
    observations = some_observations()
    first, _ = model.predict(observations, deterministic=True)
    for _ in range(3):
        np.testing.assert_array_equal(model.predict(observations, deterministic=True)[0], first)
    for was, now in zip(before, norm_statistics(model), strict=True):
        assert th.equal(was[0], now[0]) and th.equal(was[1], now[1])


def test_train_and_eval_mode_reach_every_part():
    model = with_norm_and_dropout()
    policy = model.policy
    for training in (True, False):
        policy.set_training_mode(training)
        assert policy.actor.features_extractor.dropout.training == training
        assert policy.critic_features_extractor.dropout.training == training
        # Targets are never trained
        assert not policy.critic_features_extractor_target.dropout.training and not policy.critics_target.training


def test_vec_normalize():
    env = VecNormalize(DummyVecEnv([TwoEnds] * 2))
    evaluation = VecNormalize(DummyVecEnv([TwoEnds] * 2), training=False, norm_reward=False)
    model = small_model(env, **WIDE)
    assert model.get_vec_normalize_env() is env
    model.set_env(evaluation)
    assert model.get_vec_normalize_env() is evaluation
    model.learn(10)
    model.set_env(env)
    model.learn(160, callback=EvalCallback(evaluation, eval_freq=20, n_eval_episodes=1, verbose=0, warn=False))
    np.testing.assert_array_equal(env.obs_rms.mean, evaluation.obs_rms.mean)
    assert len(model.modes) > 0
    # Stored raw
    assert model.replay_buffer.rewards.max() == 1.0


def test_vec_normalize_of_dict_observations():
    env = VecNormalize(DummyVecEnv([lambda: AnySpaces(image_dict_space())]), norm_obs_keys=["vec"])
    policy_kwargs = {"net_arch": [16], "features_extractor_kwargs": {"cnn_output_dim": 8}}
    model = small_model(env, "MultiInputPolicy", policy_kwargs=policy_kwargs, buffer_size=250, train_freq=8, **WIDE)
    model.learn(100)
    evaluate_policy(model, env, n_eval_episodes=2, warn=False)


class Memory(KVWriter):
    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        self.rows.append((step, dict(key_values)))

    def close(self):
        pass


def test_logged_keys():
    memory = Memory()
    model = small_model(make_vec_env(TwoEnds, 4), novelty="rnd")
    model.set_logger(Logger(None, [memory]))
    model.learn(400, log_interval=10)
    keys = set().union(*(row.keys() for _, row in memory.rows))
    assert keys >= {
        *("rollout/ep_len_mean", "rollout/ep_rew_mean", "rollout/success_rate"),
        *("time/episodes", "time/fps", "time/time_elapsed", "time/total_timesteps", "time/recluster"),
        *("train/learning_rate", "train/qf_learning_rate", "train/n_updates", "train/actor_loss", "train/critic_loss"),
        *("train/intrinsic_reward", "train/novelty_loss", "train/target_action_shift"),
        *("modes/n_modes", "modes/mode_0/n_trajectories", "modes/mode_1/success_rate"),
    }
    steps, rows = zip(*memory.rows, strict=True)
    assert list(steps) == sorted(steps) and rows[-1]["train/n_updates"] <= 90
    assert all(np.isfinite(value) for name, value in rows[-1].items() if name.startswith("train/"))


def test_learning_rates_have_their_own_schedules():
    memory = Memory()
    model = small_model(TwoEnds(), learning_rate=lambda remaining: 1e-3 * remaining, qf_learning_rate=5e-4, learning_starts=0)
    model.set_logger(Logger(None, [memory]))
    model.learn(32, log_interval=1)
    assert model.actor.optimizer.param_groups[0]["lr"] == pytest.approx(0.0, abs=1e-9)
    assert model.critics.optimizer.param_groups[0]["lr"] == 5e-4
    assert memory.rows[-1][1]["train/qf_learning_rate"] == 5e-4


@pytest.mark.parametrize(
    ("arguments", "of_exploration", "of_modes"),
    [
        ({}, 1, 5),
        ({"n_steps": 1}, 1, 1),
        ({"n_steps": 3}, 3, 3),
        ({"n_steps": 3, "modes": {"n_steps": 4}}, 3, 4),
        ({"n_steps": 3, "exploration": {"n_steps": 2}}, 2, 3),
        ({"modes": {"n_steps": 4}}, 1, 4),
    ],
)
def test_length_of_returns(arguments, of_exploration, of_modes, tmp_path):
    """One number for both returns, where a group does not say its own: told by the discounts of what is drawn."""
    model = small_model(DummyVecEnv([TwoEnds] * 4), gamma=0.5, **arguments).learn(300)
    model.save(tmp_path / "model.zip")
    model.export(tmp_path / "model.safetensors")
    loaded = [DDiffPG.load(tmp_path / "model.zip"), DDiffPG.load(tmp_path / "model.safetensors", safe=True)]
    drawn = []

    class Noting(ModeReplayBuffer):
        def sample_modes(self, *args, **kwargs):
            drawn.append(super().sample_modes(*args, **kwargs))
            return drawn[-1]

    model.replay_buffer.__class__ = Noting
    for each in (model, *loaded):
        each.replay_buffer = model.replay_buffer
        each.set_logger(Logger(None, []))
        drawn.clear()
        each.train(5, 60)
        discounts = th.stack([batch.discounts for batch in drawn]).numpy()  # [updates, G, n]: 0 where an episode ends
        for group, length in ((discounts[:, :1], of_exploration), (discounts[:, 1:], of_modes)):
            assert group.size and group[group > 0].min() == 0.5**length


def test_length_of_returns_is_changed_when_a_model_is_loaded(tmp_path):
    small_model(TwoEnds(), exploration={"n_steps": 2}).save(tmp_path / "model.zip")
    loaded = DDiffPG.load(tmp_path / "model.zip", n_steps=4)
    assert loaded.n_steps == 4 and loaded.exploration_settings.n_steps == 2 and loaded.mode_settings.n_steps is None


def test_what_is_not_supported_says_so():
    for arguments, message in (
        ({"optimize_memory_usage": True}, "optimize_memory_usage=True is not supported"),
        ({"replay_buffer_class": HerReplayBuffer}, "replay_buffer_class must be ModeReplayBuffer.*got HerReplayBuffer"),
        ({"replay_buffer_class": ReplayBuffer}, "replay_buffer_class must be ModeReplayBuffer"),
    ):
        with pytest.raises(ValueError, match=message):
            small_model(TwoEnds(), **arguments)


def test_environment_ids_and_automatic_wrapping():
    model = DDiffPG("DiffusionPolicy", "Pendulum-v1", **SMALL, critic={"v_min": -20.0, "v_max": 0.0}, reward_scale=0.01)
    assert isinstance(model.get_env().envs[0], Monitor)
    model.learn(60)
    assert gym.make("Pendulum-v1").action_space.contains(model.predict(np.zeros(3, dtype=np.float32))[0])
