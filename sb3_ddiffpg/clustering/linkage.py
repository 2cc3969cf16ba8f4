"""
Modes from trajectories: which goal-reached trajectories belong together, which failed ones go with them, and which
mode of the last clustering each new one continues. Pure functions of arrays; who the modes are is kept elsewhere.
"""

import numpy as np
from scipy.cluster import hierarchy
from scipy.spatial.distance import squareform

# Ward, centroid and median are left out: they are defined for Euclidean distances only, which DTW's are not.
LINKAGES = ("average", "complete", "single", "weighted")

# Mean silhouette that makes a group a mode. On synthetic routes, narrow and wide, alone and beside others, every value from
# .52 to .6 gives the true partition in 240 of 240 cases (slow tests); lower ones split a route, higher ones join two.
_CLEAR_SILHOUETTE = 0.55

# Cuts tried per branch, from the top: what lies lower is found when the branches are looked into themselves.
_MAX_CUTS = 24


def cluster(
    distances: np.ndarray, threshold: float | None, linkage: str = "average", max_modes: int = 10, min_size: int = 3
) -> np.ndarray:
    """
    Group trajectories by agglomerative clustering of their distances.

    :param distances: symmetric matrix of shape ``[n, n]``, finite and not negative, zero on the diagonal
    :param threshold: height at which the tree is cut, in the unit of ``distances``; None takes
        :func:`automatic_labels`, which needs no unit
    :param linkage: how the distance of two groups follows from their members', one of ``LINKAGES``
    :param max_modes: if more groups of at least ``min_size`` result, the tree is cut higher until at most so many are left
    :param min_size: smallest number of trajectories that makes a mode
    :return: int array of shape ``[n]``: the modes are numbered from 0 by decreasing size, equal sizes by their first
        member; -1 marks the members of smaller groups
    :raises ValueError: naming the argument that is out of range, or what is wrong with the matrix
    """
    _check_arguments(threshold, linkage, max_modes, min_size)
    distances = _check_distances(distances)
    n = len(distances)
    if n < max(2, min_size):
        return np.full(n, 0 if min_size == 1 else -1)
    if threshold is None:
        return automatic_labels(distances, linkage, max_modes, min_size)
    tree = hierarchy.linkage(squareform(distances, checks=False), linkage)
    labels = np.zeros(n, dtype=np.int64)
    for height in [threshold, *tree[tree[:, 2] > threshold, 2]]:
        labels = hierarchy.fcluster(tree, height, criterion="distance")
        if np.count_nonzero(np.bincount(labels) >= min_size) <= max_modes:
            break
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    return _numbered([group for group in groups if len(group) >= min_size], n)


