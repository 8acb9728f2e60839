"""The folder of a run: config, logs and lock; existing runs are never overwritten."""

import contextlib
import dataclasses
import json
import math
import shutil
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from envs.scene.ranges import Randomization
from lorasp_jax.base.digest import verify_digest, with_digest
from lorasp_jax.base.files import as_value_error, check_only_files, read_bytes
from lorasp_jax.base.json_values import check
from lorasp_jax.base.locks import locked
from lorasp_jax.base.writing import TEMPORARY_SUFFIX, write_text
from lorasp_jax.config import AugmentConfig, Config, OptimConfig
from lorasp_jax.peft.settings import without_removed
from lorasp_jax.training import records
from lorasp_jax.training.distributed import processes

CONFIG_FILE, TIMES_FILE, DATASET_FILE = "config.json", "seconds.json", "dataset.json"
"""Files that a run may leave behind if it fails before producing any results."""
WILDCARDS = frozenset("*?[\\")
"""Not allowed in a run's path: Orbax treats paths as glob patterns and would find no checkpoint."""
VALIDATION = "validation.json"
"""File with the final measurements on held-out episodes."""
CACHE = Path("cache", "steps")
"""The dataset of a run, converted."""
MERGED = "merged"
"""Folder of a base with the adapters of a start run merged into it."""
ADVANTAGES = "advantages.npz"
"""Values and advantages of recorded steps."""
STOPPED = "stopped.json"
"""File with the reason why training stopped; removed when training continues."""


_OPTIONAL = (
    *(("data", "cameras"), ("data", "weights"), ("data", "replay")),
    *(("model", "base_dtype"), ("model", "chunk"), ("model", "openpi_config")),
    ("optim", "rtc_max_delay"),
)
"""Settings that `to_json` omits at their defaults, which are 0 or empty, as it omits `adapt` and
`plan`: results files of studies do not have them."""


RELATIVE: dict[bool | None, bool | None] = {None: False, False: None, True: True}
"""`relative_actions` -> as recorded, and back: False once meant what None does."""


def to_json(config: Config) -> dict[str, Any]:
    """Convert a config to JSON values, including the name of the adapter method.

    `scene` has only the ranges that differ from the defaults, and is absent if none do.
    """
    fields = json.loads(json.dumps(dataclasses.asdict(config)))
    fields["model"]["relative_actions"] = RELATIVE[config.model.relative_actions]
    for group, name in _OPTIONAL:
        if not fields[group][name]:
            del fields[group][name]
    augment, data = config.data.augment, fields["data"]
    if len(data["source"]) < 2:  # as in runs from before there could be several
        data["source"] = "".join(data["source"])
    if config.optim.time_shape == OptimConfig.time_shape:
        del fields["optim"]["time_shape"]
    if config.data.statistics == "shared":
        del data["statistics"]
    if augment == AugmentConfig("auto" if not config.data.source else "none"):
        del data["augment"]  # as in runs from before there was augmentation
    else:
        data["augment"] = {"preset": augment.preset, **augment.given}
    if config.data.validation == ("0",) or not config.data.source:  # likewise
        del data["validation"], fields["keep"], fields["evaluation"]["validate_every"]
    for name in ("adapt", "plan", "protect"):
        if not fields[name]:
            del fields[name]
    if "ranks" in fields["peft"]:  # those of the plan
        del fields["peft"]["ranks"]
    if config.learn != "recap":
        del fields["recap"]
    if config.learn == "imitation":
        del fields["learn"]
    scene = fields.pop("scene")
    if changed := config.scene.changed():
        fields["scene"] = {name: scene[name] for name in changed}
    return {**fields, "peft": {"method": type(config.peft).__name__, **fields["peft"]}}


