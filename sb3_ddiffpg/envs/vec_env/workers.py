"""Environments in a few worker processes, several in each, for simulators that step one environment at a time."""

import contextlib
import math
import multiprocessing
import signal
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.util import Finalize
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import CloudpickleWrapper, DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_ddiffpg.envs.snapshots import env_snapshot, restore_env
from sb3_ddiffpg.envs.vec_env.tracing import TracedEnvs
from sb3_ddiffpg.serialization.safetensors_tree import convert
from sb3_ddiffpg.utils.processors import n_processors
from sb3_ddiffpg.utils.signals import uninterrupted

# Before the first environment's turn
_NOBODY = -1


def _work(remote: Connection, parent: Connection, wrapped: CloudpickleWrapper, turn: Any) -> None:
    """
    What a worker does: it answers each command with ``("ok", result)`` or ``("error", (environment, lacks, text))``, where
    ``lacks`` says whether it was an AttributeError; a class of one's own may be known here alone.
    """
    parent.close()
    for number in (signal.SIGINT, signal.SIGTERM):  # they may reach all processes; the parent says what happens now
        signal.signal(number, signal.SIG_IGN)
    envs: DummyVecEnv | None = None
    while True:
        try:
            command, argument = remote.recv()
        except EOFError:
            break  # the parent is gone
        answered = False
        try:
            if command == "make":
                envs = _make(wrapped.var, turn)
                result: Any = (envs.observation_space, envs.action_space, envs.render_mode)
            elif command == "close":
                break
            else:
                result = _answer(envs, command, argument)
            answered = True
            remote.send(("ok", result))
        except Exception as error:  # of an environment, or of an answer that cannot be sent
            lacks = isinstance(error, AttributeError) and not answered
            remote.send(("error", (_NOBODY if answered else turn.value, lacks, traceback.format_exc())))
    if envs is not None:
        envs.close()
    remote.close()


def _make(env_fns: Sequence[Callable[[], gym.Env]], turn: Any) -> DummyVecEnv:
    made = []
    for env_idx, make in enumerate(env_fns):
        turn.value = env_idx
        made.append(make())
    envs = DummyVecEnv([partial(made.__getitem__, i) for i in range(len(made))])
    envs.envs = TracedEnvs(made, turn)
    return envs


def _answer(envs: Any, command: str, argument: Any) -> Any:
    if command == "reset":
        envs._seeds, envs._options = argument
        return envs.reset(), envs.reset_infos
    if command == "step":
        return *envs.step(argument), envs.reset_infos
    if command == "state_dict":
        return [env_snapshot(env) for env in envs.envs]
    if command == "load_state_dict":
        for env, state in zip(envs.envs, argument, strict=True):
            restore_env(env, state)
        return None
    name, arguments, keywords = argument
    indices = keywords.pop("indices", None)
    if indices is None:
        return getattr(envs, name)(*arguments, **keywords)
    answers = []
    for env_idx in indices:
        answers.append((getattr(envs, name)(*arguments, **keywords, indices=[env_idx]) or [None])[0])
    return answers


def _end(remotes: Sequence[Connection], processes: Sequence[Any]) -> None:
    try:
        for remote in remotes:
            with contextlib.suppress(OSError):  # gone already
                remote.send(("close", None))
        for process in processes:
            process.join(timeout=5)
    finally:  # also when it is interrupted: they do not listen to signals
        for process in processes:
            if process.is_alive():
                process.kill()
                process.join()
        for remote in remotes:
            remote.close()


