"""The rules of the house: who may import whom, and how large things may get. ``benchmarks/structure.py`` counts."""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
ENVS_MAY_IMPORT = ("utils", "serialization")
MOST_AT_TOP, MOST_ARGUMENTS, MOST_METHODS, MOST_PRIVATE, MOST_LONG_FILES = 4, 34, 66, 25, 1


def _counting() -> ModuleType:
    spec = importlib.util.spec_from_file_location("structure", ROOT / "benchmarks" / "structure.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look for it there
    spec.loader.exec_module(module)
    return module


structure = _counting()


@pytest.fixture(scope="module")
def package():
    return structure.read_package(ROOT)


def made_up(folder: Path, files: dict[str, str]):
    """
    :param folder: Where to write it
    :param files: Text of each file by its path in the package, without ``.py``
    :return: What is read of it
    """
    for name, text in files.items():
        path = folder / "sb3_ddiffpg" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return structure.read_package(folder)


def lines(messages: list[str]) -> str:
    return "\n".join(messages)


# ---------------------------------------------------------------------- the rules


def test_every_package_is_in_the_order(package):
    assert sorted({each.package for each in package.values()} - {structure.TOP}) == sorted(structure.ORDER)


def test_contributors_are_told_the_same_order():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    assert tuple(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)) == structure.ORDER


def test_packages_import_downwards_only(package):
    """In the order of ``structure.ORDER``; the modules at the top may import all and are imported by none."""
    assert not (wrong := structure.upward_imports(package)), lines(wrong)


def test_no_circles_between_packages(package):
    assert not (wrong := structure.circles(package)), lines(wrong)


def test_environments_know_no_algorithm(package):
    assert not (wrong := structure.other_imports(package, "envs", ENVS_MAY_IMPORT)), lines(wrong)


def test_few_modules_at_the_top(package):
    found = structure.modules_at_top(package)
    assert len(found) <= MOST_AT_TOP, lines(found)


def test_no_larger_constructor(package):
    wrong = [f"{place}: {name} takes {n}" for n, name, place in structure.constructors(package) if n > MOST_ARGUMENTS]
    assert not wrong, lines(wrong)


def test_no_more_methods_in_one_class(package):
    found = structure.methods(package, "DDiffPG")
    assert len(found) <= MOST_METHODS, lines([f"{len(found)} methods, accepted are {MOST_METHODS}:", *found])


def test_little_is_touched_that_is_private(package):
    found = structure.private_accesses(package)
    assert len(found) <= MOST_PRIVATE, lines([f"{len(found)} accesses, accepted are {MOST_PRIVATE}:", *found])


def test_files_are_short(package):
    found = structure.long_files(package)
    assert len(found) <= MOST_LONG_FILES, lines(found)


# ---------------------------------------------------------------------- they can fail

# Beside a module of modes, which is above buffers
IMPORTS = {
    "absolute": "from sb3_ddiffpg.modes.mode import Mode",
    "whole": "import sb3_ddiffpg.modes.mode",
    "module": "from sb3_ddiffpg.modes import mode",
    "relative": "from ..modes.mode import Mode",
    "relative module": "from ..modes import mode",
}


@pytest.mark.parametrize("statement", IMPORTS.values(), ids=IMPORTS.keys())
@pytest.mark.parametrize(
    "where", ["{}", "def late():\n    {}", "if TYPE_CHECKING:\n    {}"], ids=["file", "function", "types"]
)
def test_an_upward_import_is_found(tmp_path, statement, where):
    text = where.format(statement)
    package = made_up(tmp_path, {"modes/mode": "class Mode: ...", "buffers/a": text})
    line = 1 + text.count("\n")
    message = f"sb3_ddiffpg/buffers/a.py:{line}: buffers imports sb3_ddiffpg.modes.mode, and modes is above buffers"
    assert structure.upward_imports(package) == [message]


def test_an_import_of_the_top_is_found(tmp_path):
    package = made_up(
        tmp_path,
        {"__init__": "", "report": "", "zoo/a": "\nfrom sb3_ddiffpg import DDiffPG", "zoo/b": "from .. import report"},
    )
    assert structure.upward_imports(package) == [
        "sb3_ddiffpg/zoo/a.py:2: zoo imports sb3_ddiffpg, and (top) is above zoo",
        "sb3_ddiffpg/zoo/b.py:1: zoo imports sb3_ddiffpg.report, and (top) is above zoo",
    ]


def test_downward_imports_are_none(tmp_path):
    package = made_up(
        tmp_path,
        {
            "__init__": "from sb3_ddiffpg.modes.mode import Mode",
            "report": "from sb3_ddiffpg.experiments.a import a",
            "modes/mode": "import numpy\nfrom sb3_ddiffpg.modes.other import a\nfrom sb3_ddiffpg.utils.a import a",
            "modes/other": "",
            "utils/a": "",
            "experiments/a": "from sb3_ddiffpg.modes.mode import Mode",
        },
    )
    assert structure.upward_imports(package) == structure.circles(package) == []


