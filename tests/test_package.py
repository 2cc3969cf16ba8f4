"""What is built, declared and installed."""

import configparser
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def config() -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    return parser


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, because setuptools leaves its files in the source tree."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("sb3_ddiffpg", "zoo_hyperparams"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    command = [sys.executable, "-m", "pip", "wheel", "--no-build-isolation", "--no-deps", "--no-index", "-w", out, source]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    (path,) = out.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the unpacked wheel and nothing of the checkout."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def run_installed(installed: Path, code: str) -> str:
    # Without -P the working directory would come first; PYTHONPATH comes before an editable install
    command = [sys.executable, "-P", "-c", code]
    result = subprocess.run(command, cwd=installed.parent, env={"PYTHONPATH": str(installed)}, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_wheel_holds_every_file_of_the_package(wheel):
    with zipfile.ZipFile(wheel) as archive:
        built = set(archive.namelist())
    expected = {path.relative_to(ROOT).as_posix() for path in (ROOT / "sb3_ddiffpg").rglob("*.py")}
    expected |= {f"sb3_ddiffpg/zoo_hyperparams/{path.name}" for path in (ROOT / "zoo_hyperparams").iterdir()}
    data = [ROOT / "sb3_ddiffpg" / "py.typed", ROOT / "sb3_ddiffpg" / "experiments" / "paper.yml"]
    data += [
        *(ROOT / "sb3_ddiffpg" / "visualization" / "templates").iterdir(),
        *(ROOT / "sb3_ddiffpg" / "experiments" / "suites").iterdir(),
    ]
    expected |= {path.relative_to(ROOT).as_posix() for path in data}
    assert {name for name in built if ".dist-info/" not in name} == expected
    assert any(name.endswith("LICENSE") for name in built)


def test_metadata(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("METADATA"))
        metadata = Parser().parsestr(archive.read(name).decode())
        scripts = archive.read(name.replace("METADATA", "entry_points.txt")).decode()
    assert metadata["Name"] == "sb3_ddiffpg"
    assert metadata["License-Expression"] == "MIT"
    assert set(metadata["Requires-Python"].split(",")) == {">=3.11", "<3.13"}
    assert set(metadata.get_all("Provides-Extra")) == {
        "franka",
        "zoo",
        "plots",
        "hub",
        "cluster",
        "onnx",
        "docs",
        "fuzz",
        "dev",
        "all",
    }
    assert "ddiffpg = sb3_ddiffpg.zoo:main" in scripts
    assert "ddiffpg-experiments = sb3_ddiffpg.experiments.__main__:main" in scripts
    pybullet = [Requirement(line) for line in metadata.get_all("Requires-Dist") if line.startswith("pybullet")]
    assert [requirement.marker.evaluate({"python_version": "3.12", "extra": "franka"}) for requirement in pybullet] == [False]


def test_configuration_comes_from_the_installed_package(installed):
    path = Path(run_installed(installed, "from sb3_ddiffpg.zoo import config_file; print(config_file('ddiffpg'))"))
    assert path == installed / "sb3_ddiffpg" / "zoo_hyperparams" / "ddiffpg.yml"
    assert path.read_bytes() == (ROOT / "zoo_hyperparams" / "ddiffpg.yml").read_bytes()


def test_import_is_cheap(installed):
    heavy = "mujoco", "pybullet", "gymnasium_robotics", "matplotlib", "rl_zoo3", "ray", "scipy.signal", "scipy.stats"
    for code, names in (
        ("import sb3_ddiffpg, sb3_ddiffpg.envs", (*heavy, "torch", "stable_baselines3", "scipy", "numba")),
        ("from sb3_ddiffpg import *; from sb3_ddiffpg.envs import *", heavy),
    ):
        code = f"import sys; {code}; print([name for name in {names} if name in sys.modules])"
        assert run_installed(installed, code) == "[]"


def test_what_is_imported_when_it_is_asked_for():
    import sb3_ddiffpg

    assert sb3_ddiffpg.DDiffPG is sb3_ddiffpg.ddiffpg.DDiffPG and set(sb3_ddiffpg.__all__) <= set(dir(sb3_ddiffpg))
    with pytest.raises(AttributeError, match="sb3_ddiffpg attribute DDiffGP"):
        _ = sb3_ddiffpg.DDiffGP
    with pytest.raises(ImportError, match="cannot import name 'WorkVecEnv' from 'sb3_ddiffpg.envs.vec_env'"):
        from sb3_ddiffpg.envs.vec_env import WorkVecEnv  # noqa: F401


# Imports modules, with all that they offer, as if nothing else were installed than what these extras ask for
WITHOUT_OTHERS = """
import importlib, sys
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

wanted, modules = sys.argv[1].split(","), sys.argv[2:]
known, waiting = set(), [("sb3_ddiffpg", extra) for extra in ["", *wanted]]
while waiting:
    name, extra = waiting.pop()
    if (canonicalize_name(name), extra) in known:
        continue
    known.add((canonicalize_name(name), extra))
    try:
        lines = requires(name) or []
    except PackageNotFoundError:
        continue
    for requirement in map(Requirement, lines):
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            waiting += [(requirement.name, each) for each in ["", *requirement.extras]]
installed = {name for name, _ in known}
others = {
    top
    for top, distributions in packages_distributions().items()
    if not any(canonicalize_name(each) in installed for each in distributions)
}

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in others:
            raise ModuleNotFoundError(f"No module named {name!r} where only {wanted} are installed", name=name)

sys.meta_path.insert(0, Absent())
for name in [name for name in sys.modules if name.split(".")[0] in others]:
    del sys.modules[name]
for module in map(importlib.import_module, modules):
    for name in getattr(module, "__all__", ()):
        getattr(module, name)
"""


@pytest.mark.parametrize(
    ("extras", "modules"),
    [
        ("", ["sb3_ddiffpg", "sb3_ddiffpg.callbacks.checkpoint"]),
        ("zoo", ["sb3_ddiffpg.zoo"]),
        ("plots", ["sb3_ddiffpg.visualization.plots", "sb3_ddiffpg.report"]),
        ("zoo,plots", [f"sb3_ddiffpg.experiments.{name}" for name in ("training", "run", "report")]),
        ("zoo,plots,hub", ["sb3_ddiffpg.experiments.card"]),
    ],
)
def test_extras_are_enough(extras, modules):
    """What tests and other extras bring along must not hide what is missing."""
    done = subprocess.run([sys.executable, "-c", WITHOUT_OTHERS, extras, *modules], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_one_version(config):
    version = config["metadata"]["version"]
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    assert f"version = {{{version}}}" in (ROOT / "docs" / "citing.md").read_text()
    assert f'__version__ = "{version}"' in (ROOT / "sb3_ddiffpg" / "__init__.py").read_text()
    assert re.search(rf"^## \[{re.escape(version)}\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def test_constraints_pin_every_requirement(config):
    pins = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            name, version = re.fullmatch(r"([\w.-]+)==([\w.]+)", line).groups()
            pins[canonicalize_name(name)] = version
    texts = [config["options"]["install_requires"], *config["options.extras_require"].values()]
    lines = [line for text in texts for line in text.splitlines() if line and not line.startswith("#")]
    requirements = [Requirement(line) for line in lines]
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    for requirement in [*requirements, *map(Requirement, build)]:
        if requirement.name != "sb3_ddiffpg":
            assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), str(requirement)
