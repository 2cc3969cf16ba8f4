"""The zoo's manager of one training, for this package's algorithms and tasks."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import SimpleLinearSchedule
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from sb3_ddiffpg.callbacks.checkpoint import RunCheckpointCallback
from sb3_ddiffpg.callbacks.live import LiveCallback
from sb3_ddiffpg.common.schedules import LateLinearSchedule
from sb3_ddiffpg.envs import is_ours, make_vec_env
from sb3_ddiffpg.envs.description import wrappers_said
from sb3_ddiffpg.envs.vec_env.ray_actors import RayVecEnv
from sb3_ddiffpg.envs.vec_env.tracing import TracingDummyVecEnv
from sb3_ddiffpg.envs.vec_env.workers import WorkerVecEnv
from sb3_ddiffpg.saving.algorithm import SavableAlgorithm
from sb3_ddiffpg.utils.arguments import one_by_one
from sb3_ddiffpg.utils.disk import spared_monitor
from sb3_ddiffpg.zoo.settings import ALGOS, check_hyperparameters

# How a learning rate may be given: 3e-4, `lin_3e-4`, `late_3e-4`
SCHEDULES: dict[str, Callable[[float], Any]] = {"": float, "lin": SimpleLinearSchedule, "late": LateLinearSchedule}


def _spared(wrapper: Callable[[Any], Any] | None, said: list[dict[str, Any]], env: Any) -> Any:
    """The zoo's wrapper around SB3's monitor, which a full disk does not end. It says of which wrappers it was made."""
    spared_monitor(env)
    if wrapper is None:
        return env
    wrapped = wrapper(env)
    wrapped.wrappers_said = said
    return wrapped


class ModeExperimentManager(ExperimentManager):
    """
    The zoo's manager, which refuses unknown hyperparameters, steps this package's tasks all at once, and evaluates this
    package's algorithms with sampled actions: a deterministic evaluation would show one mode only.
    """

    def __init__(
        self, *args: Any, checkpoint_freq: int = 0, resume: Path | None = None, on_ray: bool = False, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.checkpoint_freq, self.resume = checkpoint_freq, resume
        self.wrappers_said: list[dict[str, Any]] = []
        self.is_own = issubclass(ALGOS[self.algo], SavableAlgorithm)
        if self.is_own:
            self.deterministic_eval = False
            # Or `critic` on the command line would replace all of the file's
            self.custom_hyperparams = one_by_one(ALGOS[self.algo], self.custom_hyperparams or {})
        # They say where an error was raised, and Ctrl-C does not end the workers
        better: dict[Any, Any] = {DummyVecEnv: TracingDummyVecEnv, SubprocVecEnv: WorkerVecEnv}
        self.vec_env_class = RayVecEnv if on_ray else better.get(self.vec_env_class, self.vec_env_class)
        if resume is not None:
            self.continue_training = True  # with what ``_load_pretrained_agent`` gives
            self.save_path = str(resume)
            self.params_path = f"{resume}/{self.env_name}"

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        check_hyperparameters(self.algo, list(hyperparams))
        self.wrappers_said = wrappers_said(hyperparams.get("env_wrapper"))
        return super()._preprocess_hyperparams(hyperparams)

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        # The zoo knows `lin_3e-4` for the learning rate alone, takes every name for `lin`, and YAML reads 3e-4 as a string
        schedules = {}
        for key in ("learning_rate", "qf_learning_rate"):
            value = hyperparams.get(key)
            if isinstance(value, str):
                kind, _, number = value.rpartition("_")
                try:
                    schedules[key] = SCHEDULES[kind](float(number))
                except (KeyError, ValueError):
                    accepted = "a number, 'lin_<number>' or 'late_<number>'"
                    raise TypeError(f"{key} must be {accepted}, got {value!r}") from None
        others = {key: value for key, value in hyperparams.items() if key not in schedules}
        return {**ExperimentManager._preprocess_schedules(others), **schedules}

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self.resume is not None:
            own: Any = ALGOS[self.algo]
            settings = {"verbose": self.verbose, "tensorboard_log": self.tensorboard_log, "device": self.device}
            resumed: BaseAlgorithm = own.resume(self.resume / "checkpoints", env, **settings)
            print(f"Going on at step {resumed.num_timesteps} of {self.n_timesteps}, with the random numbers of then")
            return resumed
        model = super()._load_pretrained_agent(hyperparams, env)
        # The zoo counts steps from zero again; with a full buffer the random warm-up would only do harm
        if self.is_own and model.replay_buffer.size() > 0:  # type: ignore[attr-defined]
            model.learning_starts = 0  # type: ignore[attr-defined]
        return model

    def create_callbacks(self) -> None:
        """The zoo's, what ``ddiffpg watch`` reads, and checkpoints of the whole run."""
        super().create_callbacks()
        if self.is_own and not self.optimize_hyperparameters:
            self.callbacks.append(LiveCallback(self.save_path))
        if self.is_own and self.checkpoint_freq > 0 and not self.optimize_hyperparameters:
            folder = Path(self.save_path) / "checkpoints"
            self.callbacks.append(RunCheckpointCallback(folder, self.checkpoint_freq, verbose=self.verbose))

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        :param n_envs: Number of environments
        :param eval_env: Whether they serve the evaluation
        :param no_log: Whether to write no monitor file
        :return: Environments that step together for the tasks of this package, otherwise what the zoo makes
        """
        env_id = self.env_name.gym_id
        wrapped = self.env_wrapper is not None or self.frame_stack is not None
        if not is_ours(env_id) or wrapped or self.vec_env_class in (WorkerVecEnv, RayVecEnv):
            wrapper = self.env_wrapper
            self.env_wrapper = partial(_spared, wrapper, self.wrappers_said)
            try:
                return super().create_envs(n_envs, eval_env, no_log)
            finally:
                self.env_wrapper = wrapper
        env_kwargs = self.eval_env_kwargs if eval_env else self.env_kwargs
        # A run that goes on must not lose what it has noted
        n_before = len(list(Path(self.save_path).glob("*.monitor.csv")))
        monitor_file = None if eval_env or no_log else os.path.join(self.save_path, str(n_before))
        env = make_vec_env(env_id, n_envs, seed=self.seed, env_kwargs=env_kwargs)
        if isinstance(env, VecMonitor):  # it writes no file
            env = env.venv
        env = spared_monitor(VecMonitor(env, monitor_file, **{"info_keywords": ("is_success",), **self.monitor_kwargs}))
        if self.vec_env_wrapper is not None:
            env = self.vec_env_wrapper(env)
        return self._maybe_normalize(env, eval_env)
