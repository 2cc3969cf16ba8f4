"""What was where in version 0.1: its files name modules, parts and settings as they were, and so may users' imports."""

import importlib
import sys
import warnings
from types import ModuleType
from typing import Any

#: Module of 0.1 -> modules that hold now what it held
MODULES: dict[str, tuple[str, ...]] = {
    "actor_critic": ("common.actor_critic",),
    "behavior": ("exploration.episode_scheduler",),
    "buffer_state": ("buffers.state",),
    "checkpoints": ("callbacks.checkpoint", "saving.checkpoint", "utils.nested_callbacks"),
    "critics": ("networks.critics",),
    "cuda_graphs": ("networks.cuda_graphs",),
    "diffusion": ("networks.diffusion", "networks.denoiser", "networks.diffusion_actor"),
    "divergence": ("utils.divergence",),
    "dtw": ("clustering.dtw", "clustering.paths"),
    "envs.ant": ("envs.mazes.ant",),
    "envs.ant_model": ("envs.mazes.ant_model",),
    "envs.drawing": ("envs.mazes.drawing",),
    "envs.homotopy": ("envs.mazes.homotopy",),
    "envs.maze_env": ("envs.mazes.env",),
    "envs.maze_simulation": ("envs.mazes.simulation",),
    "envs.point": ("envs.mazes.point",),
    "envs.point_mass": ("envs.mazes.point_mass",),
    "envs.turns": ("envs.vec_env.tracing",),
    "envs.workers": ("envs.vec_env.workers",),
    "episodes": ("evaluation.rollout",),
    "exploration_buffer": ("buffers.mode_buffer",),
    "features": ("buffers.features", "networks.extractors"),
    "full_disk": ("utils.disk",),
    "history": ("modes.history",),
    "interrupts": ("utils.signals",),
    "intrinsic": ("exploration.novelty", "exploration.known_regions"),
    "known_ways": ("exploration.known_regions",),
    "mode_evaluation": ("evaluation.results",),
    "model_file": ("saving.model",),
    "noise": ("exploration.noise",),
    "parameter_tree": ("serialization.parameters",),
    "persistence": ("saving.algorithm",),
    "pictures": ("visualization.figures",),
    "plain_values": ("serialization.codec",),
    "plots": ("visualization.plots",),
    "policies": ("ddiffpg.policies", "networks.diffusion_actor"),
    "policy_parts": ("networks.policies",),
    "reclustering": ("modes.discovery",),
    "replanning": ("evaluation.replanner",),
    "returns": ("buffers.returns",),
    "rng": ("utils.rng", "serialization.random_states"),
    "row_storage": ("buffers.storage",),
    "safe_files": ("serialization.safetensors_tree",),
    "schedules": ("common.schedules",),
    "target_actions": ("networks.target_actions",),
    "trajectories": ("buffers.trajectory", "buffers.success", "buffers.storage", "clustering.distance_cache"),
    "trajectory_buffer": ("buffers.trajectory_buffer",),
    "twin_critic_policy": ("networks.policies", "networks.extractors"),
    "union": ("evaluation.ensemble",),
    "visits": ("exploration.visit_map",),
}
#: Names of 0.1 that are others now
NAMES: dict[str, str] = {
    "Behavior": "EpisodeScheduler",
    "Inheritance": "ModeMatching",
    "KnownPlaces": "KnownCells",
    "KnownWays": "KnownRoutes",
    "NO_WAY": "NO_ROUTE",
    "NoveltyActorCritic": "ActorCriticAlgorithm",
    "TurnVecEnv": "TracingDummyVecEnv",
    "Turns": "TracedEnvs",
    "Union": "PolicyEnsemble",
    "Way": "KnownRoute",
    "WayResult": "RouteResult",
    "evaluate_union": "evaluate_ensemble",
}
#: Parts of a model that held parameters, and where those are now
PARAMETERS: dict[str, str] = {
    "novelty_model": "bonus.novelty_model",
    "novelty_model.optimizer": "bonus.novelty_model.optimizer",
    "intrinsic_moments": "bonus.moments",
    "known_places": "bonus.known_cells",
}


class _MovedModule(ModuleType):
    """A module of 0.1, which finds what it held where it is now."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        old = self.__name__.removeprefix("sb3_ddiffpg.")
        for module in MODULES[old]:
            found = getattr(importlib.import_module(f"sb3_ddiffpg.{module}"), NAMES.get(name, name), None)
            if found is not None:
                if not _is_unpickling():
                    warnings.warn(
                        f"sb3_ddiffpg.{old}.{name} is sb3_ddiffpg.{module}.{NAMES.get(name, name)} now", FutureWarning
                    )
                return found
        raise AttributeError(f"sb3_ddiffpg.{old}, a module of version 0.1, had {name!r}: version 0.2 has nothing in its place")


def _is_unpickling() -> bool:
    """Whether it is a file that asks: nobody could do anything about a warning then."""
    frame = sys._getframe(2)
    return frame.f_globals.get("__name__", "").split(".")[0] in ("cloudpickle", "pickle", "stable_baselines3", "gymnasium")


def install() -> None:
    """Let the old names of modules be imported."""
    for old in MODULES:
        name = f"sb3_ddiffpg.{old}"
        sys.modules.setdefault(name, _MovedModule(name))


def parameters_of_0_1(parameters: Any) -> Any:
    """
    :param parameters: Of a model, by part, perhaps of version 0.1
    :return: The same with the parts' names of today
    """
    if not isinstance(parameters, dict):
        return parameters
    return {PARAMETERS.get(name, name): each for name, each in parameters.items()}


def state_of_0_1(tree: Any) -> Any:
    """
    :param tree: Numbers and records of a model, perhaps of version 0.1
    :return: The same in the order of today
    """
    if not isinstance(tree, dict) or "parts" in tree:
        return tree
    tree = dict(tree)
    parts: dict[str, Any] = {"bonus": {"routes": [], "cells": [], "visits": tree.pop("visits", None)}}
    if "modes" in tree:
        counters = dict(tree.get("counters") or {})
        number = counters.pop("_next_mode_number", 0)
        tree["counters"] = counters
        parts["modes"] = {"modes": tree.pop("modes"), "history": tree.pop("history", None), "next_number": number}
    return {**tree, "parts": parts}


def parts_of_0_1(attributes: dict[str, Any]) -> dict[str, Any] | None:
    """
    :param attributes: Of a model that SB3's ``load`` has set, perhaps of version 0.1; what was taken goes
    :return: What its parts knew, None of a file of today
    """
    if "visits" not in attributes:
        return None
    from sb3_ddiffpg.modes.mode import modes_state  # with PyTorch, which workers do not need

    attributes.pop("_behavior", None)
    for name in ("resolved_features", "novelty_cell_size"):
        attributes[name] = attributes.pop(f"_{name}", None)
    visits = attributes.pop("visits")
    parts: dict[str, Any] = {"bonus": {"routes": [], "cells": [], "visits": None if visits is None else visits.state_dict()}}
    if "_modes" in attributes:
        modes, history, number = (attributes.pop(name) for name in ("_modes", "mode_history", "_next_mode_number"))
        parts["modes"] = {"modes": modes_state(modes), "history": history.state_dict(), "next_number": number}
    return parts


def routes_of_0_1(buffer: Any) -> Any:
    """
    :param buffer: What a checkpoint says of the replay buffer, perhaps of version 0.1, when that knew the modes' routes
    :return: These routes, None of a file of today
    """
    return buffer.get("known_ways") if isinstance(buffer, dict) else None
