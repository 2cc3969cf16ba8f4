"""All that a replay buffer holds, in plain values and arrays, and a buffer filled with it again."""

from collections import deque
from typing import Any

import msgspec
import numpy as np

from sb3_ddiffpg.buffers.storage import Fields, HostRows
from sb3_ddiffpg.buffers.trajectory import PAST_GOAL, Trajectory
from sb3_ddiffpg.serialization.safetensors_tree import Count, check_array, convert


class _Trajectories(msgspec.Struct, forbid_unknown_fields=True):
    """N finished episodes; ``rows`` one after the other. ``assigned_mode`` is -1 for none."""

    rows: np.ndarray
    length: np.ndarray
    success: np.ndarray
    episode_return: np.ndarray
    serial: np.ndarray
    mode: np.ndarray
    trains: np.ndarray
    assigned_mode: np.ndarray
    off_mode_success: np.ndarray
    label: list[str | None]


class _Group(msgspec.Struct, forbid_unknown_fields=True):
    mode: int
    success: bool
    members: np.ndarray


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
    new_route_rows: np.ndarray
    frozen_modes: list[int]
    n_finished: Count
    has_signal: bool
    recent_returns: list[float]
    owner: tuple[str, list[int]]
    n_path_points: Count
    feature_scale: np.ndarray | None
    serials: np.ndarray
    distances: np.ndarray
    compared_length: float | None = None
    loop_share: float | None = None
    normalize_distances: bool | None = None
    episode_steps: np.ndarray | None = None
    goal_steps: np.ndarray | None = None
    goal_labels: list[str | None] | None = None
    unfounded_modes: list[int] | None = None
    has_goal: bool | None = None


# Settings on which they depend, beside ``n_path_points``
_OF_DISTANCES = ("compared_length", "loop_share", "normalize_distances")

# Columns of ``_Trajectories`` that have one number for each
_COLUMNS = {
    "success": bool,
    "episode_return": np.float64,
    "serial": np.int64,
    "mode": np.int64,
    "trains": bool,
    "off_mode_success": bool,
}


def buffer_state(buffer: Any) -> dict[str, Any] | None:
    """
    :param buffer: A ``ModeReplayBuffer``
    :return: What it holds; None while that is nothing
    """
    if not buffer.pos:
        return None
    groups, running, retired = buffer.groups.members, buffer.running, buffer.groups.retired
    rule = buffer.success_rule
    trajectories = [each for group in groups.values() for each in group] + list(retired)
    places = {id(each): i for i, each in enumerate(trajectories)}

    def where(members: Any) -> np.ndarray:
        return np.array([places[id(each)] for each in members], dtype=np.int64)

    columns = {name: np.array([getattr(each, name) for each in trajectories], dtype=dtype) for name, dtype in _COLUMNS.items()}
    return {
        "layouts": _layouts(buffer.part_fields()),
        "parts": [part.dump(buffer.pos) for part in buffer.parts],
        "full": buffer.full,
        "stored": buffer.stored_rows.rows[: buffer.stored_rows.size],
        "freed": buffer.free_rows.all(),
        "running": running.all_rows(),
        "running_length": running.lengths,
        "running_return": running.returns,
        "trajectories": {
            **columns,
            "rows": np.concatenate([running.rows[:0, 0], *(each.rows for each in trajectories)]),
            "length": np.array([each.length for each in trajectories], dtype=np.int64),
            "assigned_mode": np.array([-1 if t.assigned_mode is None else t.assigned_mode for t in trajectories], np.int64),
            "label": [each.label for each in trajectories],
        },
        "groups": [{"mode": mode, "success": success, "members": where(group)} for (mode, success), group in groups.items()],
        "retired": where(retired),
        "mode_rows": [row_set.rows[: row_set.size] for row_set in buffer.mode_rows],
        "new_route_rows": buffer.new_route_rows,
        "frozen_modes": sorted(buffer.groups.frozen_modes),
        "n_finished": buffer.n_finished,
        "has_signal": rule.has_signal,
        "has_goal": rule.has_goal,
        "recent_returns": list(rule.recent_returns),
        "episode_steps": rule.steps,
        "goal_steps": rule.goal_steps,
        "goal_labels": list(rule.labels),
        "unfounded_modes": sorted(buffer.unfounded_modes),
        "owner": buffer.owner,
        "n_path_points": buffer.n_path_points,
        "feature_scale": buffer.feature_scale,
        "serials": buffer.distances.serials,
        "distances": buffer.distances.distances,
        **{name: getattr(buffer, name) for name in _OF_DISTANCES},
    }


