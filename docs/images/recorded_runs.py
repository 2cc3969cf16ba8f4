"""Pictures of DDiffPG's recorded runs: success of the routes by command in training, and in a maze the first run's paths."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.evaluation.rollout import run_episodes
from sb3_ddiffpg.experiments.curve import REACHED
from sb3_ddiffpg.visualization import plots

RESULTS = Path(__file__).parents[2] / "results"
N_EPISODES = 20
ANT, ARM = "AntMaze", "Franka"
LEAST_SUCCESS = 0.5


def recorded(env_id: str) -> list[Path]:
    """
    :param env_id: Of an environment
    :return: The folders of its runs, those of baselines left out
    """
    return sorted((RESULTS / env_id).glob("seed*"))


def draw_curves(steps: Axes, hours: Axes, runs: list[Path]) -> None:
    """
    :param steps: Gets the success against environment steps of each route that a command has taken in half of a test
    :param hours: The same against hours
    :param runs: Folders of recorded runs
    """
    curves = [pd.read_csv(run / "curve.csv") for run in runs]
    routes = sorted({name.removeprefix(REACHED) for curve in curves for name in curve if name.startswith(REACHED)})
    commanded = [each for each in routes if any(each in curve and (curve[each] >= LEAST_SUCCESS).any() for curve in curves)]
    for number, (run, curve) in enumerate(zip(runs, curves, strict=True)):
        for color, route in enumerate(commanded):
            if route not in curve:
                continue
            style = {"color": f"C{color}", "ls": ["-", "--", ":"][number % 3], "label": f"{route}, {run.name}"}
            steps.plot(curve["step"], curve[route], **style)
            hours.plot(curve["hours"], curve[route], **style)
    steps.set(xlabel="environment steps", ylabel=f"success of {N_EPISODES}, best command")
    steps.xaxis.set_major_formatter(EngFormatter(sep=""))
    hours.set(xlabel="hours on one busy core")
    steps.legend(fontsize=8)


def draw_ant(env_id: str) -> Figure:
    """
    :param env_id: Of an ant maze with recorded runs
    :return: The picture
    """
    figure = Figure(figsize=(14, 4.2), layout="constrained")
    steps, hours, paths = figure.subplots(1, 3, width_ratios=(3, 3, 3.4))
    runs = recorded(env_id)
    env = make_vec_env(env_id, N_EPISODES, seed=0, start_noise=0.0, integrator="euler")
    draw_curves(steps, hours, runs)
    model = DDiffPG.load(runs[0] / "model.zip")
    model.set_random_seed(0)
    episodes = {name: run_episodes(model, env, N_EPISODES, mode=name) for name in model.modes.names}
    plots.draw_routes(paths, episodes, env.get_attr("maze")[0], plots.colors_of(list(model.modes)))
    paths.set_title(f"{runs[0].name}: paths of {N_EPISODES} episodes each")
    paths.legend(loc="lower left", fontsize=8)
    return figure


def draw_arm(env_ids: list[str]) -> Figure:
    """
    :param env_ids: Of arm tasks with recorded runs
    :return: The picture, a row for each
    """
    figure = Figure(figsize=(9.5, 3.2 * len(env_ids)), layout="constrained")
    for env_id, (steps, hours) in zip(env_ids, np.atleast_2d(figure.subplots(len(env_ids), 2)), strict=True):
        draw_curves(steps, hours, recorded(env_id))
        steps.set_title(env_id)
    return figure


def main() -> None:
    here = Path(__file__).parent
    for folder in RESULTS.glob(f"{ANT}*-v0"):
        name = folder.name.removeprefix(ANT).removesuffix("-v0").lower()
        draw_ant(folder.name).savefig(here / f"ant_{name}_routes.png", dpi=90)
    arms = sorted(folder.name for folder in RESULTS.glob(f"{ARM}*-v0"))
    draw_arm(arms).savefig(here / "arm_curves.png", dpi=90)


if __name__ == "__main__":
    main()
