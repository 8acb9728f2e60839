"""A session on disk: every reading, command, chunk and event, and every picture that was sent."""

import json
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
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
        self._writer = ThreadPoolExecutor(1)
        self._error: BaseException | None = None
        self._later(self._file.flush)  # starts the thread now, not while an arm moves

    def line(self, time: float, **values: Any) -> None:
        """Append a line."""
        self._later(self._write, {"t": round(time, 4)} | values)

    def observation(self, time: float, observation: Mapping[str, Any]) -> None:
        """Append an observation with its pictures."""
        number, self._observations = self._observations, self._observations + 1
        values = {"observation": number, "state": observation["state"]}
        self.line(time, **values, prompt=observation["prompt"])
        for camera, image in observation["image"].items():
            self._later(self._save, f"{number:06}_{camera}.png", image)

    def close(self) -> None:
        """Wait until all is written.

        Raises:
            OSError: something could not be written, for example to a full disk.
        """
        self._later(self._file.close)
        self._writer.shutdown()
        if self._error:
            problem = f"the log in {self._folder} is incomplete: {self._error}"
            raise OSError(problem) from self._error

    def _later(self, write: Callable[..., None], *arguments: Any) -> None:
        self._writer.submit(write, *arguments).add_done_callback(self._note)

    def _note(self, written: Future) -> None:
        self._error = self._error or written.exception()  # raised by `close`; the arm goes on

    def _write(self, values: dict[str, Any]) -> None:
        self._file.write(json.dumps(values, default=_plain) + "\n")

    def _save(self, name: str, image: np.ndarray) -> None:
        Image.fromarray(image).save(self._folder / name, compress_level=1)


def _plain(value: Any) -> Any:
    """Convert NumPy's values to JSON's, rounded to micrometers and microradians."""
    return np.round(np.asarray(value, float), 6).tolist()
