"""
Train DDiffPG on a point maze, command each mode that it found, and draw the routes. The settings are those of
``zoo_hyperparams/ddiffpg.yml``.
"""

import argparse
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import torch as th
import yaml

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.episodes import EpisodeResult, run_episodes
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


def summarize(episodes: list[EpisodeResult]) -> dict[str, Any]:
    """
    :param episodes: What came of one command
    :return: Number of episodes and successes, mean length of the successes, and how often each route was taken
    """
    successes = [episode for episode in episodes if episode.success]
    return {
        "episodes": len(episodes),
        "successes": len(successes),
        "length": sum(episode.length for episode in successes) / len(successes) if successes else None,
        "routes": dict(Counter(str(episode.label) for episode in successes).most_common()),
    }


def format_line(name: str, summary: dict[str, Any]) -> str:
    """
    :param name: What was commanded
    :param summary: From ``summarize``
    :return: A line of the table
    """
    length = "       -" if summary["length"] is None else f"{summary['length']:8.1f}"
    routes = ", ".join(f"{label} x{count}" for label, count in summary["routes"].items())
    return f"{name:<12} {summary['successes']:4d}/{summary['episodes']:<4d} {length}   {routes}"


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
    seconds = time.perf_counter() - started
    print(f"\ntrained for {seconds:.0f} s, {model.num_timesteps} steps\n\n{model.modes}\n")
    options.output.mkdir(parents=True, exist_ok=True)
    model.save(options.output / "model.zip")

    # One fixed start: routes that differ only because their starts differ would be no modes
    test_env = make_vec_env(options.env, options.episodes, seed=options.seed + 1_000, start_noise=0.0)
    episodes = {name: run_episodes(model, test_env, options.episodes, mode=name) for name in model.modes.names}
    summaries = {name: summarize(runs) for name, runs in episodes.items()}
    summaries["(none)"] = summarize(run_episodes(model, test_env, options.episodes))
    print(f"{'commanded':<12} {'success':>9} {'length':>8}   routes taken (goal:word, see docs/point_mazes.md)")
    for name, summary in summaries.items():
        print(format_line(name, summary))

    settings = {"env": options.env, "seed": options.seed, "override": options.override, "steps": model.num_timesteps}
    result = {**settings, "training_seconds": round(seconds, 1), "commanded": summaries}
    (options.output / "result.json").write_text(json.dumps(result, indent=2) + "\n")
    figure = plot_routes(episodes, maze=test_env.get_attr("maze", indices=0)[0])
    figure.savefig(options.output / "modes.png", dpi=120)
    print(f"\nwrote model.zip, modes.png and result.json to {options.output}")


if __name__ == "__main__":
    main()
