"""What a folder of results comes to: tables and figures, as Markdown beside PNG files and as one page of HTML."""

import argparse
import base64
import io
import re
import shlex
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jinja2
import markdown
import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from sb3_ddiffpg.experiments import figures
from sb3_ddiffpg.experiments.ablations import register
from sb3_ddiffpg.experiments.files import check_output, task_file_name
from sb3_ddiffpg.experiments.record import command_line
from sb3_ddiffpg.experiments.store import Recorded, by, check_alike, read_results, task_of, variant_of
from sb3_ddiffpg.experiments.summary import elsewhere_table, seconds_per_update, task_table
from sb3_ddiffpg.experiments.trial import setting_of

_IMAGE = re.compile(r'src="([^":]+\.png)"')


def make_report(
    results: Path,
    output: Path,
    title: str,
    ablation: str | None = None,
    suite: tuple[Collection[str], Collection[str]] | None = None,
) -> Path:
    """
    :param results: Folder in which trainings have left their records
    :param output: Folder of the report
    :param title: Of the report
    :param ablation: Setting in which the variants differ, for a figure over its values
    :param suite: Only trainings of these tasks and variants; all if None
    :return: The page, ``report.html``; ``report.md`` and the PNG files lie beside it
    :raises ValueError: If no training is complete
    """
    runs, incomplete = read_results(results)
    if suite is not None:
        runs = [run for run in runs if task_of(run) in suite[0] and variant_of(run) in suite[1]]
        places = {(task_file_name(task), variant) for task in suite[0] for variant in suite[1]}
        incomplete = [folder for folder in incomplete if folder.relative_to(results).parts[:2] in places]
    if not runs:
        raise ValueError(f"results: none of the {len(incomplete)} trainings in {results} is complete")
    check_alike(runs)
    values = [setting_of(run.trial, ablation) for run in runs] if ablation is not None else []
    if not all(isinstance(value, (int, float)) for value in values):
        raise ValueError(f"ablation: {ablation!r} given; accepted is a setting that is a number in every training")
    output.mkdir(parents=True, exist_ok=True)
    drawn = _Drawn(output)
    _draw(drawn, runs, ablation)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sb3_ddiffpg.visualization"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    elsewhere = elsewhere_table(runs)
    text = environment.get_template("results.md").render(
        title=title,
        last=all(run.trial.tests.last for run in runs),
        machines=_machines(runs),
        incomplete=[str(folder.relative_to(results)) for folder in incomplete],
        tasks={task: _table(task_table(own)) for task, own in by(task_of, runs).items()},
        elsewhere=None if elsewhere.empty else _table(elsewhere),
        figures=drawn.captions,
        commands=_commands(runs),
    )
    (output / "report.md").write_text(text)
    body = markdown.markdown(text, extensions=["tables"])
    body = _IMAGE.sub(lambda found: f'src="data:image/png;base64,{_encoded(output / found[1])}"', body)
    page = environment.get_template("results.html").render(title=title, body=body)
    (output / "report.html").write_text(page)
    return output / "report.html"


class _Drawn:
    """
    Figures that were written.

    :param folder: Of the files
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        #: File -> what it shows
        self.captions: dict[str, str] = {}

    def add(self, name: str, caption: str, figure: Figure | None) -> None:
        """
        :param name: Of the file, without ending
        :param caption: What it shows
        :param figure: The figure; None if there is nothing to show
        """
        if figure is not None:
            drawn = io.BytesIO()
            figure.savefig(drawn, dpi=90)
            # With a palette that keeps every colour to some hundredths: a quarter of the size
            smaller = Image.open(drawn).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
            smaller.save(self.folder / f"{name}.png", optimize=True)
            self.captions[f"{name}.png"] = caption


def _draw(drawn: _Drawn, runs: Sequence[Recorded], setting: str | None) -> None:
    for measure, name in (
        ("success_rate", "Success without command"),
        ("mean_return", "Mean return without command"),
        ("expected_modes", "Routes expected in 20 episodes without command"),
        ("commanded_modes", "Routes that can be commanded"),
        ("cells", "Known cells"),
    ):
        if any(measure in run.curve for run in runs):
            text = f"{name} along training: mean over seeds, between the lowest and the highest."
            drawn.add(measure, text, figures.curves(runs, measure))
    if any(len(run.curve) for run in runs):
        drawn.add(
            "success_rate_hours", "Success without command against hours.", figures.curves(runs, "success_rate", "hours")
        )
    if len(by(task_of, runs)) > 1:
        scope = "variants that have every task, over tasks and seeds (as many of each task as the one with fewest has)"
        drawn.add("aggregate", f"Interquartile means of the {scope}, stratified bootstrap.", figures.aggregate(runs))
    if setting is not None:
        drawn.add("ablation", f"The models of the tables over {setting}.", figures.ablation(runs, setting))
    if any(seconds_per_update(run) is not None for run in runs):
        drawn.add("wall_clock", "Time of 1000 updates and the collection between them, by part.", figures.wall_clock(runs))
    for task, own in by(task_of, runs).items():
        maps, place = figures.Maps(own), task_file_name(task)
        drawn.add(f"exploration_{place}", f"{task}: where training went (first seed), by cell.", maps.exploration())
        text = f"{task}: what the critics expect, of reward and novelty, of DDiffPG of its best mode's reward alone"
        drawn.add(f"values_{place}", f"{text} (first seed, last model; each panel has its own scale).", maps.values())


def _table(frame: pd.DataFrame) -> str:
    rows = [list(frame.columns), ["---"] * len(frame.columns), *frame.astype(str).to_numpy().tolist()]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _machines(runs: Sequence[Recorded]) -> list[str]:
    """Where, of which commit, and with what; several lines tell that not all was made alike."""
    found = Counter(
        f"{run.record['machine']['gpu'] or run.record['machine']['processor']}, {run.record['machine']['cores']} cores, "
        f"{run.record['machine']['torch_threads']} threads each, commit {run.record['git_commit']}, "
        + ", ".join(f"{name} {version}" for name, version in run.record["versions"].items())
        for run in runs
    )
    return [f"{n} of {len(runs)} trainings: {what}" for what, n in found.most_common()]


def _commands(runs: Sequence[Recorded]) -> dict[str, str]:
    """How the first training of each variant can be done again."""
    found = {}
    for variant, own in by(variant_of, runs).items():
        words = command_line(own[0].trial, Path("DIR"))
        found[variant] = f"python -m sb3_ddiffpg.experiments {shlex.join(words)}"
    return found


def _encoded(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: Of the command line
    """
    parser.add_argument("results", type=Path, help="folder in which trainings have left their records")
    parser.add_argument("--out", type=Path, help="folder of the report; RESULTS/report if not given")
    parser.add_argument("--title", help="the name of the folder of results if not given")
    parser.add_argument("--ablation", metavar="SETTING", help="in which the variants differ, for a figure over its values")


def prepare(given: argparse.Namespace) -> Callable[[], Any]:
    """
    :param given: The command line
    :return: What does it
    :raises ValueError: If it asks for what there is not
    """
    register()
    output = given.out or given.results / "report"
    check_output(output)
    title = given.title or given.results.resolve().name
    # Nothing in it runs for long: what is wrong with the results is said as what is wrong with the arguments
    return partial(print, f"wrote {make_report(given.results, output, title, given.ablation)}")
