"""What is remembered of episodes to plan by: where they went, by which actions, and whether they reached a goal."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.buffers.features import ModeFeatures
from sb3_ddiffpg.evaluation.rollout import episode_shares, run_episodes
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert

#: Steps that are remembered, of the newest episodes
MOST_STEPS = 400_000


class _State(msgspec.Struct, forbid_unknown_fields=True):
    lengths: np.ndarray
    success: np.ndarray
    inputs: np.ndarray
    places: np.ndarray
    actions: np.ndarray


@dataclass(frozen=True)
class Travel:
    """
    One episode, up to its goal if it reached one.

    :param inputs: What a waypoint policy sees at each step, shape [length, n_inputs], float32
    :param places: Mode features along it, terminal state included, shape [length + 1, dim], float32
    :param actions: Actions in [-1, 1], shape [length, action_dim], float32
    :param success: Whether it reached a goal
    """

    inputs: np.ndarray
    places: np.ndarray
    actions: np.ndarray
    success: bool

    def __len__(self) -> int:
        return len(self.actions)


class Senses:
    """
    Tells where an agent is, and what else it sees: the latter is what a waypoint policy goes by.

    :param observation_space: A box of numbers, or a dict of such
    :param selection: Mode features, see ``ModeFeatures``
    :raises ValueError: If the space is something else
    """

    def __init__(self, observation_space: spaces.Space, selection: Any) -> None:
        parts = observation_space.spaces.values() if isinstance(observation_space, spaces.Dict) else [observation_space]
        for part in parts:
            if not isinstance(part, spaces.Box) or is_image_space(part):
                raise ValueError(f"model: it observes {observation_space}; accepted are boxes of numbers and dicts of such")
        self.features = ModeFeatures(observation_space, selection)
        self._whole = ModeFeatures(observation_space)
        others = np.setdiff1d(np.arange(self._whole.dim), _position_components(observation_space, self.features.selection))
        # Where it sees nothing else, it may as well see where it is
        self._others = others if len(others) else np.arange(self._whole.dim)

    @property
    def n_inputs(self) -> int:
        """Number of components of what is seen besides."""
        return len(self._others)

    def places(self, observations: Any) -> np.ndarray:
        """
        :param observations: Batch of N observations, not normalised
        :return: Where that is, shape [N, dim]
        """
        return self.features(observations)

    def inputs(self, observations: Any) -> np.ndarray:
        """
        :param observations: Batch of N observations, not normalised
        :return: What else they say, shape [N, n_inputs]
        """
        return self._whole(observations)[:, self._others]


def _position_components(space: spaces.Space, selection: Any) -> np.ndarray:
    """Components of the flat observation that say where the agent is, or where it is to go."""
    if selection is None or callable(selection):  # the whole of it, or who knows which
        return np.empty(0, dtype=int)
    if not isinstance(space, spaces.Dict):
        return np.asarray(selection)
    chosen, begin = [], 0
    for key in sorted(space.spaces):
        end = begin + int(np.prod(space[key].shape or (1,)))
        if key in ("achieved_goal", "desired_goal") or (isinstance(selection, str) and key == selection):
            chosen.append(np.arange(begin, end))
        begin = end
    return np.concatenate([np.empty(0, dtype=int), *chosen, *([] if isinstance(selection, str) else [selection])])


def newest(travels: Sequence[Travel], most_steps: int = MOST_STEPS) -> list[Travel]:
    """
    :param travels: In order of finishing
    :param most_steps: Steps of all that are kept; at least one is
    :return: The last ones
    """
    total = np.cumsum([len(each) for each in reversed(travels)])
    return list(travels[len(travels) - max(int(np.searchsorted(total, most_steps, side="right")), 1) :])


def stored_travels(buffer: Any, senses: Senses) -> list[Travel]:
    """
    :param buffer: A ``ModeReplayBuffer``
    :param senses: Of its observations
    :return: The newest episodes that it holds, in order of finishing
    """
    found: list[Travel] = []
    finished = sorted(buffer.finished_trajectories(), key=lambda trajectory: -trajectory.serial)
    total = np.cumsum([each.length for each in finished])
    for each in reversed(finished[: int(np.searchsorted(total, MOST_STEPS, side="right"))]):
        before, after = (_arrays(part) for part in buffer.read_observations(each.rows))
        places = np.concatenate((senses.places(before), senses.places(after)[-1:]))
        actions = _arrays(buffer.steps.tensors(each.rows)["actions"])
        found.append(Travel(senses.inputs(before), places, actions, each.success))
    return found


def _arrays(tensors: Any) -> Any:
    return {key: _arrays(each) for key, each in tensors.items()} if isinstance(tensors, dict) else tensors.cpu().numpy()


class _Recorder:
    """Acts like an agent, of whose steps it keeps a record: for each environment a list of episodes."""

    def __init__(self, agent: Any, model: Any, senses: Senses, original: Callable[[Any], Any]) -> None:
        self.agent, self.model, self.senses, self.original = agent, model, senses, original
        self.episodes: list[list[list[tuple[np.ndarray, np.ndarray]]]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.model, name)  # which features there are, and what a success is

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None, **kwargs: Any) -> Any:
        actions, state = self.agent.predict(observation, state=state, episode_start=episode_start, **kwargs)
        inputs = self.senses.inputs(self.original(observation))
        scaled = self.model.policy.scale_action(actions).astype(np.float32)
        self.episodes = self.episodes or [[] for _ in inputs]
        for env, begins in enumerate(episode_start):
            if begins:
                self.episodes[env].append([])
            self.episodes[env][-1].append((inputs[env], scaled[env]))
        return actions, state


def recorded_travels(
    agent: Any, model: Any, senses: Senses, original: Callable[[Any], Any], env: VecEnv, n_episodes: int
) -> list[Travel]:
    """
    Run complete episodes and remember them.

    :param agent: Acts like a model
    :param model: Whose observations and actions those are
    :param senses: Of its observations
    :param original: Function that gives observations as the environment made them
    :param env: Vectorised environments
    :param n_episodes: Number of episodes
    :return: The episodes
    """
    recorder = _Recorder(agent, model, senses, original)
    results = run_episodes(recorder, env, n_episodes)
    shares = episode_shares(n_episodes, env.num_envs)
    records = [record for own, n in zip(recorder.episodes, shares, strict=True) for record in own[:n]]
    travels = []
    for record, result in zip(records, results, strict=True):
        inputs, actions = (np.array(part) for part in zip(*record[: result.length], strict=True))
        travels.append(Travel(inputs, result.path, actions, bool(result.success)))
    return travels


def travels_state(travels: Sequence[Travel]) -> dict[str, Any]:
    """
    :param travels: At least one
    :return: All that is known of them, in arrays
    """
    return {
        "lengths": np.array([len(each) for each in travels], dtype=np.int64),
        "success": np.array([each.success for each in travels]),
        **{name: np.concatenate([getattr(each, name) for each in travels]) for name in ("inputs", "places", "actions")},
    }


def travels_of_state(tree: Any, n_inputs: int, dim: int, action_dim: int) -> list[Travel]:
    """
    :param tree: What ``travels_state`` gave
    :param n_inputs: Number of components of what is seen
    :param dim: Number of mode features
    :param action_dim: Number of components of an action
    :return: The episodes
    :raises ValueError: If it is something else
    """
    state = convert(tree, _State, "planner.travels")
    check_array(state.lengths, np.int64, [None], "planner.travels.lengths")
    check_array(state.success, bool, [len(state.lengths)], "planner.travels.success")
    if not len(state.lengths) or (state.lengths < 1).any() or state.lengths.sum() != len(state.actions):
        raise ValueError("planner.travels.lengths: accepted are those of at least one episode, of all steps together")
    n = len(state.actions)
    for name, rows, size in (("inputs", n, n_inputs), ("places", n + len(state.lengths), dim), ("actions", n, action_dim)):
        array = check_array(getattr(state, name), np.float32, [rows, size], f"planner.travels.{name}")
        if not np.isfinite(array).all():
            raise ValueError(f"planner.travels.{name}: accepted are finite numbers")
    ends = np.cumsum(state.lengths)[:-1]
    places = np.split(state.places, ends + np.arange(1, len(ends) + 1))
    parts = zip(np.split(state.inputs, ends), places, np.split(state.actions, ends), state.success.tolist(), strict=True)
    return [Travel(*part) for part in parts]
