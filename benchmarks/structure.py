"""
How the package is built: its sizes, what imports what, and how far one has to read for one update of DDiffPG.

``python benchmarks/structure.py [CHECKOUT ...]`` prints one table with a column for each checkout (default: this one). All but
the last row is read from the source by AST: a checkout need not be importable. ``tests/test_structure.py`` holds the limits.

What is counted:

- modules at the top: files of ``sb3_ddiffpg/`` itself but ``__init__.py``; packages: folders of it with Python files
- longest import chain: modules of this package in the longest chain of imports at the top of a file, each importing the next.
  ``from package import name`` leads to the module ``package.name`` if there is one, else to ``package/__init__.py``. That
  importing a module also runs the ``__init__.py`` above it is left out
- file lines: all lines of a file; ``__init__.py`` left out
- body lines: of every function and method, nested ones too, from the first statement after the docstring to the last line
- largest constructor: arguments of an ``__init__`` that is written out, positional and keyword-only, without ``self``,
  ``*args`` and ``**kwargs``
- methods: definitions (functions, properties, class- and static methods) in the bodies of a class and of those of its bases
  that are of this package, found by their names. A method that is overridden counts wherever it is defined, a property with a
  setter twice. ``__init__`` counts, other names with two underscores on both sides do not
- private attributes of others: ``x._y``, read or written, where x is not ``self``, ``cls`` or ``super()``. Not those of names
  that are imported modules, and not ``_replace`` and the like, which are a named tuple's public methods
- circles: groups of packages that import each other, directly or not, at the top of a file or within a function; the modules
  at the top count as one package, above all others
- packages that import upwards: those with an import of a package that is later in ``ORDER``, or of the top
- files of an update: files of this package in which a function or method is called (``sys.setprofile``; not comprehensions,
  generator expressions and lambdas) by one ``train(1, batch)`` of a DDiffPG with a mode or two in a tiny point maze, counts as
  novelty; and how often the file of a call is another one than that of the call before
"""

import argparse
import ast
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

NAME = "sb3_ddiffpg"
#: The packages from the lowest up: each imports only those before it
ORDER = (
    *("utils", "serialization", "clustering", "networks", "buffers", "exploration", "modes", "envs", "saving", "common"),
    *("evaluation", "planning", "visualization", "callbacks", "ddiffpg", "check", "baselines", "zoo", "experiments"),
)
#: What ``__init__.py`` and the modules beside it count as
TOP = "(top)"
LONG_FILE = 450
#: Public methods of a named tuple, whatever their names say
NAMED_TUPLE = ("_asdict", "_field_defaults", "_fields", "_make", "_replace")


@dataclass(frozen=True)
class Module:
    """
    A source file.

    :param name: As it is imported, such as ``"sb3_ddiffpg.modes.mode"``
    :param path: Of the file, from the checkout
    :param package: The folder of ``sb3_ddiffpg`` that it is in, or ``TOP``
    :param tree: Its source
    :param n_lines: Of the file
    """

    name: str
    path: str
    package: str
    tree: ast.Module = field(repr=False)
    n_lines: int

    @property
    def is_init(self) -> bool:
        """Whether it is an ``__init__.py``."""
        return self.path.endswith("__init__.py")


@dataclass(frozen=True)
class Import:
    """
    One module of the package imports another one.

    :param source: The importing module
    :param target: The imported module
    :param line: Where
    :param at_top: Whether it runs when the source is imported
    """

    source: Module
    target: Module
    line: int
    at_top: bool

    @property
    def place(self) -> str:
        """File and line."""
        return f"{self.source.path}:{self.line}"


Package = Mapping[str, Module]


def read_package(checkout: Path) -> Package:
    """
    :param checkout: Folder in which ``sb3_ddiffpg`` is
    :return: Its modules by name
    :raises SystemExit: If there are none
    """
    modules = {}
    for path in sorted((checkout / NAME).rglob("*.py")):
        parts = path.relative_to(checkout).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        package = parts[1] if len(parts) > 2 else TOP
        text = path.read_text()
        relative = path.relative_to(checkout).as_posix()
        modules[name] = Module(name, relative, package, ast.parse(text, relative), len(text.splitlines()))
    if not modules:
        raise SystemExit(f"{checkout} given; accepted are folders with {NAME}/ in them")
    return modules


# ---------------------------------------------------------------------- imports


def _from(module: Module, node: ast.ImportFrom) -> str:
    """The module after ``from``, in full."""
    if not node.level:
        return node.module or ""
    own = module.name.split(".")
    above = own[: len(own) - node.level + module.is_init]
    return ".".join([*above, *([node.module] if node.module else [])])


