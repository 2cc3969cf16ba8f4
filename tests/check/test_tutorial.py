"""What ``docs/tutorials/your_own_environment.md`` tells a reader to do is done, from top to bottom."""

import os
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from sb3_ddiffpg import DDiffPG, report
from sb3_ddiffpg.check import command

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "your_own_environment.md"
COMMANDS = {"ddiffpg check": command.main, "python -m sb3_ddiffpg.report": report.main}
# Few steps, in a room whose exit random actions reach in one episode of eight: enough for a first mode
FEW = {
    "30_000, 20": "4_800, 4",
    "--episodes 20": "--episodes 2",
    "else -120": "else -40",
    "else 120": "else 40",
    "- 110) > 28": "- 110) > 90",
}


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of each block of code, in order."""
    return re.findall(r"^```(python|bash)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)


def follow(page: str) -> dict[str, Any]:
    """Do what it says in the folder in which we are; what is defined at its end."""
    names: dict[str, Any] = {}
    for language, text in blocks(page):
        if text.startswith("# room.py"):
            Path("room.py").write_text(text)
        elif language == "python":
            exec(compile(text, PAGE.name, "exec"), names)
        else:
            (start,) = [each for each in COMMANDS if text.startswith(each)]
            COMMANDS[start](shlex.split(text.removeprefix(start)))
    return names


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """A folder of their own, from which modules are imported."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(os.fspath(tmp_path))
    yield tmp_path
    sys.modules.pop("room", None)
    gym.registry.pop("Room-v0", None)


def test_all_blocks_run(reader, capsys):
    page = PAGE.read_text()
    for whole, few in FEW.items():
        assert page.count(whole) == 1
        page = page.replace(whole, few)
    names = follow(page)
    out = capsys.readouterr().out
    assert "room:Room-v0 can be trained on" in out and "Replanner" in out
    assert (reader / "room.html").stat().st_size > 10_000
    assert set(names["again"].modes.names) >= set(names["model"].modes.names) and names["model"].modes
    assert names["again"].num_timesteps == 5_280


def test_the_page_shows_what_is_printed(reader, capsys):
    """Numbers apart, which are those of one machine."""
    page = PAGE.read_text()
    follow("".join(f"```{language}\n{text}```\n" for language, text in blocks(page)[:2]))
    shown = re.search(r"^```text\n(room:Room-v0 can be .*?)^```$", page, re.MULTILINE | re.DOTALL)
    without = [re.sub(r"[\d.]+", "#", text).split() for text in (shown[1], capsys.readouterr().out)]
    assert without[0] == without[1]


@pytest.mark.slow
def test_default_settings_learn_both_ways(reader):
    names = follow(PAGE.read_text())
    sides = {name.split()[0] for name in names["model"].modes.names}
    assert sides == {"west", "east"} and isinstance(names["model"], DDiffPG)
