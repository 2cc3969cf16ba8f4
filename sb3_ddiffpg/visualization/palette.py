"""How modes are told apart in pictures: the colours of Okabe and Ito, and a marker beside each. Needs no library."""

from collections.abc import Iterable
from dataclasses import dataclass

#: The palette of M. Okabe and K. Ito, "Color Universal Design" (2008), with which colour-blind readers tell eight things apart
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#F0E442")
#: Nine, so that seventy-two modes differ in one or the other: as Matplotlib calls them
MARKERS = ("o", "s", "^", "D", "v", "X", "P", "*", "h")
#: As Plotly calls them
SYMBOLS = ("circle", "square", "triangle-up", "diamond", "triangle-down", "x", "cross", "star", "hexagon")
#: As the path of an SVG of 16 by 16
SHAPES = (
    "M8 2a6 6 0 1 0 .01 0z",
    "M2.5 2.5h11v11h-11z",
    "M8 1.5l7 12.5h-14z",
    "M8 1l7 7-7 7-7-7z",
    "M8 14.5l7-12.5h-14z",
    "M3 1l5 5 5-5 2 2-5 5 5 5-2 2-5-5-5 5-2-2 5-5-5-5z",
    "M6 1h4v5h5v4h-5v5h-4v-5h-5v-4h5z",
    "M8 .8l2.1 4.9 5.3.4-4 3.5 1.2 5.2-4.6-2.8-4.6 2.8 1.2-5.2-4-3.5 5.3-.4z",
    "M8 1l6.2 3.5v7l-6.2 3.5-6.2-3.5v-7z",
)


#: Of a mode that has ended
GREY = "#8a8a8a"


@dataclass(frozen=True)
class Style:
    """
    How a mode looks.

    :param color: ``"#rrggbb"``
    :param marker: As Matplotlib calls it
    :param symbol: The same marker, as Plotly calls it
    :param shape: The same, as the path of an SVG of 16 by 16
    """

    color: str
    marker: str
    symbol: str
    shape: str


def styles(numbers: Iterable[int]) -> dict[int, Style]:
    """
    The first eight modes have a colour each, the first nine a marker; no two of the first 72 have both in common. A mode that
    is born changes no other's.

    :param numbers: Of the modes that are drawn together
    :return: How each looks, by number
    """
    found: dict[int, Style] = {}
    colors: list[int] = []
    markers: list[int] = []
    for place, number in enumerate(sorted(set(numbers))):
        # Its own, or the next one that is free; once all are taken, they are taken again
        color = _free(number % len(COLORS), len(COLORS), colors[place - place % len(COLORS) :])
        marker = _free(number % len(MARKERS), len(MARKERS), markers[place - place % len(MARKERS) :])
        while (color, marker) in zip(colors, markers, strict=True) and place < len(COLORS) * len(MARKERS):
            marker = (marker + 1) % len(MARKERS)
        colors.append(color)
        markers.append(marker)
        found[number] = Style(COLORS[color], MARKERS[marker], SYMBOLS[marker], SHAPES[marker])
    return found


def _free(wanted: int, n: int, taken: list[int]) -> int:
    return next((index % n for index in range(wanted, wanted + n) if index % n not in taken), wanted)
