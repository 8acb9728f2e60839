"""A session on disk: every reading, command, chunk and event, and every picture that was sent."""

import functools
import json
import queue
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

FILE = "log.jsonl"


class Log:
    """Writes in a thread, so that the control loop never waits for a disk.

    A folder gets `log.jsonl`, one JSON object per line with the time `t` [s], and the pictures as
    `NUMBER_CAMERA.png`, where NUMBER is that of the line's `observation`.
    """

    def __init__(self, folder: Path) -> None:
        """Create a log.

        Raises:
            ValueError: the folder already has one.
            OSError: the folder or the file cannot be created.
        """
        if (folder / FILE).exists():
            raise ValueError(f"{folder} already has a log: choose another folder")
        folder.mkdir(parents=True, exist_ok=True)
        self._file = open(folder / FILE, "w")  # noqa: SIM115
        self._folder, self._observations = folder, 0
        self._queue: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._write)
        self._thread.start()

    def line(self, time: float, **values: Any) -> None:
        """Append a line."""
        self._queue.put({"t": round(time, 4)} | values)

    def observation(self, time: float, observation: Mapping[str, Any]) -> None:
        """Append an observation with its pictures."""
        number, self._observations = self._observations, self._observations + 1
        values = {"observation": number, "state": observation["state"]}
        self.line(time, **values, prompt=observation["prompt"])
        for camera, image in observation["image"].items():
            self._queue.put((f"{number:06}_{camera}.png", image))

    def close(self) -> None:
        """Wait until all is written.

        Raises:
            OSError: something could not be written, for example to a full disk.
        """
        self._queue.put(None)
        self._thread.join()
        if self._error:
            problem = f"the log in {self._folder} is incomplete: {self._error}"
            raise OSError(problem) from self._error

    def _write(self) -> None:
        while (item := self._queue.get()) is not None:
            self._attempt(functools.partial(self._write_item, item))
        self._attempt(self._file.close)

    def _attempt(self, write: Callable[[], None]) -> None:
        try:
            write()
        except Exception as error:  # raised by `close`; the arm goes on
            self._error = self._error or error

    def _write_item(self, item: Any) -> None:
        if isinstance(item, dict):
            self._file.write(json.dumps(item, default=_plain) + "\n")
        else:
            name, image = item
            Image.fromarray(image).save(self._folder / name, compress_level=1)


def _plain(value: Any) -> Any:
    """Convert NumPy's values to JSON's, rounded to micrometers and microradians."""
    return np.round(np.asarray(value, float), 6).tolist()
