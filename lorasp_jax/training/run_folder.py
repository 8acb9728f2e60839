"""The folder of one run: its config, its logs, and the rule that nothing is overwritten."""

import contextlib
import dataclasses
import json
import math
import os
import platform
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import filelock
import numpy as np
from tensorboardX import summary
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary

from envs.datasets.files import as_value_error, check_only_files, read_bytes
from envs.datasets.locks import acquire
from envs.datasets.writing import TEMPORARY_SUFFIX, write_text
from lorasp_jax.config import Config
from lorasp_jax.peft._settings import upgrade
from lorasp_jax.storage.digest import verify_digest, with_digest
from lorasp_jax.storage.json_values import check
from lorasp_jax.training import records
from lorasp_jax.training.distributed import processes

RECORD, CLOCK, DATASET = "config.json", "seconds.json", "dataset.json"
"""All files that a run leaves which failed before it had anything."""
WILDCARDS = frozenset("*?[\\")
"""Orbax takes paths for patterns: below a folder with one of these it finds no checkpoint again."""
STOPPED = "stopped.json"
"""Why training could not go on, until it does."""


def to_json(config: Config) -> dict[str, Any]:
    """The config as plain JSON values, the adapter method with its name."""
    plain = json.loads(json.dumps(dataclasses.asdict(config)))
    return {**plain, "peft": {"method": type(config.peft).__name__, **plain["peft"]}}


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write a JSON object with its digest so that readers never see half of it."""
    write_text(path, json.dumps(with_digest(value), indent=2) + "\n")


def read_json(path: Path, kind: Mapping[Any, Any] = MappingProxyType({})) -> dict[str, Any]:
    """What `write_json` wrote; nothing without a file.

    Args:
        path: the file.
        kind: what must be in it, see `json_values.check`.

    Raises:
        ValueError: the file is damaged, or another version wrote other values.
    """
    if not path.exists():
        return {}
    with as_value_error(path, remedy=": put back a whole one"):
        found = verify_digest(json.loads(read_bytes(path)))
        check(found, kind)
        return found


@contextlib.contextmanager
def open_run(config: Config, root: Path, *, resume: bool | Literal["auto"]) -> Iterator[Path]:
    """The run's folder, for this process alone as long as it is open.

    It is created, or with `resume` checked to hold this very run; "auto" is that of the two which
    fits.

    Raises:
        ValueError: the folder cannot be made or has a wildcard in its path; another process works
            on it; it holds a run and `resume` is off, holds none and `resume` is on, or holds a run
            with another config, a pipe, or a link to elsewhere.
    """
    folder = root / config.name
    if found := WILDCARDS & set(str(folder.absolute())):
        raise ValueError(
            f"checkpoints cannot be read again from {folder.absolute()}, because of the "
            f"{' '.join(sorted(found))} in it: choose another --name or place"
        )
    with _locked(folder):
        if (folder / RECORD).exists() if resume == "auto" else resume:
            check_only_files(folder, folder)
            changed = _differences(_recorded(folder), to_json(config))
            if changed:
                raise ValueError(
                    f"{folder} holds a run with other settings ({', '.join(changed)}): resume with "
                    "the settings it was started with, or give this run another --name"
                )
        else:
            _begin(config, folder)
        yield folder


def _begin(config: Config, folder: Path) -> None:
    """Record a new run in a folder that holds none."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: remove it, or give this run another --name")
    names = (RECORD, CLOCK, DATASET)
    allowed = {folder / name for name in names}
    for name in names:
        allowed |= {*folder.glob(f".{name}.*{TEMPORARY_SUFFIX}")}  # of a process that was killed
    if any(path not in allowed for path in folder.rglob("*") if not path.is_dir()):
        raise ValueError(
            f"{folder} already holds a run: add --resume to continue it, "
            "or give this one another --name"
        )
    folder.mkdir(exist_ok=True)
    for path in allowed - {folder / RECORD}:
        path.unlink(missing_ok=True)
    write_json(folder / RECORD, to_json(config))


