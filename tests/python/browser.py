# SPDX-License-Identifier: Apache-2.0
"""Headless Chromium, spoken to through a pair of pipes (its DevTools protocol), so that tests see pages as users do."""

from __future__ import annotations

import base64
import itertools
import json
import os
import select
import shutil
import subprocess
import time

COMMAND = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
WHY = "no Chromium here: apt-get install chromium"
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--disable-dev-shm-usage",
    "--no-first-run",
)


class Browser:
    """One page; leaves no process behind."""

    def __init__(self, folder, size=(1300, 1000), seconds=60):
        assert COMMAND is not None, WHY
        self._seconds, self._numbers, self._events = seconds, itertools.count(1), []
        theirs, self._out = os.pipe()
        self._in, answers = os.pipe()
        self._rest = b""
        window = f"--window-size={size[0]},{size[1]}"
        command = [COMMAND, *FLAGS, window, f"--user-data-dir={folder}", "--remote-debugging-pipe", "about:blank"]
        pipes = f'exec 3<&{theirs} 4>&{answers}; exec "$@"'
        self._process = subprocess.Popen(
            ["bash", "-c", pipes, "bash", *command], pass_fds=(theirs, answers), stderr=subprocess.DEVNULL
        )
        os.close(theirs)
        os.close(answers)
        page = next(t for t in self._call("Target.getTargets")["targetInfos"] if t["type"] == "page")
        self._session = None
        attached = self._call("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self._session = attached["sessionId"]
        self._call("Page.enable")
        self._call("Runtime.enable")

    def open(self, address):
        """Opens a page and waits until it has loaded."""
        self._events.clear()
        self._call("Page.navigate", url=address)
        while not any(event["method"] == "Page.loadEventFired" for event in self._events):
            self._events.append(self._message())

    def resize(self, width, height):
        """Give the page a window of so many CSS pixels; below 600 it is a phone's."""
        self._call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )

    def ask(self, script):
        """The value of JavaScript, of a promise what comes of it."""
        answer = self._call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def complaints(self):
        """What the page's scripts threw or the browser refused so far."""
        wrong = ("Runtime.exceptionThrown", "Log.entryAdded")
        return [event for event in self._events if event["method"] in wrong]

    def screenshot(self):
        """PNG of the window."""
        return base64.b64decode(self._call("Page.captureScreenshot")["data"])

    def close(self):
        os.close(self._out)  # the end of its pipe ends the browser
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._in)

    def _call(self, method, **parameters):
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if getattr(self, "_session", None):
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._message()
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]
            self._events.append(answer)

    def _message(self):
        end = time.monotonic() + self._seconds
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._in], [], [], max(0, end - time.monotonic()))
            data = os.read(self._in, 1 << 16) if ready else b""
            assert data, "the browser is silent"
            self._rest += data
        first, _, self._rest = self._rest.partition(b"\0")
        return json.loads(first)