def recorded_ranges(config: Mapping[str, Any]) -> Randomization | None:
    """Return `Config.ranges` of a config that `to_json` converted.

    Raises:
        ValueError: the config has an unknown range.
    """
    ranges = config.get("scene", {})
    known = [field.name for field in dataclasses.fields(Randomization)]
    if unknown := [name for name in ranges if name not in known]:
        raise ValueError(f"unknown range {unknown[0]!r}: choose from {', '.join(known)}")
    found = {name: (value[0], value[1]) for name, value in ranges.items()}
    return Randomization(**found) if found else None


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write a JSON object with its digest, atomically."""
    write_text(path, json.dumps(with_digest(value), indent=2) + "\n")


def read_json(path: Path, schema: Mapping[Any, Any] = MappingProxyType({})) -> dict[str, Any]:
    """Read a file written by `write_json`; return {} if it does not exist.

    Raises:
        ValueError: the file is corrupt or does not match `schema` (see `json_values.check`).
    """
    if not path.exists():
        return {}
    with as_value_error(path, remedy=": restore it from a backup"):
        value = verify_digest(json.loads(read_bytes(path)))
        check(value, schema)
        return value


@contextlib.contextmanager
def open_run(config: Config, root: Path, *, resume: bool | Literal["auto"]) -> Iterator[Path]:
    """Open the run's folder under an exclusive lock.

    Without `resume`, the folder is created in `root`; with True, it must contain a run with the
    same config; "auto" resumes the run if it exists and creates it otherwise. A new run that is
    refused before it has results leaves nothing.

    Raises:
        ValueError: the path contains a wildcard, or another process uses the folder. For a new
            run: the folder already contains a run, or is a file. To resume: the folder contains no
            run, a run with another config, a pipe, or a symlink that points outside it.
    """
    folder = root / config.name
    if wildcards := WILDCARDS & set(str(folder.absolute())):
        raise ValueError(
            f"checkpoints cannot be restored from {folder.absolute()} because its path contains "
            f"{' '.join(sorted(wildcards))}: choose another --name or working directory"
        )
    with locked(folder):
        is_new = not ((folder / CONFIG_FILE).exists() if resume == "auto" else resume)
        if is_new:
            _begin(config, folder)
        else:
            check_only_files(folder, folder)
            recorded = _recorded(folder)
            if changed := changed_settings(recorded, to_json(config)):
                if removed := _removed(recorded, config):
                    raise ValueError(
                        f"{folder} contains a run of another version, with settings that this one "
                        f"does not have ({', '.join(removed)}): use another --name"
                    )
                if "data.validation" in changed and "validation" not in recorded["data"]:
                    changed += ["an older run has --data.validation 0 --data.augment.preset none"]
                raise ValueError(
                    f"{folder} contains a run with different settings ({', '.join(changed)}): "
                    "resume with the original settings or use another --name"
                )
        try:
            yield folder
        except (ValueError, ModuleNotFoundError):
            made = {path for name in (CACHE, MERGED) for path in (folder / name).rglob("*")}
            if is_new and not _results(folder) - made:
                shutil.rmtree(folder, ignore_errors=True)  # a link to a folder stays
            raise


def _begin(config: Config, folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: remove it or use another --name")
    if _results(folder):
        raise ValueError(
            f"{folder} already contains a run: add --resume to continue it or use another --name"
        )
    folder.mkdir(exist_ok=True)
    for path in _files(folder):
        path.unlink()
    write_json(folder / CONFIG_FILE, to_json(config))


def _files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if not path.is_dir()}


def _results(folder: Path) -> set[Path]:
    """Return the files of a run that are more than its beginning."""
    unfinished = {*folder.glob(f".*{TEMPORARY_SUFFIX}")}  # left by a killed process
    begun = {folder / name for name in (CONFIG_FILE, TIMES_FILE, DATASET_FILE, ADVANTAGES)}
    return _files(folder) - unfinished - begun


def record_dataset(folder: Path, facts: Mapping[str, Any], *, streams: bool) -> bool:
    """Record the run's dataset and return whether to stream it.

    `streams` tells whether the dataset is too large for this device. A run that started streaming
    keeps streaming, because streamed batches differ from batches sampled on the device.

    Raises:
        ValueError: the run started with a different dataset.
    """
    path, current = folder / DATASET_FILE, {"facts": dict(facts), "streams": streams}
    recorded = read_json(path, records.DATASET)
    if not recorded:
        write_json(path, current)
        return streams
    if recorded["facts"] != current["facts"]:
        raise ValueError(
            f"the dataset differs from the one {folder} was started with: restore the original, or "
            "train on this one under another --name"
        )
    return streams or recorded["streams"]


def _recorded(folder: Path) -> dict[str, Any]:
    if not (folder / CONFIG_FILE).exists():
        raise ValueError(f"{folder} contains no run to resume: omit --resume to start one")
    return read_json(folder / CONFIG_FILE, records.CONFIG)


def changed_settings(recorded: Mapping[str, Any], current: Mapping[str, Any]) -> list[str]:
    """Return the dotted names of settings that differ between two results of `to_json`."""
    recorded = {**recorded, "peft": without_removed(recorded["peft"])}
    return _differences(recorded, current)


def _removed(recorded: Mapping[str, Any], config: Config) -> list[str]:
    """Return the dotted names of recorded settings that the config's groups do not have."""
    groups = {name: x for name, x in dataclasses.asdict(config).items() if isinstance(x, dict)}
    del groups["peft"]  # another method has other settings
    return [
        f"{group}.{name}"
        for group, known in groups.items()
        for name in recorded.get(group, {})
        if name not in known
    ]


