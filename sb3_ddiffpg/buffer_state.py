"""All that a replay buffer holds, in plain values and arrays, and a buffer filled with it again."""

from collections import deque
from typing import Any

import msgspec
import numpy as np

from sb3_ddiffpg.buffers import ModeReplayBuffer
from sb3_ddiffpg.known_ways import Way
from sb3_ddiffpg.row_storage import HostRows
from sb3_ddiffpg.safe_files import Count, check_array, convert
from sb3_ddiffpg.trajectories import NO_MODE, RowSet, Trajectory


class _Trajectories(msgspec.Struct, forbid_unknown_fields=True):
    """N finished episodes; ``rows`` one after the other. ``commanded`` is -1 for none."""

    rows: np.ndarray
    length: np.ndarray
    success: np.ndarray
    episode_return: np.ndarray
    serial: np.ndarray
    mode: np.ndarray
    trains: np.ndarray
    commanded: np.ndarray
    foreign: np.ndarray
    label: list[str | None]


class _Group(msgspec.Struct, forbid_unknown_fields=True):
    mode: int
    success: bool
    members: np.ndarray


class _Way(msgspec.Struct, forbid_unknown_fields=True):
    number: int
    paths: np.ndarray
    radius: float


class _Buffer(msgspec.Struct, forbid_unknown_fields=True):
    layouts: list[str]
    parts: list[np.ndarray]
    full: bool
    stored: np.ndarray
    freed: np.ndarray
    running: np.ndarray
    running_length: np.ndarray
    running_return: np.ndarray
    trajectories: _Trajectories
    groups: list[_Group]
    retired: np.ndarray
    mode_rows: list[np.ndarray]
    new_way_rows: np.ndarray
    frozen_modes: list[int]
    n_finished: Count
    has_signal: bool
    recent_returns: list[float]
    owner: tuple[str, list[int]]
    n_path_points: Count
    feature_scale: np.ndarray | None
    last_positions: np.ndarray
    serials: np.ndarray
    distances: np.ndarray
    compared_length: float | None = None
    loop_share: float | None = None
    normalize_distances: bool | None = None
    known_ways: list[_Way] = []


# Settings on which they depend, beside ``n_path_points``
_OF_DISTANCES = ("compared_length", "loop_share", "normalize_distances")

# Columns of ``_Trajectories`` that have one number for each
_COLUMNS = {
    "success": bool,
    "episode_return": np.float64,
    "serial": np.int64,
    "mode": np.int64,
    "trains": bool,
    "foreign": bool,
}


def buffer_state(buffer: ModeReplayBuffer) -> dict[str, Any] | None:
    """
    :param buffer: A replay buffer
    :return: What it holds; None while that is nothing
    """
    if not buffer.pos:
        return None
    groups = [(key, list(group)) for key, group in buffer._groups.items()]
    trajectories = [each for _, group in groups for each in group] + list(buffer._retired)
    places = {id(each): i for i, each in enumerate(trajectories)}

    def where(members: Any) -> np.ndarray:
        return np.array([places[id(each)] for each in members], dtype=np.int64)

    columns = {name: np.array([getattr(each, name) for each in trajectories], dtype=dtype) for name, dtype in _COLUMNS.items()}
    lengths, running = buffer._running_length, buffer._running
    return {
        "layouts": _layouts(buffer),
        "parts": [part.dump(buffer.pos) for part in buffer._stored()],
        "full": buffer.full,
        "stored": buffer._all.rows[: buffer._all.size],
        "freed": buffer._free[: buffer._n_free],
        "running": np.concatenate([running[:0, 0], *(running[env, :n] for env, n in enumerate(lengths))]),
        "running_length": lengths,
        "running_return": buffer._running_return,
        "trajectories": {
            **columns,
            "rows": np.concatenate([running[:0, 0], *(each.rows for each in trajectories)]),
            "length": np.array([each.length for each in trajectories], dtype=np.int64),
            "commanded": np.array([-1 if t.commanded is None else t.commanded for t in trajectories], dtype=np.int64),
            "label": [each.label for each in trajectories],
        },
        "groups": [{"mode": mode, "success": success, "members": where(group)} for (mode, success), group in groups],
        "retired": where(buffer._retired),
        "mode_rows": [row_set.rows[: row_set.size] for row_set in buffer.mode_rows],
        "new_way_rows": buffer._new_way_rows,
        "frozen_modes": sorted(buffer.frozen_modes),
        "n_finished": buffer._n_finished,
        "has_signal": buffer._success_rule.has_signal,
        "recent_returns": list(buffer._success_rule.recent_returns),
        "owner": buffer.owner,
        "n_path_points": buffer.n_path_points,
        "feature_scale": buffer._feature_scale,
        "last_positions": buffer._last_positions,
        "known_ways": [{"number": way.number, "paths": way.paths, "radius": way.radius} for way in buffer.known_ways.ways],
        "serials": buffer._distances.serials,
        "distances": buffer._distances.distances,
        **{name: getattr(buffer, name) for name in _OF_DISTANCES},
    }