def _names(module: Module, node: ast.stmt) -> Iterator[tuple[str, str, str]]:
    """What an import statement binds: the name here, the module, and the name there (none for a whole module)."""
    if isinstance(node, ast.Import):
        for alias in node.names:
            yield alias.asname or alias.name.partition(".")[0], alias.name, ""
    elif isinstance(node, ast.ImportFrom):
        for alias in node.names:
            yield alias.asname or alias.name, _from(module, node), alias.name


def _statements(node: ast.AST, at_top: bool = True) -> Iterator[tuple[ast.stmt, bool]]:
    """All import statements below a node, and whether they run with the file."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child, at_top
        else:
            inside = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            # What only a type checker reads
            typing = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
            yield from _statements(child, at_top and not inside and not typing)


def imports(package: Package) -> list[Import]:
    """
    :param package: The modules
    :return: Every import of one of them by another, also those within functions and for type checkers
    """
    found = []
    for module in package.values():
        for node, at_top in _statements(module.tree):
            targets = {
                package.get(f"{there}.{name}" if name else there) or package.get(there)
                for _, there, name in _names(module, node)
            }
            for target in sorted((each for each in targets if each is not None), key=lambda each: each.name):
                if target is not module:
                    found.append(Import(module, target, node.lineno, at_top))
    return found


def _level(package: str) -> int:
    """Its place in ``ORDER``; the top is above all, and what is not in it above that."""
    return len(ORDER) if package == TOP else ORDER.index(package) if package in ORDER else len(ORDER) + 1


def upward_imports(package: Package) -> list[str]:
    """
    :param package: The modules
    :return: A message for every import of a package by a lower one, and for every package that is not in ``ORDER``
    """
    unknown = {each.package: each.path for each in package.values() if _level(each.package) > len(ORDER)}
    wrong = [f"{path}: the package {name} is not in the order of packages" for name, path in unknown.items()]
    for each in _between_packages(package):
        low, high = each.source.package, each.target.package
        if _level(low) < _level(high):
            wrong.append(f"{each.place}: {low} imports {each.target.name}, and {high} is above {low}")
    return wrong


def other_imports(package: Package, name: str, accepted: Iterable[str]) -> list[str]:
    """
    :param package: The modules
    :param name: Of one of its packages
    :param accepted: Those that it may import beside itself
    :return: A message for every import of another one
    """
    allowed = tuple(accepted)
    return [
        f"{each.place}: {name} imports {each.target.name}; accepted are {', '.join(allowed)}"
        for each in _between_packages(package)
        if each.source.package == name and each.target.package not in allowed
    ]


def _between_packages(package: Package) -> list[Import]:
    return [each for each in imports(package) if each.source.package != each.target.package]


def _reachable(graph: Mapping[str, set[str]], start: str) -> set[str]:
    """All that follows, the start itself only if it is on a circle."""
    reached: set[str] = set()
    waiting = [*graph.get(start, ())]
    while waiting:
        node = waiting.pop()
        if node not in reached:
            reached.add(node)
            waiting += graph.get(node, ())
    return reached


def _circles(graph: Mapping[str, set[str]]) -> list[set[str]]:
    """Groups of nodes of which each leads to each."""
    reached = {node: _reachable(graph, node) for node in graph}
    groups = {frozenset(other for other in reached[node] if node in reached.get(other, ())) for node in graph}
    return sorted((set(group) for group in groups if len(group) > 1), key=lambda group: sorted(group))


def circles(package: Package) -> list[str]:
    """
    :param package: The modules
    :return: A message for every group of packages that import each other
    """
    edges = _between_packages(package)
    graph: dict[str, set[str]] = defaultdict(set)
    first: dict[tuple[str, str], str] = {}
    for each in edges:
        graph[each.source.package].add(each.target.package)
        first.setdefault((each.source.package, each.target.package), each.place)
    messages = []
    for group in _circles(graph):
        places = [f"{low} imports {high} ({place})" for (low, high), place in first.items() if low in group and high in group]
        messages.append(f"a circle of {', '.join(sorted(group))}: {'; '.join(places)}")
    return messages


def longest_chain(package: Package) -> list[str]:
    """
    :param package: The modules
    :return: Names of the modules of the longest chain of imports at the top of a file; a circle is passed through once
    """
    graph: dict[str, set[str]] = defaultdict(set)
    for each in imports(package):
        if each.at_top:
            graph[each.source.name].add(each.target.name)
    known: dict[str, list[str]] = {}

    def chain(name: str, above: tuple[str, ...]) -> list[str]:
        if name not in known:
            below = [chain(each, (*above, name)) for each in sorted(graph[name]) if each not in (*above, name)]
            known[name] = [name, *max(below, key=len, default=[])]
        return known[name]

    return max((chain(name, ()) for name in sorted(package)), key=len)


# ---------------------------------------------------------------------- sizes


def modules_at_top(package: Package) -> list[str]:
    """
    :param package: The modules
    :return: Paths of those at the top but ``__init__.py``
    """
    return [each.path for each in package.values() if each.package == TOP and not each.is_init]


def file_lines(package: Package) -> dict[str, int]:
    """
    :param package: The modules
    :return: Lines of each file by its path, without ``__init__.py``
    """
    return {each.path: each.n_lines for each in package.values() if not each.is_init}


def long_files(package: Package) -> list[str]:
    """
    :param package: The modules
    :return: A message for every file of more than ``LONG_FILE`` lines
    """
    return [f"{path}: {lines} lines" for path, lines in file_lines(package).items() if lines > LONG_FILE]


def body_lines(package: Package) -> list[int]:
    """
    :param package: The modules
    :return: Lines of every function's body without its docstring
    """
    found = []
    for module in package.values():
        for node in ast.walk(module.tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = node.body[ast.get_docstring(node) is not None :]
                found.append(0 if not body else (node.end_lineno or 0) - body[0].lineno + 1)
    return found


def constructors(package: Package) -> list[tuple[int, str, str]]:
    """
    :param package: The modules
    :return: Number of arguments, name of the class and place of every constructor, the largest one first
    """
    found = []
    for module in package.values():
        for kind in (node for node in ast.walk(module.tree) if isinstance(node, ast.ClassDef)):
            for node in kind.body:
                if isinstance(node, ast.FunctionDef) and node.name == "__init__":
                    arguments = node.args
                    n = len([*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]) - 1
                    found.append((n, kind.name, f"{module.path}:{node.lineno}"))
    return sorted(found, key=lambda each: -each[0])


# ---------------------------------------------------------------------- classes


def _class_in(package: Package, module: Module, name: str) -> tuple[Module, ast.ClassDef] | None:
    """The class that a name means in a module, wherever in the package it is defined."""
    for node in module.tree.body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return module, node
        for here, there, original in _names(module, node):
            if here == name and original and there in package:
                return _class_in(package, package[there], original)
    return None


def _base_name(node: ast.expr) -> str:
    """Of ``Base``, ``module.Base`` and ``Base[...]``."""
    if isinstance(node, ast.Subscript):
        return _base_name(node.value)
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def inheritance_chain(package: Package, name: str) -> list[tuple[Module, ast.ClassDef]]:
    """
    :param package: The modules
    :param name: Of a class that only one of them defines
    :return: The class, and those of its bases, and theirs, that are of this package
    :raises ValueError: If there is no such class
    """
    for module in package.values():
        if any(isinstance(node, ast.ClassDef) and node.name == name for node in module.tree.body):
            break
    else:
        raise ValueError(f"{name} is not defined in {NAME}")
    chain: list[tuple[Module, ast.ClassDef]] = []
    waiting = [_class_in(package, module, name)]
    while waiting:
        found = waiting.pop(0)
        if found is not None and found not in chain:
            chain.append(found)
            waiting += [_class_in(package, found[0], _base_name(base)) for base in found[1].bases]
    return chain


def methods(package: Package, name: str) -> list[str]:
    """
    :param package: The modules
    :param name: Of a class
    :return: Class and method of every definition in its inheritance chain
    """
    return [
        f"{kind.name}.{node.name}"
        for _, kind in inheritance_chain(package, name)
        for node in kind.body
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.name == "__init__" or not (node.name.startswith("__") and node.name.endswith("__")))
    ]


def _is_own(node: ast.expr, modules: set[str]) -> bool:
    """Whether it is ``self``, ``cls``, ``super()`` or a module."""
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Name) and node.func.id == "super"
    return isinstance(node, ast.Name) and node.id in {"self", "cls", *modules}


def private_accesses(package: Package) -> list[str]:
    """
    :param package: The modules
    :return: A message for every private attribute that is touched from outside
    """
    found = []
    for module in package.values():
        statements = (node for node, _ in _statements(module.tree))
        whole = {here for node in statements for here, _, original in _names(module, node) if not original}
        for node in ast.walk(module.tree):
            if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__"):
                if node.attr not in NAMED_TUPLE and not _is_own(node.value, whole):
                    found.append(f"{module.path}:{node.lineno}: {ast.unparse(node)}")
    return found


# ---------------------------------------------------------------------- an update

# Runs in a process of its own, in which the checkout comes before an installed package
UPDATE = """
import json, sys, warnings
from pathlib import Path
import torch as th
import sb3_ddiffpg
from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.envs import make_vec_env
from stable_baselines3.common.logger import Logger

