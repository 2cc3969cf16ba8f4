"""One body in a maze (:class:`MazeEnv`), or many at once (:class:`MazeVecEnv`), step for step the same."""

import warnings
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import msgspec
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_ddiffpg.envs.mazes.drawing import Image
from sb3_ddiffpg.envs.mazes.maze import MazeMap
from sb3_ddiffpg.envs.mazes.simulation import MazeSimulation
from sb3_ddiffpg.serialization.random_states import restore_generator
from sb3_ddiffpg.serialization.safetensors_tree import check_array, convert

#: Edge of the floor's cells in which visits are counted, in metres
NOVELTY_CELL, VISIT_CELL = 0.5, 1.0
# A step takes 0.1 s, whatever the body
_METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}


def _check_render_mode(render_mode: str | None) -> None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode: {render_mode!r} given; accepted are None and 'rgb_array'")


def reset_info(simulation: MazeSimulation, i: int) -> dict[str, Any]:
    """
    :param simulation: of a maze
    :param i: index of a body that has begun an episode
    :return: what ``reset`` tells of it
    """
    return {"blocked": simulation.blocked[i]} if simulation.has_obstacles else {}


class _EnvState(msgspec.Struct, forbid_unknown_fields=True):
    simulation: Any
    random: Any


class _VecState(msgspec.Struct, forbid_unknown_fields=True):
    simulation: Any
    random: list[Any]
    steps: np.ndarray