def test_a_package_that_is_not_in_the_order_is_found(tmp_path):
    package = made_up(tmp_path, {"helpers/a": ""})
    assert structure.upward_imports(package) == [
        "sb3_ddiffpg/helpers/a.py: the package helpers is not in the order of packages"
    ]


def test_a_circle_is_found(tmp_path):
    """Of three packages, though no two modules import each other."""
    package = made_up(
        tmp_path,
        {
            "utils/a": "\nfrom sb3_ddiffpg.modes import a",
            "modes/a": "",
            "modes/b": "def late():\n    from sb3_ddiffpg.envs.a import a",
            "envs/a": "",
            "envs/b": "from sb3_ddiffpg.utils.b import a",
            "utils/b": "",
            "zoo/a": "from sb3_ddiffpg.utils.b import a",
        },
    )
    (message,) = structure.circles(package)
    assert message.startswith("a circle of envs, modes, utils: ")
    for part in (
        "envs imports utils (sb3_ddiffpg/envs/b.py:1)",
        "modes imports envs (sb3_ddiffpg/modes/b.py:2)",
        "utils imports modes (sb3_ddiffpg/utils/a.py:2)",
    ):
        assert part in message
    assert "zoo" not in message


def test_what_environments_import_is_found(tmp_path):
    text = "from sb3_ddiffpg.utils import a\nimport sb3_ddiffpg.buffers.a"
    package = made_up(tmp_path, {"utils/a": "", "buffers/a": "", "envs/a": text})
    assert structure.other_imports(package, "envs", ENVS_MAY_IMPORT) == [
        "sb3_ddiffpg/envs/a.py:2: envs imports sb3_ddiffpg.buffers.a; accepted are utils, serialization"
    ]


def test_sizes_by_hand(tmp_path):
    package = made_up(
        tmp_path,
        {
            "__init__": "",
            "one": "",
            "two": "",
            "utils/long": "\n" * 451,
            "utils/full": "\n" * 450,
            "utils/a": "class A:\n    def __init__(self, a, b, /, c, *d, e, **f): ...\nclass B:\n    def __init__(self): ...",
        },
    )
    assert structure.modules_at_top(package) == ["sb3_ddiffpg/one.py", "sb3_ddiffpg/two.py"]
    assert structure.long_files(package) == ["sb3_ddiffpg/utils/long.py: 451 lines"]
    assert structure.constructors(package) == [(4, "A", "sb3_ddiffpg/utils/a.py:2"), (0, "B", "sb3_ddiffpg/utils/a.py:4")]


ROOT_CLASS = """
class Root:
    def __init__(self): ...
    def __len__(self): ...
    def shared(self): ...
"""
LEAF_CLASS = """
import torch
from sb3_ddiffpg.utils import Base

class Middle(Base, torch.nn.Module):
    @property
    def value(self): ...

class Leaf(Middle, Generic[T]):
    def shared(self):
        def inner(): ...
    @staticmethod
    def own(): ...

class Other(Base):
    def none(self): ...
"""


def test_methods_are_those_of_the_chain(tmp_path):
    """Through other files, also where an ``__init__.py`` hands a class on; of classes of others none."""
    handed_on = "from sb3_ddiffpg.utils.root import Root as Base"
    package = made_up(tmp_path, {"utils/__init__": handed_on, "utils/root": ROOT_CLASS, "modes/a": LEAF_CLASS})
    assert structure.methods(package, "Leaf") == ["Leaf.shared", "Leaf.own", "Middle.value", "Root.__init__", "Root.shared"]
    with pytest.raises(ValueError, match="Absent is not defined"):
        structure.methods(package, "Absent")


TOUCHES = """
import torch
class A(B):
    def f(self, other):
        self._x = other._x
        super()._f()
        self.part._y += 1
        torch._C, other.__dict__, other._replace(a=1)
        return make()._z
"""


def test_private_accesses_are_those_of_others(tmp_path):
    assert structure.private_accesses(made_up(tmp_path, {"utils/a": TOUCHES})) == [
        "sb3_ddiffpg/utils/a.py:5: other._x",
        "sb3_ddiffpg/utils/a.py:7: self.part._y",
        "sb3_ddiffpg/utils/a.py:9: make()._z",
    ]


def test_the_longest_chain_by_hand(tmp_path):
    """An import within a function is none of it, and a circle ends."""
    files = {
        "utils/a": "",
        "utils/b": "from sb3_ddiffpg.utils import a",
        "utils/c": "from sb3_ddiffpg.utils.b import x\nfrom sb3_ddiffpg.utils.a import y",
        "utils/d": "def late():\n    from sb3_ddiffpg.utils import c",
    }
    assert structure.longest_chain(made_up(tmp_path, files)) == [f"sb3_ddiffpg.utils.{name}" for name in "cba"]
    package = made_up(tmp_path, {"utils/a": "from sb3_ddiffpg.utils import c"})
    assert len(structure.longest_chain(package)) == 3


def test_bodies_are_counted_without_docstrings(tmp_path):
    text = 'def f():\n    """\n    Long.\n    """\n    a = 1\n\n    return a\n\n\ndef g():\n    """Nothing."""\n'
    assert structure.body_lines(made_up(tmp_path, {"utils/a": text})) == [3, 0]
