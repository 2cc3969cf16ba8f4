"""Pages lead where they say, every public name has a page, and the quickstart runs. Needs nothing that builds the site."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)(?: \"[^\"]*\")?\)")


def pages() -> list[Path]:
    """All that git knows, or may come to know, but models of recorded runs and what other versions wrote."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    return [ROOT / name for name in names if not name.startswith("tests/") and (ROOT / name).exists()]


def prose(text: str) -> str:
    """Without blocks of code."""
    return re.sub(r"^(```+).*?^\1$", "", text, flags=re.MULTILINE | re.DOTALL)


def anchor(heading: str) -> str:
    """As GitHub makes it."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading.strip()).lower()
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


def anchors(text: str) -> list[str]:
    return [anchor(heading) for heading in re.findall(r"^#+ (.*)$", prose(text), re.MULTILINE)]


def dead_links(page: Path) -> list[str]:
    """
    :param page: A page in Markdown
    :return: What its links name and is not there
    """
    dead = []
    for target in LINK.findall(re.sub(r"`[^`\n]*`", "", prose(page.read_text()))):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, fragment = target.partition("#")
        path = page.parent / name if name else page
        if not path.exists() or (fragment and fragment not in anchors(path.read_text())):
            dead.append(target)
    return dead


def test_links_lead_somewhere():
    dead = [f"{page.relative_to(ROOT)}: {target}" for page in pages() for target in dead_links(page)]
    assert not dead, "\n".join(dead)


def test_a_dead_link_is_found(tmp_path):
    page = tmp_path / "a.md"
    page.write_text("# A `b`: c\n\n[1](a.md#a-b-c) [2](a.md#a) [3](#a-b-c) [4](b.md) ![5](b.png) [6](https://b) `[7](c)`\n")
    assert dead_links(page) == ["a.md#a", "b.md", "b.png"]


def offered(package: Path) -> set[tuple[str, str]]:
    """
    :param package: Its folder
    :return: Module and name of all that any ``__all__`` lists
    """
    found = set()
    for file in package.rglob("*.py"):
        parts = file.relative_to(package.parent).with_suffix("").parts
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.Assign) and [ast.unparse(each) for each in node.targets] == ["__all__"]:
                found |= {(module, name) for name in ast.literal_eval(node.value)}
    return found


def listed(pages: list[str]) -> set[tuple[str, str]]:
    """
    :param pages: Texts of API pages
    :return: Module and name of all that they describe
    """
    lists = re.compile(r"^\.\. public-api:: (\S+)\n\n((?:   \S+\n)+)", re.MULTILINE)
    return {(module, name) for page in pages for module, names in lists.findall(page) for name in names.split()}


def test_every_public_name_has_a_page():
    pages = [page.read_text() for page in (ROOT / "docs" / "api").glob("*.rst")]
    public = offered(ROOT / "sb3_ddiffpg")
    assert len(public) > 90
    assert not (missing := sorted(public - listed(pages))), missing


def test_settings_have_a_page():
    page = (ROOT / "docs" / "api" / "settings.rst").read_text()
    groups = {
        name
        for file in ROOT.glob("sb3_ddiffpg/*/settings.py")
        for name in re.findall(r"^class (\w+)\(Settings", file.read_text(), re.M)
    }
    assert len(groups) == 5
    assert groups <= {name for _, name in listed([page])}


def test_a_name_without_a_page_is_found(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "__init__.py").write_text('__all__ = ["B", "c"]')
    page = ".. public-api:: a\n\n   B\n   b.d\n\nWords\n"
    assert offered(tmp_path / "a") - listed([page]) == {("a", "c")}


def test_every_page_is_in_the_navigation():
    """The site's build asks for it too."""
    named = {"docs/index"}
    for index in (ROOT / "docs").rglob("index.md"):
        for line in index.read_text().splitlines():
            entry = re.sub(r"^.*<(.*)>$", r"\1", line)
            if re.fullmatch(r"\w[\w/]*", entry):
                named.add((index.parent / entry).relative_to(ROOT).as_posix())
    found = {page.relative_to(ROOT).with_suffix("").as_posix() for page in pages() if page.is_relative_to(ROOT / "docs")}
    assert not (missing := found - named), missing


NOTEBOOK = """---
jupytext:
  text_representation:
    extension: .md
    format_name: myst
kernelspec:
  display_name: Python 3
  name: python3
---
"""


def test_tutorials_open_as_notebooks():
    """The site's build runs them; without all of these lines Jupyter would see a single cell of text."""
    pages = [page for page in (ROOT / "docs" / "tutorials").glob("*.md") if page.name != "index.md"]
    assert len(pages) == 5 and all(page.read_text().startswith(NOTEBOOK) for page in pages)


def quickstart() -> str:
    (code,) = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / "quickstart.md").read_text(), re.MULTILINE | re.DOTALL)
    return code


def test_quickstart_is_short():
    assert len([line for line in quickstart().splitlines() if line]) <= 20


@pytest.mark.slow
def test_quickstart_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(quickstart(), "quickstart.md", "exec"), names)
    assert "uncommanded: 2.00 modes expected" in capsys.readouterr().out
