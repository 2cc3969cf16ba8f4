"""The page in a real browser: each control does what it says, by mouse and by keyboard."""

import itertools
import json

import numpy as np
import pytest

from sb3_ddiffpg.visualization.page import Shown, as_json, render
from sb3_ddiffpg.visualization.palette import COLORS, MARKERS, SHAPES, SYMBOLS, styles
from sb3_ddiffpg.visualization.sketch import Course, Life, MazeSketch, ModeSketch, Sketch

HOSTILE = "</script><img src=x onerror='window.hacked = 1'><b>bold</b>"


def shown(label, n_modes=3, route="above"):
    """A model whose mode k goes to (10, 2 k); of its four episodes the last one fails."""
    names = [f"mode_{k}" for k in range(n_modes)]
    modes = [ModeSketch(k, name, 100 * k, 5, 0.5, 10.0, k == 1, [[0, 10], [0, 2 * k]]) for k, name in enumerate(names)]
    episodes = [
        [
            {
                "ok": e < 3,
                "length": 10 + e,
                "ret": 1.0,
                "route": route,
                "path": [[0, 5, 10], [0, k + 0.3 * e, 2 * k + 0.3 * e]],
            }
            for e in range(4)
        ]
        for k in range(n_modes)
    ]
    values = {"step": [0, 1, 2], "value": [[k, k + 1, k + 2] for k in range(n_modes)]}
    starts = {"x": [0, 1], "y": [0, 1], "ok": [True, False], "said": "1 of 2 reached the goal."}
    return Shown(
        label=label,
        subtitle=f"{n_modes} modes",
        sketch=Sketch(
            "Some-v0",
            1000,
            ["x [m]", "y [m]"],
            MazeSketch([[-2, 8, 12, 9]], [-2, 12, -2, 9], [0, 0], [[10, 2]]),
            modes,
            [Life(k, name, 100 * k, "born") for k, name in enumerate(names)]
            + [Life(12, "mode_12", 50, "born", 70, "merged into mode_1")],
            [Course(k, [0, 500, 1000], [0.0, None, 1.0], [1, 2, 3]) for k in range(n_modes)],
            [(0, "mode_0 born"), (100, "mode_1 born"), (50, "mode_12 born"), (70, "mode_12 merged into mode_1")],
            ([0, 1000], [1, 50]),
        ),
        head=["route taken", "success"],
        cells={name: [route, "75%"] for name in names},
        best="mode_1",
        extra={n: {"episodes": e, "starts": starts, "values": values} for n, e in zip(names, episodes, strict=True)},
        tests={"step": [500, 1000], "success": [0.2, 0.9], "modes": [0.5, 2.0]},
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "page.html"
    path.write_text(render(f"A title {HOSTILE}", [shown("first", route=HOSTILE), shown("second")], "versions"))
    return path


@pytest.fixture
def opened(browser, page):
    """The page as it is when it has just been opened; loaded once, and led back between tests."""
    if browser.run("location.href") != page.as_uri():
        browser.open(page.as_uri())
        browser.until("!!document.body.dataset.drawn")
    browser.move(1, 1)
    browser.resize(1280, 900)
    browser.run(RESET)
    yield browser
    assert browser.errors == []


RESET = """(() => {
  const change = (selector, value, kind = "change") =>
    Object.assign(document.querySelector(selector), {value}).dispatchEvent(new Event(kind));
  change("#beside", "");
  change("#shown", "0/0");
  change("#shown", "0/1");
  window.scrollTo(0, 0);
})()"""


def heads(browser):
    return browser.run("[...document.querySelectorAll('.panel h3')].map((each) => each.textContent)")


def said(browser, panel=0):
    return browser.run(f"document.querySelectorAll('.panel .said')[{panel}].textContent")


def place(browser, chart, x, y):
    """Where in the window a chart draws a point of its data."""
    return browser.run(
        f"(() => {{const chart = document.querySelector({json.dumps(chart)}); chart.scrollIntoView({{block: 'center'}});"
        "const {left, top} = chart.getBoundingClientRect(), {xaxis, yaxis} = chart._fullLayout;"
        f"return [left + xaxis._offset + xaxis.l2p({x}), top + yaxis._offset + yaxis.l2p({y})]}})()"
    )


def pick(browser, selector, value):
    """Choose of a list by the keyboard: its first letters would do, but all begin alike."""
    browser.run(f"document.querySelector('{selector}').focus()")
    values = browser.run(f"[...document.querySelector('{selector}').options].map((each) => each.value)")
    at = browser.run(f"document.querySelector('{selector}').selectedIndex")
    for _ in range(values.index(value) - at):
        browser.press("ArrowDown")
    assert browser.run(f"document.querySelector('{selector}').value") == value


# ---------------------------------------------------------------------- clicked through


def test_a_click_shows_a_mode(opened):
    assert heads(opened) == ["mode_1 of first"]  # the one to command first, at the top
    opened.click("button[data-model='0'][data-mode='2']")
    assert heads(opened) == ["mode_2 of first"]
    pressed = "[...document.querySelectorAll('button[aria-pressed=true]')].map((each) => each.textContent.trim())"
    assert opened.run(pressed) == ["mode_2"]
    drawn = "[...document.querySelectorAll('.panel .chart')].map((each) => each.data?.length ?? 0)"
    assert all(n > 0 for n in opened.run(drawn))
    labels = opened.run("[...document.querySelectorAll('.panel .chart')].map((each) => each.getAttribute('aria-label'))")
    assert "Paths of mode_2 of first. All: 3 of 4 episodes reached the goal" in labels[0]
    assert "1 of 2 reached the goal." in labels[1]
    # A mode of the other model, then one by a click on a path that all modes' chart draws
    opened.click("button[data-model='1'][data-mode='0']")
    assert heads(opened) == ["mode_0 of second"]
    opened.click_at(*place(opened, "#paths-0", 10, 4))
    opened.until("document.querySelector('.panel h3').textContent === 'mode_2 of first'", 10)


def test_events_of_a_mode_are_its_own(opened):
    events = "[...document.querySelectorAll('.panel .events li')].map((each) => each.textContent)"
    assert opened.run(events) == ["step 100: mode_1 born", "step 70: mode_12 merged into mode_1"]


def test_hovering_a_path_tells_its_episode(opened):
    opened.move(*place(opened, ".panel .paths", 5, 1.6))  # the third of mode_1
    opened.until("document.querySelector('.panel .said').textContent.startsWith('Episode 3 of 4')", 10)
    assert "Episode 3 of 4: success, 12 steps, return 1, route </script>" in said(opened)
    assert opened.run("document.querySelector('.panel .episode input').value") == "3"
    told = opened.run("document.querySelector('.panel .paths .hoverlayer').textContent")
    assert "mode_1. Episode 3 of 4: success" in told and "<b>bold</b>" in told
    opened.move(*place(opened, ".panel .paths", 5, 1.9))
    opened.until("document.querySelector('.panel .said').textContent.startsWith('Episode 4 of 4: failure')", 10)


def test_all_of_it_by_keyboard(opened):
    reached = []
    opened.run("Object.assign(document.querySelector('h1'), {tabIndex: -1}).focus()")
    for _ in range(60):
        opened.press("Tab")
        what = opened.run(
            "(() => {const e = document.activeElement, text = e.textContent.trim();"
            "return [e.tagName, e.id || text.slice(0, 9) || e.type, getComputedStyle(e).outlineStyle,"
            "Boolean(e.labels?.length || e.ariaLabel || text)]})()"
        )
        if what[0] == "BODY":
            break
        reached.append(what)
    assert [each[2] for each in reached] == ["solid"] * len(reached), "focus can be seen"
    assert all(each[3] for each in reached), "each control has a name"
    names = [each[1] for each in reached]
    for control in ("mode_0", "mode_2", "shown", "beside", "range"):
        assert control in names, names
    # A button by space, an episode by arrows
    opened.run("document.querySelector(\"button[data-model='0'][data-mode='0']\").focus()")
    opened.press("Space")
    assert heads(opened) == ["mode_0 of first"]
    opened.run("document.querySelector('.panel .episode input').focus()")
    opened.press("ArrowRight")
    assert said(opened).startswith("Episode 1 of 4: success, 10 steps")
    assert opened.run("document.activeElement.ariaValueText").startswith("Episode 1 of 4")
    opened.press("End")
    assert said(opened).startswith("Episode 4 of 4: failure")
    pick(opened, "#shown", "1/1")
    assert heads(opened) == ["mode_1 of second"]


def test_two_side_by_side_and_on_a_phone(opened):
    pick(opened, "#beside", "0/2")  # of one model
    assert heads(opened) == ["mode_1 of first", "mode_2 of first"]
    pick(opened, "#beside", "1/1")  # of two
    assert heads(opened) == ["mode_1 of first", "mode_1 of second"]
    boxes = "[...document.querySelectorAll('.panel')].map((each) => [each.offsetLeft, each.offsetTop])"
    (left, top), (right, level) = opened.run(boxes)
    assert right > left + 300 and level == top
    fits = "[...document.querySelectorAll('.panel .main-svg')].every((each) => each.getBoundingClientRect().right <="
    opened.until(f"{fits} each.closest('.panel').getBoundingClientRect().right)", 10)
    # An episode of one is not one of the other
    opened.run("document.querySelectorAll('.panel .episode input')[1].focus()")
    opened.press("ArrowRight")
    assert said(opened, 1).startswith("Episode 1 of 4") and said(opened, 0).startswith("All")
    opened.resize(390, 844)
    opened.until("document.querySelector('.panel .paths .main-svg').getBoundingClientRect().width < 390", 10)
    (left, top), (right, level) = opened.run(boxes)
    assert right == left and level > top + 300  # one below the other
    assert opened.run("document.documentElement.scrollWidth") <= 390
    widest = (
        "Math.max(...[...document.querySelectorAll('.chart .main-svg')].map((each) => each.getBoundingClientRect().right))"
    )
    opened.until(f"{widest} <= 390", 10)
    opened.run("Object.assign(document.querySelector('#beside'), {selectedIndex: 0}).dispatchEvent(new Event('change'))")
    assert heads(opened) == ["mode_1 of first"]


def test_texts_of_users_are_texts(opened):
    assert opened.run("window.hacked ?? null") is None and opened.run("document.querySelectorAll('img').length") == 0
    assert opened.run("document.querySelector('h1').textContent") == f"A title {HOSTILE}"
    # Nothing can be fetched, whatever a text may have become
    fetched = opened.run("fetch('http://127.0.0.1:9/').then(() => 'fetched', (error) => error.name)")
    assert fetched == "TypeError"
    assert opened.run("performance.getEntriesByType('resource').filter((each) => !each.name.startsWith('data:')).length") == 0
    assert any("Content Security Policy" in each for each in opened.errors)
    opened.errors.clear()


def test_data_cannot_end_its_element():
    text = as_json({"name": f"{HOSTILE}<!-- &\u2028"})
    assert not set("<>&\u2028") & set(text) and json.loads(text) == {"name": f"{HOSTILE}<!-- &\u2028"}
    with pytest.raises(ValueError):
        as_json(float("nan"))


# ---------------------------------------------------------------------- colours

# What is left of linear RGB without one of the three receptors: G. M. Machado, M. M. Oliveira, L. A. F. Fernandes, "A
# Physiologically-based Model for Simulation of Color Vision Deficiency" (2009), severity 1
SEEN_BY = {
    "all": np.eye(3),
    "protanopes": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopes": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopes": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(color, seen):
    """CIELAB of a colour ``#rrggbb``, as somebody sees it."""
    rgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    white = _XYZ @ np.ones(3)
    x, y, z = np.cbrt(np.maximum(_XYZ @ np.clip(np.asarray(seen) @ linear, 0, 1) / white, 1e-9))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("seen", SEEN_BY.values(), ids=SEEN_BY.keys())
def test_eight_colours_are_told_apart(seen):
    """By at least six times what is just noticed (2.3). Of Matplotlib's own ten, two are 5 apart to protanopes."""
    seen_as = [lab(color, seen) for color in COLORS]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen_as, 2)) > 6 * 2.3


@pytest.mark.parametrize("numbers", [range(72), [6, 9, 12, 13, 22, 26, 29, 30], range(0, 576, 8), range(0, 5184, 72)])
def test_modes_are_told_apart_whatever_their_numbers(numbers):
    """The second ones are those of a recorded run: by their numbers alone three were black, and two sky blue."""
    looks = styles(numbers)
    assert len({(look.color, look.marker) for look in looks.values()}) == len(numbers)
    first = sorted(numbers)[:8]
    assert len({looks[number].color for number in first}) == len({looks[number].marker for number in first}) == 8
    # A mode that is born changes no other's
    assert styles([*numbers, max(numbers) + 5]).items() >= looks.items()
    assert len(COLORS) == 8 and len(MARKERS) == len(SYMBOLS) == len(SHAPES) == 9
