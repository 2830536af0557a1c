"""A real browser without a window, for pages: opens one, waits for what a script says, takes pictures."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.request import urlopen

import pytest
from websockets.sync.client import connect

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
PHONE = (390, 844)
_FLAGS = (
    "--headless", "--no-sandbox", "--no-first-run", "--hide-scrollbars", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--remote-debugging-port=0",
)  # fmt: skip


class Browser:
    """One page in Chromium, drawn by software; `profile` is a folder of its own. phone: as on a phone held upright."""

    def __init__(
        self, url: str, profile: Path, width: int = 1400, height: int = 900, phone: bool = False
    ) -> None:  # fmt: skip
        arguments = [str(CHROMIUM), *_FLAGS, f"--window-size={width},{height}", f"--user-data-dir={profile}"]
        arguments.append("about:blank" if phone else url)
        self._process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        port = int(_when_there(profile / "DevToolsActivePort").splitlines()[0])
        pages = _until(lambda: [p for p in _json(f"http://127.0.0.1:{port}/json/list") if p["type"] == "page"])
        self._socket = connect(pages[0]["webSocketDebuggerUrl"], max_size=1 << 28)
        self._number = 0
        if phone:
            width, height = PHONE
            screen = {"width": width, "height": height, "deviceScaleFactor": 2, "mobile": True}
            self._call("Emulation.setDeviceMetricsOverride", **screen)
            self._call("Emulation.setTouchEmulationEnabled", enabled=True)
            self._call("Page.navigate", url=url)

    def tap(self, element: str) -> None:
        """Touch the middle of what a script gives, scrolled to where it is seen."""
        box = f"(() => {{ const e = {element}; e.scrollIntoView({{block: 'center'}}); const r ="
        x, y = self.wait_for(f"{box} e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }})()")
        # Both at once: on a busy host a touch whose end is sent a little later is a long one.
        touch = "Input.dispatchTouchEvent"
        began = self._send(touch, type="touchStart", touchPoints=[{"x": x, "y": y}])
        ended = self._send(touch, type="touchEnd", touchPoints=[])
        self._answer(began)
        self._answer(ended)

    def ask(self, script: str) -> Any:
        """The value of a script in the page."""
        answer = self._call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, script: str, seconds: float = 40.0) -> Any:
        """The value of a script once it is true."""
        return _until(lambda: self.ask(script), seconds)

    def picture(self, path: Path) -> None:
        """Write what the page looks like (.png)."""
        path.write_bytes(base64.b64decode(self._call("Page.captureScreenshot")["data"]))

    def _call(self, method: str, **parameters: Any) -> Any:
        return self._answer(self._send(method, **parameters))

    def _send(self, method: str, **parameters: Any) -> int:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        return self._number

    def _answer(self, number: int) -> Any:
        while True:
            said = json.loads(self._socket.recv(timeout=60))
            if said.get("id") == number:
                return said["result"]

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(20)


def _json(url: str) -> Any:
    with urlopen(url, timeout=10) as answer:
        return json.load(answer)


def _when_there(path: Path) -> str:
    return _until(lambda: path.read_text() if path.exists() else "")


def _until(look: Any, seconds: float = 40.0) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = look()
        if found:
            return found
        time.sleep(0.1)
    raise AssertionError("it did not come")
