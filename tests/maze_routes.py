"""Ways through the mazes of the paper, shared by tests."""

import numpy as np

# Corners of a way of each kind, from the start, written down by looking at the maps
ROUTES = {
    ("V1", "0:a"): [(0, 4), (-8, 4), (-8, 0)],
    ("V1", "0:-"): [(0, -4), (-8, -4), (-8, 0)],
    ("V2", "0:-"): [(-8, 0), (-8, 8)],
    ("V2", "1:-"): [(8, 0)],
    ("V3", "0:a"): [(0, 12), (-12, 12)],
    ("V3", "0:c"): [(0, 4), (-12, 4), (-12, 12)],
    ("V3", "0:e"): [(0, -4), (-12, -4), (-12, 12)],
    ("V3", "1:D"): [(12, 0), (12, -12)],
    ("V3", "1:-"): [(0, -8), (12, -8), (12, -12)],
    ("V4", "0:ba"): [(0, 4), (-8, 4), (-8, 8), (-16, 8), (-16, 4)],
    ("V4", "0:bc"): [(0, 4), (-8, 4), (-8, 0), (-16, 0), (-16, 4)],
    ("V4", "1:c"): [(0, -4), (-8, -4), (-8, 0), (-16, 0), (-16, -4)],
    ("V4", "1:-"): [(0, -4), (-8, -4), (-8, -8), (-16, -8), (-16, -4)],
}


def polyline(corners, step=0.5):
    """Points at most ``step`` apart on the way from corner to corner."""
    points = [np.asarray(corners[0], dtype=float)]
    for corner in np.asarray(corners, dtype=float)[1:]:
        n = int(np.ceil(np.abs(corner - points[-1]).max() / step))
        points.extend(points[-1] + (corner - points[-1]) * np.linspace(0, 1, n + 1)[1:, None])
    return np.array(points)
