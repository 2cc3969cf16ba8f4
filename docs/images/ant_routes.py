"""Pictures of the recorded ants: success of the commanded ways along training, and the first run's routes."""

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_ddiffpg import DDiffPG, plots
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.episodes import run_episodes

RESULTS = Path(__file__).parents[2] / "results"
N_EPISODES = 20


def draw(env_id: str) -> Figure:
    """
    :param env_id: Of an ant maze with recorded runs
    :return: The picture
    """
    figure = Figure(figsize=(14, 4.2), layout="constrained")
    steps, hours, routes = figure.subplots(1, 3, width_ratios=(3, 3, 3.4))
    runs = sorted((RESULTS / env_id).iterdir())
    env = make_vec_env(env_id, N_EPISODES, seed=0, start_noise=0.0, integrator="euler")
    curves = [pd.read_csv(run / "curve.csv") for run in runs]
    taken = [way for way in env.get_attr("listed_modes")[0] if any(curve[way].any() for curve in curves)]
    for number, (run, curve) in enumerate(zip(runs, curves, strict=True)):
        for color, way in enumerate(taken):
            style = {"color": f"C{color}", "ls": ["-", "--", ":"][number % 3], "label": f"{way}, {run.name}"}
            steps.plot(curve["step"], curve[way], **style)
            hours.plot(curve["hours"], curve[way], **style)
    steps.set(xlabel="environment steps", ylabel=f"success of {N_EPISODES}, best command")
    steps.xaxis.set_major_formatter(EngFormatter(sep=""))
    hours.set(xlabel="hours on one busy core")
    steps.legend(fontsize=8)

    model = DDiffPG.load(runs[0] / "model.zip")
    model.set_random_seed(0)
    episodes = {name: run_episodes(model, env, N_EPISODES, mode=name) for name in model.modes.names}
    plots.draw_routes(routes, episodes, env.get_attr("maze")[0], plots.colors_of(list(model.modes)))
    routes.set_title(f"{runs[0].name}: routes of {N_EPISODES} episodes each")
    routes.legend(loc="lower left", fontsize=8)
    return figure


def main() -> None:
    for folder in RESULTS.glob("AntMaze*-v0"):
        name = folder.name.removeprefix("AntMaze").removesuffix("-v0").lower()
        draw(folder.name).savefig(Path(__file__).with_name(f"ant_{name}_routes.png"), dpi=90)


if __name__ == "__main__":
    main()