def restore_buffer(buffer: Any, tree: Any) -> None:
    """
    :param buffer: A ``ModeReplayBuffer`` made for the same spaces and number of environments; what it holds is lost
    :param tree: What ``buffer_state`` gave, here or in version 0.1
    :raises ValueError: If it is something else or contradicts itself; the buffer is as before then
    """
    if tree is None:
        n_modes = len(buffer.mode_rows)
        buffer.reset()
        buffer.expect_modes(n_modes)
        return
    state = convert(from_0_1(tree), _Buffer, "replay buffer")
    own, old = buffer.part_fields(), fields_of_0_1(buffer)
    if state.layouts == _layouts(old) and len(state.parts) == len(old):
        pairs = [(HostRows(0, before).dtype, HostRows(0, now).dtype) for before, now in zip(old, own, strict=True)]
        state.parts = [_converted(raw, *pair) for raw, pair in zip(state.parts, pairs, strict=True)]
        state.layouts = _layouts(own)
    trajectories = _trajectories(state.trajectories)
    _check(buffer, state, trajectories)

    buffer.reset()
    buffer.allocate()
    for part, raw in zip(buffer.parts, state.parts, strict=True):
        part.restore(raw)
    buffer.pos, buffer.full = len(state.parts[0]), state.full
    buffer.stored_rows.add(state.stored)
    buffer.free_rows.restore(state.freed)
    buffer.running.restore(state.running, state.running_length, state.running_return)
    for group in state.groups:
        key, members = (group.mode, group.success), [trajectories[i] for i in group.members]
        buffer.groups.members[key], buffer.groups.n_rows[key] = deque(members), sum(each.length for each in members)
    buffer.groups.retired = deque(trajectories[i] for i in state.retired)
    buffer.mode_rows = [buffer.make_row_set() for _ in state.mode_rows]
    for row_set, rows in zip(buffer.mode_rows, state.mode_rows, strict=True):
        row_set.add(rows)
    buffer.new_route_rows = state.new_route_rows
    buffer.groups.frozen_modes = set(state.frozen_modes)
    buffer.n_finished = state.n_finished
    rule = buffer.success_rule
    rule.has_signal = rule.has_key = rule.has_goal = state.has_signal
    if state.has_goal is not None:  # of later versions than 0.1
        rule.has_goal = state.has_goal
    rule.recent_returns.extend(state.recent_returns)
    rule.steps = (state.running_length if state.episode_steps is None else state.episode_steps).copy()
    if state.goal_steps is not None and state.goal_labels is not None:
        rule.goal_steps, rule.labels = state.goal_steps.copy(), state.goal_labels
    buffer.unfounded_modes = set(state.unfounded_modes or ())
    buffer.owner = state.owner
    if state.feature_scale is not None:
        buffer.feature_scale = state.feature_scale
    if all(getattr(state, name) == getattr(buffer, name) for name in _OF_DISTANCES):  # else they are of other paths
        buffer.distances.serials, buffer.distances.distances = state.serials, state.distances


# ------------------------------------------------------------------ files of version 0.1

_NOTES_OF_0_1 = {"off_mode_success": "foreign", "route_novelty": "way_novelty"}
_COLUMNS_OF_0_1 = {"assigned_mode": "commanded", "off_mode_success": "foreign"}


def from_0_1(tree: Any) -> Any:
    """
    :param tree: What ``buffer_state`` gave, perhaps in version 0.1
    :return: The same with the names of today
    """
    if not isinstance(tree, dict):
        return tree
    tree = {"new_route_rows" if name == "new_way_rows" else name: each for name, each in tree.items()}
    for of_the_bonus in ("last_positions", "known_ways"):
        tree.pop(of_the_bonus, None)
    columns = tree.get("trajectories")
    if isinstance(columns, dict):
        now = {old: name for name, old in _COLUMNS_OF_0_1.items()}
        tree["trajectories"] = {now.get(name, name): each for name, each in columns.items()}
    return tree


def fields_of_0_1(buffer: Any) -> tuple[Fields, ...]:
    """
    :param buffer: A ``ModeReplayBuffer``
    :return: What the parts of its rows held in version 0.1: names of then, and target actions of each algorithm
    """
    steps, nexts, _ = buffer.part_fields()
    own = {name: each for name, each in steps.items() if name not in buffer.target_action_fields}
    targets = dict.fromkeys(("target_actions", "exploratory_target_actions"), steps["actions"])
    return {**own, **targets}, nexts, {_NOTES_OF_0_1.get(name, name): each for name, each in buffer.note_fields().items()}


def _converted(raw: np.ndarray, old: np.dtype, new: np.dtype) -> np.ndarray:
    """Bytes of rows of version 0.1, as bytes of today's."""
    if raw.dtype != np.uint8 or raw.ndim != 2 or raw.shape[1] != old.itemsize:
        raise ValueError(f"replay buffer.parts: {raw.dtype} {raw.shape} given; accepted are rows of {old.itemsize} bytes")
    before, made = raw.view(old)[:, 0], np.zeros((len(raw), new.itemsize), dtype=np.uint8)
    after = made.view(new)[:, 0]
    for name in new.names or ():
        after[name] = before[_NOTES_OF_0_1.get(name, name) if _NOTES_OF_0_1.get(name) in (old.names or ()) else name]
    return made


# ------------------------------------------------------------------ checks


def _layouts(parts: Any) -> list[str]:
    """What the rows are made of."""
    return [str(HostRows(0, part).dtype) for part in parts]


