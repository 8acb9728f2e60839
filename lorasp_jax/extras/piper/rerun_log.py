"""Show a session in Rerun while it runs, or record each episode as an `.rrd` file for it.

Rerun runs in a process of its own, behind a queue of limited length: a viewer that is slow, stuck
or gone costs the control loop nothing but what is dropped and counted.
"""

import os
import queue
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lorasp_jax.extras.piper.asking import Observation
from lorasp_jax.extras.piper.log import Log
from lorasp_jax.extras.serving import wire

TICK = 0.02
"""Time between two poses that are shown [s]."""
MOST, MOST_WITH_PICTURES = 512, 32
"""Length of the queue beyond which messages, and pictures, are dropped."""
LARGEST = 320
"""Longest side of a picture that is shown [pixels]."""
GRACE = 10.0
"""Time for what is queued at the end, and for files to be completed [s]."""
_TIMINGS = ("policy_timing", "server_timing")  # of a reply
_VALUES = ("active_rank",)  # the same


class Viewer:
    """Sends messages to Rerun's process.

    Attributes:
        dropped: number of messages that were dropped, as the process was busy.
    """

    def __init__(self, target: str, control_dt: float) -> None:
        """Start the process, which is ready when this returns.

        Args:
            target: folder for a recording of each episode, or a viewer's address.
            control_dt: duration of an action [s].

        Raises:
            ValueError: rerun-sdk is not installed, or the target is unsuitable.
        """
        self.dropped, self._dt, self._ticked = 0, control_dt, -np.inf
        self._target, self._live = target, "://" in target
        self._process = subprocess.Popen(
            [sys.executable, "-m", "lorasp_jax.extras.piper.rerun_writer", target],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"RUST_LOG": "off"},  # what matters is said by an exception, too
            start_new_session=True,  # Ctrl-C is for the arm
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._pipe, self._said = self._process.stdin, self._process.stdout
        if (line := self._said.readline().decode().strip()) != "ready":
            self._process.kill()
            self._finish()
            raise ValueError(line or "Rerun's process has ended: see above")
        self._queue: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="rerun", daemon=True)
        self._thread.start()

    def line(self, time: float, **values: Any) -> None:
        """Show a line of the log; a new episode begins a recording."""
        if "episode" in values:
            self._ticked = -np.inf
        elif "pose" in values:
            if time - self._ticked < TICK - 1e-9:
                return
            self._ticked = time
        if "chunk" in values:
            values["dt"] = self._dt
        self._put({"t": time, **values}, np.inf if "episode" in values else MOST)

    def observation(self, time: float, observation: Observation) -> None:
        """Show what the policy sees."""
        delay = {key: observation[key] for key in ("executed", "delay") if key in observation}
        images = {name: _smaller(image) for name, image in observation["image"].items()}
        self._put({"t": time, "images": images, **delay}, MOST_WITH_PICTURES)

    def reply(self, reply: Mapping[str, Any]) -> None:
        """Show what a server says of its answer besides the actions."""
        values = {name: _numbers(reply.get(name)) for name in _TIMINGS}
        message = {"reply": {name: given for name, given in values.items() if given}}
        self._put(message | _numbers({name: reply.get(name) for name in _VALUES}), MOST)

    def close(self) -> None:
        """Wait until all is shown, but not for a viewer that is stuck; say what was lost.

        Raises:
            OSError: the last recording is incomplete.
        """
        self._queue.put(None)
        self._thread.join(GRACE)
        stuck = self._thread.is_alive()
        if stuck:
            self._process.kill()
            self._thread.join()
        said = self._finish()
        if self.dropped:
            print(f"Rerun was too slow: {self.dropped} messages are missing", flush=True)
        if stuck or self._process.returncode:
            reason = said or ("it did not take it in time" if stuck else "its process has ended")
            if not self._live:
                raise OSError(f"a recording in {self._target} is incomplete: {reason}")
            print(f"the viewer has lost the rest: {reason}", flush=True)

    def _finish(self) -> str:
        """End the process, and return what it still said."""
        try:
            said, _ = self._process.communicate(timeout=GRACE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            said, _ = self._process.communicate()
        return said.decode().strip()

    def _put(self, message: dict[str, Any], most: float) -> None:
        if self._queue.qsize() < most:
            self._queue.put(message)
        else:
            self.dropped += 1

    def _work(self) -> None:
        gone = False
        while (message := self._queue.get()) is not None:
            frame = b"" if gone else wire.pack(message)
            try:
                self._pipe.write(len(frame).to_bytes(4) + frame)
                self._pipe.flush()
            except OSError:  # the process has ended, and has said why
                gone, self.dropped = True, self.dropped + 1


class WatchedLog(Log):
    """A log that is shown, too."""

    def __init__(self, folder: Path, viewer: Viewer) -> None:
        """Create a log; see `Log`."""
        super().__init__(folder)
        self._viewer = viewer

    def line(self, time: float, **values: Any) -> None:
        """Append a line."""
        super().line(time, **values)
        self._viewer.line(time, **values)

    def observation(self, time: float, observation: Observation) -> None:
        """Append an observation with its pictures."""
        super().observation(time, observation)
        self._viewer.observation(time, observation)

    def close(self) -> None:
        """Wait until all is written and shown; see `Log` and `Viewer`."""
        try:
            super().close()
        finally:
            self._viewer.close()


def _smaller(image: np.ndarray) -> np.ndarray:
    """Return every k-th pixel: packing a large picture would hold Python's lock for too long."""
    step = max(1, -(-max(image.shape[:2]) // LARGEST))
    return np.ascontiguousarray(image[::step, ::step])


def _numbers(values: Any) -> dict[str, float]:
    """Return the numbers by name in a part of a reply, which may be anything."""
    if not isinstance(values, Mapping):
        return {}
    return {
        str(name): float(x)
        for name, x in [*values.items()][:32]
        if isinstance(x, int | float | np.integer | np.floating)
    }