class WorkerVecEnv(VecEnv):
    """
    SB3's ``SubprocVecEnv`` with several environments in each process: one process for each of many environments costs more
    memory than the environments, and time to tell each its action.

    An environment that raises or hangs, and a worker that dies, end the run with an error that names the environment and the
    cause.

    :param env_fns: functions that make the environments
    :param n_workers: number of processes; None: one per processor that this process may use
    :param timeout: seconds for which the environments of a worker may be at work on one answer, the first of which comes after
        the process has begun and made them; None: for ever
    :raises ValueError: if ``n_workers`` is less than 1, or ``timeout`` is not positive
    """

    def __init__(
        self, env_fns: Sequence[Callable[[], gym.Env]], n_workers: int | None = None, timeout: float | None = 300.0
    ) -> None:
        if n_workers is None:
            n_workers = n_processors()
        if n_workers < 1:
            raise ValueError(f"n_workers: {n_workers} given; accepted are whole numbers from 1 up")
        if timeout is not None and not timeout > 0:
            raise ValueError(f"timeout: {timeout} given; accepted are numbers above 0, and None")
        self.timeout = math.inf if timeout is None else timeout
        n_workers = min(n_workers, len(env_fns))
        #: First environment of each worker, and the number of environments
        self.first = np.linspace(0, len(env_fns), n_workers + 1).round().astype(int)
        # Not fork: simulators and networks have threads by then. No server that forks: a signal to all would end it, and them
        context: Any = multiprocessing.get_context("spawn")
        self.remotes: list[Connection] = []
        self.processes: list[Any] = []
        self._turns: list[Any] = []
        self._closed = self._made = False
        for first, last in zip(self.first[:-1], self.first[1:], strict=True):
            remote, theirs = context.Pipe()
            turn = context.RawValue("i", _NOBODY)
            # A daemon, so that it does not outlive a crash of this process
            process = context.Process(
                target=_work, args=(theirs, remote, CloudpickleWrapper(list(env_fns[first:last])), turn), daemon=True
            )
            process.start()
            self._turns.append(turn)
            theirs.close()
            self.remotes.append(remote)
            self.processes.append(process)
        # At the end of this process, before it waits for its daemons, which do not listen to its signals
        self._ending = Finalize(self, _end, (self.remotes, self.processes), exitpriority=10)
        #: Answers that each worker still owes
        self._owed = [0] * n_workers
        observation_space, action_space, self.render_mode = self._ask("make", [None] * n_workers)[0]
        self._made = True
        super().__init__(len(env_fns), observation_space, action_space)

    # ------------------------------------------------------------------ talking to the workers

    def _ask(self, command: str, arguments: Sequence[Any]) -> list[Any]:
        self._tell(command, arguments)
        return self._hear()

    def _tell(self, command: str, arguments: Sequence[Any]) -> None:
        if self._closed:
            raise RuntimeError("The environments are closed")
        for worker, (remote, argument) in enumerate(zip(self.remotes, arguments, strict=True)):
            while self._owed[worker]:  # somebody was interrupted before he heard it
                self._hear_one(worker)
            try:
                with uninterrupted():
                    remote.send((command, argument))
                    self._owed[worker] += 1
            except OSError:
                self._fail(worker)

    def _hear(self) -> list[Any]:
        answers = [self._hear_one(worker) for worker in range(len(self.remotes))]
        for worker, (status, result) in enumerate(answers):
            if status == "error":
                env, lacks, text = result
                message = f"{self._who(worker, env)} raised an error:\n{text}"
                if lacks:
                    raise AttributeError(message)
                self.close()
                raise RuntimeError(message)
        return [result for _, result in answers]

    def _hear_one(self, worker: int) -> tuple[str, Any]:
        remote = self.remotes[worker]
        left = self.timeout
        # In slices: while all processes are stopped (Ctrl-Z), the clock goes on
        while not wait([remote, self.processes[worker].sentinel], min(left, 1.0)):
            left -= 1.0
            if left <= 0:
                self._give_up(worker)
        try:
            # An answer may still lie in the pipe of a worker that has ended since
            if remote.poll():
                with uninterrupted():
                    answer: tuple[str, Any] = remote.recv()
                    self._owed[worker] -= 1
                    return answer
        except (EOFError, ConnectionResetError):
            pass
        return self._fail(worker)

    def _give_up(self, worker: int) -> NoReturn:
        who = self._who(worker, self._turns[worker].value)
        for process in self.processes:
            process.kill()  # who hangs would not hear that he is to close
        self.close()
        raise RuntimeError(f"{who} has hung: no answer for {self.timeout:g} seconds (timeout of WorkerVecEnv)")

    def _fail(self, worker: int) -> NoReturn:
        process = self.processes[worker]
        process.join(timeout=5)
        code = process.exitcode
        self.close()
        cause = f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"
        hint = "" if self._made else ". A script that makes such environments must do so under `if __name__ == '__main__':`"
        raise RuntimeError(f"{self._who(worker)} has died ({cause}){hint}")

    def _who(self, worker: int, turn: int = _NOBODY) -> str:
        first, last = self.first[worker], self.first[worker + 1] - 1
        return f"The worker process with environments {first} to {last}" if turn == _NOBODY else f"Environment {first + turn}"

    # ------------------------------------------------------------------ VecEnv

    def _join(self, parts: list[Any]) -> VecEnvObs:
        if isinstance(parts[0], dict):
            return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        return np.concatenate(parts)

    def _split(self, values: Any) -> list[Any]:
        return [values[first:last] for first, last in zip(self.first[:-1], self.first[1:], strict=True)]

    def reset(self) -> VecEnvObs:
        """
        :return: observations of new episodes
        """
        seeds_and_options = zip(self._split(self._seeds), self._split(self._options), strict=True)
        answers = self._ask("reset", list(seeds_and_options))
        self.reset_infos = [info for _, infos in answers for info in infos]
        self._reset_seeds()
        self._reset_options()
        return self._join([observations for observations, _ in answers])

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: shape (n_envs, *action shape)
        """
        self._tell("step", self._split(actions))

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations, rewards, dones and infos
        """
        observations, rewards, dones, infos, reset_infos = zip(*self._hear(), strict=True)
        self.reset_infos = [info for part in reset_infos for info in part]
        joined = [info for part in infos for info in part]
        return self._join(list(observations)), np.concatenate(rewards), np.concatenate(dones), joined

    def state_dict(self) -> list[Any]:
        """
        :return: of each environment what ``env_snapshot`` gives, for ``load_state_dict``
        """
        return [each for part in self._ask("state_dict", [None] * len(self.remotes)) for each in part]

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: what ``state_dict`` gave
        :raises ValueError: if it is of other environments
        """
        states = convert(state, list[Any], "environments")
        if len(states) != self.num_envs:
            raise ValueError(f"environments: {len(states)} saved, there are {self.num_envs}")
        self._ask("load_state_dict", self._split(states))

    def close(self) -> None:
        """End the workers; those that do not end by themselves are killed."""
        if self._closed:
            return
        self._closed = True
        self._ending()

    def _each(self, name: str, indices: VecEnvIndices, *arguments: Any, **keywords: Any) -> list[Any]:
        """Call a method of the workers' ``DummyVecEnv`` for some environments, which are given it as ``indices``."""
        chosen = list(self._get_indices(indices))
        local = [[i - first for i in chosen if first <= i < last] for first, last in self._ranges()]
        answers = self._ask("call", [(name, arguments, {**keywords, "indices": part}) for part in local])
        by_env = {
            first + i: value
            for (first, _), part, values in zip(self._ranges(), local, answers, strict=True)
            for i, value in zip(part, values, strict=True)
        }
        return [by_env[i] for i in chosen]

    def _ranges(self) -> list[tuple[int, int]]:
        return list(zip(self.first[:-1].tolist(), self.first[1:].tolist(), strict=True))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :param attr_name: name of an attribute
        :param indices: which environments, None for all
        :return: one value per environment
        """
        return self._each("get_attr", indices, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :param attr_name: name of an attribute
        :param value: its value
        :param indices: which environments, None for all
        """
        self._each("set_attr", indices, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        :param method_name: name of a method
        :param indices: which environments, None for all
        :return: one result per environment
        """
        return self._each("env_method", indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """
        :param wrapper_class: a wrapper
        :param indices: which environments, None for all
        :return: one answer per environment
        """
        return self._each("env_is_wrapped", indices, wrapper_class)

    def has_attr(self, attr_name: str) -> bool:
        """
        :param attr_name: name of an attribute
        :return: whether every environment has it
        """
        return all(self._ask("call", [("has_attr", (attr_name,), {})] * len(self.remotes)))

    def get_images(self) -> Sequence[np.ndarray | None]:
        """
        :return: one RGB image per environment
        """
        if self.render_mode != "rgb_array":
            return [None] * self.num_envs
        return self.env_method("render")
