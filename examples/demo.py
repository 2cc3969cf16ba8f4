"""
Train DDiffPG on a point maze, command each mode that it found, and draw the paths. The settings are those of
``zoo_hyperparams/ddiffpg.yml``.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch as th
import yaml

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation import clustering_agreement, evaluate_modes
from sb3_ddiffpg.visualization.plots import plot_routes

PRESETS = Path(__file__).parent.parent / "zoo_hyperparams" / "ddiffpg.yml"
OF_TRAINING = ("n_envs", "n_timesteps")  # the rest is the model's


def train(env_id: str, seed: int, overrides: dict[str, Any]) -> DDiffPG:
    """
    :param env_id: An environment with a preset
    :param seed: Seed of the run
    :param overrides: What is to be different from the preset
    :return: The trained model
    """
    n_envs, n_timesteps = (int((yaml.safe_load(PRESETS.read_text())[env_id] | overrides)[name]) for name in OF_TRAINING)
    changes = {name: value for name, value in overrides.items() if name not in OF_TRAINING}
    env = make_vec_env(env_id, n_envs, seed=seed)
    model = DDiffPG.from_preset(f"ddiffpg:{env_id}", env, seed=seed, verbose=1, **changes)
    model.learn(n_timesteps, log_interval=10**9, progress_bar=True)
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="PointMazeV1-v0")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=100, help="test episodes for each mode")
    parser.add_argument("--output", type=Path, default=Path("logs/demo"))
    parser.add_argument("--override", type=yaml.safe_load, default={}, help="settings as YAML, such as '{modes.max_modes: 1}'")
    options = parser.parse_args()
    th.set_num_threads(1)  # small networks: a second thread costs more than it brings

    started = time.perf_counter()
    model = train(options.env, options.seed, options.override)
    seconds = time.perf_counter() - started
    print(f"\ntrained for {seconds:.0f} s, {model.num_timesteps} steps\n\n{model.modes}\n")
    options.output.mkdir(parents=True, exist_ok=True)
    model.save(options.output / "model.zip")

    result = evaluate_modes(model, options.env, options.episodes, seed=options.seed + 1_000)
    agreement, kept = clustering_agreement(model), model.mode_history.share_kept()
    print(
        f"{result}\n\nclusters against labels: adjusted Rand index {agreement:.3f}; names kept in {kept:.1%} of re-clusterings"
    )

    settings = {"env": options.env, "seed": options.seed, "override": options.override, "steps": model.num_timesteps}
    measured = {"training_seconds": round(seconds, 1), "adjusted_rand_index": agreement, "share_kept": kept}
    report = {**settings, **measured, "evaluation": result.to_dict()}
    (options.output / "result.json").write_text(json.dumps(report, indent=2) + "\n")
    commanded = {name: runs for name, runs in result.episodes.items() if name != "(none)"}
    maze = make_vec_env(options.env).get_attr("maze", indices=0)[0]
    plot_routes(commanded, maze=maze).savefig(options.output / "modes.png", dpi=120)
    print(f"\nwrote model.zip, modes.png and result.json to {options.output}")


if __name__ == "__main__":
    main()
