"""A headless Chromium, spoken to by the DevTools protocol, which needs no driver."""

import base64
import contextlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
from pathlib import Path

import pytest
from websockets.sync.client import connect

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")


class Tab:
    """A page of a browser.

    Attributes:
        problems: what its console, its scripts and its security policy complained of.
    """

    def __init__(self, socket, session):
        self._socket, self._session, self._numbers = socket, session, itertools.count(1)
        self.problems, self._answer = [], {}
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method, **values):
        number = next(self._numbers)
        message = {"id": number, "sessionId": self._session, "method": method, "params": values}
        self._socket.send(json.dumps(message))
        while (event := json.loads(self._socket.recv(60))).get("id") != number:
            self._note(event)
        assert "error" not in event, event
        return event["result"]

    def _note(self, event):
        method, values = event.get("method"), event.get("params", {})
        if method == "Fetch.authRequired":
            self._later("Fetch.continueWithAuth", values, authChallengeResponse=self._answer)
        elif method == "Fetch.requestPaused":
            self._later("Fetch.continueRequest", values)
        elif method == "Page.loadEventFired":
            self._loaded = True
        elif method == "Runtime.exceptionThrown" or (
            method == "Log.entryAdded" and values["entry"]["level"] == "error"
        ):
            self.problems.append(values)

    def _later(self, method, values, **more):
        message = {"id": 0, "sessionId": self._session, "method": method}
        params = {"requestId": values["requestId"], **more}
        self._socket.send(json.dumps({**message, "params": params}))

    def answer_password(self, password):
        """Type a password wherever one is asked for, once."""
        self._answer = {"response": "ProvideCredentials", "username": "me", "password": password}
        self.call("Fetch.enable", handleAuthRequests=True)

    def look(self, *, width=1000, dark=False):
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def open(self, address):
        self._loaded = False
        self.call("Page.navigate", url=address)
        while not self._loaded:
            self._note(json.loads(self._socket.recv(60)))

    def run(self, script):
        """Return what an expression, or the promise that it gives, evaluates to."""
        options = {"awaitPromise": True, "returnByValue": True}
        result = self.call("Runtime.evaluate", expression=script, **options)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait(self, condition):
        """Wait until an expression is true."""
        self.run(
            "new Promise((yes, no) => { const end = Date.now() + 30000; const look = () => "
            f"({condition}) ? yes() : Date.now() > end ? no(document.body.innerText) : "
            "setTimeout(look, 20); look(); })"
        )

    def screenshot(self, path):
        shot = self.call("Page.captureScreenshot", captureBeyondViewport=True)
        Path(path).write_bytes(base64.b64decode(shot["data"]))


@contextlib.contextmanager
def browser():
    """Yield a function that opens an empty `Tab`; skip the test if there is no browser."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        command = [found, *options, f"--user-data-dir={folder}", "about:blank"]
        group = {"start_new_session": True}  # what is installed may be a script that starts it
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **group) as process:
            assert process.stderr
            line = next(line for line in process.stderr if "DevTools listening on" in line)
            options = {"max_size": None, "proxy": None, "close_timeout": 1}
            with contextlib.ExitStack() as sockets:
                sockets.callback(os.killpg, process.pid, signal.SIGKILL)
                yield lambda: _tab(sockets.enter_context(connect(line.split()[-1], **options)))


def _tab(socket):
    def call(number, method, **values):
        socket.send(json.dumps({"id": number, "method": method, "params": values}))
        while (event := json.loads(socket.recv(60))).get("id") != number:
            pass
        return event["result"]

    context = call(1, "Target.createBrowserContext")["browserContextId"]
    target = call(2, "Target.createTarget", url="about:blank", browserContextId=context)
    attached = call(3, "Target.attachToTarget", targetId=target["targetId"], flatten=True)
    return Tab(socket, attached["sessionId"])
