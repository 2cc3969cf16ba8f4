"""Pure functions on paths: their distances, clusters, and which cluster continues which."""

from sb3_ddiffpg.clustering.dtw import dtw_distances
from sb3_ddiffpg.clustering.linkage import LINKAGES, automatic_labels, cluster
from sb3_ddiffpg.clustering.matching import ModeMatching, assign_to_nearest, match_modes, medoid
from sb3_ddiffpg.clustering.paths import comparable_path, erase_loops, resample_path

__all__ = [
    "LINKAGES",
    "ModeMatching",
    "assign_to_nearest",
    "automatic_labels",
    "cluster",
    "comparable_path",
    "dtw_distances",
    "erase_loops",
    "match_modes",
    "medoid",
    "resample_path",
]
