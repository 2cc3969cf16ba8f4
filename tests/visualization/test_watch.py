"""Watching a run in progress: what is written, what is read of it, who may ask, and a browser that sees it change."""

import errno
import http.client
import json
import os
import socket
import threading

import msgspec
import numpy as np
import pytest
from environments import TwoEnds, small_model
from stable_baselines3.common.vec_env import DummyVecEnv
from test_page import shown
from test_report import SPLIT_AND_MERGED

from sb3_ddiffpg import LiveCallback
from sb3_ddiffpg.modes.history import ModeHistory
from sb3_ddiffpg.visualization.runs import MOST_RUNS, read_runs, read_sketch
from sb3_ddiffpg.visualization.sketch import CURVE_POINTS, PATH_POINTS, Life, columns, lives, sketch, thin
from sb3_ddiffpg.visualization.watch import Watcher, main
from sb3_ddiffpg.zoo.commands import COMMANDS

# ---------------------------------------------------------------------- what is written


def test_a_sketch_is_of_the_model(trained, tmp_path):
    found = sketch(trained, "TwoEnds")
    path = tmp_path / "live.json"
    path.write_bytes(msgspec.json.encode(found))
    assert read_sketch(path) == found
    assert [(mode.number, mode.name, mode.born_at) for mode in found.modes] == [
        (mode.number, mode.name, mode.born_at) for mode in trained.modes
    ]
    assert found.events == [(event.step, str(event)) for event in trained.mode_history]
    assert found.steps == 400 and found.coverage[1] == sorted(found.coverage[1])
    for mode, own in zip(found.modes, trained.modes, strict=True):
        last = [own.representative[-1, index] for index in range(len(mode.route))]
        np.testing.assert_allclose([column[-1] for column in mode.route], last, atol=1e-3 * np.ptp(own.representative))
    for course in found.courses:
        states = [state for state in trained.mode_history.states if state.number == course.number]
        kept = thin(len(states), CURVE_POINTS)
        assert course.n_trajectories == [states[index].n_trajectories for index in kept]


def test_the_lives_of_modes():
    assert lives(ModeHistory([*SPLIT_AND_MERGED])) == [
        Life(0, "old road", 10, "born"),
        Life(1, "mode_1", 20, "split from mode_0", 30, "merged into old road"),
    ]


def test_paths_are_thinned():
    path = np.stack([np.linspace(0, 1000, 5000), np.zeros(5000)], axis=1)
    x, y = columns(path)
    assert len(x) == len(y) == PATH_POINTS and (x[0], x[-1]) == (0.0, 1000.0)
    assert columns(np.zeros((0, 0))) == [] and columns(np.ones((1, 2))) == [[1.0], [1.0]]
    assert thin(0, 5).tolist() == [] and thin(3, 5).tolist() == [0, 1, 2]


def test_a_run_writes_it_and_goes_on_without(tmp_path, monkeypatch):
    model = small_model(DummyVecEnv([TwoEnds] * 4))
    model.learn(40, callback=LiveCallback(tmp_path / "run", 0))
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["live.json"]
    assert read_sketch(tmp_path / "run" / "live.json").steps == model.num_timesteps

    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    model.learn(40, callback=LiveCallback(tmp_path / "run", 0))
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["live.json"]
    with pytest.raises(ValueError, match="seconds: -1 given"):
        LiveCallback(tmp_path, -1)


# ---------------------------------------------------------------------- what is read


@pytest.fixture
def logs(tmp_path):
    folder = tmp_path / "logs"
    (folder / "one").mkdir(parents=True)
    (folder / "one" / "live.json").write_bytes(msgspec.json.encode(shown("one", n_modes=2).sketch))
    return folder


