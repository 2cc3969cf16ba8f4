"""DTW distances of a set of paths that changes a little each time."""

import numpy as np

from sb3_ddiffpg.clustering.dtw import dtw_distances


class DistanceCache:
    """
    Pairwise DTW distances of the last set of paths: of the next set only the new pairs are computed.

    :param normalize: See ``dtw_distances``
    """

    def __init__(self, normalize: bool = True) -> None:
        self.normalize = normalize
        self.serials = np.zeros(0, dtype=np.int64)
        self.distances = np.zeros((0, 0), dtype=np.float32)

    def __call__(self, serials: np.ndarray, paths: list[np.ndarray]) -> np.ndarray:
        """
        :param serials: Ascending numbers that identify the paths, shape [N]
        :param paths: Each [n_path_points, dim]
        :return: Shape [N, N]
        """
        known = np.isin(serials, self.serials)
        old = np.searchsorted(self.serials, serials[known])
        distances = np.zeros((len(serials), len(serials)), dtype=np.float32)
        distances[np.ix_(known, known)] = self.distances[np.ix_(old, old)]
        if not known.all():
            new = [path for path, is_known in zip(paths, known, strict=True) if not is_known]
            distances[np.ix_(~known, ~known)] = dtw_distances(new, normalize=self.normalize)
            if known.any():
                seen = [path for path, is_known in zip(paths, known, strict=True) if is_known]
                across = dtw_distances(new, seen, self.normalize)
                distances[np.ix_(~known, known)] = across
                distances[np.ix_(known, ~known)] = across.T
        self.serials, self.distances = serials, distances
        return distances
