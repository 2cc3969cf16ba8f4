"""One page about a trained model, without network. Needs the extra ``plots``."""

import base64
import inspect
import io
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import imageio.v3 as imageio
import jinja2
import numpy as np
from matplotlib.colors import to_hex
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_ddiffpg.evaluation.evaluate import evaluate_modes
from sb3_ddiffpg.evaluation.results import ModeEvaluation
from sb3_ddiffpg.evaluation.task import Task
from sb3_ddiffpg.utils.arguments import groups_of, settings_attribute
from sb3_ddiffpg.utils.vec_envs import env_attribute
from sb3_ddiffpg.utils.versions import versions
from sb3_ddiffpg.visualization import figures, plots

# Of an evaluation's episodes, so many are drawn for each mode
_ROUTES_DRAWN = 20


def film(model: Any, task: Task, mode: str | None, seed: int, max_frames: int = 400) -> tuple[np.ndarray, int]:
    """
    One episode in figures.

    :param model: A trained model
    :param task: Where
    :param mode: The mode to command
    :param seed: Of the environment
    :param max_frames: The film ends after so many
    :return: Frames, shape [T, height, width, 3], and frames in a second
    :raises ValueError: If the environment draws no pictures
    """
    env = task.make(1, seed, render_mode="rgb_array")
    observation, state = env.reset(), None
    frames, done = [env.get_images()[0]], False
    while not done and len(frames) < max_frames and isinstance(frames[0], np.ndarray):
        action, state = model.predict(observation, state, mode=mode)
        observation, _, dones, _ = env.step(action)
        done = bool(dones[0])
        if not done:  # then the next episode has begun
            frames.append(env.get_images()[0])
    metadata: Any = getattr(env, "metadata", None) or {}
    rate = int(metadata.get("render_fps", 20))
    env.close()
    if not isinstance(frames[0], np.ndarray) or frames[0].ndim != 3:
        raise ValueError(f"{task.id} gives no picture of shape [height, width, 3]")
    height, width = (size - size % 2 for size in frames[0].shape[:2])  # what the codec wants
    return np.stack(frames)[:, :height, :width], rate  # type: ignore[arg-type]


