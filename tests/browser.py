"""A headless Chromium for tests, spoken to in its DevTools protocol over a pipe: no driver."""

import base64
import io
import json
import os
import select
import shutil
import subprocess
import time

import numpy as np
from PIL import Image

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
#: Seconds to wait for anything, on a machine that does much else.
PATIENCE = 60


def program():
    """Path of the browser, or None where there is none."""
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


class Browser:
    """One page of one browser.

    Attributes:
        problems: what the page said on its console, and exceptions that it did not catch.
    """

    def __init__(self, folder):
        self.folder, self.problems, self._count, self._session = folder, [], 0, None
        theirs_in, self._write = os.pipe()
        self._read, theirs_out = os.pipe()
        flags = (
            *("--headless", "--no-sandbox", "--remote-debugging-pipe", "--no-first-run"),
            *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars"),
            *("--disable-dev-shm-usage", "--disable-extensions", "--disable-background-networking"),
            *("--force-device-scale-factor=1", f"--user-data-dir={folder / 'profile'}"),
        )
        # It reads commands from 3 and answers on 4.
        self._process = subprocess.Popen(
            [
                *("sh", "-c", f'exec "$0" "$@" 3</dev/fd/{theirs_in} 4>/dev/fd/{theirs_out}'),
                *(program(), *flags, "about:blank"),
            ],
            pass_fds=(theirs_in, theirs_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._unread = b""
        pages = self.call("Target.getTargets")["targetInfos"]
        page = next(target for target in pages if target["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        os.close(self._write)  # it leaves
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._read)

    def call(self, method, **parameters):
        """One command of the protocol; its result."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session and not method.startswith("Browser."):
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._count:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]

    def _receive(self):
        deadline = time.monotonic() + PATIENCE
        while b"\0" not in self._unread:
            ready, _, _ = select.select([self._read], [], [], deadline - time.monotonic())
            assert ready, "The browser does not answer."
            read = os.read(self._read, 1 << 20)
            assert read, "The browser has ended."
            self._unread += read
        text, _, self._unread = self._unread.partition(b"\0")
        message = json.loads(text)
        if message.get("method") in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled"):
            self.problems.append(message["params"])
        if message.get("method") == "Log.entryAdded":
            self.problems.append(message["params"]["entry"])
        return message

    def size(self, width, height, *, touch=False):
        self.call(
            "Emulation.setDeviceMetricsOverride",
            **{"width": width, "height": height, "deviceScaleFactor": 1, "mobile": touch},
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=touch)

    def open(self, path):
        """Load a file, and wait until it has been drawn."""
        self.call("Page.navigate", url=path.as_uri())
        self.until("document.readyState === 'complete' && location.protocol === 'file:'")
        self.drawn()

    def value(self, expression):
        """What an expression, or a promise, comes to."""
        done = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def until(self, expression):
        deadline = time.monotonic() + PATIENCE
        while not (found := self.value(expression)):
            assert time.monotonic() < deadline, f"never: {expression}"
            time.sleep(0.02)
        return found

    def drawn(self):
        """Wait for two frames: what was asked for before the first is on the screen."""
        self.value("new Promise(d => requestAnimationFrame(() => requestAnimationFrame(d)))")

    def picture(self):
        """(H, W, 3) uint8 of the window."""
        self.drawn()
        shot = self.call("Page.captureScreenshot", format="png")["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB"))

    def click(self, selector, across=0.5):
        """With the mouse, on an element: in its middle, or at another share of its width."""
        x, y = self.value(
            f"(() => {{ const e = document.querySelector({selector!r}); e.scrollIntoView();"
            " const b = e.getBoundingClientRect();"
            f" return [b.x + {across} * b.width, b.y + b.height / 2]; }})()"
        )
        self.click_at(x, y)

    def click_at(self, x, y):
        for what in ("mousePressed", "mouseReleased"):
            self.call(
                "Input.dispatchMouseEvent",
                **{"type": what, "x": x, "y": y, "button": "left", "clickCount": 1},
            )

    def tap(self, x, y):
        self.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def key(self, key, code):
        """Press a key, by its name and its number."""
        for what in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=what, key=key, code=key, windowsVirtualKeyCode=code
            )