def restore_buffer(buffer: ModeReplayBuffer, tree: Any) -> None:
    """
    :param buffer: A replay buffer made for the same spaces and number of environments; what it holds is lost
    :param tree: What ``buffer_state`` gave
    :raises ValueError: If it is something else or contradicts itself; the buffer is as before then
    """
    if tree is None:
        n_modes = len(buffer.mode_rows)
        buffer.reset()
        buffer.expect_modes(n_modes)
        return
    state = convert(tree, _Buffer, "replay buffer")
    trajectories = _trajectories(state.trajectories)
    _check(buffer, state, trajectories)

    buffer.reset()
    buffer.allocate()
    for part, raw in zip(buffer._stored(), state.parts, strict=True):
        part.restore(raw)
    buffer.pos, buffer.full = len(state.parts[0]), state.full
    buffer._all.add(state.stored)
    buffer._free, buffer._n_free = state.freed.copy(), len(state.freed)
    ends = np.cumsum(state.running_length)
    buffer._running = np.empty((buffer.n_envs, max(64, 2 * int(state.running_length.max()))), dtype=np.int32)
    for env, (end, length) in enumerate(zip(ends, state.running_length, strict=True)):
        buffer._running[env, :length] = state.running[end - length : end]
    buffer._running_length, buffer._running_return = state.running_length.copy(), state.running_return.copy()
    for group in state.groups:
        key, members = (group.mode, group.success), [trajectories[i] for i in group.members]
        buffer._groups[key], buffer._group_rows[key] = deque(members), sum(each.length for each in members)
    buffer._retired = deque(trajectories[i] for i in state.retired)
    buffer.mode_rows = [RowSet(buffer._mode_position) for _ in state.mode_rows]
    for row_set, rows in zip(buffer.mode_rows, state.mode_rows, strict=True):
        row_set.add(rows)
    buffer._new_way_rows = state.new_way_rows
    buffer.frozen_modes = set(state.frozen_modes)
    buffer._n_finished = state.n_finished
    buffer._success_rule.has_signal = state.has_signal
    buffer._success_rule.recent_returns.extend(state.recent_returns)
    buffer.owner = state.owner
    buffer._feature_scale, buffer._last_positions = state.feature_scale, state.last_positions
    if all(getattr(state, name) == getattr(buffer, name) for name in _OF_DISTANCES):  # else they are of other paths
        buffer._distances.serials, buffer._distances.distances = state.serials, state.distances
    buffer.known_ways.replace([Way(way.number, way.paths, way.radius) for way in state.known_ways])
    buffer.recall_places()


def _layouts(buffer: ModeReplayBuffer) -> list[str]:
    """What the rows are made of."""
    return [str(dtype) for dtype in _row_dtypes(buffer)]


def _row_dtypes(buffer: ModeReplayBuffer) -> list[np.dtype]:
    return [HostRows(0, part).dtype for part in buffer.part_fields()]


def _trajectories(columns: _Trajectories) -> list[Trajectory]:
    n = len(columns.label)
    check_array(columns.length, np.int64, [n], "replay buffer.trajectories.length")
    for name, dtype in {**_COLUMNS, "commanded": np.int64}.items():
        check_array(getattr(columns, name), dtype, [n], f"replay buffer.trajectories.{name}")
    check_array(columns.rows, np.int32, [None], "replay buffer.trajectories.rows")
    if (columns.length < 1).any() or columns.length.sum() != len(columns.rows):
        raise ValueError("replay buffer.trajectories: their lengths do not fit their rows")
    if len(np.unique(columns.serial)) != n:
        raise ValueError("replay buffer.trajectories: two have the same serial number")
    ends = np.cumsum(columns.length)
    return [
        Trajectory(
            rows=columns.rows[ends[i] - columns.length[i] : ends[i]].copy(),
            commanded=None if columns.commanded[i] < 0 else int(columns.commanded[i]),
            label=columns.label[i],
            **{name: getattr(columns, name)[i].item() for name in _COLUMNS},
        )
        for i in range(n)
    ]


