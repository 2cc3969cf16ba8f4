"""
One update of DDiffPG: its parts, beside SB3's TD3 of the same batch and hidden sizes (small networks), and beside a plain
implementation of the same arithmetic (the paper's networks). Medians, all in one run: on a processor of the process's CPU time
on one thread, on a GPU of the wall clock until its work is done.

Only ratios carry over to another machine.
Usage: ``python benchmarks/bench_update.py [--seconds 4] [--batches 256 1024 4096] [--device cuda]``
"""

import argparse
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from plain_update import PlainUpdate
from stable_baselines3 import TD3
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv
from timing import clock, median_ms
from torch import nn

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.buffers.trajectory import NO_MODE
from sb3_ddiffpg.common.presets import preset

N_MODES = 2
PARTS = {
    "sampling": "sample_modes",
    "novelty": "_rewards",
    "critics, denoising in it": "_update_critics",
    "ascent": "_improve_target_actions",
    "policy": "_update_policy",
    "targets": "_update_targets",
}


class Noise(gym.Env[np.ndarray, np.ndarray]):
    """An environment of random observations whose episodes last 100 steps."""

    def __init__(self, observation_dim: int, action_dim: int) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (observation_dim,), dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (action_dim,), dtype=np.float32)
        self.mode_features = np.array([0, 1])
        self.steps, self.rng = 0, np.random.default_rng(0)

    def _observe(self) -> np.ndarray:
        return self.rng.normal(size=self.observation_space.shape).astype(np.float32)

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode."""
        self.steps = 0
        return self._observe(), {}

    def step(self, _: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Every other episode reaches a goal."""
        self.steps += 1
        done = self.steps == 100
        return self._observe(), float(done), done, False, {"is_success": done and self.rng.random() < 0.5}

    def close(self) -> None:
        """Nothing."""


def filled(observation_dim: int, action_dim: int, **settings: Any) -> DDiffPG:
    """
    :param observation_dim: Size of an observation
    :param action_dim: Size of an action
    :param settings: Of the model
    :return: A model with two modes and 20 000 random transitions
    """
    env = DummyVecEnv([lambda: Noise(observation_dim, action_dim)] * 20)
    model = DDiffPG("DiffusionPolicy", env, **{**settings, "buffer_size": 50_000, "learning_starts": 10**9})
    model.set_logger(configure(None, []))
    model.learn(20_000, callback=None, log_interval=10**9)
    buffer = model.replay_buffer
    model.mode_manager.expect_unknown(N_MODES, model.num_timesteps, buffer, model.scheduler)
    model.policy.inherit([None] * N_MODES, [False] * N_MODES)
    successes, failures = buffer.trajectories(True), buffer.trajectories(False)
    labels = [np.arange(len(part)) % N_MODES for part in (successes, failures)]
    buffer.assign_modes(successes, labels[0], failures, labels[1], [None] * N_MODES)
    assert all(t.mode != NO_MODE for t in successes[-20:])
    return model


def parts_ms(model: DDiffPG, batch_size: int, n_updates: int) -> dict[str, float]:
    """
    :param model: A filled model
    :param batch_size: Transitions of an update
    :param n_updates: How many
    :return: Median milliseconds by part
    """
    times: dict[str, list[float]] = defaultdict(list)

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            started = clock(model.device.type)
            result = function(*args, **kwargs)
            times[name].append(clock(model.device.type) - started)
            return result

        return call

    for name, method in PARTS.items():
        owner: Any = model.replay_buffer if method == "sample_modes" else model
        setattr(owner, method, timed(name, getattr(owner, method)))
    model.train(n_updates, batch_size)
    for method in PARTS.values():
        owner = model.replay_buffer if method == "sample_modes" else model
        delattr(owner, method)
    return {name: 1e3 * float(np.median(values)) for name, values in times.items()}


def print_parts(model: DDiffPG, batch_size: int) -> None:
    """
    :param model: A filled model
    :param batch_size: Transitions of an update
    """
    for name, value in parts_ms(model, batch_size, 100).items():
        print(f"  {name:<48} {value:9.2f}")


