"""Pages lead where they say: files and headings. Needs nothing that builds the site."""

import re
import subprocess
from pathlib import Path

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
