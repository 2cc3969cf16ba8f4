"""
How often an agent reaches a goal in mazes of which two passages are walled that training had open, and both goals of V3 in one
episode: a ``ModePlanner`` beside a ``Replanner`` and the model without command.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation import Replanner, run_episodes
from sb3_ddiffpg.planning import ModePlanner


def reached(agent: Any, env: VecEnv, n_episodes: int) -> str:
    """
    :param agent: Acts like a model
    :param env: The environments
    :param n_episodes: Number of episodes
    :return: A cell of the table: successes, and their mean length
    """
    lengths = [episode.length for episode in run_episodes(agent, env, n_episodes) if episode.success]
    return f"{len(lengths):4d} of {n_episodes}" + (f", {np.mean(lengths):6.1f} steps" if lengths else "")


def both_goals(planner: ModePlanner, env: VecEnv) -> str:
    """
    :param planner: Knows the goals
    :param env: Environments whose episodes do not end at a goal, of each of which one episode is run
    :return: A cell of the table: episodes in which the environment said of both goals that they are reached, and their length
    """
    goals = env.get_attr("maze")[0].goals
    agent = planner.go_to(*goals)
    seen = np.zeros((env.num_envs, len(goals)), dtype=bool)
    finished, lengths = np.zeros(env.num_envs, dtype=bool), []
    obs, state, starts, step = env.reset(), None, np.ones(env.num_envs, dtype=bool), 0
    while not finished.all():
        actions, state = agent.predict(obs, state, starts)
        obs, _, starts, infos = env.step(actions)
        step += 1
        for i in np.flatnonzero(~finished):
            if infos[i]["goal_id"] is not None:
                seen[i, infos[i]["goal_id"]] = True
            if seen[i].all():
                lengths.append(step)
            finished[i] = seen[i].all() or starts[i]
    return f"{len(lengths):4d} of {env.num_envs}" + (f", {np.mean(lengths):6.1f} steps" if lengths else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", type=Path, nargs="+", help="DDiffPG's models of V3")
    parser.add_argument("--body", choices=("Point", "Ant"), default="Point")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=2, help="of practice, 50 episodes each")
    parser.add_argument("--seed", type=int, default=11, help="of the walls and actions")
    options = parser.parse_args()
    th.set_num_threads(1)
    kwargs: dict[str, Any] = {"integrator": "euler"} if options.body == "Ant" else {"start_noise": 0.0}
    for path in options.models:
        set_random_seed(options.seed)
        model = DDiffPG.load(path)
        known = make_vec_env(f"{options.body}MazeV3-v0", 50, seed=options.seed, **kwargs)
        walled = make_vec_env(f"{options.body}MazeRandom-v0", 100, seed=options.seed, **kwargs)
        steps = 2000 if options.body == "Ant" else 300
        kind: Any = type(known.unwrapped)
        endless = kind(100, maze_map="V3", max_episode_steps=steps, changes={"ends_at_goal": False}, **kwargs)
        planner = ModePlanner(model)
        for _ in range(options.rounds):
            planner.practise(known)
        print(path)
        for name, agent in {"planner": planner, "Replanner": Replanner(model), "without command": model}.items():
            print(f"  {name:<16} walled: {reached(agent, walled, options.episodes)}", flush=True)
        print(f"  {'planner':<16} open:   {reached(planner, known, 100)}")
        print(f"  {'planner':<16} both:   {both_goals(planner, endless)}", flush=True)
        obs, state = walled.reset(), None
        begin = time.process_time()
        for _ in range(200):
            _, state = planner.predict(obs[0], state)
        took = (time.process_time() - begin) / 200 * 1e3
        print(f"  a step of one environment takes {took:.2f} ms, places: {len(planner.graph)}")


if __name__ == "__main__":
    main()
