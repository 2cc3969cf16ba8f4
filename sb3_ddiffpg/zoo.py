"""
DDiffPG in the RL zoo: ``ddiffpg train``, ``ddiffpg enjoy`` and ``ddiffpg record_video``, with all options of the zoo's own
scripts (https://rl-baselines3-zoo.readthedocs.io) and DDiffPG where nothing else is asked for.
"""

import argparse
import difflib
import importlib.util
import os
import runpy
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.callbacks import ModeEvalCallback
from sb3_ddiffpg.checkpoints import RunCheckpointCallback, checkpoint_files
from sb3_ddiffpg.ddiffpg import DDiffPG
from sb3_ddiffpg.envs import is_ours, make_vec_env
from sb3_ddiffpg.model_file import constructor_arguments
from sb3_ddiffpg.schedules import LateLinearSchedule

try:
    import optuna
    import rl_zoo3.enjoy
    import rl_zoo3.exp_manager
    import rl_zoo3.train
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
    from rl_zoo3.utils import ALGOS, SimpleLinearSchedule
except ImportError as error:
    raise ImportError(f"the RL zoo is an extra ({error}); install it with: pip install 'sb3_ddiffpg[zoo]'") from error

ALGO = "ddiffpg"
# Environment steps between two checkpoints, unless --checkpoint-freq says otherwise
CHECKPOINT_FREQ = 100_000

# Keys of the zoo's YAML files that its ExperimentManager takes out before it calls the algorithm
ZOO_KEYS = {
    "callback",
    "env_kwargs",
    "env_wrapper",
    "frame_stack",
    "monitor_kwargs",
    "n_envs",
    "n_timesteps",
    "noise_std",
    "noise_type",
    "normalize",
    "vec_env_wrapper",
}
# How a learning rate may be given: 3e-4, `lin_3e-4`, `late_3e-4`
SCHEDULES: dict[str, Callable[[float], Any]] = {"": float, "lin": SimpleLinearSchedule, "late": LateLinearSchedule}
# Constructor arguments that come from the command line
COMMAND_LINE_ARGUMENTS = {"env", "tensorboard_log", "seed", "verbose", "device", "_init_setup_model"}


def register() -> None:
    """
    Make DDiffPG and the baselines known to the zoo, with their samplers for Optuna and the :class:`ModeExperimentManager`.
    Call it before the zoo's functions; they read the names of the algorithms when they start.
    """
    ALGOS[ALGO] = DDiffPG
    ALGOS.update(BASELINES)
    for name in (ALGO, *BASELINES):
        HYPERPARAMS_SAMPLER[name] = partial(sample_params, name)
        HYPERPARAMS_CONVERTER[name] = convert_params
    rl_zoo3.train.ExperimentManager = ModeExperimentManager  # type: ignore[misc]
    rl_zoo3.exp_manager.EvalCallback = ModeEvalCallback  # type: ignore[misc, assignment]


def config_file(name: str) -> Path | None:
    """
    :param name: Of a YAML file of ours: ``ddiffpg`` or ``ddiffpg-cpu``
    :return: Where it is, installed or in a checkout; None when there is none
    """
    package = Path(__file__).parent
    for folder in (package, package.parent):
        if (path := folder / "zoo_hyperparams" / f"{name}.yml").is_file():
            return path
    return None


def check_hyperparameters(algo: str, keys: Sequence[str]) -> None:
    """
    The zoo hands unknown keys on when it builds a model, and drops them silently when it resumes one.

    :param algo: Name of an algorithm in the zoo
    :param keys: Names of hyperparameters, from a YAML file or the command line
    :raises TypeError: If one is neither a key of the zoo nor an argument of the algorithm. Not a ValueError: the zoo
        takes those for an unlucky trial when it optimises.
    """
    arguments = constructor_arguments(ALGOS[algo]) - COMMAND_LINE_ARGUMENTS
    for key in keys:
        if key in arguments or key in ZOO_KEYS:
            continue
        near = difflib.get_close_matches(key, sorted(arguments | ZOO_KEYS))
        hint = f"did you mean {' or '.join(map(repr, near))}?" if near else f"it takes {', '.join(sorted(arguments))}"
        raise TypeError(f"{key!r} is not a hyperparameter of {algo}: {hint}")


