"""How modes are told apart in pictures: the colours of Okabe and Ito, and a marker beside each. Needs no library."""

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


def mode_color(number: int) -> str:
    """
    :param number: A mode's number
    :return: Its colour in all pictures, ``"#rrggbb"``
    """
    return COLORS[number % len(COLORS)]


def mode_marker(number: int) -> str:
    """
    :param number: A mode's number
    :return: Its marker in Matplotlib's pictures
    """
    return MARKERS[number % len(MARKERS)]


def mode_symbol(number: int) -> tuple[str, str]:
    """
    :param number: A mode's number
    :return: The same marker on the page: Plotly's name, and the path of an SVG of 16 by 16
    """
    index = number % len(MARKERS)
    return SYMBOLS[index], SHAPES[index]
