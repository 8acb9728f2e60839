"""The process that speaks to Rerun: `python -m lorasp_jax.extras.piper.rerun_writer TARGET`.

It reads messages of `rerun_log.Viewer` from its standard input, each a frame of `wire` behind its
length in 4 bytes, and ends with them, also if the client was killed: recordings are complete then.
"""

import os
import re
import socket
import sys
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lorasp_jax.base.errors import one_line
from lorasp_jax.extras.piper.arms import JOINTS, SIDES
from lorasp_jax.extras.serving import wire

INSTALL = 'pip install "lorasp_jax[rerun]"'
_ADDRESS = re.compile(r"rerun(\+https?)?://\[?(?P<host>[^/\s]+?)\]?:(?P<port>\d+)/proxy")
_COLORS = {"measured": (40, 160, 80), "commanded": (240, 150, 40), "predicted": (110, 150, 220)}
_TICKS = 25  # poses that are sent at once
_JPEG_QUALITY = 80
_CONNECTING, _WRITING = 2.0, 5.0  # s to wait for a viewer, and for what was logged


def joint_names(number: int) -> list[str]:
    """Return the names of the numbers of a pose, of one arm or of two."""
    prefixes = [f"{side}/" for side in SIDES] if number > len(JOINTS) else [""]
    return [prefix + name for prefix in prefixes for name in JOINTS][:number]