class ModeExperimentManager(ExperimentManager):
    """
    The zoo's manager, which refuses unknown hyperparameters, steps this package's tasks all at once, and evaluates this
    package's algorithms with sampled actions: a deterministic evaluation would show one mode only.
    """

    def __init__(self, *args: Any, checkpoint_freq: int = 0, resume: Path | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.checkpoint_freq, self.resume = checkpoint_freq, resume
        self.is_own = self.algo == ALGO or self.algo in BASELINES
        if self.is_own:
            self.deterministic_eval = False
        if resume is not None:
            self.continue_training = True  # with what ``_load_pretrained_agent`` gives
            self.save_path = str(resume)
            self.params_path = f"{resume}/{self.env_name}"

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        check_hyperparameters(self.algo, list(hyperparams))
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
            print(f"Going on at step {resumed.num_timesteps} of {self.n_timesteps}")
            return resumed
        model = super()._load_pretrained_agent(hyperparams, env)
        # The zoo counts steps from zero again; with a full buffer the random warm-up would only do harm
        if self.is_own and model.replay_buffer.size() > 0:  # type: ignore[attr-defined]
            model.learning_starts = 0  # type: ignore[attr-defined]
        return model

    def create_callbacks(self) -> None:
        """The zoo's, and checkpoints of the whole run."""
        super().create_callbacks()
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
        if not is_ours(env_id) or wrapped or self.vec_env_class is SubprocVecEnv:
            return super().create_envs(n_envs, eval_env, no_log)
        env_kwargs = self.eval_env_kwargs if eval_env else self.env_kwargs
        # A run that goes on must not lose what it has noted
        n_before = len(list(Path(self.save_path).glob("*.monitor.csv")))
        monitor_file = None if eval_env or no_log else os.path.join(self.save_path, str(n_before))
        env = make_vec_env(env_id, n_envs, seed=self.seed, **env_kwargs)
        if isinstance(env, VecMonitor):  # it writes no file
            env = env.venv
        env = VecMonitor(env, monitor_file, **{"info_keywords": ("is_success",), **self.monitor_kwargs})
        if self.vec_env_wrapper is not None:
            env = self.vec_env_wrapper(env)
        return self._maybe_normalize(env, eval_env)


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: What Optuna sampled
    :return: Constructor arguments
    """
    hyperparams = dict(sampled_params)
    hyperparams["gamma"] = 1 - hyperparams.pop("one_minus_gamma")
    hyperparams["batch_size"] = 2 ** hyperparams.pop("batch_size_pow")
    return hyperparams


def sample_params(
    algo: str, trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Hyperparameters of one trial. The networks stay those of the YAML file.

    :param algo: Name of the algorithm in the zoo
    :param trial: Optuna's trial
    :param n_actions: Not used
    :param n_envs: Not used
    :param additional_args: Not used
    :return: Constructor arguments of the algorithm
    """
    sampled = {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
        "qf_learning_rate": trial.suggest_float("qf_learning_rate", 1e-4, 3e-3, log=True),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.003, 0.05, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 7, 12),
        "tau": trial.suggest_float("tau", 0.005, 0.1, log=True),
        "gradient_steps": trial.suggest_int("gradient_steps", 1, 8, log=True),
        "intrinsic_coef": trial.suggest_float("intrinsic_coef", 1e-3, 1.0, log=True),
    }
    if algo in (ALGO, "dipo"):
        sampled["action_lr"] = trial.suggest_float("action_lr", 0.01, 0.5, log=True)
        sampled["n_action_gradient_steps"] = trial.suggest_int("n_action_gradient_steps", 1, 20, log=True)
    if algo == ALGO:
        sampled["mode_n_steps"] = trial.suggest_int("mode_n_steps", 1, 5)
        sampled["mode_mask_prob"] = trial.suggest_float("mode_mask_prob", 0.1, 0.8)
        sampled["recluster_freq"] = trial.suggest_categorical("recluster_freq", [25, 50, 100, 200])
    else:
        sampled["n_steps"] = trial.suggest_int("n_steps", 1, 5)
    if algo in ("diffusion_ql", "consistency_ac", "dipo"):
        sampled["n_diffusion_steps"] = trial.suggest_int("n_diffusion_steps", 2, 10)
    if algo == "sac_c51":
        sampled["entropy_learning_rate"] = trial.suggest_float("entropy_learning_rate", 1e-4, 1e-2, log=True)
    if algo == "td3_c51":
        sampled["policy_delay"] = trial.suggest_int("policy_delay", 1, 2)
    hyperparams = convert_params(sampled)
    # What was sampled are the exponents; show the values too
    for name in ("gamma", "batch_size"):
        trial.set_user_attr(name, hyperparams[name])
    return hyperparams