def _row_dtypes(buffer: Any) -> list[np.dtype]:
    return [HostRows(0, part).dtype for part in buffer.part_fields()]


def _trajectories(columns: _Trajectories) -> list[Trajectory]:
    n = len(columns.label)
    check_array(columns.length, np.int64, [n], "replay buffer.trajectories.length")
    for name, dtype in {**_COLUMNS, "assigned_mode": np.int64}.items():
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
            assigned_mode=None if columns.assigned_mode[i] < 0 else int(columns.assigned_mode[i]),
            label=columns.label[i],
            **{name: getattr(columns, name)[i].item() for name in _COLUMNS},
        )
        for i in range(n)
    ]


def _check(buffer: Any, state: _Buffer, trajectories: list[Trajectory]) -> None:
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
        "a mode that is not there": any(not PAST_GOAL <= each.mode < n_modes for each in trajectories),
        "a trajectory that trains no mode": any(each.trains and each.mode < 0 for each in trajectories),
        "a success past a goal": any(each.success and each.mode == PAST_GOAL for each in trajectories),
        "two groups of the same": len({(group.mode, group.success) for group in state.groups}) < len(state.groups),
        "a group with another mode's member": any(trajectories[i].mode != g.mode for g in state.groups for i in g.members),
        "new routes that are not stored": not np.isin(state.new_route_rows, state.stored).all(),
        "frozen modes that are not there": not set(state.frozen_modes) <= set(range(n_modes)),
        "unfounded modes that are not there": not set(state.unfounded_modes or ()) <= set(range(n_modes)),
        "a trajectory from the future": any(each.serial >= state.n_finished for each in trajectories),
        "a number that is not finite": not _finite(buffer, state),
        "a row that is followed by none of its rows": bool(((next_rows < -1) | (next_rows >= pos)).any()),
    }
    for problem, found in problems.items():
        if found:
            raise ValueError(f"replay buffer: there is {problem}")


def _finite(buffer: Any, state: _Buffer) -> bool:
    """Of rows in use, and of what was gathered from them."""
    parts = [raw.view(dtype)[:, 0][state.stored] for raw, dtype in zip(state.parts, _row_dtypes(buffer), strict=True)]
    numbers = [part[name] for part in parts for name in part.dtype.names or () if part[name].dtype.kind == "f"]
    numbers += [state.running_return, state.trajectories.episode_return, state.distances]
    numbers += [np.array(state.recent_returns), *([] if state.feature_scale is None else [state.feature_scale])]
    return all(np.isfinite(each).all() for each in numbers)


def _check_arrays(buffer: Any, state: _Buffer) -> None:
    if state.layouts != (own := _layouts(buffer.part_fields())):
        raise ValueError(f"replay buffer: its rows hold {state.layouts}, those of the model {own}")
    dtypes = _row_dtypes(buffer)
    if len(state.parts) != len(dtypes):
        raise ValueError(f"replay buffer.parts: {len(state.parts)} given; accepted are {len(dtypes)}")
    pos = len(state.parts[0])
    if not 0 < pos <= buffer.buffer_size:
        raise ValueError(f"replay buffer: {pos} rows do not fit buffer_size={buffer.buffer_size}")
    n_known = len(state.serials)
    expected: list[Any] = [
        *((f"parts[{i}]", state.parts[i], np.uint8, [pos, dtype.itemsize]) for i, dtype in enumerate(dtypes)),
        *((name, getattr(state, name), np.int32, [None]) for name in ("stored", "freed", "running", "new_route_rows")),
        ("running_length", state.running_length, np.int64, [buffer.n_envs]),
        ("running_return", state.running_return, np.float64, [buffer.n_envs]),
        ("retired", state.retired, np.int64, [None]),
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
    _check_episodes(buffer, state)
    if (np.diff(state.serials) <= 0).any():
        raise ValueError("replay buffer.serials must ascend")


def _check_episodes(buffer: Any, state: _Buffer) -> None:
    """How long the running episodes are, and where they have reached their goals."""
    steps = state.running_length if state.episode_steps is None else state.episode_steps
    goals = np.zeros_like(steps) if state.goal_steps is None else state.goal_steps
    for name, array in (("episode_steps", steps), ("goal_steps", goals)):
        check_array(array, np.int64, [buffer.n_envs], f"replay buffer.{name}")
    if (steps < state.running_length).any() or (goals < 0).any() or (goals > steps).any():
        raise ValueError("replay buffer.episode_steps, goal_steps: accepted are those of episodes as long as the running ones")
    if state.goal_labels is not None and len(state.goal_labels) != buffer.n_envs:
        raise ValueError(f"replay buffer.goal_labels: {len(state.goal_labels)} given; accepted are {buffer.n_envs}")


def _check_partition(parts: np.ndarray, whole: np.ndarray, problem: str) -> None:
    """Each of ``whole`` is in ``parts``, once, and nothing else."""
    if not np.array_equal(np.sort(parts), np.sort(whole)):
        raise ValueError(f"replay buffer: there are {problem}")
