"""The zoo's scripts as commands of this package: train, enjoy, record_video. Beside them check and watch."""

import argparse
import importlib.util
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
import rl_zoo3.enjoy
import rl_zoo3.train
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.buffers.success import GoalWatch
from sb3_ddiffpg.check.command import main as check
from sb3_ddiffpg.ddiffpg.ddiffpg import DDiffPG
from sb3_ddiffpg.envs import import_packages, registered_id
from sb3_ddiffpg.saving.checkpoint import checkpoint_files
from sb3_ddiffpg.utils.vec_envs import labels_routes
from sb3_ddiffpg.zoo.manager import ModeExperimentManager
from sb3_ddiffpg.zoo.registration import register
from sb3_ddiffpg.zoo.settings import ALGO, ALGOS, check_config_file, config_file

# Environment steps between two checkpoints, unless --checkpoint-freq says otherwise
CHECKPOINT_FREQ = 100_000


class OutcomeVecEnv(DummyVecEnv):
    """
    Counts how the episodes ended, by the ground-truth label in ``info["mode"]``, where the environments declare one.

    :param env_fns: Functions that make the environments
    :param outcomes: Label -> [episodes, successes]; counted up in place
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]], outcomes: dict[str, list[int]]) -> None:
        super().__init__(env_fns)
        self.outcomes, self.watch = outcomes, GoalWatch(len(env_fns), labelled=labels_routes(self))

    def reset(self) -> VecEnvObs:
        self.watch = GoalWatch(self.num_envs, labelled=self.watch.labelled)
        return super().reset()

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = super().step_wait()
        self.watch.observe(infos)
        for index in np.flatnonzero(dones).tolist():
            if self.watch.labelled:
                label = self.watch.so_far(index, infos[index]).label
                outcome = self.outcomes["(no goal)" if label is None else label]
                outcome[0] += 1
                outcome[1] += bool(self.watch.so_far(index, infos[index]).success)
            self.watch.end(index)
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
    ``--checkpoint-freq STEPS`` (0: no checkpoints), ``--vec-env ray`` for environments on a Ray cluster, and ``--resume
    [FOLDER]``, which goes on with the newest run of this algorithm and environment, or with the one in the folder.

    :param arguments: Command line, without the name of the program
    """
    parser = _parser()
    parser.add_argument("--n-envs", type=int)
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-params", "--hyperparams", nargs="+", default=[])
    parser.add_argument("-f", "--log-folder", default="logs")
    parser.add_argument("--checkpoint-freq", type=int, default=CHECKPOINT_FREQ)
    parser.add_argument("--resume", nargs="?", const="")
    parser.add_argument("--vec-env", choices=["dummy", "subproc", "ray"], default="dummy")
    known, rest = _read(parser, arguments)
    for each in known.hyperparams:
        if not each.partition(":")[2]:
            raise SystemExit(f"--hyperparams: {each!r} given; accepted is name:value, such as gamma:0.97")
    hyperparams = [*known.hyperparams, *([] if known.n_envs is None else [f"n_envs:{known.n_envs}"])]
    if hyperparams:
        rest += ["--hyperparams", *hyperparams]
    path = config_file(known.conf_file or known.algo) or known.conf_file
    if path is not None and not Path(path).is_file() and not _is_module(str(path)):
        ours = sorted(each.stem for each in config_file(ALGO).parent.glob("*.yml"))  # type: ignore[union-attr]
        raise SystemExit(f"--conf-file: {known.conf_file!r} given; accepted are a YAML or Python file, a module, and {ours}")
    check_config_file(path, known.env)
    if known.resume is not None and known.hyperparams:
        print("--resume: the run goes on with its own settings, not with what --hyperparams says")
    resume = None if known.resume is None else _run_folder(known.resume, known.log_folder, known.algo, known.env)
    on_ray = known.vec_env == "ray"
    manager = partial(ModeExperimentManager, checkpoint_freq=known.checkpoint_freq, resume=resume, on_ray=on_ray)
    rest += ["--log-folder", known.log_folder, "--vec-env", "dummy" if on_ray else known.vec_env]
    try:
        rl_zoo3.train.ExperimentManager = manager  # type: ignore[assignment, misc]
        with _command_line([*([] if path is None else ["--conf-file", str(path)]), *rest]):
            rl_zoo3.train.train()
    except SyntaxError as error:
        if error.filename != "<string>":
            raise
        raise SystemExit(f"{(error.text or '').strip()!r} in the settings is no expression of Python: {error.msg}") from None
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


def watch(arguments: Sequence[str]) -> None:
    """
    Serves a page on runs in progress, for this machine alone.

    :param arguments: Command line, without the name of the program
    """
    try:
        from sb3_ddiffpg.visualization.watch import main  # needs another extra
    except ImportError as error:
        raise SystemExit(f"watch needs the extra plots ({error}); install it with: pip install 'sb3_ddiffpg[plots]'") from None
    main(arguments)


COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {
    "check": check,
    "train": train,
    "enjoy": enjoy,
    "record_video": record_video,
    "watch": watch,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: A command and its options; those of the process when None
    """
    parser = argparse.ArgumentParser(
        prog="ddiffpg",
        description="DDiffPG in the RL zoo.",
        epilog="check ENV says what DDiffPG makes of an environment, watch LOGDIR shows runs in progress. "
        "`ddiffpg COMMAND -h` lists the options, also the zoo's. "
        "Beside them: train --n-envs N, "
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
    parser.add_argument("--gym-packages", nargs="+", default=[])
    return parser


def _read(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Take out what ``parser`` knows, and see to it that the zoo will know the algorithm and the environment."""
    register()
    known, rest = parser.parse_known_args(arguments)
    try:
        import_packages(known.gym_packages)
        if known.env is not None:
            known.env = registered_id(known.env)
            rest += ["--env", known.env]
    except ValueError as error:
        raise SystemExit(str(error)) from None
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
    if known.algo in (ALGO, *BASELINES) and "--deterministic" not in rest:
        rest.append("--stochastic")
    try:
        # First, so that the user's own option wins
        with _command_line(["--folder", "logs", *rest]):
            script()
    finally:
        ALGOS[ALGO] = DDiffPG
