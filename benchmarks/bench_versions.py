"""
This checkout beside others, in turns: processor time of an update (quick networks, ant's size), of a vector step without
updates, and of one of the whole loop (point maze with modes, one update; ant without modes yet, four).

``python benchmarks/bench_versions.py OTHER_CHECKOUT ...`` prints the ratio of the medians of each to the first other one.
``--settings '{n_diffusion_steps: null}'`` are of this checkout alone.
"""

import argparse
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path
from statistics import median
from typing import Any

import yaml

MAZE = ["#######", "#g.r.g#", "#######"]
# Flat settings of version 0.1, which every version takes
QUICK = dict(learning_starts=800, batch_size=256, gamma=0.97, reward_scale=5, policy_kwargs={"net_arch": [128, 128]})
ANT = dict(
    learning_starts=800,
    batch_size=512,
    gamma=0.97,
    reward_scale=10,
    n_atoms=1,
    v_max=10,
    action_optimizer="normalized",
    action_lr=0.2,
    n_action_gradient_steps=3,
    exploration_n_steps=3,
    policy_kwargs={"net_arch": [256, 256]},
)
ANT_LOOP = {**ANT, "learning_starts": 2560, "gradient_steps": 4}
#: Settings, repeats, and the environments: an id, how many, further arguments
POINTS: tuple[str, int, dict[str, Any]] = "PointMazeV1-v0", 16, {"maze_map": MAZE}
ANTS: tuple[str, int, dict[str, Any]] = "AntMazeV1-v0", 256, {"integrator": "euler", "ends_on_fall": True}
MEASURES = {
    "update, quick": (QUICK, 40, POINTS),
    "update, ant": (ANT, 20, POINTS),
    "vector step": (QUICK, 200, POINTS),
    "loop, point maze": (QUICK, 40, POINTS),
    "loop, ant": (ANT_LOOP, 5, ANTS),
}


def serve(changes: dict[str, Any]) -> None:
    """
    Answer each line of the input, the name of a measure, with seconds of processor time for one update or step.

    :param changes: Settings beside those of the measures
    """
    import torch as th
    from stable_baselines3.common.logger import Logger

    from sb3_ddiffpg import DDiffPG
    from sb3_ddiffpg.envs import make_vec_env

    th.set_num_threads(1)
    models = {}
    for name, (settings, _, (env_id, n_envs, env_kwargs)) in MEASURES.items():
        env = make_vec_env(env_id, n_envs=n_envs, seed=0, **env_kwargs)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            models[name] = DDiffPG("MlpPolicy", env, seed=0, device="cpu", **settings, **changes)
            models[name].learn(6_000)
        models[name].set_logger(Logger(None, []))
        models[name].learning_starts = 0
        if name == "vector step":
            # Without updates and re-clusterings, whose cost is that of the modes that a version happens to have found
            models[name].gradient_steps, models[name].recluster_freq = 0, 10**9
    th.set_flush_denormal(True)
    print("ready", flush=True)
    for line in sys.stdin:
        name = line.strip()
        model, (_, repeats, (_, n_envs, _)) = models[name], MEASURES[name]
        started = time.process_time()
        if name.startswith("update"):
            model.train(repeats, model.batch_size)
        else:
            model.learn(n_envs * repeats, reset_num_timesteps=False)
        print((time.process_time() - started) / repeats, flush=True)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkouts", nargs="*", type=Path)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--settings", type=yaml.safe_load, default={})
    parser.add_argument("--serve", action="store_true")
    given = parser.parse_args()
    if given.serve:
        return serve(given.settings)
    workers = []
    for checkout, changes in [*((each, {}) for each in given.checkouts), (Path(__file__).parents[1], given.settings)]:
        environment = {**os.environ, "PYTHONPATH": str(checkout.resolve()), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, __file__, "--serve", "--settings", yaml.safe_dump(changes)]
        worker = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        while worker.stdout.readline().strip() != "ready":
            pass
        workers.append(worker)
    seconds: dict[str, list[list[float]]] = {name: [[] for _ in workers] for name in MEASURES}
    for _ in range(given.rounds):
        for name in MEASURES:
            for worker, found in zip(workers, seconds[name], strict=True):
                worker.stdin.write(f"{name}\n")
                worker.stdin.flush()
                found.append(float(worker.stdout.readline()))
    for name, found in seconds.items():
        medians = [median(each) for each in found]
        ratios = ", ".join(f"{each * 1e3:.3f} ms ({each / medians[0]:.3f})" for each in medians)
        print(f"{name}: {ratios}")
    for worker in workers:
        worker.stdin.close()


if __name__ == "__main__":
    main()
