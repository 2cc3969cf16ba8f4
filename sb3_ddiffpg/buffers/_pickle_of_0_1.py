"""Replay buffers that version 0.1 has pickled."""

from typing import Any

import numpy as np

from sb3_ddiffpg.buffers.features import ModeFeatures

# What those held beside settings
_RECORDS = {
    *(
        "_allocated",
        "_free",
        "_n_free",
        "_running",
        "_running_length",
        "_running_return",
        "_groups",
        "_group_rows",
        "_retired",
    ),
    *("frozen_modes", "_n_finished", "_success_rule", "just_finished", "owner", "_distances", "_mode_position", "mode_rows"),
    *("_new_way_rows", "_feature_scale", "_last_positions", "_episode_places", "known_ways", "_last_followed", "_all"),
    *("_all_position", "saved_rows", "saved_fields", "saved_positions", "visit_cell_size", "new_way_share", "route_share"),
}


def state_of_pickle(state: dict[str, Any], fields: tuple[str, ...]) -> tuple[dict[str, Any], int, Any]:
    """
    :param state: As it was pickled, by this version or by 0.1
    :param fields: Target actions that a buffer of its class stores
    :return: Settings, number of modes, and what ``buffer_state`` would have given
    :raises ValueError: If its rows hold something else than those of these versions
    """
    if "_groups" not in state:
        return (
            {name: each for name, each in state.items() if name not in ("n_modes", "state", "owner")},
            state["n_modes"],
            state["state"],
        )
    settings = {name: each for name, each in state.items() if name not in _RECORDS}
    settings["features"] = ModeFeatures(state["observation_space"], state["features"].selection)
    settings["standardize"] = None
    settings["new_route_share"] = state["new_way_share"]
    # All buffers had them then; of those without modes this is the one that an algorithm may go on with
    settings["target_action_fields"] = fields or ("exploratory_target_actions",)
    return settings, len(state["mode_rows"]), _tree(state)


def _tree(state: dict[str, Any]) -> dict[str, Any] | None:
    if not state["_allocated"] or not state["pos"]:
        return None
    groups, retired, lengths = state["_groups"], state["_retired"], state["_running_length"]
    trajectories = [each for group in groups.values() for each in group] + list(retired)
    places = {id(each): i for i, each in enumerate(trajectories)}

    def where(members: Any) -> np.ndarray:
        return np.array([places[id(each)] for each in members], dtype=np.int64)

    def column(name: str, dtype: Any) -> np.ndarray:
        return np.array([getattr(each, name) for each in trajectories], dtype=dtype)

    no_rows = np.empty(0, dtype=np.int32)
    return {
        "layouts": [str(np.dtype(_aligned(fields))) for fields in state["saved_fields"]],
        "parts": state["saved_rows"],
        "full": state["full"],
        "stored": state["_all"].rows,
        "freed": state["_free"][: state["_n_free"]],
        "running": np.concatenate([no_rows, *(rows[:n] for rows, n in zip(state["_running"], lengths, strict=True))]),
        "running_length": lengths,
        "running_return": state["_running_return"],
        "trajectories": {
            "rows": np.concatenate([no_rows, *(each.rows for each in trajectories)]),
            "length": column("length", np.int64),
            "success": column("success", bool),
            "episode_return": column("episode_return", np.float64),
            "serial": column("serial", np.int64),
            "mode": column("mode", np.int64),
            "trains": column("trains", bool),
            "assigned_mode": np.array([-1 if t.assigned_mode is None else t.assigned_mode for t in trajectories], np.int64),
            "off_mode_success": column("off_mode_success", bool),
            "label": [each.label for each in trajectories],
        },
        "groups": [{"mode": mode, "success": success, "members": where(group)} for (mode, success), group in groups.items()],
        "retired": where(retired),
        "mode_rows": [each.rows for each in state["mode_rows"]],
        "new_route_rows": state["_new_way_rows"],
        "frozen_modes": sorted(state["frozen_modes"]),
        "n_finished": state["_n_finished"],
        "has_signal": state["_success_rule"].has_signal,
        "recent_returns": list(state["_success_rule"].recent_returns),
        "owner": state["owner"],
        "n_path_points": state["n_path_points"],
        "feature_scale": state["_feature_scale"],
        "serials": state["_distances"].serials,
        "distances": state["_distances"].distances,
        **{name: state[name] for name in ("compared_length", "loop_share", "normalize_distances")},
    }


def _aligned(description: list[Any]) -> np.dtype:
    """The type that has such a description; the gaps of an aligned one have no name there."""
    offset, names, formats, offsets = 0, [], [], []
    for name, kind, *shape in description:
        dtype = np.dtype((kind, *shape)) if shape else np.dtype(kind)
        if name:
            names.append(name)
            formats.append(dtype)
            offsets.append(offset)
        offset += dtype.itemsize
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": offset, "aligned": True})
