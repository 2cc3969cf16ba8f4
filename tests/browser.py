"""A headless Chromium that tests click in, by its DevTools protocol: real mouse and keyboard events, no driver."""

import base64
import itertools
import json
import shutil
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium")
_OPTIONS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-extensions", "--remote-debugging-port=0", "--mute-audio"),
)
# Key by name: its code, the number that Windows has for it, the text that it types
_KEYS = {
    "Tab": ("Tab", 9, ""),
    "Enter": ("Enter", 13, "\r"),
    "Space": ("Space", 32, " "),
    "ArrowRight": ("ArrowRight", 39, ""),
    "ArrowDown": ("ArrowDown", 40, ""),
    "End": ("End", 35, ""),
}


class Browser:
    """
    One tab.

    :param folder: For its profile
    :param offline: Whether no name of a host is known, so that nothing can be fetched from a network
    """

    def __init__(self, folder: Path, offline: bool = True) -> None:
        from websockets.sync.client import connect

        rules = ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"] if offline else []
        command = [str(CHROMIUM), *_OPTIONS, *rules, f"--user-data-dir={folder}", "about:blank"]
        self._process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        told = folder / "DevToolsActivePort"
        _wait(lambda: told.is_file() and "\n" in told.read_text(), "Chromium did not start")
        port, path = told.read_text().split("\n")[:2]
        self._open = ExitStack()
        self._socket = self._open.enter_context(connect(f"ws://127.0.0.1:{port}{path}", max_size=None, ping_interval=None))
        self._numbers, self._session = itertools.count(1), None
        #: What the page has written to the console as an error, and exceptions
        self.errors: list[str] = []
        target = next(each for each in self.call("Target.getTargets")["targetInfos"] if each["type"] == "page")
        attach = {"targetId": target["targetId"], "flatten": True}
        self._session = self.call("Target.attachToTarget", **attach)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """
        :param method: Of the DevTools protocol
        :param parameters: Of it
        :return: What it answers
        """
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        self._socket.send(json.dumps(message | ({"sessionId": self._session} if self._session else {})))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("method") == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(answer["params"]["exceptionDetails"])[:500])
            elif answer.get("method") == "Log.entryAdded" and answer["params"]["entry"]["level"] == "error":
                self.errors.append(answer["params"]["entry"]["text"])
            if answer.get("id") == number:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    def run(self, script: str) -> Any:
        """
        :param script: An expression of JavaScript
        :return: Its value
        """
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, script: str, seconds: float = 60) -> None:
        """
        :param script: An expression that is to become true
        :param seconds: How long to wait
        """
        _wait(lambda: self.run(script), f"not within {seconds} s: {script}", seconds)

    def open(self, address: str, width: int = 1280, height: int = 900) -> None:
        """
        :param address: Of the page, which says by ``data-ready`` that it is
        :param width: Of the window in pixels
        :param height: Of the window in pixels
        """
        self.resize(width, height)
        self.errors.clear()
        self.call("Page.navigate", url=address)
        self.until("location.href !== 'about:blank' && document.readyState === 'complete' && !!document.body.dataset.ready")

    def resize(self, width: int, height: int = 900) -> None:
        """
        :param width: Of the window in pixels
        :param height: Of the window in pixels
        """
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def move(self, x: float, y: float) -> None:
        """Move the mouse to a place of the window, in pixels."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def click(self, selector: str) -> None:
        """
        Click in the middle of an element.

        :param selector: Of CSS
        """
        x, y = self.run(
            f"(() => {{const e = document.querySelector({json.dumps(selector)}); e.scrollIntoView({{block: 'center'}});"
            "const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]})()"
        )
        self.click_at(x, y)

    def click_at(self, x: float, y: float) -> None:
        """Click at a place of the window, in pixels."""
        self.move(x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key: str) -> None:
        """
        :param key: Of the keyboard, by its name
        """
        code, number, text = _KEYS[key]
        common = {"key": text or key, "code": code, "windowsVirtualKeyCode": number}
        self.call("Input.dispatchKeyEvent", type="keyDown", **common, **({"text": text} if text else {}))
        self.call("Input.dispatchKeyEvent", type="keyUp", **common)

    def screenshot(self, path: Path, whole: bool = True) -> None:
        """
        :param path: Of the PNG
        :param whole: Whether all of the page, not what the window shows
        """
        picture = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(picture["data"]))

    def close(self) -> None:
        """End the browser."""
        try:
            self._session = None
            self.call("Browser.close")
        except Exception:
            self._process.kill()
        self._open.close()
        self._process.wait(timeout=30)


def _wait(condition: Any, message: str, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise AssertionError(message)
        time.sleep(0.05)