def _differences(a: Mapping[str, Any], b: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Return the dotted names of values that differ between two nested mappings."""
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

    Only the first process writes. It alone imports tensorboardX, which imports PyTorch where that
    is installed: 3 s of which readers of a run folder, such as a server, have nothing.
    """

    def __init__(self, folder: Path, start_step: int = 0) -> None:
        """Open the log and drop rows after `start_step`, from which the run resumes."""
        self.path: Path = folder / "metrics.jsonl"
        self._writes = processes.is_first()
        if not self._writes:
            return
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import SessionLog

        rows = [row for row in read_metrics(folder) if row["step"] <= start_step]
        write_text(self.path, "".join(map(_line, rows)))
        board = folder / "tensorboard"
        board.mkdir(exist_ok=True)
        # SummaryWriter would block its callers forever if its thread failed. The step makes file
        # names unique, because their time has a resolution of 1 s.
        self._board = EventsWriter(str(board / "events"), f".{start_step:09}")
        start = SessionLog(status=SessionLog.START)  # discards old events from this step on
        self._add(start_step + 1, session_log=start)

    def write(
        self,
        step: int,
        values: Mapping[str, float],
        histograms: Mapping[str, np.ndarray] = MappingProxyType({}),
    ) -> None:
        """Log scalars at `step` and, to TensorBoard only, histograms of per-layer arrays.

        Non-finite values are omitted, because JSON cannot represent them.
        """
        if not self._writes:
            return
        from tensorboardX import summary
        from tensorboardX.proto.summary_pb2 import Summary

        values = {name: value for name, value in values.items() if math.isfinite(value)}
        with self.path.open("a") as file:
            file.write(_line({"step": step, **values}))
        summaries = [summary.scalar(name, value) for name, value in values.items()]
        # TensorBoard keeps only one kind of summary per tag, hence "/layers".
        summaries += [
            summary.histogram(f"{name}/layers", array, "auto") for name, array in histograms.items()
        ]
        self._add(step, summary=Summary(value=[value for s in summaries for value in s.value]))

    def _add(self, step: int, **content: Any) -> None:
        from tensorboardX.proto.event_pb2 import Event

        self._board.write_event(Event(wall_time=time.time(), step=step, **content))
        self._board.flush()

    def close(self) -> None:
        """Close the event file."""
        if self._writes:
            self._board.close()


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Read the rows of `metrics.jsonl`; a last line truncated by a crash is dropped.

    Raises:
        ValueError: a row is corrupt.
    """
    path = folder / "metrics.jsonl"
    lines = read_bytes(path).split(b"\n")[:-1] if path.exists() else []
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            check(row, records.ROW)
            rows.append(row)
        except (ValueError, RecursionError) as error:
            raise ValueError(
                f"line {number} of {path} is damaged ({error}): restore the file or delete the line"
            ) from error
    return rows


def _line(row: Mapping[str, float]) -> str:
    return json.dumps(row) + "\n"