def make_report(
    model: Any,
    output: str | Path,
    task: Task,
    n_episodes: int = 100,
    seed: int = 0,
    videos: bool = True,
    title: str | None = None,
    command: str = "",
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
    :return: The evaluation
    """
    output = Path(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    env = task.make(min(n_episodes, 25), seed)
    found = evaluate_modes(model, env, n_episodes, seed=seed)
    first: Any = env.reset()
    maze = env_attribute(env, "maze")
    normalizer = unwrap_vec_normalize(env)
    original: Any = first if normalizer is None else normalizer.get_original_obs()
    observation = None if isinstance(original, dict) else original[0]
    drawn = {name: runs[:_ROUTES_DRAWN] for name, runs in found.episodes.items() if name != "(none)"}
    values = model.mode_values(first)[0] if len(model.modes) else np.zeros(0)
    env.close()
    films, no_films = _films(model, task, seed, output) if videos else ([], "")
    template = jinja2.Environment(
        loader=jinja2.PackageLoader("sb3_ddiffpg.visualization"), autoescape=True, undefined=jinja2.StrictUndefined
    ).get_template("report.html")
    page = template.render(
        title=title or f"Routes in {task.id}",
        subtitle=f"{len(model.modes)} modes after {model.num_timesteps:,} environment steps",
        rows=_rows(model, found, values),
        ways_note=_ways_note(found),
        summary=_summary(found),
        evaluation=str(found),
        pictures=[
            {"name": name, "caption": figures.CAPTIONS[name], "data": _png(figure)}
            for name, figure in figures.draw_all(model, maze, observation, drawn, normalizer).items()
        ],
        videos=films,
        no_films=no_films,
        history=str(model.mode_history),
        settings=_settings(model),
        reproduce=command,
        versions=", ".join(f"{name} {number}" for name, number in versions().items()),
    )
    output.write_text(page, encoding="utf-8")
    return found


def _films(model: Any, task: Task, seed: int, output: Path) -> tuple[list[dict[str, str]], str]:
    """A film of each mode, beside the page and for it; or why there is none."""
    films = []
    with TemporaryDirectory(dir=output.parent) as folder:
        for index, name in enumerate(model.modes.names):
            path = Path(folder, f"{output.stem}-{index}-{re.sub(r'[^-a-zA-Z0-9_.]', '_', name)}.mp4")
            try:
                frames, rate = film(model, task, name, seed)
            except Exception as error:  # whatever an environment's drawing raises: a page without films is better than none
                return [], f"No film could be made: {error}"
            imageio.imwrite(path, frames, fps=rate, macro_block_size=2)
            films.append({"name": name, "data": base64.b64encode(path.read_bytes()).decode()})
        for path in Path(folder).iterdir():
            path.replace(output.with_name(path.name))
    return films, ""


def _png(figure: Any) -> str:
    with io.BytesIO() as file:
        figure.savefig(file, format="png", dpi=90)
        return base64.b64encode(file.getvalue()).decode()


def _rows(model: Any, found: ModeEvaluation, values: np.ndarray) -> list[dict[str, Any]]:
    by_name = {each.mode: each for each in found.commanded}
    top = max((each.success_rate for each in found.commanded), default=0.0)
    least = min((each.success_interval[0] for each in found.commanded if each.success_rate == top), default=0.0)
    good = [each for each in found.commanded if each.n_successes and each.success_rate >= least]
    best = min(good, key=lambda each: (-round(each.mean_return, 1), each.mean_length)).mode if good else None
    rows = []
    for mode, value in zip(model.modes, values, strict=True):
        result = by_name[mode.name]
        low, high = result.success_interval
        rows.append(
            {
                "name": mode.name,
                "color": to_hex(plots.mode_color(mode.number)),
                "frozen": mode.frozen,
                "best": mode.name == best,
                "routes": ", ".join(f"{label} ({count})" for label, count in result.labels.items()) or "none",
                "success": f"{result.success_rate:.0%}",
                "interval": f"{low:.0%} to {high:.0%}",
                "length": "-" if np.isnan(result.mean_length) else f"{result.mean_length:.0f}",
                "episode_return": f"{result.mean_return:.2f}",
                "value": f"{value:.2f}",
                "born_at": f"{mode.born_at:,}",
            }
        )
    return sorted(rows, key=lambda row: not row["best"])


def _ways_note(found: ModeEvaluation) -> str:
    if found.label_source == "clustering":
        return "The environment does not say which route was taken: routes are clusters of these episodes' own paths."
    return "Routes are told apart by the environment, not by the clustering that found the modes."


def _summary(found: ModeEvaluation) -> list[tuple[str, str]]:
    def percent(value: float) -> str:
        return "-" if np.isnan(value) else f"{value:.1%}"

    low, high = found.uncommanded.success_interval
    return [
        ("success without command", f"{found.uncommanded.success_rate:.1%} (95 %: {low:.1%} to {high:.1%})"),
        ("routes expected in 20 episodes without command", f"{found.expected_modes():.2f}"),
        ("routes taken in at least 5 % of them", str(found.robust_modes)),
        ("effective number of routes", f"{found.effective_modes:.2f}"),
        ("share of the task's listed routes", percent(found.coverage)),
        ("commanded episodes that took their mode's own route", percent(found.control_accuracy)),
        ("episodes start apart by at most", f"{found.start_spread:.3g}"),
    ]


def _settings(model: Any) -> list[tuple[str, str]]:
    """Constructor arguments, and settings of groups, that differ from their defaults."""
    settings, groups = [], groups_of(type(model))
    for name, parameter in inspect.signature(type(model).__init__).parameters.items():
        if name in groups:
            chosen, usual = getattr(model, settings_attribute(name)).to_dict(), groups[name]().to_dict()
            settings += [(f"{name}.{key}", repr(value)) for key, value in chosen.items() if value != usual[key]]
            continue
        value = getattr(model, name, None)
        if name in ("self", "policy", "env", "device", "verbose", "tensorboard_log", "_init_setup_model", "action_noise"):
            continue
        if callable(value) or value is None or repr(value) == repr(parameter.default):
            continue
        shown = f"{value.frequency} {value.unit.value}" if name == "train_freq" else repr(value)
        if name != "train_freq" or value.frequency != 1:
            settings.append((name, shown))
    return settings
