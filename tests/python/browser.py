"""A page in headless Chromium, by its DevTools protocol."""

import base64
import io
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""Chromium on this machine; None: there is none."""
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu-sandbox",
    "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)


class Page:
    """A page, until the end of a `with`."""

    def __init__(self, url: str, size: tuple[int, int] = (960, 600)) -> None:
        """Opens a page of this width and height, pixels."""
        from websockets.sync.client import connect

        assert PROGRAM is not None
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        flags = (*_FLAGS, f"--window-size={size[0]},{size[1]}", f"--user-data-dir={self._folder.name}")
        self._process = subprocess.Popen(
            [PROGRAM, *flags, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        port_file = Path(self._folder.name) / "DevToolsActivePort"
        deadline = time.monotonic() + 60.0
        while not (port_file.exists() and port_file.read_text().count("\n") >= 1):
            assert time.monotonic() < deadline, "Chromium does not start"
            assert self._process.poll() is None, "Chromium has ended"
            time.sleep(0.05)
        port, path = port_file.read_text().splitlines()[:2]
        self._socket = connect(f"ws://127.0.0.1:{port}{path}", max_size=1 << 28)
        self._number = 0
        self._session: str | None = None
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False
        )
        self._call("Page.enable")
        self._call("Page.navigate", url=url)
        while self.run("location.href + document.readyState") != f"{url}/complete":
            assert time.monotonic() < deadline, f"{url} does not load"
            time.sleep(0.05)

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait()
        self._folder.cleanup()

    def picture(self) -> "np.ndarray[Any, Any]":
        """[height, width, 3], what is seen now."""
        from PIL import Image

        data = base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def text(self) -> str:
        """All text of the page."""
        return str(self.run("document.body.innerText"))

    def run(self, script: str) -> Any:
        """The value of an expression of JavaScript."""
        return self._call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def press(self, key: str, code: str) -> None:
        """Presses a key and lets it go."""
        for kind in ("rawKeyDown", "char", "keyUp"):
            text = {"text": key} if kind == "char" else {}
            number = ord(key.upper())
            self._call("Input.dispatchKeyEvent", type=kind, key=key, code=code, windowsVirtualKeyCode=number, **text)

    def _call(self, method: str, **parameters: Any) -> Any:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=180.0))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer["error"]
                return answer["result"]
