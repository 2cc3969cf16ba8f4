"""The picture of the recorded ants of AntMazeV1: success of the commanded ways along training, and the first one's routes."""

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_ddiffpg import DDiffPG, plots
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.episodes import run_episodes

RESULTS = Path(__file__).parents[2] / "results" / "AntMazeV1-v0"
WAYS = {"0:-": "C0", "0:a": "C1"}
N_EPISODES = 20


def main() -> None:
    figure = Figure(figsize=(14, 4.2), layout="constrained")
    steps, hours, routes = figure.subplots(1, 3, width_ratios=(3, 3, 3.4))
    runs = sorted(RESULTS.iterdir())
    for number, run in enumerate(runs):
        curve = pd.read_csv(run / "curve.csv")
        for way, color in WAYS.items():
            style = {"color": color, "ls": ["-", "--", ":"][number % 3], "label": f"{way}, {run.name}"}
            steps.plot(curve["step"], curve[way], **style)
            hours.plot(curve["hours"], curve[way], **style)
    steps.set(xlabel="environment steps", ylabel=f"success of {N_EPISODES}, best command")
    steps.xaxis.set_major_formatter(EngFormatter(sep=""))
    hours.set(xlabel="hours on one busy core")
    steps.legend(fontsize=8)

    model = DDiffPG.load(runs[0] / "model.zip")
    env = make_vec_env("AntMazeV1-v0", N_EPISODES, seed=0, start_noise=0.0, integrator="euler")
    episodes = {name: run_episodes(model, env, N_EPISODES, mode=name) for name in model.modes.names}
    plots.draw_routes(routes, episodes, env.get_attr("maze")[0], plots.colors_of(list(model.modes)))
    routes.set(xlim=(-11, 3), ylim=(-7, 7))
    routes.set_title(f"{runs[0].name}: routes of {N_EPISODES} episodes each")
    routes.legend(loc="lower left", fontsize=8)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=90)


if __name__ == "__main__":
    main()
