"""
Train DDiffPG on a point maze, command each mode that it found, and draw the routes. The settings are those of
``zoo_hyperparams/ddiffpg.yml``.
"""

import argparse
import time
from collections import Counter
from pathlib import Path
from typing import Any

import torch as th
import yaml

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation import EpisodeResult, run_episodes
from sb3_ddiffpg.plots import plot_routes

PRESETS = Path(__file__).parent.parent / "zoo_hyperparams" / "ddiffpg.yml"


def train(env_id: str, seed: int, overrides: dict[str, Any]) -> DDiffPG:
    """
    :param env_id: An environment with a preset
    :param seed: Seed of the run
    :param overrides: Settings that replace the preset's
    :return: The trained model
    """
    preset = yaml.safe_load(PRESETS.read_text())[env_id] | overrides
    env = make_vec_env(env_id, preset.pop("n_envs"), seed=seed)
    n_timesteps = int(preset.pop("n_timesteps"))
    model = DDiffPG(preset.pop("policy"), env, seed=seed, verbose=1, **preset)
    model.learn(n_timesteps, log_interval=10**9, progress_bar=True)
    return model


def summary_line(name: str, episodes: list[EpisodeResult]) -> str:
    """
    :param name: What was commanded
    :param episodes: What came of it
    :return: A line of the table
    """
    successes = [episode for episode in episodes if episode.success]
    length = sum(episode.length for episode in successes) / max(len(successes), 1)
    routes = ", ".join(f"{label} x{count}" for label, count in Counter(e.label for e in successes).most_common())
    return f"{name:<12} {len(successes):4d}/{len(episodes):<4d} {length:8.1f}   {routes}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="PointMazeV1-v0")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=100, help="test episodes for each mode")
    parser.add_argument("--output", type=Path, default=Path("logs/demo"))
    parser.add_argument("--override", type=yaml.safe_load, default={}, help="settings as YAML, such as '{max_modes: 1}'")
    options = parser.parse_args()
    th.set_num_threads(1)  # small networks: a second thread costs more than it brings

    started = time.perf_counter()
    model = train(options.env, options.seed, options.override)
    print(f"\ntrained for {time.perf_counter() - started:.0f} s, {model.num_timesteps} steps\n\n{model.modes}\n")
    options.output.mkdir(parents=True, exist_ok=True)
    model.save(options.output / "model.zip")

    # One fixed start: routes that differ only because their starts differ would be no modes
    test_env = make_vec_env(options.env, options.episodes, seed=options.seed + 1_000, start_noise=0.0)
    episodes = {name: run_episodes(model, test_env, options.episodes, mode=name) for name in model.modes.names}
    print(f"{'commanded':<12} {'success':>9} {'length':>8}   routes taken (goal:word, see docs/point_mazes.md)")
    for name, runs in episodes.items():
        print(summary_line(name, runs))
    print(summary_line("(none)", run_episodes(model, test_env, options.episodes)))
    figure = plot_routes(episodes, maze=test_env.get_attr("maze", indices=0)[0])
    figure.savefig(options.output / "modes.png", dpi=120)
    print(f"\nwrote {options.output / 'model.zip'} and {options.output / 'modes.png'}")


if __name__ == "__main__":
    main()
