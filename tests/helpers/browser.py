"""A headless Chromium, driven over its DevTools socket: enough for a test of a page, and for a picture of it.

python tests/helpers/browser.py http://127.0.0.1:8080 docs/results/figures/play.png
"""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import mkdtemp
from typing import Any
from urllib.request import urlopen

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",  # containers run tests as root
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",  # WebGL without a GPU
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)
PATIENCE = 240.0  # s: software rendering on a busy core
#: Closes the notice that WebGL runs in software.
CLOSE_NOTICE = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())"


def find_chromium() -> str | None:
    """The browser's executable, if there is one."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Chromium:
    """One tab. A context manager; it ends the browser."""

    def __init__(self, width: int, height: int) -> None:
        program = find_chromium()
        assert program is not None
        self._profile = mkdtemp(prefix="pace_chromium_")
        where = (f"--user-data-dir={self._profile}", f"--window-size={width},{height}", "about:blank")
        self.process = subprocess.Popen([program, *FLAGS, *where], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._messages = 0
        self._socket = self._connect()

    def _connect(self) -> Any:
        from websockets.sync.client import connect

        file = Path(self._profile) / "DevToolsActivePort"
        wait_for(lambda: file.exists() and len(file.read_text().splitlines()) == 2, "the browser's start")
        port = file.read_text().splitlines()[0]
        with urlopen(f"http://127.0.0.1:{port}/json") as answer:
            tab = next(target for target in json.load(answer) if target["type"] == "page")
        return connect(tab["webSocketDebuggerUrl"], max_size=None)

    def __enter__(self) -> Chromium:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()  # it does not say goodbye to the page
        self.process.wait()
        shutil.rmtree(self._profile, ignore_errors=True)

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """A DevTools command and its result."""
        self._messages += 1
        self._socket.send(json.dumps({"id": self._messages, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            if answer.get("id") == self._messages:
                return answer["result"]

    def open(self, url: str) -> None:
        """Go to ``url``."""
        assert "errorText" not in self.call("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        """The value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    @property
    def text(self) -> str:
        """What the page says."""
        return self.evaluate("document.body ? document.body.innerText : ''") or ""

    def click(self, label: str) -> None:
        """Press the button of that name."""
        found = f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() === {json.dumps(label)})"
        assert self.evaluate(f"(b => b && (b.click(), true))({found})"), f"no button {label!r}"

    def screenshot(self) -> bytes:
        """The tab as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])


def wait_for(condition: Callable[[], bool], what: str) -> None:
    """Return when ``condition`` holds; fail when it takes too long."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"waited {PATIENCE:.0f} s for {what}"
        time.sleep(0.2)


def main() -> None:
    """Take a picture of a page that plays (best with speed=0.3), half a minute after it was opened."""
    url, file = sys.argv[1:]
    with Chromium(1200, 800) as browser:
        browser.open(url)
        wait_for(lambda: "Next serve" in browser.text, "the page")
        time.sleep(30)
        browser.evaluate(CLOSE_NOTICE)
        browser.click("Next serve")
        time.sleep(1.5)
        Path(file).write_bytes(browser.screenshot())


if __name__ == "__main__":
    main()
