"""LeRobot datasets for tests: copies of the golden ones, intact or damaged."""

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from tests import GOLDEN

VERSIONS = ("v21", "v3")


def golden(version: str) -> Path:
    return GOLDEN / f"lerobot_{version}" / "dataset"


def copied(version: str, to: Path) -> Path:
    return Path(shutil.copytree(golden(version), to / "dataset"))


def digest(folder: Path) -> dict[str, str]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def edit_info(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    path = folder / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def edit_rows(folder: Path, change: Callable[[pa.Table], pa.Table], of: str = "data") -> None:
    """Change the first parquet file in a folder of the dataset."""
    path = next(iter(sorted((folder / of).rglob("*.parquet"))))
    pq.write_table(change(pq.read_table(path)), path)


def replaced(table: pa.Table, name: str, values: Any) -> pa.Table:
    return table.set_column(table.column_names.index(name), name, values)


def set_value(name: str, row: int, value: Any) -> Callable[[pa.Table], pa.Table]:
    """Make a change for `edit_rows` that replaces one value of a column."""

    def change(table: pa.Table) -> pa.Table:
        column = table[name]
        values = column.to_pylist()
        values[row] = value(values[row])
        ragged = isinstance(values[row], list) and len(values[row]) != len(values[row - 1])
        kind = pa.list_(pa.float32()) if ragged else column.type
        return replaced(table, name, pa.array(values, kind))

    return change


def cut(folder: Path, pattern: str, share: float) -> None:
    """Truncate a file."""
    path = next(iter(sorted(folder.rglob(pattern))))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