class OutcomeVecEnv(DummyVecEnv):
    """
    Counts how the episodes ended, by the ground-truth label in ``info["mode"]``.

    :param env_fns: Functions that make the environments
    :param outcomes: Label -> [episodes, successes]; counted up in place
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]], outcomes: dict[str, list[int]]) -> None:
        super().__init__(env_fns)
        self.outcomes = outcomes

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = super().step_wait()
        for index in np.flatnonzero(dones):
            if "mode" in infos[index]:
                label = infos[index]["mode"]
                outcome = self.outcomes["(no goal)" if label is None else str(label)]
                outcome[0] += 1
                outcome[1] += bool(infos[index].get("is_success", False))
        return observations, rewards, dones, infos


def commanded_to(mode: str | int) -> type[DDiffPG]:
    """
    :param mode: Name or index of a mode
    :return: DDiffPG whose predictions follow this mode where no other is asked for
    """

    class CommandedDDiffPG(DDiffPG):
        def predict(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
            return super().predict(*args, **{"mode": mode, **kwargs})

    return CommandedDDiffPG


def train(arguments: Sequence[str]) -> None:
    """
    The zoo's training script. Beside its options it takes ``--n-envs N``, as ``--conf-file`` also the name of a file of ours,
    ``--checkpoint-freq STEPS`` (0: no checkpoints), and ``--resume [FOLDER]``, which goes on with the newest run of this
    algorithm and environment, or with the one in the folder.

    :param arguments: Command line, without the name of the program
    """
    parser = _parser()
    parser.add_argument("--n-envs", type=int)
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-params", "--hyperparams", nargs="+", default=[])
    parser.add_argument("-f", "--log-folder", default="logs")
    parser.add_argument("--checkpoint-freq", type=int, default=CHECKPOINT_FREQ)
    parser.add_argument("--resume", nargs="?", const="")
    known, rest = _read(parser, arguments)
    hyperparams = [*known.hyperparams, *([] if known.n_envs is None else [f"n_envs:{known.n_envs}"])]
    if hyperparams:
        rest += ["--hyperparams", *hyperparams]
    path = config_file(known.conf_file or known.algo) or known.conf_file
    if path is not None and not Path(path).is_file() and not _is_module(str(path)):
        ours = sorted(each.stem for each in config_file(ALGO).parent.glob("*.yml"))  # type: ignore[union-attr]
        raise SystemExit(f"--conf-file: {known.conf_file!r} given; accepted are a YAML or Python file, a module, and {ours}")
    resume = None if known.resume is None else _run_folder(known.resume, known.log_folder, known.algo, known.env)
    manager = partial(ModeExperimentManager, checkpoint_freq=known.checkpoint_freq, resume=resume)
    rest += ["--log-folder", known.log_folder]
    try:
        rl_zoo3.train.ExperimentManager = manager  # type: ignore[assignment, misc]
        with _command_line([*([] if path is None else ["--conf-file", str(path)]), *rest]):
            rl_zoo3.train.train()
    finally:
        rl_zoo3.train.ExperimentManager = ModeExperimentManager  # type: ignore[misc]


def _run_folder(given: str, log_folder: str, algo: str, env_id: str | None) -> Path:
    """The run that ``--resume`` means."""
    if given:
        folder = Path(given)
    else:
        runs = Path(log_folder, algo).glob(f"{(env_id or '').replace('/', '-')}_*/checkpoints")
        numbered = [path.parent for path in runs if path.parent.name.rpartition("_")[2].isdecimal()]
        if not numbered:
            raise SystemExit(f"--resume: {log_folder}/{algo} holds no run of {env_id} with checkpoints")
        folder = max(numbered, key=lambda path: int(path.name.rpartition("_")[2]))
    if not checkpoint_files(folder / "checkpoints"):
        raise SystemExit(f"--resume: {str(folder)!r} given; accepted is the folder of a run, with checkpoints/ in it")
    return folder


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # of its parent
        return False


def enjoy(arguments: Sequence[str]) -> None:
    """
    The zoo's script that watches a trained agent. Takes ``--mode NAME_OR_INDEX`` beside its options, looks into
    ``logs``, samples actions unless told ``--deterministic``, and counts the outcomes by the environment's own label.

    :param arguments: Command line, without the name of the program
    """
    outcomes: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    vec_env_cls = ExperimentManager.default_vec_env_cls
    ExperimentManager.default_vec_env_cls = partial(OutcomeVecEnv, outcomes=outcomes)  # type: ignore[assignment]
    try:
        _play(rl_zoo3.enjoy.enjoy, arguments)
    finally:
        ExperimentManager.default_vec_env_cls = vec_env_cls
    if outcomes:
        width = max(13, *(len(label) for label in outcomes))
        print(f"{'observed mode':<{width}}  episodes  successes")
        for label, (episodes, successes) in sorted(outcomes.items(), key=lambda item: -item[1][0]):
            print(f"{label:<{width}}  {episodes:8d}  {successes:9d}")


def record_video(arguments: Sequence[str]) -> None:
    """
    The zoo's script that films a trained agent, with the additions of :func:`enjoy`.

    :param arguments: Command line, without the name of the program
    """
    _play(partial(runpy.run_module, "rl_zoo3.record_video", run_name="__main__"), arguments)


COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {"train": train, "enjoy": enjoy, "record_video": record_video}


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: A command and its options; those of the process when None
    """
    parser = argparse.ArgumentParser(
        prog="ddiffpg",
        description="DDiffPG in the RL zoo.",
        epilog="`ddiffpg COMMAND -h` lists the zoo's options. Beside them: train --n-envs N, "
        "--checkpoint-freq STEPS, --resume [FOLDER]; enjoy and record_video --mode M.",
    )
    parser.add_argument("command", choices=list(COMMANDS))
    parser.add_argument("options", nargs=argparse.REMAINDER)
    known = parser.parse_args(arguments)
    COMMANDS[known.command](known.options)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default=ALGO)
    parser.add_argument("--env")
    return parser