class Writer:
    """Turns messages into Rerun's recordings."""

    def __init__(self, target: str) -> None:
        """Check the target.

        Raises:
            ValueError: rerun-sdk is missing, or the target is neither a folder nor a viewer.
        """
        try:
            import rerun
            import rerun.blueprint
        except ModuleNotFoundError as error:
            raise ValueError(f"--rerun needs the package rerun-sdk: {INSTALL}") from error
        if not hasattr(rerun, "RecordingStream"):
            raise ValueError(f"the installed rerun is not that of rerun-sdk: {INSTALL}")
        self._rerun, self._target = rerun, target
        self._live = "://" in target
        self._stream: Any = None  # the present recording
        if not self._live:
            Path(target).mkdir(parents=True, exist_ok=True)
            return
        if not (where := _ADDRESS.fullmatch(target)):
            address = "rerun+http://HOST:9876/proxy"
            raise ValueError(f"--rerun must be a folder or an address {address}, got {target}")
        try:
            socket.create_connection((where["host"], int(where["port"])), _CONNECTING).close()
        except OSError as error:
            raise ValueError(f"no viewer at {target}: start one with the command rerun") from error

    def close(self) -> None:
        """Complete the recording; raise RuntimeError if that fails."""
        if self._stream is None:
            return
        self._send_ticks()
        self._stream.flush(timeout_sec=_WRITING)
        self._stream.disconnect()
        self._stream = None

    def write(self, message: dict[str, Any]) -> None:
        """Log a message; raise RuntimeError if that fails."""
        if "episode" in message:
            self.close()
            self._begin(message["t"], f"episode {message['episode']}")
        if self._stream is None:
            return
        self._time = message.get("t", self._time)
        if "pose" in message:
            self._ticks.append(message)
            if len(self._ticks) == _TICKS:
                self._send_ticks()
                # Else what a viewer does not take piles up.
                self._stream.flush(timeout_sec=_WRITING)
            return
        self._stream.set_time("time", duration=self._time - self._start)
        if "images" in message:
            self._observe(message)
        if "chunk" in message:
            self._predict(message)
        if "reply" in message:
            self._reply(message["reply"])
        if "active_rank" in message:
            self._rank(message["active_rank"])
        if "observation" in message:
            self._joints = joint_names(len(message["state"]))
            self._say(message["prompt"], "INFO")
        if "problem" in message:
            self._say(message["problem"], "WARN")

    def _begin(self, time: float, name: str) -> None:
        """Begin a recording, as the first free file of a folder or at the viewer."""
        stream = self._rerun.RecordingStream("lorasp_jax_piper")
        if self._live:
            stream.connect_grpc(self._target)
        else:
            known = [int(path.stem[8:]) for path in Path(self._target).glob("episode-*.rrd")
                     if path.stem[8:].isdecimal()]  # fmt: skip
            stream.save(Path(self._target) / f"episode-{max(known, default=-1) + 1:04}.rrd")
        stream.send_recording_name(name)
        self._stream, self._start, self._time = stream, time, time
        self._ticks: list[dict[str, Any]] = []
        self._lanes: list[float] = []
        self._asked: float | None = None
        self._cameras: list[str] = []
        self._joints: list[str] = []
        self._others = ["latency_ms", "steps"]
        self._said = ""
        self._known: set[str] = set()

    def _say(self, text: str, level: str) -> None:
        """Log a sentence, unless it was the last one."""
        if text != self._said:
            self._stream.log("events", self._rerun.TextLog(text, level=level))
        self._said = text

    def _observe(self, message: dict[str, Any]) -> None:
        """Log pictures, and how much of the previous chunk was and will be executed."""
        self._asked = message["t"]
        for camera, image in message["images"].items():
            picture = self._rerun.Image(image).compress(jpeg_quality=_JPEG_QUALITY)
            self._stream.log(f"camera/{camera}", picture)
        for name in ("executed", "delay"):
            if name in message:
                self._scalar(f"steps/{name}", message[name])
        if not self._cameras:
            self._cameras = [*message["images"]]
            self._stream.send_blueprint(self._blueprint())

    def _predict(self, message: dict[str, Any]) -> None:
        """Log a chunk as lines from when its first action begins.

        Chunks overlap, so they take turns on as many lines as that needs; a line breaks at its end.
        """
        chunk, dt = message["chunk"], message["dt"]
        times = message["start"] - self._start + dt * np.arange(1, len(chunk) + 2)
        free = [lane for lane, end in enumerate(self._lanes) if end <= times[0]]
        lane = free[0] if free else len(self._lanes)
        self._lanes[lane : lane + 1] = [times[-1]]
        parts = [1] * len(chunk) + [0]
        for name, values in zip(joint_names(chunk.shape[1]), chunk.T, strict=True):
            self._columns(f"{name}/predicted/{lane}", times, values, parts)
        if self._asked is not None:
            self._scalar("latency_ms/answer", 1e3 * (message["t"] - self._asked))
            self._asked = None

    def _reply(self, reply: dict[str, dict[str, float]]) -> None:
        """Log a server's timings, and how long a request waited there."""
        for part, numbers in reply.items():
            for name, value in numbers.items():
                root = f"latency_ms/{part.removesuffix('_timing')}"
                self._scalar(f"{root}/{name.removesuffix('_ms')}", value)
        parts = ("server_timing", "policy_timing")
        whole, policy = (reply.get(part, {}).get("infer_ms") for part in parts)
        if whole is not None and policy is not None:
            self._scalar("latency_ms/server/waiting", whole - policy)

    def _rank(self, rank: float) -> None:
        """Log a mean active rank, which gets a view with the first."""
        if "active_rank" not in self._others:
            self._others.append("active_rank")
            if self._cameras and self._joints:
                self._stream.send_blueprint(self._blueprint())
        self._scalar("active_rank", rank)

    def _send_ticks(self) -> None:
        """Log the poses that were collected: measured, commanded, and the age of the former."""
        if not self._ticks:
            return
        times = np.array([tick["t"] for tick in self._ticks]) - self._start
        for key, said in (("pose", "measured"), ("command", "commanded")):
            poses = np.array([tick[key] for tick in self._ticks])
            for name, values in zip(joint_names(poses.shape[1]), poses.T, strict=True):
                self._columns(f"{name}/{said}", times, values)
        ages = 1e3 * np.array([tick["age"] for tick in self._ticks], float)
        self._columns("latency_ms/feedback", times, ages)
        self._ticks = []

    def _columns(self, path: str, times: np.ndarray, values: np.ndarray, parts: Any = None) -> None:
        kind = next((kind for kind in _COLORS if f"/{kind}" in path), None)
        if path not in self._known and kind:
            self._known.add(path)
            style = self._rerun.SeriesLines(colors=[_COLORS[kind]], names=[kind])
            self._stream.log(path, style, static=True)
        column = self._rerun.Scalars.columns(scalars=np.asarray(values, float))
        when = [self._rerun.TimeColumn("time", duration=times)]
        self._stream.send_columns(path, when, column.partition(parts) if parts else column)

    def _scalar(self, path: str, value: float) -> None:
        self._stream.log(path, self._rerun.Scalars(float(value)))

    def _blueprint(self) -> Any:
        """Return a layout: pictures and events, the joints, and what takes time."""
        views = self._rerun.blueprint
        legends = [views.PlotLegend(visible=name == self._joints[0]) for name in self._joints]
        joints = [
            views.TimeSeriesView(origin=name, plot_legend=legend)
            for name, legend in zip(self._joints, legends, strict=True)
        ]
        pictures = [views.Spatial2DView(origin=f"camera/{name}") for name in self._cameras]
        return views.Blueprint(
            views.Horizontal(
                views.Vertical(*pictures, views.TextLogView(origin="events")),
                views.Grid(*joints),
                views.Vertical(*(views.TimeSeriesView(origin=name) for name in self._others)),
                column_shares=[1, 2, 1],
            ),
            collapse_panels=True,
        )


def main(target: str, frames: BinaryIO) -> int:
    """Write until there is nothing more to read; return the exit code, after a sentence."""
    try:
        writer = Writer(target)
        print("ready", flush=True)
        while size := int.from_bytes(frames.read(4)):
            if len(frame := frames.read(size)) < size:  # the client was killed
                break
            writer.write(wire.unpack(frame))
        writer.close()
    except (ValueError, OSError) as error:
        print(one_line(error), flush=True)
        return 1
    except RuntimeError as error:  # of Rerun, which does not say whether a disk is full
        print(f"Rerun could not write ({one_line(error)}): see whether there is space", flush=True)
        return 1
    return 0


if __name__ == "__main__":
    os._exit(main(sys.argv[1], sys.stdin.buffer))  # Rerun's exit waits for what it cannot write