def without_outliers(labels: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """
    :param labels: as :func:`cluster` gives them, of shape ``[n]``
    :param distances: of the same trajectories
    :return: the labels with every outlier in the group of the trajectory nearest to it; if there is no group, all are one
    """
    members = np.flatnonzero(labels >= 0)
    if not len(members):
        return np.zeros_like(labels)
    return np.where(labels >= 0, labels, labels[members[distances[:, members].argmin(axis=1)]])


def automatic_labels(distances: np.ndarray, linkage: str = "average", max_modes: int = 10, min_size: int = 3) -> np.ndarray:
    """
    Clusters without a threshold: the same answer whatever the unit of the distances, and possibly a single one.

    Candidates are the cuts of the merge tree just below a merge of two groups of at least ``min_size``. At each, a group
    counts as a mode if its mean silhouette (Rousseeuw, 1987) is at least 0.55, that is, if the nearest other group lies
    about 2.2 times as far from its members as they from one another; members of the other groups are outliers. Cuts that leave
    fewer than two modes, or half of the trajectories outside of them, are dismissed, and the cut of largest mean
    silhouette, outliers counting zero, is taken. The same question is then put to each of its modes, so that two goals
    far apart do not hide the routes to each of them. If no cut is left, all trajectories are one mode, but for those few that
    join it last and from so far away that its silhouette beside them is as clear: the first of a rarer route, which would
    otherwise be taken for its members and be forgotten among them.

    :param distances: as in :func:`cluster`
    :param linkage: as in :func:`cluster`
    :param max_modes: if more modes result, those that merge lowest in the tree are joined until so many are left
    :param min_size: as in :func:`cluster`
    :return: labels as :func:`cluster` gives them
    """
    _check_arguments(None, linkage, max_modes, min_size)
    distances = _check_distances(distances)
    n = len(distances)
    if n < max(2, min_size):
        return np.full(n, 0 if min_size == 1 else -1)
    tree = _MergeTree(distances, linkage)
    modes, undecided = [], [tree.root]
    while undecided:
        node = undecided.pop()
        parts = _clearest_cut(tree, node, min_size)
        if len(parts):
            undecided.extend(parts)
        else:
            modes.append(_without_strays(tree, node, min_size))
    return _numbered(tree.groups(modes, max_modes), n)


class _MergeTree:
    """
    A linkage with its leaves put in the tree's order, where the members of every node stand side by side: node ``v``
    is the places ``first[v]`` to ``first[v] + size[v]``. Nodes are numbered as in scipy's linkage matrix.

    :param distances: matrix of shape ``[n, n]`` with ``n`` at least 2
    :param method: one of ``LINKAGES``
    """

    def __init__(self, distances: np.ndarray, method: str):
        merges = hierarchy.linkage(squareform(distances, checks=False), method)
        n = len(distances)
        self.root = 2 * n - 2
        self.children = merges[:, :2].astype(np.int64)
        self.height = np.concatenate([np.zeros(n), merges[:, 2]])
        self.size = np.concatenate([np.ones(n, dtype=np.int64), merges[:, 3].astype(np.int64)])
        self.first = np.zeros(2 * n - 1, dtype=np.int64)
        self.parent_height = np.full(2 * n - 1, np.inf)
        for node in range(self.root, n - 1, -1):
            left, right = self.children[node - n]
            self.first[left] = self.first[node]
            self.first[right] = self.first[node] + self.size[left]
            self.parent_height[[left, right]] = self.height[node]
        self.order = np.argsort(self.first[:n])
        # Column j holds the summed distances to the places before j, so that a node's sum is one difference.
        self.sums = np.zeros((n, n + 1))
        np.cumsum(distances[np.ix_(self.order, self.order)], axis=1, dtype=np.float64, out=self.sums[:, 1:])

    def _below(self, node: int) -> np.ndarray:
        """Mask of the nodes in the subtree of ``node``, itself included."""
        inside = (self.first >= self.first[node]) & (self.first < self.first[node] + self.size[node])
        return inside & (self.size <= self.size[node])

    def merge_heights(self, node: int, min_size: int) -> np.ndarray:
        """Heights, from the top and each once, where two groups of at least ``min_size`` meet below ``node``."""
        n = len(self.order)
        both_large = (self.size[self.children] >= min_size).all(axis=1)
        return np.unique(self.height[n:][both_large & self._below(node)[n:]])[::-1]

    def children_of(self, node: int) -> np.ndarray:
        """The two nodes that were merged to this one, none for a single trajectory."""
        n = len(self.order)
        return self.children[node - n] if node >= n else np.zeros(0, dtype=np.int64)

    def cut(self, node: int, height: float, min_size: int) -> np.ndarray:
        """The groups of at least ``min_size`` that ``node`` falls into when everything from ``height`` on is undone."""
        top = (self.height < height) & (self.parent_height >= height) & (self.size >= min_size)
        return np.flatnonzero(top & self._below(node))

    def silhouettes(self, nodes: np.ndarray) -> np.ndarray:
        """Mean silhouette of each of some disjoint nodes, at least two, with the rest of the tree left out."""
        first, size = self.first[nodes], self.size[nodes]
        owner = np.repeat(np.arange(len(nodes)), size)
        places = np.concatenate([np.arange(start, start + length) for start, length in zip(first, size, strict=True)])
        sums = self.sums[np.ix_(places, first + size)] - self.sums[np.ix_(places, first)]
        own = (np.arange(len(places)), owner)
        within = sums[own] / np.maximum(size[owner] - 1, 1)
        means = sums / size
        means[own] = np.inf
        nearest = means.min(axis=1)
        scale = np.maximum(within, nearest)
        # One trajectory alone, or copies of one everywhere, say nothing about groups: silhouette 0 by convention.
        known = (scale > 0.0) & (size[owner] > 1)
        values = np.divide(nearest - within, scale, out=np.zeros_like(scale), where=known)
        return np.bincount(owner, weights=values) / size

    def groups(self, nodes: list[int], most: int) -> list[np.ndarray]:
        """Trajectories of disjoint nodes; those that meet lowest in the tree are joined until at most ``most`` are left."""
        owner = np.full(len(self.order), -1)
        for index, node in enumerate(nodes):
            owner[self.first[node] : self.first[node] + self.size[node]] = index
        excess = len(nodes) - most
        for node in range(len(self.order), self.root + 1):
            if excess <= 0:
                break
            inside = owner[self.first[node] : self.first[node] + self.size[node]]
            present = np.unique(inside[inside >= 0])
            if len(present) == 2:
                inside[inside == present[1]] = present[0]
                excess -= 1
        return [self.order[owner == index] for index in np.unique(owner[owner >= 0])]


def _clearest_cut(tree: _MergeTree, node: int, min_size: int) -> np.ndarray:
    """The modes that ``node`` falls into, none if it is one itself; see :func:`automatic_labels`."""
    best, best_score = np.zeros(0, dtype=np.int64), 0.0
    for height in tree.merge_heights(node, min_size)[:_MAX_CUTS]:
        parts = tree.cut(node, height, min_size)
        if len(parts) > 1:
            parts = parts[tree.silhouettes(parts) >= _CLEAR_SILHOUETTE]
        sizes = tree.size[parts]
        if len(parts) < 2 or 2 * sizes.sum() < tree.size[node]:
            continue
        score = (tree.silhouettes(parts) * sizes).sum() / tree.size[node]
        if score > best_score:
            best, best_score = parts, score
    return best


def _without_strays(tree: _MergeTree, node: int, min_size: int) -> int:
    """The node within a mode that is left when groups too small for a mode, and clearly apart from it, are taken off."""
    while True:
        children = tree.children_of(node)
        sizes = tree.size[children]
        if not len(children) or (sizes >= min_size).sum() != 1:
            return node
        core, stray = children[sizes.argsort()[::-1]]
        # A few alone could look as clear by chance: the core must be many
        if tree.size[core] < 4 * tree.size[stray] or tree.silhouettes(np.array([core, stray]))[0] < _CLEAR_SILHOUETTE:
            return node
        node = int(core)


def _numbered(groups: list[np.ndarray], n: int) -> np.ndarray:
    """Labels of ``n`` trajectories from disjoint groups, the largest first, -1 for those in none."""
    labels = np.full(n, -1, dtype=np.int64)
    for label, group in enumerate(sorted(groups, key=lambda group: (-len(group), group.min()))):
        labels[group] = label
    return labels


def _check_arguments(threshold: float | None, linkage: str, max_modes: int, min_size: int) -> None:
    if threshold is not None and not threshold > 0.0:
        raise ValueError(f"threshold must be greater than 0, or None for the automatic rule, got {threshold}")
    if linkage not in LINKAGES:
        raise ValueError(f"linkage must be one of {', '.join(LINKAGES)}, got {linkage!r}")
    for name, value in (("max_modes", max_modes), ("min_size", min_size)):
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")


def _check_distances(distances: np.ndarray) -> np.ndarray:
    distances = np.asarray(distances)
    if distances.ndim != 2 or distances.shape[0] != distances.shape[1]:
        raise ValueError(f"distances must be a square matrix, got shape {distances.shape}")
    wrong = np.argwhere(~(np.isfinite(distances) & (distances >= 0.0)))
    if len(wrong):
        row, column = wrong[0]
        raise ValueError(f"distances[{row}, {column}] is {distances[row, column]}: it must be finite and not negative")
    if not np.allclose(distances, distances.T, rtol=1e-4) or np.diagonal(distances).any():
        raise ValueError("distances must be symmetric with a zero diagonal")
    return distances
