"""Suites: tasks times variants of algorithms times seeds, declared in a YAML file."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from sb3_ddiffpg.experiments.files import read_yaml, task_file_name
from sb3_ddiffpg.experiments.trial import Tests, Trial, can_be_made, hyperparameters, setting_of
from sb3_ddiffpg.zoo import ALGO

T = TypeVar("T")

SUITES = Path(__file__).parent / "suites"


class Variant(msgspec.Struct, forbid_unknown_fields=True):
    """
    An algorithm with settings of its own.

    :param algo: Name in the zoo
    :param conf_file: YAML file of settings; the suite's when None, else the algorithm's own
    :param settings: What differs from its entry there
    :param members: More than one: see ``Trial``
    :param entries: Task -> the entry of the RL zoo's file (``conf_file: rl_zoo3``) that it takes, if not its own
    :param tasks: Task -> what differs there for this variant alone
    """

    algo: str = ALGO
    conf_file: str | None = None
    settings: dict[str, Any] = {}
    members: int = 1
    entries: dict[str, str] = {}
    tasks: dict[str, dict[str, Any]] = {}


class Resources(msgspec.Struct, forbid_unknown_fields=True):
    """
    What one trial takes of a machine.

    :param cpus: Processor cores, and threads of PyTorch
    :param gpus: Accelerators, or a share of one
    """

    cpus: int = 1
    gpus: float = 0.0


class Suite(msgspec.Struct, forbid_unknown_fields=True):
    """
    What is trained, and how it is tested.

    :param description: One line
    :param tasks: Id of an environment -> settings for all variants there
    :param variants: Name -> what it is
    :param seeds: Their seeds
    :param settings: For all
    :param conf_file: YAML file of settings for all variants that name no other
    :param tests: How each is tested
    :param also: Task -> further environments in which what was trained there is evaluated
    :param resources: What one trial takes
    :param ablation: The setting in which the variants differ, for a figure over its values
    :param needs: Task -> what pip installs for it; such a task is left out where it is not
    """

    description: str
    tasks: dict[str, dict[str, Any] | None]
    variants: dict[str, Variant]
    seeds: list[int]
    settings: dict[str, Any] = {}
    conf_file: str | None = None
    tests: Tests = msgspec.field(default_factory=Tests)
    also: dict[str, list[str]] = {}
    resources: Resources = msgspec.field(default_factory=Resources)
    ablation: str | None = None
    needs: dict[str, str] = {}

    @property
    def n_trials(self) -> int:
        """How many trials it has."""
        return len(self.tasks) * len(self.variants) * len(self.seeds)

    def trials(self) -> dict[Path, Trial]:
        """
        :return: Folder below the results -> trial; all of the first seed come first, so that there is something of everything
            soon
        :raises ValueError: If one cannot be
        """
        found = {}
        for seed in self.seeds:
            for task in self.tasks:
                for name in self.variants:
                    trial = self._trial(task, name, seed)
                    trial.check()
                    found[Path(task_file_name(task), name, f"seed{seed}")] = trial
        values = [] if self.ablation is None else [setting_of(trial, self.ablation) for trial in found.values()]
        if not all(isinstance(value, (int, float)) for value in values):
            raise ValueError(f"ablation: {self.ablation!r} given; accepted is a setting that is a number in every variant")
        return found

    def leave_out(self) -> dict[str, str]:
        """
        Leave out the tasks that cannot be made with what is installed.

        :return: These, and what they need
        """
        kwargs = {task: {**self.settings, **(self.tasks[task] or {})}.get("env_kwargs", {}) for task in self.tasks}
        out = {task: self.needs[task] for task in self.tasks if task in self.needs and not can_be_made(task, kwargs[task])}
        self.tasks = {task: settings for task, settings in self.tasks.items() if task not in out}
        return out

    def _trial(self, task: str, name: str, seed: int) -> Trial:
        variant = self.variants[name]
        changes = self.settings, self.tasks[task] or {}, variant.settings, variant.tasks.get(task, {})
        settings = hyperparameters(
            variant.algo, task, variant.conf_file or self.conf_file, *changes, entry=variant.entries.get(task)
        )
        return Trial(
            env=task,
            algo=variant.algo,
            variant=name,
            seed=seed,
            hyperparams=settings,
            members=variant.members,
            tests=msgspec.structs.replace(self.tests, also=[*self.tests.also, *self.also.get(task, [])]),
        )


def suite_names() -> list[str]:
    """
    :return: Names of the suites in the package
    """
    return sorted(path.stem for path in SUITES.glob("*.yml"))


def read_suite(
    name: str,
    tasks: Sequence[str] | None = None,
    variants: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
) -> Suite:
    """
    :param name: Of a suite in the package, or path of a YAML file
    :param tasks: Only these of its tasks
    :param variants: Only these of its variants
    :param seeds: Instead of its seeds
    :return: The suite
    :raises ValueError: If there is no such suite, task or variant, or the file says something else
    """
    path = SUITES / f"{name}.yml"
    path = path if path.is_file() else Path(name)
    if not path.is_file():
        raise ValueError(f"suite: {name!r} given; accepted are {', '.join(suite_names())}, or the path of a YAML file")
    said = read_yaml("suite", path)
    variants_said = said.get("variants") if isinstance(said, dict) else None
    for variant, of_variant in variants_said.items() if isinstance(variants_said, dict) else ():
        _convert(of_variant, Variant, f"{path}: variant {variant!r}")
    suite = _convert(said, Suite, str(path))
    of_tasks = [suite.also, suite.needs, *(each for of in suite.variants.values() for each in (of.entries, of.tasks))]
    for names in of_tasks:
        _chosen("tasks", suite.tasks, list(names))
    suite.tasks = _chosen("tasks", suite.tasks, tasks)
    suite.variants = _chosen("variants", suite.variants, variants)
    suite.also = {task: others for task, others in suite.also.items() if task in suite.tasks}
    suite.seeds = list(suite.seeds if seeds is None else seeds)
    if suite.resources.cpus < 1 or not 0 <= suite.resources.gpus < math.inf:
        raise ValueError(f"resources: {suite.resources} given; accepted are cpus from 1 and gpus from 0 up")
    for kind, of_kind in (("tasks", suite.tasks), ("variants", suite.variants), ("seeds", suite.seeds)):
        if not of_kind or (kind == "seeds" and len(set(suite.seeds)) < len(suite.seeds)):
            raise ValueError(f"{kind}: {list(of_kind)} given; accepted are one or more, each once")
    return suite


def _convert(said: Any, kind: type[T], what: str) -> T:
    try:
        return msgspec.convert(said, kind)
    except msgspec.ValidationError as error:
        accepted = ", ".join(kind.__struct_fields__)  # type: ignore[attr-defined]
        raise ValueError(f"suite: {what} is none: {error}; accepted are {accepted}") from None


def _chosen(kind: str, known: dict[str, Any], names: Sequence[str] | None) -> dict[str, Any]:
    for name in names or ():
        if name not in known:
            raise ValueError(f"{kind}: {name!r} given; the suite's are {', '.join(known)}")
    return known if names is None else {name: known[name] for name in known if name in names}
