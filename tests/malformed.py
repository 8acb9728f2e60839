"""Corrupt valid inputs, with a name and a function of the folder per case; check the error."""

import json
import random
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import safetensors.numpy

from lorasp_jax.base.digest import DIGEST, with_digest
from lorasp_jax.base.files import RefusedError
from tests import ROOT

Damage = Callable[[Path], None]
Cases = Iterator[tuple[str, Damage]]
ABSENT = object()
HUGE = 1e999  # infinity in JSON


def first(folder: Path, pattern: str) -> Path:
    return sorted(folder.rglob(pattern))[0]


def _noise(data: bytes) -> bytes:
    return random.Random(0).randbytes(len(data))


_BYTES = {"empty": lambda data: b"", "half": lambda data: data[: len(data) // 2], "noise": _noise}


def files(*patterns: str) -> Cases:
    """Remove a file, empty it, cut it in half, or replace it by noise."""
    for pattern in patterns:
        yield f"{pattern} missing", lambda folder, p=pattern: first(folder, p).unlink()
        for name, change in _BYTES.items():

            def spoil(folder: Path, p: str = pattern, change: Any = change) -> None:
                path = first(folder, p)
                path.write_bytes(change(path.read_bytes()))

            yield f"{pattern} {name}", spoil


def flips(pattern: str, positions: tuple[int, ...]) -> Cases:
    """Invert one byte of a file."""
    for position in positions:

        def spoil(folder: Path, position: int = position) -> None:
            path = first(folder, pattern)
            data = bytearray(path.read_bytes())
            data[position] ^= 0xFF
            path.write_bytes(data)

        yield f"{pattern} byte {position}", spoil


def fields(pattern: str, values: dict[str, list[Any]], line: int | None = None) -> Cases:
    """Change a field, such as a/b/c, of a JSON file or of a line in a JSONL file."""
    for field, bad in values.items():
        for value in bad:

            def spoil(folder: Path, field: str = field, value: Any = value) -> None:
                path = first(folder, pattern)
                lines = path.read_text().splitlines() if line is not None else [path.read_text()]
                content = json.loads(lines[line or 0])
                *parents, key = field.split("/")
                owner = content
                for name in parents:
                    owner = owner[name]
                if value is ABSENT:
                    del owner[key]
                else:
                    owner[key] = value
                if isinstance(content, dict) and content.pop(DIGEST, None):
                    content = with_digest(content)  # a wrong digest must not hide the error
                lines[line or 0] = json.dumps(content)
                path.write_text("\n".join(lines))

            shown = "absent" if value is ABSENT else repr(value)
            yield f"{pattern} {field} {shown}", spoil


def columns(pattern: str, values: dict[str, list[Any]], row: int = 3) -> Cases:
    """Drop a column of a parquet file, or change its value in one row or in all rows."""
    for column, bad in values.items():
        for value in bad:

            def spoil(folder: Path, column: str = column, value: Any = value) -> None:
                path = first(folder, pattern)
                table = pq.read_table(path)
                if value is ABSENT:
                    pq.write_table(table.drop_columns(column), path)
                    return
                rows = table[column].to_pylist()
                if isinstance(value, str | list):  # another type: change all rows
                    rows = pa.array([value] * len(rows))
                else:
                    rows[row] = value(rows[row]) if callable(value) else value
                    kind = table[column].type
                    ragged = isinstance(rows[row], list)
                    rows = pa.array(rows, pa.list_(pa.float32()) if ragged else kind)
                index = table.column_names.index(column)
                pq.write_table(table.set_column(index, column, rows), path)

            shown = getattr(value, "__name__", repr(value))
            yield f"{pattern} {column} {'absent' if value is ABSENT else shown}", spoil


def tensors(pattern: str, changes: dict[str, Callable[[dict[str, np.ndarray]], Any]]) -> Cases:
    """Change the tensors of a safetensors file."""
    for name, change in changes.items():

        def spoil(folder: Path, change: Any = change) -> None:
            path = first(folder, pattern)
            path.write_bytes(safetensors.numpy.save(change(safetensors.numpy.load_file(path))))

        yield f"{pattern} {name}", spoil


def _on_first(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict[str, Any]], Any]:
    """Apply a change to the first tensor only."""

    def changed(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        name = min(arrays)
        return arrays | {name: np.ascontiguousarray(change(arrays[name]))}

    return changed


def _one_nan(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array.flat[0] = np.nan
    return array


TENSORS: dict[str, Callable[[dict[str, np.ndarray]], Any]] = {
    "none": lambda arrays: {},
    "one missing": lambda arrays: {n: x for n, x in arrays.items() if n != min(arrays)},
    "one more": lambda arrays: arrays | {"other": np.zeros(3, np.float32)},
    "one renamed": lambda arrays: {
        n if n != min(arrays) else f"{n}_": x for n, x in arrays.items()
    },
    "flat": _on_first(np.ravel),
    "scalar": _on_first(lambda x: np.ones((), np.float32)),
    "shorter": _on_first(lambda x: x[..., :-1]),
    "of rank 0": _on_first(lambda x: x[:0]),
    "transposed": _on_first(lambda x: x.T),
    "integers": _on_first(lambda x: x.astype(np.int32)),
    "flags": _on_first(lambda x: x > 0),
    "nan": _on_first(_one_nan),
    "infinite": _on_first(lambda x: np.full_like(x, np.inf)),
}


def drop_last(values: list[float]) -> list[float]:
    return values[:-1]


def with_nan(values: list[float]) -> list[float]:
    return [*values[:-1], float("nan")]


def with_infinity(values: list[float]) -> list[float]:
    return [*values[:-1], float("inf")]


def check_refusal(error: BaseException, *names: str) -> None:
    """Check that the error is this project's, has one line and names one of `names`."""
    assert type(error) in (ValueError, FileNotFoundError, RefusedError), repr(error)
    raised = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
    assert raised.is_relative_to(ROOT), f"{error!r} was raised in {raised}"
    text = str(error)
    assert "\n" not in text
    assert "Traceback" not in text
    assert any(name in text for name in names), text
