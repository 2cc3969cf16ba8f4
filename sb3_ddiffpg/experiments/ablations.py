"""DDiffPG with one of its parts made useless, for comparison only: what the part is good for."""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_ddiffpg.ddiffpg import DDiffPG, DiffusionPolicy
from sb3_ddiffpg.modes.manager import ModeManager
from sb3_ddiffpg.saving.algorithm import SavableAlgorithm
from sb3_ddiffpg.zoo import ALGO, ALGOS
from sb3_ddiffpg.zoo import register as register_in_zoo


class ShuffledEmbeddingsPolicy(DiffusionPolicy):
    """Each row of a mode has a mode's embedding where the policy learns, but anyone's."""

    def _embeddings_of_groups(self, n: int) -> th.Tensor:
        embeddings = super()._embeddings_of_groups(n)
        of_modes = embeddings[1:].flatten(0, 1)
        owners = th.randperm(len(of_modes), device=of_modes.device)
        return th.cat((embeddings[:1], of_modes[owners].view_as(embeddings[1:])))


class ShuffledEmbeddings(DDiffPG):
    """DDiffPG with a ``ShuffledEmbeddingsPolicy``."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        name: ShuffledEmbeddingsPolicy for name, policy in DDiffPG.policy_aliases.items() if policy is DiffusionPolicy
    }


class RandomClusterManager(ModeManager):
    """Finds as many clusters of the same sizes, but of any trajectories."""

    def _cluster(self, distances: np.ndarray) -> np.ndarray:
        labels = super()._cluster(distances)
        return labels if self.settings.max_modes == 1 else np.random.permutation(labels)


class RandomClusters(DDiffPG):
    """DDiffPG with a ``RandomClusterManager``."""

    manager_class = RandomClusterManager


#: By their names in experiments
ABLATIONS: dict[str, type[DDiffPG]] = {
    "ddiffpg_random_clusters": RandomClusters,
    "ddiffpg_shuffled_embeddings": ShuffledEmbeddings,
}


def register() -> None:
    """Make this package's algorithms and the ablations known to the zoo."""
    register_in_zoo()
    ALGOS.update(ABLATIONS)


def load_to_act(algo: str, path: Path) -> Any:
    """
    :param algo: Name of an algorithm
    :param path: Of its model
    :return: The model. One of SB3's own has no replay buffer worth the name: one for goals needs an environment
    """
    algorithm: Any = ALGOS[algo]
    if issubclass(algorithm, SavableAlgorithm):
        return algorithm.load(path)
    no_buffer: dict[str, Any] = {"replay_buffer_class": None, "replay_buffer_kwargs": {}, "buffer_size": 1}
    return algorithm.load(path, custom_objects=no_buffer)


def settings_file(algo: str) -> str:
    """
    :param algo: Name of an algorithm
    :return: Name of the YAML file that has its settings
    """
    return ALGO if algo in ABLATIONS else algo
