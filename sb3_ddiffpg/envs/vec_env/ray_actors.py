"""Environments in the actors of a Ray cluster, for simulators that outgrow one machine."""

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_ddiffpg.envs.vec_env.group import NOBODY, Actor
from sb3_ddiffpg.envs.vec_env.grouped import GroupedVecEnv, check_groups, first_of_groups

# Losses of one group in a row, without an answer between them, after which there is no further one
MOST_LOSSES = 3


class RayVecEnv(GroupedVecEnv):
    """
    ``WorkerVecEnv`` over the actors of a Ray cluster: the same numbers, step for step, on any number of machines.

    When a machine or process is lost, or does not answer, a warning names its environments and the cause, and others take
    their place, on whatever machine has room. Their episodes end there, as by a time limit: that step has
    ``info["lost"]``, a reward of 0 and the observation before it as the terminal one. An environment that raises ends the run
    with an error that names it, as on one machine.

    :param env_fns: functions that make the environments, which travel to the machines by pickle: a module of one's own must be
        there, as by ``ray.init(runtime_env={"working_dir": "."})`` before
    :param n_workers: number of actors; None: as many as the cluster has cores
    :param timeout: seconds for which an actor may be at work on one answer, to begin and to find room included; None: for ever
    :param address: of the cluster; None: the one that this process is connected to, or a new one on this machine
    :param options: of each actor, as for ``ray.remote``, such as ``{"num_cpus": 1}``, which it then has for itself. If nothing
        is said they are spread over the machines, and take a core only where others leave it
    :raises ValueError: if ``n_workers`` is less than 1, or ``timeout`` is not positive
    :raises ImportError: if Ray is not installed
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env]],
        n_workers: int | None = None,
        timeout: float | None = 300.0,
        address: str | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        try:
            import ray
        except ImportError as error:
            raise ImportError(f"Ray is an extra ({error}); install it with: pip install 'sb3_ddiffpg[cluster]'") from error
        check_groups(n_workers, timeout)
        self._ray, self.timeout = ray, timeout
        if not ray.is_initialized():
            ray.init(address, log_to_driver=False, configure_logging=False, include_dashboard=False)
        if n_workers is None:
            n_workers = max(1, math.floor(ray.cluster_resources().get("CPU", 1)))
        n_workers = min(n_workers, len(env_fns))
        self.first = first_of_groups(len(env_fns), n_workers)
        self._env_fns = [list(env_fns[first:last]) for first, last in self._ranges()]
        self._actor: Any = ray.remote(**{"scheduling_strategy": "SPREAD", **(options or {})})(Actor)
        self._closed = False
        self._asked: list[tuple[str, Any, Any]] = []
        #: Of each group what it saw last, and what a new one begins with that has taken its place since the latest step
        self._seen: list[Any] = [None] * n_workers
        self._begun: dict[int, tuple[Any, list[dict[str, Any]]]] = {}
        self.actors: list[Any] = [self._actor.remote() for _ in range(n_workers)]
        try:
            made = self._ask("make", self._env_fns)
        except BaseException:
            self.close()
            raise
        observation_space, action_space, self.render_mode = made[0]
        super().__init__(len(env_fns), observation_space, action_space)

    # ------------------------------------------------------------------ talking to the actors

    def _tell(self, command: str, arguments: Sequence[Any]) -> None:
        if self._closed:
            raise RuntimeError("The environments are closed")
        self._asked = []
        for group, argument in enumerate(arguments):
            # One that has just begun has not seen the observation that this action is for
            waits = command == "step" and group in self._begun
            reference = None if waits else self.actors[group].answer.remote(command, argument)
            self._asked.append((command, argument, reference))

    def _hear(self) -> list[Any]:
        asked, self._asked = self._asked, []
        results = self._results([self._hear_one(group, *each) for group, each in enumerate(asked)])
        for group, result in enumerate(results):
            if asked[group][0] in ("reset", "step"):
                self._seen[group] = result[0]
        return results

    def _hear_one(self, group: int, command: str, argument: Any, reference: Any) -> tuple[str, Any]:
        for n_losses in range(MOST_LOSSES):
            try:
                if n_losses:
                    reference = self._replace(group, command, argument)
                if reference is None:
                    return "ok", self._lost_step(group)
                answer: tuple[str, Any] = self._ray.get(reference, timeout=self.timeout)
                if command == "reset":
                    self._begun.pop(group, None)
                return answer
            except self._ray.exceptions.RayTaskError as error:  # the actor lives, but could not read what it was sent
                return "error", (NOBODY, False, str(error))
            except self._ray.exceptions.RayError as error:
                cause: Exception = error
                warnings.warn(f"{self._who(group)} are lost ({_short(cause)}). They begin new episodes elsewhere")
        self.close()
        raise RuntimeError(f"{self._who(group)} were lost {MOST_LOSSES} times in a row; the last time: {_short(cause)}")

    def _replace(self, group: int, command: str, argument: Any) -> Any:
        """A new actor, and the answer to the command that it is to give; None to a step, for it is where a reset leads."""
        self._ray.kill(self.actors[group])  # it may yet live
        actor = self.actors[group] = self._actor.remote()
        answer = actor.answer.remote("make", self._env_fns[group])
        if command == "make":
            return answer
        if command != "reset":
            n_envs = len(self._env_fns[group])
            begun = actor.answer.remote("reset", ([None] * n_envs, [{}] * n_envs))
            status, result = self._ray.get(begun, timeout=self.timeout)
            if status == "error":
                return begun
            self._begun[group] = result
        return None if command == "step" else actor.answer.remote(command, argument)

    def _lost_step(self, group: int) -> tuple[Any, ...]:
        """The step of environments that were lost before it, or in it."""
        observations, reset_infos = self._begun.pop(group)
        before, n_envs = self._seen[group], len(self._env_fns[group])
        last = [
            {key: each[i] for key, each in before.items()} if isinstance(before, dict) else before[i] for i in range(n_envs)
        ]
        infos = [{"TimeLimit.truncated": True, "lost": True, "terminal_observation": each} for each in last]
        return observations, np.zeros(n_envs, np.float32), np.ones(n_envs, bool), infos, reset_infos

    def _who(self, group: int, turn: int = NOBODY) -> str:
        first, last = self.first[group], self.first[group + 1] - 1
        return f"Environments {first} to {last}" if turn == NOBODY else f"Environment {first + turn}"

    def close(self) -> None:
        """End the actors. The cluster goes on."""
        if self._closed:
            return
        self._closed = True
        if self._ray.is_initialized():
            for actor in self.actors:
                self._ray.kill(actor)


def _short(error: Exception) -> str:
    said = str(error).strip().splitlines()
    return f"{type(error).__name__}: {said[0]}" if said else type(error).__name__