def _read(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Take out what ``parser`` knows, and see to it that the zoo will know the algorithm and the environment."""
    register()
    known, rest = parser.parse_known_args(arguments)
    if known.env is not None:
        rest += ["--env", known.env]
        if known.env not in gym.registry:
            gym.register_envs(importlib.import_module("gymnasium_robotics"))
    return known, [*rest, "--algo", known.algo]


@contextmanager
def _command_line(arguments: Sequence[str]) -> Iterator[None]:
    """The zoo's scripts read ``sys.argv``."""
    before = sys.argv
    sys.argv = [before[0], *arguments]
    try:
        yield
    finally:
        sys.argv = before


def _play(script: Callable[[], Any], arguments: Sequence[str]) -> None:
    """Run one of the zoo's scripts that play a trained agent."""
    parser = _parser()
    parser.add_argument("--mode", type=lambda value: int(value) if value.isdigit() else value)
    known, rest = _read(parser, arguments)
    if known.mode is not None:
        if known.algo != ALGO:
            raise SystemExit(f"--mode needs --algo {ALGO}, got {known.algo}")
        ALGOS[ALGO] = commanded_to(known.mode)
    if known.algo == ALGO and "--deterministic" not in rest:
        rest.append("--stochastic")
    try:
        # First, so that the user's own option wins
        with _command_line(["--folder", "logs", *rest]):
            script()
    finally:
        ALGOS[ALGO] = DDiffPG