class MazeEnv(gym.Env[npt.NDArray[Any], npt.NDArray[Any]]):
    """
    A body that is to reach a goal it does not see.

    An episode terminates at a goal with that goal's reward; every other reward is 0. ``info`` holds on every step
    ``is_success``, ``goal_id`` and ``mode`` (the label of the route it came, see :meth:`Maze.label
    <sb3_ddiffpg.envs.mazes.maze.Maze.label>`); the last two are None until a goal is reached. Where obstacles change, the info
    of ``reset`` holds ``blocked``, their cells. The time limit is the registration's.

    :param maze_map: ``"V1"`` to ``"V4"`` or a map of one's own
    :param render_mode: None or ``"rgb_array"``
    :param kwargs: further arguments of the simulation
    """

    metadata = _METADATA
    simulation_class: ClassVar[type[MazeSimulation]]

    def __init__(self, maze_map: MazeMap = "V1", render_mode: str | None = None, **kwargs: Any) -> None:
        _check_render_mode(render_mode)
        self.simulation = self.simulation_class(1, maze_map=maze_map, **kwargs)
        self.maze = self.simulation.maze
        #: Indices of the position in the observation.
        self.mode_features = np.array([0, 1])
        self.listed_modes = self.maze.listed_routes
        self.cell_size, self.novelty_cell_size = VISIT_CELL, NOVELTY_CELL
        self.observation_space = self.simulation.observation_space()
        self.action_space = self.simulation.action_space()
        self.render_mode = render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """
        :param seed: new seed of ``np_random``
        :param options: see :meth:`MazeSimulation.draw_start`
        :return: observation and info
        """
        super().reset(seed=seed)
        self.simulation.place([0], [self.simulation.draw_start(self.np_random, options)])
        return self.simulation.observations()[0], reset_info(self.simulation, 0)

    def step(self, action: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """
        :param action: in [-1, 1]
        :return: observation, reward, terminated, truncated (never), info
        """
        goal_id = int(self.simulation.move(np.asarray(action)[None])[0])
        info: dict[str, Any] = {"is_success": goal_id >= 0, "goal_id": None, "mode": None}
        if goal_id >= 0:
            info.update(goal_id=goal_id, mode=self.simulation.label(0, goal_id))
        terminated = (goal_id >= 0 and self.simulation.changes.ends_at_goal) or bool(self.simulation.lost()[0])
        return self.simulation.observations()[0], float(self.simulation.rewards[goal_id]), terminated, False, info

    def state_dict(self) -> dict[str, Any]:
        """
        :return: where the episode is, and the state of ``np_random``, for ``load_state_dict``
        """
        return {"simulation": self.simulation.state_dict(), "random": self.np_random.bit_generator.state}

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: what ``state_dict`` gave
        :raises ValueError: if it is of another environment
        """
        known = convert(state, _EnvState, "environment")
        self.simulation.load_state_dict(known.simulation)
        restore_generator(self.np_random, known.random)

    def render(self) -> Image | None:
        """
        :return: RGB image if the render mode is ``"rgb_array"``
        """
        return self.simulation.draw(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Release what pictures needed."""
        self.simulation.close()


class MazeVecEnv(VecEnv):
    """
    Many :class:`MazeEnv` in one process, moved together (no gymnasium wrappers in between).

    Seeded alike, it gives what ``DummyVecEnv`` gives over that many time-limited environments, bit for bit. The
    environments share their attributes, so that ``set_attr`` changes all of them at once.

    :param n_envs: number of environments
    :param maze_map: ``"V1"`` to ``"V4"`` or a map of one's own
    :param render_mode: None or ``"rgb_array"``
    :param max_episode_steps: episodes are truncated after this many steps
    :param kwargs: further arguments of the simulation
    """

    simulation_class: ClassVar[type[MazeSimulation]]

    def __init__(
        self,
        n_envs: int,
        maze_map: MazeMap = "V1",
        render_mode: str | None = None,
        max_episode_steps: int = 150,
        **kwargs: Any,
    ) -> None:
        if n_envs < 1:
            raise ValueError(f"n_envs: {n_envs} given; accepted are whole numbers from 1 up")
        if max_episode_steps < 1:
            raise ValueError(f"max_episode_steps: {max_episode_steps} given; accepted are whole numbers from 1 up")
        _check_render_mode(render_mode)
        self.simulation = self.simulation_class(n_envs, maze_map=maze_map, **kwargs)
        self.maze = self.simulation.maze
        self.mode_features = np.array([0, 1])
        self.listed_modes = self.maze.listed_routes
        self.cell_size, self.novelty_cell_size = VISIT_CELL, NOVELTY_CELL
        self.max_episode_steps = max_episode_steps
        self.spec: EnvSpec | None = None
        # VecEnv's constructor asks get_attr for the render mode
        self.num_envs, self.render_mode = n_envs, render_mode
        super().__init__(n_envs, self.simulation.observation_space(), self.simulation.action_space())
        self.metadata = _METADATA
        self._rngs = [seeding.np_random()[0] for _ in range(n_envs)]
        self._steps = np.zeros(n_envs, dtype=np.int64)
        self._actions = np.zeros((n_envs, self.simulation.action_dim))

    def reset(self) -> npt.NDArray[np.float32]:
        """
        :return: observations, shape (n_envs, observation dim)
        """
        for i, seed in enumerate(self._seeds):
            if seed is not None:
                self._rngs[i] = seeding.np_random(seed)[0]
        self._begin(range(self.num_envs), self._options)
        # Seeds and options are used once
        self._reset_seeds()
        self._reset_options()
        return self.simulation.observations()

    def _begin(self, indices: Sequence[int], options: Sequence[dict[str, Any]]) -> None:
        starts = [self.simulation.draw_start(self._rngs[i], o) for i, o in zip(indices, options, strict=True)]
        self.simulation.place(indices, starts)
        self._steps[indices] = 0
        for i in indices:
            self.reset_infos[i] = reset_info(self.simulation, i)

    def step_async(self, actions: npt.NDArray[np.float32]) -> None:
        """
        :param actions: shape (n_envs, action dim)
        """
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations, rewards, dones and infos; environments that are done have begun a new episode
        """
        goal_ids = self.simulation.move(self._actions)
        self._steps += 1
        terminated = ((goal_ids >= 0) & self.simulation.changes.ends_at_goal) | self.simulation.lost()
        dones = terminated | (self._steps >= self.max_episode_steps)
        observations = self.simulation.observations()
        ongoing = {"is_success": False, "goal_id": None, "mode": None, "TimeLimit.truncated": False}
        infos: list[dict[str, Any]] = [ongoing.copy() for _ in range(self.num_envs)]
        for i in np.flatnonzero(goal_ids >= 0).tolist():
            goal_id = int(goal_ids[i])
            infos[i].update(is_success=True, goal_id=goal_id, mode=self.simulation.label(i, goal_id))
        done = np.flatnonzero(dones).tolist()
        if done:
            for i in done:
                infos[i]["TimeLimit.truncated"] = not terminated[i]
                infos[i]["terminal_observation"] = observations[i].copy()
            self._begin(done, [{}] * len(done))
            observations = self.simulation.observations()
        return observations, self.simulation.rewards[goal_ids].astype(np.float32), dones, infos

    def state_dict(self) -> dict[str, Any]:
        """
        :return: where the episodes are, and the random states of the next ones, for ``load_state_dict``
        """
        random = [rng.bit_generator.state for rng in self._rngs]
        return {"simulation": self.simulation.state_dict(), "random": random, "steps": self._steps}

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: what ``state_dict`` gave
        :raises ValueError: if it is of other environments
        """
        known = convert(state, _VecState, "environments")
        steps = check_array(known.steps, np.int64, [self.num_envs], "environments.steps")
        if len(known.random) != self.num_envs:
            raise ValueError(f"environments.random: {len(known.random)} states for {self.num_envs} environments")
        self.simulation.load_state_dict(known.simulation)
        for rng, each in zip(self._rngs, known.random, strict=True):
            restore_generator(rng, each)
        self._steps = steps.copy()

    def close(self) -> None:
        """Release what pictures needed."""
        self.simulation.close()

    def get_images(self) -> Sequence[Image | None]:
        """
        :return: one RGB image per environment, or None each without ``render_mode="rgb_array"``
        """
        if self.render_mode != "rgb_array":
            warnings.warn(f"The render mode is {self.render_mode}, but images need `rgb_array`.", stacklevel=2)
        return self.env_method("render")

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :param attr_name: an attribute of the single environment
        :param indices: which environments, None for all
        :return: one value per environment
        """
        if attr_name == "np_random":
            return [self._rngs[i] for i in self._get_indices(indices)]
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :param attr_name: attribute to set, of all environments at once
        :param value: its value
        :param indices: None, or all of them
        :raises ValueError: if only some environments are meant
        """
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ValueError(f"indices: {indices} given; the environments share their attributes, accepted is all or None")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        :param method_name: ``"render"``, the one method of a single environment that leaves the others alone
        :param indices: which environments, None for all
        :return: one result per environment
        :raises AttributeError: for another method
        """
        if method_name != "render":
            raise AttributeError(
                f"method_name: {method_name!r} given; the environments of {type(self).__name__} have 'render' alone"
            )
        visible = self.render_mode == "rgb_array"
        return [self.simulation.draw(i) if visible else None for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """
        :param wrapper_class: any
        :param indices: which environments, None for all
        :return: False for each
        """
        return [False for _ in self._get_indices(indices)]