folder = str(Path(sb3_ddiffpg.__file__).parent)
assert Path(folder).parent == Path(sys.argv[1]), folder
th.set_num_threads(1)
warnings.simplefilter("ignore")
env = make_vec_env("PointMazeV1-v0", 8, seed=0, maze_map=["#######", "#g.r.g#", "#######"])
model = DDiffPG("MlpPolicy", env, seed=0, learning_starts=800, batch_size=32, buffer_size=12_000, device="cpu",
    policy_kwargs={"net_arch": [16]}, verbose=0)
model.set_logger(Logger(None, []))
for _ in range(20):
    model.learn(400, log_interval=10**9, reset_num_timesteps=False)
    if len(model.modes):
        break
assert len(model.modes), "no mode was found"
model.train(1, 32)  # what only the first update does
files = []

def note(frame, event, _):
    # Python 3.12 runs comprehensions within their function
    if event == "call" and frame.f_code.co_filename.startswith(folder) and not frame.f_code.co_name.startswith("<"):
        files.append(frame.f_code.co_filename)

sys.setprofile(note)
model.train(1, 32)
sys.setprofile(None)
changes = sum(before != after for before, after in zip(files, files[1:]))
print(json.dumps({"files": sorted({str(Path(each).relative_to(folder)) for each in files}), "changes": changes}))
"""


def update_files(checkout: Path) -> tuple[list[str], int] | None:
    """
    :param checkout: Folder in which ``sb3_ddiffpg`` is
    :return: Files that one update enters, and how often it changes file; None if it cannot run
    """
    checkout = checkout.resolve()
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", UPDATE, str(checkout)]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode:
        print(f"{checkout.name}: no update ran\n{done.stderr[-500:]}", file=sys.stderr)
        return None
    found = json.loads(done.stdout.splitlines()[-1])
    return found["files"], found["changes"]


# ---------------------------------------------------------------------- the table


def measure(checkout: Path) -> dict[str, str]:
    """
    :param checkout: Folder in which ``sb3_ddiffpg`` is
    :return: What was found, by what it is
    """
    package = read_package(checkout)
    lines, bodies = sorted(file_lines(package).values()), sorted(body_lines(package))
    n_arguments, name, _ = constructors(package)[0]
    upwards = {
        each.source.package for each in _between_packages(package) if _level(each.source.package) < _level(each.target.package)
    }
    update = update_files(checkout)
    ninetieth = bodies[int(0.9 * len(bodies))]
    return {
        "modules at the top": str(len(modules_at_top(package))),
        "packages": str(len({each.package for each in package.values()} - {TOP})),
        "longest import chain": str(len(longest_chain(package))),
        "file lines, median / max": f"{statistics.median(lines):.0f} / {lines[-1]}",
        f"files over {LONG_FILE} lines": str(len(long_files(package))),
        "body lines, median / 90 % / max": f"{statistics.median(bodies):.0f} / {ninetieth} / {bodies[-1]}",
        "largest constructor": f"{n_arguments} ({name})",
        "methods of DDiffPG": str(len(methods(package, "DDiffPG"))),
        "methods of ModeReplayBuffer": str(len(methods(package, "ModeReplayBuffer"))),
        "private attributes of others": str(len(private_accesses(package))),
        "circles between packages": str(len(circles(package))),
        "packages that import upwards": str(len(upwards)),
        "files / changes of an update": "-" if update is None else f"{len(update[0])} / {update[1]}",
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    here = Path(__file__).resolve().parents[1]
    parser.add_argument("checkouts", nargs="*", type=Path, default=[here], metavar="CHECKOUT", help="folder with sb3_ddiffpg/")
    given = parser.parse_args()
    columns = [measure(each) for each in given.checkouts]
    heads = [each.resolve().name for each in given.checkouts]
    widths = [max(map(len, (head, *column.values()))) for head, column in zip(heads, columns, strict=True)]
    print(f"{'':<32}", *(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True)), sep="  ")
    for row in columns[0]:
        print(f"{row:<32}", *(f"{column[row]:>{width}}" for column, width in zip(columns, widths, strict=True)), sep="  ")


if __name__ == "__main__":
    main()