def test_whatever_a_file_holds(logs):
    (own,) = read_runs(logs)
    assert own.label == "one" and list(own.cells) == ["mode_0", "mode_1"]
    whole = (logs / "one" / "live.json").read_bytes()
    known = json.loads(whole)
    for damaged in (
        b"",
        whole[: len(whole) // 2],
        b"[" * 100_000,
        b"\xff\xfe",
        b"[]",
        json.dumps({**known, "coverage": [[1], []]}).encode(),
        json.dumps({**known, "modes": "none"}).encode(),
    ):
        (logs / "one" / "live.json").write_bytes(damaged)
        assert read_runs(logs) == []
    (logs / "one" / "curve.csv").write_text("step,success_rate,commanded_modes,cells\n100,0.5,1.5,7\n200,0.7")
    (own,) = read_runs(logs)
    assert own.tests == {"step": [100.0], "success": [0.5], "modes": [1.5]} and own.sketch.coverage == ([100], [7])
    (logs / "one" / "curve.csv").write_bytes(b"\xff\x00")
    assert read_runs(logs) == []


def test_tests_along_the_way(logs):
    line = {"step": 10, "uncommanded": {"n_successes": 1, "n_episodes": 4}, "summary": {"commanded_modes": 2.0}}
    (logs / "one" / "evaluations.jsonl").write_text(json.dumps(line) + '\n{"step": 20, "unc')
    (own,) = read_runs(logs)
    assert own.tests == {"step": [10.0], "success": [0.25], "modes": [2.0]} and len(own.sketch.modes) == 2


def test_an_experiment_is_one_run_and_the_latest_are_shown(logs):
    text = (logs / "one" / "live.json").read_bytes()
    for number in range(MOST_RUNS + 1):
        folder = logs / f"trial_{number}"
        (folder / "logs").mkdir(parents=True)
        (folder / "curve.csv").write_text("step,success_rate\n5,1\n")
        (folder / "logs" / "live.json").write_bytes(text)
        for path in (folder / "curve.csv", folder / "logs" / "live.json"):
            os.utime(path, (2e9 + number, 2e9 + number))
    assert [run.label for run in read_runs(logs)] == [f"trial_{number}" for number in range(MOST_RUNS, 0, -1)]
    assert read_runs(logs)[0].tests["success"] == [1.0] and len(read_runs(logs)[0].sketch.modes) == 2
    assert read_runs(logs / "trial_1")[0].label == "trial_1"


# ---------------------------------------------------------------------- who may ask for it


@pytest.fixture
def served(logs):
    with Watcher(logs, 0) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def ask(server, path, method="GET", host=None):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    connection.putrequest(method, path, skip_host=True)
    if host is not None:
        connection.putheader("Host", host)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def test_for_this_machine_alone(served, logs):
    own = f"127.0.0.1:{served.server_port}"
    assert served.server_address[0] == "127.0.0.1"
    answer, body = ask(served, "/now", host=own)
    assert answer.status == 200 and b"mode_1" in body and b'id="library"' not in body
    assert answer.headers["Cache-Control"] == "no-store" and answer.headers["X-Frame-Options"] == "DENY"
    assert ask(served, "/now", host=f"localhost:{served.server_port}")[0].status == 200
    # Somebody's name that leads here, another port, none
    for host in (
        "evil.example",
        f"evil.example:{served.server_port}",
        "127.0.0.1",
        f"127.0.0.1.evil:{served.server_port}",
        None,
    ):
        assert ask(served, "/now", host=host)[0].status == 403
    (logs / "secret").write_text("a secret")
    for path in (
        "/secret",
        "/../logs/secret",
        "/%2e%2e/secret",
        "//secret",
        "/now/../secret",
        "/one/live.json",
        "/?file=secret",
    ):
        answer, body = ask(served, path, host=own)
        assert answer.status == 404 and b"secret" not in body
    for method in ("POST", "PUT", "DELETE", "OPTIONS"):
        assert ask(served, "/", method, own)[0].status == 501
    answer, body = ask(served, "/now", "HEAD", own)
    assert answer.status == 200 and body == b""


def test_what_cannot_be_served(tmp_path, capsys, monkeypatch):
    with pytest.raises(SystemExit, match="LOGDIR: .*none' given, which is no folder"):
        main([str(tmp_path / "none")])
    with pytest.raises(SystemExit, match="--port: 70000 given; accepted are 0 to 65535"):
        main([str(tmp_path), "--port", "70000"])
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(SystemExit, match=f"--port: {port} given, which cannot be had .*in use"):
            COMMANDS["watch"]([str(tmp_path), "--port", str(port)])

    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(Watcher, "serve_forever", interrupted)
    main([str(tmp_path), "--port", "0"])  # Ctrl-C ends it without a traceback
    assert "on http://127.0.0.1:" in capsys.readouterr().out


# ---------------------------------------------------------------------- seen by a browser


def test_a_browser_sees_a_run_go_on(browser, served, logs):
    path = logs / "one" / "live.json"
    whole = path.read_bytes()
    path.unlink()
    browser.open(served.address)
    assert "Nothing to show yet" in browser.run("document.querySelector('#models').textContent")
    path.write_bytes(whole)
    buttons = "[...document.querySelectorAll('button.mode')].map((each) => each.textContent.trim().split(' ')[0])"
    browser.until(f"{buttons}.join() === 'mode_0,mode_1'", 20)
    browser.click("button[data-mode='1']")
    browser.run("document.querySelector(\"button[data-mode='1']\").focus()")
    # A mode is born, and takes the first place; another file is half-written
    known = json.loads(whole)
    born = {**known["modes"][0], "number": 7, "name": "mode_7"}
    life = {"number": 7, "name": "mode_7", "begin": 300, "came": "born", "end": None, "went": None}
    news = {**known, "steps": 999, "modes": [born, *known["modes"]], "lives": [*known["lives"], life]}
    (logs / "two").mkdir()
    (logs / "two" / "live.json").write_text('{"env": "')
    path.write_text(json.dumps(news))
    browser.until(f"{buttons}.join() === 'mode_7,mode_0,mode_1'", 20)
    assert browser.run("document.querySelector('.panel h3').textContent") == "mode_1"  # still the same one
    assert browser.run("document.querySelector('#timeline-0').data.map((each) => each.name)")[-1] == "mode_7"
    assert "999 environment steps" in browser.run("document.querySelector('#models').textContent")
    assert browser.run("document.activeElement.className") == "mode"
    assert browser.errors == []
    # It says so when nobody answers any more
    served.shutdown()
    served.server_close()
    browser.until("document.querySelector('#state').textContent.includes('does not answer')", 20)
    browser.call("Page.navigate", url="about:blank")
