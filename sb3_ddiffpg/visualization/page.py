"""
The page that one can touch: one file of HTML with its data, our script, and Plotly's, which needs no network. The same page
shows a finished model and a run in progress. Needs the extra ``plots``.
"""

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import jinja2
import msgspec
from markupsafe import Markup

from sb3_ddiffpg.visualization.palette import GREY, styles
from sb3_ddiffpg.visualization.sketch import Sketch

# Within a script element these end it, or begin a comment
_ESCAPED = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"}


@dataclass
class Shown:
    """
    One model, or one run, on a page.

    :param label: How the page calls it
    :param subtitle: A line about it
    :param sketch: What is drawn
    :param head: Of the table of modes
    :param cells: Its rows, by the mode's name
    :param best: The mode to command first, None: not known
    :param note: Below the table
    :param extra: What is known of each mode beside its sketch, by name: ``episodes``, ``starts``, ``values``
    :param tests: Evaluations along the way: ``step``, ``success``, ``modes``, each a list
    :param summary: Of an evaluation, pairs of a name and a value
    :param evaluation: The same as text
    :param pictures: Each with ``name``, ``caption`` and ``data`` (a PNG in base64)
    :param films: By mode: an mp4 in base64, and ``rate``, its frames in a second
    :param no_films: Why there are none
    :param history: What happened, as text
    :param settings: Pairs of a name and a value
    :param reproduce: The command that makes the page
    """

    label: str
    subtitle: str
    sketch: Sketch
    head: Sequence[str] = ()
    cells: Mapping[str, Sequence[str]] = field(default_factory=dict)
    best: str | None = None
    note: str = ""
    extra: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    tests: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    summary: Sequence[tuple[str, str]] = ()
    evaluation: str = ""
    pictures: Sequence[Mapping[str, str]] = ()
    films: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    no_films: str = ""
    history: str = ""
    settings: Sequence[tuple[str, str]] = ()
    reproduce: str = ""

    def rows(self) -> list[dict[str, Any]]:
        """
        :return: Of the table of modes, the one to command first at the top
        """
        looks = styles(mode.number for mode in self.sketch.modes)
        rows = [
            {
                "index": index,
                "name": mode.name,
                "color": looks[mode.number].color,
                "shape": looks[mode.number].shape,
                "frozen": mode.frozen,
                "best": mode.name == self.best,
                "cells": self.cells.get(mode.name, ()),
            }
            for index, mode in enumerate(self.sketch.modes)
        ]
        return sorted(rows, key=lambda row: not row["best"])

    def data(self) -> dict[str, Any]:
        """
        :return: What the script draws, in values that JSON can hold
        """
        known = msgspec.to_builtins(self.sketch)
        known["modes"] = [
            {**mode, **self.extra.get(mode["name"], {}), "rate": self.films.get(mode["name"], {}).get("rate")}
            for mode in known["modes"]
        ]
        numbers = {each["number"] for part in ("modes", "lives", "courses") for each in known[part]}
        looks = {number: {"color": GREY, "symbol": "circle"} for number in sorted(numbers)}
        for number, style in styles(mode.number for mode in self.sketch.modes).items():
            looks[number] = {"color": style.color, "symbol": style.symbol}
        return {**known, "label": self.label, "looks": looks, "tests": dict(self.tests)}


def as_json(value: Any) -> Markup:
    """
    :param value: What JSON can hold; no NaN
    :return: The same as JSON that can stand within a script element, whatever texts are in it
    :raises ValueError: If there is a number that is not finite
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character, escape in _ESCAPED.items():
        text = text.replace(character, escape)
    return Markup(text)


@cache
def library() -> str:
    """
    :return: Plotly's script, as gzip in base64: a third of its size
    """
    from plotly.offline import get_plotlyjs  # slow to import

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode()


def render(title: str, shown: Sequence[Shown], made_with: str = "", live: bool = False, whole: bool = True) -> str:
    """
    :param title: Of the page
    :param shown: Models or runs; none yet, if it is live
    :param made_with: Versions
    :param live: Whether the page asks its server for news
    :param whole: False leaves the plotting library out, for who has it already
    :return: HTML
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sb3_ddiffpg.visualization"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template("report.html").render(
        title=title,
        shown=shown,
        made_with=made_with,
        live=live,
        data=as_json([each.data() for each in shown]),
        library=Markup(library()) if whole else "",
    )
