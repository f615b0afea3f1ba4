"""A headless Chromium that is told what to do over a pipe (the DevTools protocol)."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

CHROMIUM = next(filter(shutil.which, ("chromium", "chromium-browser", "google-chrome")), None)


class Browser:
    """One page in a browser.

    Args:
        profile: folder for what the browser keeps.
        url: that is opened.
    """

    def __init__(self, profile: Path, url: str) -> None:
        assert CHROMIUM is not None
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        # Chromium reads commands from descriptor 3 and answers on 4, each ended by a zero byte.
        command = 'exec "$@" 3<&$IN 4>&$OUT'
        self._process = subprocess.Popen(
            ["bash", "-c", command, "bash", CHROMIUM, "--headless", "--no-sandbox",
             "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
             "--disable-background-networking", "--remote-debugging-pipe",
             f"--user-data-dir={profile}", "--window-size=800,600", "about:blank"],
            pass_fds=(to_browser, from_browser), stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "IN": str(to_browser), "OUT": str(from_browser)},
        )  # fmt: skip
        os.close(to_browser)
        os.close(from_browser)
        self._buffer, self._number, self._session = b"", 0, None
        (page,) = (
            target
            for target in self.tell("Target.getTargets")["targetInfos"]
            if target["type"] == "page"
        )
        attached = self.tell("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self._session = attached["sessionId"]
        self.tell("Page.enable")
        self.tell("Page.navigate", url=url)

    def tell(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Sends a command; returns the answer's result."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._buffer:
                part = os.read(self._read, 65536)
                assert part, "the browser has gone"
                self._buffer += part
            line, self._buffer = self._buffer.split(b"\0", 1)
            answer = json.loads(line)
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result

    def evaluate(self, expression: str) -> Any:
        """Returns what a JavaScript expression gives in the page."""
        answer = self.tell("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, expression: str, seconds: float = 30.0) -> None:
        """Waits until an expression is true."""
        end = time.monotonic() + seconds
        while self.evaluate(f"Boolean({expression})") is not True:
            assert time.monotonic() < end, f"in vain: {expression}"
            time.sleep(0.1)

    def press(self, code: str, times: int = 1) -> None:
        """Presses a key and lets it go, `KeyW` for example."""
        key = code.removeprefix("Key").lower() if code != "Space" else " "
        for _ in range(times):
            for kind in ("keyDown", "keyUp"):
                self.tell("Input.dispatchKeyEvent", type=kind, code=code, key=key)

    def close(self) -> None:
        """Ends the browser."""
        self._process.terminate()
        self._process.wait(30)
        os.close(self._write)
        os.close(self._read)
