"""One page about a trained model, or about two side by side, without network. Needs the extra ``plots``."""

import base64
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import imageio.v3 as imageio
import numpy as np
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_ddiffpg.envs import is_ours
from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.evaluation.rollout import EpisodeResult, run_episodes
from sb3_ddiffpg.evaluation.task import Task
from sb3_ddiffpg.utils.rng import preserved_rng
from sb3_ddiffpg.utils.vec_envs import env_attribute
from sb3_ddiffpg.utils.versions import versions
from sb3_ddiffpg.visualization import figures, tables
from sb3_ddiffpg.visualization.page import Shown, render
from sb3_ddiffpg.visualization.sketch import columns, sketch, thin
from sb3_ddiffpg.visualization.walk import Walk, walk

# Of an evaluation's episodes, so many are drawn for each mode in the pictures; the charts have all
_ROUTES_DRAWN = 20
# Episodes for each mode that begin elsewhere, and of one episode's values
_STARTS, _VALUE_POINTS = 50, 150


def make_report(
    model: Any,
    output: str | Path,
    task: Task,
    n_episodes: int = 100,
    seed: int = 0,
    videos: bool = True,
    title: str | None = None,
    command: str = "",
    compared: tuple[str, Any, Task] | None = None,
    label: str = "the model",
) -> ModeEvaluation:
    """
    Evaluate a model, draw it, and write a page of HTML that needs no other file and no network. Videos lie beside it too.

    :param model: A trained model; with its replay buffer there are more pictures
    :param output: The page
    :param task: Where it is evaluated
    :param n_episodes: Episodes for each mode
    :param seed: Of the evaluation
    :param videos: Whether to film an episode of each mode
    :param title: Of the page
    :param command: The command that makes this page
    :param compared: Another model that the page shows beside it: how it is called, itself, and where it is evaluated
    :param label: How the page calls the model, where there is another one
    :return: The evaluation of the model
    """
    output = Path(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    found, shown = _show(model, task, label, output, "", n_episodes, seed, videos)
    shown.reproduce = command
    others = []
    if compared is not None:
        name, other, its_task = compared
        others = [_show(other, its_task, name, output, "-compared", n_episodes, seed, videos)[1]]
    made_with = ", ".join(f"{name} {number}" for name, number in versions().items())
    page = render(title or f"Routes in {task.id}", [shown, *others], made_with)
    output.write_text(page, encoding="utf-8")
    return found


def _show(
    model: Any, task: Task, label: str, output: Path, suffix: str, n_episodes: int, seed: int, videos: bool
) -> tuple[ModeEvaluation, Shown]:
    """Evaluate a model, and say what a page shows of it."""
    env = task.make(min(n_episodes, 25), seed)
    found = evaluate_modes(model, env, n_episodes, seed=seed)
    first: Any = env.reset()
    maze = env_attribute(env, "maze")
    normalizer = unwrap_vec_normalize(env)
    original: Any = first if normalizer is None else normalizer.get_original_obs()
    observation = None if isinstance(original, dict) else original[0]
    commanded = {name: runs for name, runs in found.episodes.items() if name != "(none)"}
    values = model.mode_values(first)[0] if len(model.modes) else np.zeros(0)
    env.close()
    films, walks, no_films = _films(model, task, seed, output, suffix) if videos else ({}, {}, "")
    for name in model.modes.names:
        if name not in walks:
            walks[name] = walk(model, task, name, seed, filmed=False)
    starts = _starts(model, task, commanded, min(n_episodes, _STARTS), seed)
    cells = tables.cells(model, found, values)
    drawn = {name: runs[:_ROUTES_DRAWN] for name, runs in commanded.items()}
    shown = Shown(
        label=label,
        subtitle=f"{len(model.modes)} modes in {task.id} after {model.num_timesteps:,} environment steps",
        sketch=sketch(model, task.id, maze),
        head=tables.HEAD,
        cells=cells,
        best=tables.best_mode(found),
        note=tables.ways_note(found),
        extra={
            name: {
                "episodes": _episodes(commanded[name]),
                "starts": starts[name],
                "values": _values(walks[name]),
                "facts": f"Success {cells[name][1]} ({cells[name][2]} with 95 % confidence), {cells[name][3]} steps, return "
                f"{cells[name][4]}, value at the start {cells[name][5]}. Routes: {cells[name][0]}.",
            }
            for name in model.modes.names
        },
        summary=tables.summary(found),
        evaluation=str(found),
        pictures=[
            {"name": name, "caption": figures.CAPTIONS[name], "data": _png(figure)}
            for name, figure in figures.draw_all(model, maze, observation, drawn, normalizer).items()
        ],
        films=films,
        no_films=no_films,
        history=str(model.mode_history),
        settings=tables.settings(model),
    )
    return found, shown


def _episodes(runs: Sequence[EpisodeResult]) -> list[dict[str, Any]]:
    return [
        {
            "ok": None if run.success is None else bool(run.success),
            "length": run.length,
            "ret": round(run.episode_return, 2),
            "route": run.label,
            "path": columns(run.path),
        }
        for run in runs
    ]


def _starts(
    model: Any, task: Task, commanded: Mapping[str, Sequence[EpisodeResult]], n_episodes: int, seed: int
) -> dict[str, dict[str, Any]]:
    """Of a task of ours, whose evaluation has one start, further episodes from all over where training began."""
    runs = dict(commanded)
    if is_ours(task.id) and runs and task.kwargs.get("start_noise") == 0.0:
        kwargs = {name: value for name, value in task.kwargs.items() if name != "start_noise"}
        env = replace(task, kwargs=kwargs).make(min(n_episodes, 25), seed + 1)
        with preserved_rng():
            set_random_seed(seed + 1)
            runs = {name: run_episodes(model, env, n_episodes, mode=name) for name in runs}
        env.close()
    found = {}
    for name, episodes in runs.items():
        began = np.stack([episode.path[0] for episode in episodes])
        reached = sum(episode.success is not False for episode in episodes)
        apart = float(np.linalg.norm(np.ptp(began, axis=0)))
        x, y = [*columns(began, len(began)), [0.0] * len(began)][:2]
        ok = [None if episode.success is None else bool(episode.success) for episode in episodes]
        said = f"{reached} of {len(episodes)} reached the goal, from starts at most {apart:.3g} apart."
        found[name] = {"x": x, "y": y, "ok": ok, "said": said}
    return found


def _values(seen: Walk) -> dict[str, Any]:
    steps = thin(len(seen.values), _VALUE_POINTS)
    return {"step": steps.tolist(), "value": [column.round(3).tolist() for column in seen.values[steps].T.astype(float)]}


def _films(
    model: Any, task: Task, seed: int, output: Path, suffix: str
) -> tuple[dict[str, dict[str, Any]], dict[str, Walk], str]:
    """A film of each mode, beside the page and for it, and the episodes in it; or why there is none."""
    films, walks = {}, {}
    with TemporaryDirectory(dir=output.parent) as folder:
        for index, name in enumerate(model.modes.names):
            path = Path(folder, f"{output.stem}{suffix}-{index}-{re.sub(r'[^-a-zA-Z0-9_.]', '_', name)}.mp4")
            try:
                seen = walk(model, task, name, seed)
            except Exception as error:  # whatever an environment's drawing raises: a page without films is better than none
                return {}, {}, f"No film could be made: {error}"
            assert seen.frames is not None
            imageio.imwrite(path, seen.frames, fps=seen.rate, macro_block_size=2)
            films[name] = {"data": base64.b64encode(path.read_bytes()).decode(), "rate": seen.rate}
            walks[name] = replace(seen, frames=None)
        for path in Path(folder).iterdir():
            path.replace(output.with_name(path.name))
    return films, walks, ""


def _png(figure: Any) -> str:
    with io.BytesIO() as file:
        figure.savefig(file, format="png", dpi=90)
        return base64.b64encode(file.getvalue()).decode()
