"""The folder of one run: its config, its logs, and the rule that nothing is overwritten."""

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from tensorboardX import SummaryWriter

from lorasp_jax.config import Config
from lorasp_jax.training import processes

RECORD, CLOCK = "config.json", "seconds.json"
"""All that a run leaves which failed before it had anything."""
STOPPED = "stopped.json"
"""Why training could not go on, until it does."""


def to_json(config: Config) -> dict[str, Any]:
    """The config as plain JSON values, the adapter method with its name."""
    plain = json.loads(json.dumps(dataclasses.asdict(config)))
    return {**plain, "peft": {"method": type(config.peft).__name__, **plain["peft"]}}


def write_json(path: Path, value: Any) -> None:
    """Write JSON so that readers never see half of it."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a whole file under a temporary name, then give it its own."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def open_run(config: Config, root: Path, *, resume: bool) -> Path:
    """Create the run's folder, or with `resume` check that it holds this very run.

    Raises:
        ValueError: the name is not one folder's, the folder holds a run and `resume` is off, holds
            none and `resume` is on, or holds a run with another config.
    """
    if config.name in ("", ".", "..") or Path(config.name).name != config.name:
        raise ValueError(f"--name must be a plain folder name, got {config.name!r}")
    folder = root / config.name
    if resume:
        changed = _differences(_recorded(folder), to_json(config))
        if changed:
            raise ValueError(
                f"{folder} holds a run with other settings ({', '.join(changed)}): resume with the "
                "settings it was started with, or give this run another --name"
            )
        return folder
    if folder.exists() and any(path.name not in (RECORD, CLOCK) for path in folder.iterdir()):
        raise ValueError(
            f"{folder} already holds a run: add --resume to continue it, "
            "or give this one another --name"
        )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CLOCK).unlink(missing_ok=True)
    write_json(folder / RECORD, to_json(config))
    return folder


def _recorded(folder: Path) -> dict[str, Any]:
    """The config of the run in `folder`."""
    record = folder / RECORD
    if not record.exists():
        raise ValueError(f"{folder} holds no run to resume: start it without --resume")
    try:
        return json.loads(record.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{record} is damaged ({error}): the run cannot be resumed") from error


def _differences(a: Mapping[str, Any], b: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Dotted names of the values in which two nested mappings differ."""
    names: list[str] = []
    for key in sorted({*a, *b}):
        x, y = a.get(key), b.get(key)
        if isinstance(x, Mapping) and isinstance(y, Mapping):
            names += _differences(x, y, f"{prefix}{key}.")
        elif x != y:
            names.append(f"{prefix}{key}")
    return names


class MetricsLog:
    """Appends scalars to `metrics.jsonl` and to TensorBoard event files.

    A resumed run drops the lines past the step it continues from, so that the file reads like that
    of an uninterrupted run. Of several processes the first one alone writes.
    """

    def __init__(self, folder: Path, start_step: int = 0) -> None:
        """Open the log of the run in `folder`, which continues at `start_step`."""
        self.path, self._writes = folder / "metrics.jsonl", processes.is_first()
        if not self._writes:
            return
        kept = [row for row in read_metrics(folder) if row["step"] <= start_step]
        write_text(self.path, "".join(json.dumps(row) + "\n" for row in kept))
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=start_step + 1)

    def write(
        self,
        step: int,
        values: Mapping[str, float],
        histograms: Mapping[str, np.ndarray] = MappingProxyType({}),
    ) -> None:
        """Record scalars at `step`, and for TensorBoard alone histograms of arrays.

        JSON has no numbers that are not finite: they are left out.
        """
        if not self._writes:
            return
        values = {name: value for name, value in values.items() if math.isfinite(value)}
        with self.path.open("a") as file:
            file.write(json.dumps({"step": step, **values}) + "\n")
        for name, value in values.items():
            self._board.add_scalar(name, value, step)
        for name, array in histograms.items():
            self._board.add_histogram(name, array, step)

    def close(self) -> None:
        """Flush the event file."""
        if self._writes:
            self._board.close()


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """The rows of `metrics.jsonl`; a last line cut off by a crash is dropped."""
    path = folder / "metrics.jsonl"
    if not path.exists():
        return []
    text = path.read_text()
    complete = text[: text.rfind("\n") + 1]
    return [json.loads(line) for line in complete.splitlines()]
