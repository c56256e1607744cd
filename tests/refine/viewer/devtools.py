"""A page in headless Chromium that tests can touch: the DevTools protocol over a pipe.

Input that is sent this way is the browser's own, not a script's: it is hit-tested, captured and turned from
touches into pointers as a person's would be. Nothing is served and no port is opened.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eval.benchmarks.browser import FLAGS as WEBGL_FLAGS
from refine.files import decode_image

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
FLAGS = (
    *WEBGL_FLAGS,
    "--force-device-scale-factor=1",
    "--force-color-profile=srgb",
    "--hide-scrollbars",
    "--window-size=600,600",
)

needs_browser = pytest.mark.skipif(BROWSER is None, reason=f"none of {', '.join(BROWSERS)} is installed")

PATIENCE = 120.0
"""Seconds until a browser that has not answered, or a page that has not changed, is given up."""

SIZE = {"width": 900, "height": 700}
"""Pixels of the tab."""

READS, WRITES = 3, 4
"""Descriptors at which Chromium expects the pipe."""


class Tab:
    """One page.

    Args:
        commands: descriptor that is written to.
        answers: descriptor that is read from.
        shots: an existing folder for screenshots.
    """

    def __init__(self, commands: int, answers: int, shots: Path) -> None:
        self._commands, self._answers, self._shots = commands, answers, shots
        self._read, self._number, self._session = b"", 0, ""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        self.call("Emulation.setDeviceMetricsOverride", **SIZE, deviceScaleFactor=1, mobile=False)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return the answer.

        Raises:
            RuntimeError: Chromium refuses it, or does not answer.
        """
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        answer = next(one for one in self._messages() if one.get("id") == self._number)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']['message']}")
        result: dict[str, Any] = answer["result"]
        return result

    def open(self, address: str) -> None:
        """Open a page of ours, and wait until it has drawn."""
        self.call("Page.navigate", url=address)
        self.wait(lambda: self.value("document.body?.dataset.ready === ''"))

    def value(self, expression: str) -> Any:
        """Return what a script's expression is worth on the page, if a promise, when it is kept."""
        told = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in told, told
        return told["result"].get("value")

    def wait(self, happened: Callable[[], bool]) -> None:
        """Wait until something is so.

        Raises:
            TimeoutError: it never is.
        """
        end = time.monotonic() + PATIENCE
        while not happened():
            if time.monotonic() > end:
                raise TimeoutError("the page did not do it")
            time.sleep(0.05)

    def shot(self) -> np.ndarray:  # float [h, w, 3]
        """Return what the tab shows, in steps of 1 from 0 to 255."""
        self.value(
            "new Promise((shown) => requestAnimationFrame(() => requestAnimationFrame(() => shown())))"
        )
        path = self._shots / "tab.png"
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))
        return decode_image(path).pixels[..., :3] * 255.0

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send `mousePressed`, `mouseMoved`, `mouseReleased` or `mouseWheel` at a place of the tab."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def touch(self, kind: str, *fingers: tuple[float, float]) -> None:
        """Send `touchStart`, `touchMove` or `touchEnd` with the places of all fingers that are down."""
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(fingers)]
        self.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    def _messages(self) -> Iterator[Mapping[str, Any]]:
        while True:
            message, end, rest = self._read.partition(b"\0")
            if end:
                self._read = rest
                yield json.loads(message)
                continue
            ready, _, _ = select.select([self._answers], [], [], PATIENCE)
            more = os.read(self._answers, 1 << 20) if ready else b""
            if not more:
                raise RuntimeError("Chromium does not answer")
            self._read += more


@contextmanager
def open_tab(folder: Path) -> Iterator[Tab]:
    """Start Chromium with an empty page, and end it afterwards.

    Args:
        folder: an existing one, for its profile and screenshots.
    """
    assert BROWSER is not None
    reads, commands = os.pipe()
    answers, writes = os.pipe()

    def connect() -> None:
        # Copied out of the way first: the one may be where the other has to go.
        for copy, place in [
            (fcntl.fcntl(reads, fcntl.F_DUPFD, 10), READS),
            (fcntl.fcntl(writes, fcntl.F_DUPFD, 10), WRITES),
        ]:
            os.dup2(copy, place)

    profile = f"--user-data-dir={folder / 'profile'}"
    process = subprocess.Popen(
        [BROWSER, *FLAGS, "--remote-debugging-pipe", profile, "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=connect,
        pass_fds=(READS, WRITES),
    )
    os.close(reads)
    os.close(writes)
    try:
        yield Tab(commands, answers, folder)
    finally:
        process.terminate()
        process.wait(30)
        os.close(commands)
        os.close(answers)