def record_dataset(folder: Path, facts: Mapping[str, Any], *, streams: bool) -> bool:
    """Whether a run's dataset streams: where it did when the run began, it goes on to.

    Streamed batches are others than those that are drawn on the device.

    Args:
        folder: the run's, which keeps all this.
        facts: JSON values by which the dataset is known again.
        streams: whether it has to, now.

    Raises:
        ValueError: the run began with another dataset.
    """
    path, now = folder / DATASET, {"facts": dict(facts), "streams": streams}
    before = read_json(path, records.DATASET) or now
    if before is now:
        write_json(path, now)
    if before["facts"] != now["facts"]:
        raise ValueError(
            f"the dataset is not the one that {folder} began with: put that back where it was, or "
            "give this run another --name"
        )
    return streams or before["streams"]


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes out of a folder, by a lock file beside it that names its last user."""
    file = folder.parent / f".{folder.name}.lock"
    try:
        lock = acquire(file)
    except filelock.Timeout as error:
        user = file.read_text().strip() or "another process"
        raise ValueError(
            f"{folder} is in use by {user}: wait for that run or stop it, or give this one another "
            "--name"
        ) from error
    with lock:
        file.write_text(f"process {os.getpid()} on {platform.node()}\n")
        yield


def _recorded(folder: Path) -> dict[str, Any]:
    """The config of the run in `folder`."""
    if not (folder / RECORD).exists():
        raise ValueError(f"{folder} holds no run to resume: start it without --resume")
    found = read_json(folder / RECORD, records.CONFIG)
    return {**found, "peft": upgrade(found["peft"])}


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
        self.path: Path = folder / "metrics.jsonl"
        self._writes = processes.is_first()
        if not self._writes:
            return
        kept = [row for row in read_metrics(folder) if row["step"] <= start_step]
        write_text(self.path, "".join(map(_line, kept)))
        board = folder / "tensorboard"
        board.mkdir(exist_ok=True)
        # Not SummaryWriter: when its thread cannot write, whoever adds to its queue waits for ever.
        # The name has whole seconds: with the step, no other log is written over.
        self._board = EventsWriter(str(board / "events"), f".{start_step:09}")
        start = SessionLog(status=SessionLog.START)  # drop what was drawn from this step on
        self._add(start_step + 1, session_log=start)

    def write(
        self,
        step: int,
        values: Mapping[str, float],
        histograms: Mapping[str, np.ndarray] = MappingProxyType({}),
    ) -> None:
        """Record scalars at `step`, and for TensorBoard alone histograms of arrays over layers.

        JSON has no numbers that are not finite: they are left out.
        """
        if not self._writes:
            return
        values = {name: value for name, value in values.items() if math.isfinite(value)}
        with self.path.open("a") as file:
            file.write(_line({"step": step, **values}))
        drawn = [summary.scalar(name, value) for name, value in values.items()]
        # TensorBoard drops all but the first kind of a tag.
        drawn += [summary.histogram(f"{name}/layers", a, "auto") for name, a in histograms.items()]
        self._add(step, summary=Summary(value=[value for one in drawn for value in one.value]))

    def _add(self, step: int, **content: Any) -> None:
        """Put an event where TensorBoard finds it."""
        self._board.write_event(Event(wall_time=time.time(), step=step, **content))
        self._board.flush()

    def close(self) -> None:
        """Close the event file."""
        if self._writes:
            self._board.close()


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """The rows of `metrics.jsonl`; a last line cut off by a crash is dropped.

    Raises:
        ValueError: a row is not as it was written.
    """
    path = folder / "metrics.jsonl"
    lines = read_bytes(path).split(b"\n")[:-1] if path.exists() else []
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            rows.append(verify_digest(json.loads(line)))
            check(rows[-1], records.ROW)
        except (ValueError, RecursionError) as error:
            raise ValueError(
                f"line {number} of {path} is damaged ({error}): put back a whole one, or remove it"
            ) from error
    return rows


def _line(row: Mapping[str, float]) -> str:
    return json.dumps(with_digest(row)) + "\n"