def small(seconds: float, device: str) -> None:
    """
    :param seconds: Spent on it
    :param device: Of the networks
    """
    model = filled(4, 2, gamma=0.97, exploration={"n_steps": 3}, device=device)
    env: Any = DummyVecEnv([lambda: Noise(4, 2)] * 20)
    hidden = dict(net_arch=[128, 128])
    td3 = TD3("MlpPolicy", env, batch_size=256, learning_starts=10**9, buffer_size=50_000, policy_kwargs=hidden, device=device)
    td3.set_logger(configure(None, []))
    td3.learn(20_000, log_interval=10**9)
    flow = filled(4, 2, gamma=0.97, exploration={"n_steps": 3}, device=device, n_diffusion_steps=None)
    # TD3 and a flow train the policy at every other update
    calls: dict[str, Any] = {"DDiffPG": model, "DDiffPG, a flow of two steps": flow, "SB3 TD3": td3}
    pairs = {name: lambda each=each: [each.train(1, 256) for _ in range(2)] for name, each in calls.items()}
    found = {name: value / 2 for name, value in median_ms(pairs, seconds, device).items()}
    print("\nsmall networks (128-128), batch 256, 2 modes                ms")
    print_parts(model, 256)
    for name, value in found.items():
        print(f"  {name + ', a whole update':<48} {value:9.2f}   {value / found['SB3 TD3']:.2f}x")


def check_equal(model: DDiffPG, plain: PlainUpdate) -> None:
    """
    :param model: A model
    :param plain: Made from it
    :raises AssertionError: If the two do not compute the same actions and gradients
    """
    policy = model.policy
    device = model.device
    features, actions = th.randn(N_MODES + 1, 64, 29, device=device), th.rand(N_MODES + 1, 64, 8, device=device) * 2 - 1
    noise = th.randn(model.n_diffusion_steps, 64, 8, device=device)
    condition = th.cat((features[1], policy.mode_embeddings[1].expand(64, -1)), dim=1)
    with th.no_grad():
        th.testing.assert_close(
            policy.actor.diffusion.sample(condition, noise=noise), plain.denoise(condition, noise), rtol=1e-4, atol=1e-5
        )
    ours = policy.critics.action_gradient(features)(actions)
    theirs = th.stack([plain.action_gradient(group, features[group], actions[group]) for group in range(N_MODES + 1)])
    th.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5)


def paper(batch_size: int, seconds: float, activation: str, device: str) -> None:
    """
    :param batch_size: Transitions of an update
    :param seconds: Spent on it
    :param activation: Of the policy, "mish" as in the authors' code, or "silu"
    :param device: Of the networks
    """
    drop = {"policy", "policy_kwargs", "replay_buffer_kwargs", "learning_starts", "buffer_size"}
    settings = {name: value for name, value in preset("paper").items() if name not in drop}
    settings |= {"device": device, "replay_buffer_kwargs": {"storage_device": "auto"}}

    def kwargs(activation_fn: type[nn.Module]) -> dict[str, Any]:
        sizes = dict(pi=[1024, 512, 256], qf=[512, 256, 128])
        return dict(net_arch=sizes, activation_fn=activation_fn, critic_activation_fn=nn.ELU, time_embedding_dim=256)

    reference = filled(29, 8, **settings, policy_kwargs=kwargs(nn.Mish))
    plain = PlainUpdate(reference)
    check_equal(reference, plain)
    model = filled(29, 8, **settings, policy_kwargs=kwargs(nn.Mish if activation == "mish" else nn.SiLU))
    calls = {"ours": lambda: model.train(1, batch_size), "plain": lambda: plain(batch_size)}
    if device != "cpu":
        by_kernels = filled(29, 8, **settings, policy_kwargs=kwargs(nn.Mish if activation == "mish" else nn.SiLU))
        for graph in by_kernels.graphs.values():
            graph.enabled = False
        calls["without graphs"] = lambda: by_kernels.train(1, batch_size)
    found = median_ms(calls, seconds, device)
    label = f"batch {batch_size}, {activation}"
    print(
        f"  {label:<24}", *(f"{name} {value:8.1f}" for name, value in found.items()), f"{found['plain'] / found['ours']:.2f}x"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=4.0, help="time spent on each entry")
    parser.add_argument("--batches", type=int, nargs="*", default=[256, 1024, 4096], help="of the paper's networks")
    parser.add_argument("--device", default="cpu", help="of the networks, such as cuda")
    given = parser.parse_args()
    th.set_num_threads(1)
    th.set_flush_denormal(True)
    small(given.seconds, given.device)
    print("\nthe paper's networks, 2 modes, K = 20, ms")
    for batch_size in given.batches:
        for activation in ("mish", "silu"):
            paper(batch_size, given.seconds, activation, given.device)


if __name__ == "__main__":
    main()