def _check(buffer: ModeReplayBuffer, state: _Buffer, trajectories: list[Trajectory]) -> None:
    """All rows are somebody's, once, and all that is said about them fits."""
    if state.n_path_points != buffer.n_path_points:
        raise ValueError(f"replay buffer: n_path_points={state.n_path_points} there, {buffer.n_path_points} in the model")
    if len(state.mode_rows) != len(buffer.mode_rows):
        raise ValueError(f"replay buffer: of {len(state.mode_rows)} modes, the model has {len(buffer.mode_rows)}")
    _check_arrays(buffer, state)
    pos, n_modes = len(state.parts[0]), len(state.mode_rows)
    empty = np.zeros(0, dtype=np.int32)
    owned = np.concatenate([empty, state.running, *(each.rows for each in trajectories)])
    _check_partition(owned, state.stored, "rows that are stored, but not in one trajectory each")
    _check_partition(np.concatenate((state.stored, state.freed)), np.arange(pos), "rows neither stored nor free, or both")
    members = np.concatenate([state.retired, *(group.members for group in state.groups)])
    _check_partition(members, np.arange(len(trajectories)), "trajectories that are not in one group each")
    for mode, rows in enumerate(state.mode_rows):
        own = np.concatenate([empty, *(each.rows for each in trajectories if each.trains and each.mode == mode)])
        _check_partition(own, rows, f"rows of mode {mode}, but not of the trajectories that train it")
    next_rows = state.parts[-1].view(_row_dtypes(buffer)[-1])[:, 0]["next_row"][state.stored]
    problems = {
        "a mode that is not there": any(not NO_MODE <= each.mode < n_modes for each in trajectories),
        "a trajectory that trains no mode": any(each.trains and each.mode == NO_MODE for each in trajectories),
        "two groups of the same": len({(group.mode, group.success) for group in state.groups}) < len(state.groups),
        "a group with another mode's member": any(trajectories[i].mode != g.mode for g in state.groups for i in g.members),
        "a known way that cannot be": not all(_can_be(way) for way in state.known_ways),
        "new ways that are not stored": not np.isin(state.new_way_rows, state.stored).all(),
        "frozen modes that are not there": not set(state.frozen_modes) <= set(range(n_modes)),
        "a trajectory from the future": any(each.serial >= state.n_finished for each in trajectories),
        "a number that is not finite": not _finite(buffer, state),
        "a row that is followed by none of its rows": bool(((next_rows < -1) | (next_rows >= pos)).any()),
    }
    for problem, found in problems.items():
        if found:
            raise ValueError(f"replay buffer: there is {problem}")


def _finite(buffer: ModeReplayBuffer, state: _Buffer) -> bool:
    """Of rows in use, and of what was gathered from them."""
    parts = [raw.view(dtype)[:, 0][state.stored] for raw, dtype in zip(state.parts, _row_dtypes(buffer), strict=True)]
    numbers = [part[name] for part in parts for name in part.dtype.names or () if part[name].dtype.kind == "f"]
    numbers += [state.running_return, state.trajectories.episode_return, state.last_positions, state.distances]
    numbers += [np.array(state.recent_returns), *([] if state.feature_scale is None else [state.feature_scale])]
    return all(np.isfinite(each).all() for each in numbers)


def _can_be(way: _Way) -> bool:
    return bool(0 <= way.number < 2**31 and len(way.paths) and np.isfinite(way.paths).all() and 0 <= way.radius < np.inf)


def _check_arrays(buffer: ModeReplayBuffer, state: _Buffer) -> None:
    if state.layouts != _layouts(buffer):
        raise ValueError(f"replay buffer: its rows hold {state.layouts}, those of the model {_layouts(buffer)}")
    dtypes = _row_dtypes(buffer)
    if len(state.parts) != len(dtypes):
        raise ValueError(f"replay buffer.parts: {len(state.parts)} given; accepted are {len(dtypes)}")
    pos = len(state.parts[0])
    if not 0 < pos <= buffer.buffer_size:
        raise ValueError(f"replay buffer: {pos} rows do not fit buffer_size={buffer.buffer_size}")
    n_known = len(state.serials)
    expected: list[Any] = [
        *((f"parts[{i}]", state.parts[i], np.uint8, [pos, dtype.itemsize]) for i, dtype in enumerate(dtypes)),
        *((name, getattr(state, name), np.int32, [None]) for name in ("stored", "freed", "running", "new_way_rows")),
        ("running_length", state.running_length, np.int64, [buffer.n_envs]),
        ("running_return", state.running_return, np.float64, [buffer.n_envs]),
        ("retired", state.retired, np.int64, [None]),
        ("last_positions", state.last_positions, np.float32, [buffer.n_envs, buffer.features.dim]),
        *(
            (f"known_ways[{i}]", way.paths, np.float32, [None, buffer.n_path_points, buffer.features.dim])
            for i, way in enumerate(state.known_ways)
        ),
        ("serials", state.serials, np.int64, [None]),
        ("distances", state.distances, np.float32, [n_known, n_known]),
        *((f"mode_rows[{i}]", rows, np.int32, [None]) for i, rows in enumerate(state.mode_rows)),
        *((f"groups[{i}]", group.members, np.int64, [None]) for i, group in enumerate(state.groups)),
    ]
    if state.feature_scale is not None:
        expected.append(("feature_scale", state.feature_scale, np.float32, [buffer.features.dim]))
    for name, array, dtype, shape in expected:
        check_array(array, dtype, shape, f"replay buffer.{name}")
    if (state.running_length < 0).any() or state.running_length.sum() != len(state.running):
        raise ValueError("replay buffer.running: the lengths do not fit the rows")
    if (np.diff(state.serials) <= 0).any():
        raise ValueError("replay buffer.serials must ascend")


def _check_partition(parts: np.ndarray, whole: np.ndarray, problem: str) -> None:
    """Each of ``whole`` is in ``parts``, once, and nothing else."""
    if not np.array_equal(np.sort(parts), np.sort(whole)):
        raise ValueError(f"replay buffer: there are {problem}")
