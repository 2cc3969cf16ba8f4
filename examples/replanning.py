"""
Passages are blocked that were open in training: a DDiffPG trained on V3 (by ``examples/demo.py --env PointMazeV3-v0``)
with and without replanning, and SB3's TD3 trained on V3 for as many steps, on ``PointMazeRandom-v0``.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation import Replanner, evaluate_modes, run_episodes


def train_td3(seed: int) -> TD3:
    """
    :param seed: Of the run
    :return: A TD3 with the networks, batch, rates, discount and number of updates of DDiffPG's preset
    """
    noise = NormalActionNoise(np.zeros(2), 0.3 * np.ones(2))
    settings: dict[str, Any] = {"learning_rate": 1e-3, "batch_size": 256, "tau": 0.05, "gamma": 0.97, "learning_starts": 6400}
    schedule: dict[str, Any] = {"train_freq": 1, "gradient_steps": 1, "policy_kwargs": {"net_arch": [128, 128]}}
    model = TD3(
        "MlpPolicy", make_vec_env("PointMazeV3-v0", 32, seed=seed), action_noise=noise, seed=seed, **settings, **schedule
    )
    return model.learn(350_000, log_interval=10**9)


def successes(model: Any, n_episodes: int, seed: int) -> str:
    """
    :param model: Anything that predicts
    :param n_episodes: How many
    :param seed: Of the environments, which draws the walls
    :return: A line for the table
    """
    env = make_vec_env("PointMazeRandom-v0", min(n_episodes, 100), seed=seed, start_noise=0.0)
    episodes = run_episodes(model, env, n_episodes)
    lengths = [episode.length for episode in episodes if episode.success]
    return f"{len(lengths):4d}/{n_episodes}" + (f"   mean length {np.mean(lengths):.1f}" if lengths else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, default=Path("logs/demo/model.zip"))
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=11, help="of the walls")
    parser.add_argument("--td3", type=int, nargs="*", default=[], help="seeds of TD3 runs to train and compare with")
    options = parser.parse_args()
    th.set_num_threads(1)
    model = DDiffPG.load(options.model)
    rows = {"replanning": Replanner(model), "replanning by return": Replanner(model, order="return"), "uncommanded": model}
    for name, agent in rows.items():
        print(f"{name:<24} {successes(agent, options.episodes, options.seed)}", flush=True)
    for seed in options.td3:
        td3 = train_td3(seed)
        print(f"{f'TD3, seed {seed}':<24} {successes(td3, options.episodes, options.seed)}")
        print(evaluate_modes(td3, "PointMazeV3-v0", 100, seed=7))


if __name__ == "__main__":
    main()
