"""Change a folder's files randomly; each change takes a random generator and the files."""

import contextlib
import copy
import json
import os
import random
import re
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lorasp_jax.base.digest import DIGEST, with_digest

Change = Callable[[random.Random, list[Path]], None]
VALUES: list[Any] = [
    *(None, True, 0, -1, 2.5, 1e300, 1e999, float("nan"), 10**30, -(2**63), 2**31),
    *("", "x", "9" * 5000, "../../x", "/etc/passwd", "http://localhost:9/x", "\0", "\ud800"),
    *("{0.__class__}", "{x:0999999999}", "é" * 300, [], {}, [None], [[]], [1e999], {"": None}),
]
NUMBERS = ["", "x", "nan", "inf", "-1", "0", "1e300", "99999999999999", "1 2", "../x", "/dev/zero"]
ELEMENTS = [
    '<replicate count="100000000"><geom size="1"/></replicate>',
    '<include file="/etc/passwd"/>',
    '<flexcomp name="q" type="grid" count="1000 1000 1000" spacing="1 1 1"/>',
    '<size nkey="100000000"/>',
    '<hfield name="u" nrow="100000" ncol="100000" size="1 1 1 1"/>',
    '<plugin plugin="x"/>',
    '<attach model="x" body="y" prefix="z"/>',
    '<option timestep="0"/>',
]
TYPES = [pa.string(), pa.int8(), pa.float64(), pa.list_(pa.float64()), pa.bool_(), pa.binary()]


def change_json(r: random.Random, files: list[Path]) -> None:
    """Change or delete a value in a JSON file, or in one line of a JSONL file."""
    file = r.choice([file for file in files if file.suffix in (".json", ".jsonl")])
    lines = file.read_text().splitlines() if file.suffix == ".jsonl" else [file.read_text()]
    number = r.randrange(len(lines))
    value = {"": json.loads(lines[number])}
    owner, key = r.choice(list(_items(value)))
    if r.random() < 0.85:
        owner[key] = copy.deepcopy(r.choice(VALUES))
    else:
        del owner[key]
    lines[number] = json.dumps(_with_valid_digest(value.get("", {})))
    file.write_text("\n".join(lines))


def _with_valid_digest(value: Any) -> Any:
    """Update the digest, if any, so that a wrong digest does not hide other errors."""
    if not isinstance(value, dict) or DIGEST not in value:
        return value
    with contextlib.suppress(TypeError, RecursionError):
        return with_digest({name: item for name, item in value.items() if name != DIGEST})
    return value


def _items(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield all values inside a JSON value as (container, key)."""
    keys = value if isinstance(value, dict) else range(min(len(value), 6))
    for key in keys:
        yield value, key
        if isinstance(value[key], dict | list):
            yield from _items(value[key])


def change_bytes(r: random.Random, files: list[Path]) -> None:
    """Truncate a file, change its bits, or insert or remove bytes."""
    file = r.choice(files)
    data = bytearray(file.read_bytes())
    place, size = r.randrange(len(data) + 1), r.choice([1, 8, 100])
    match r.choice(["cut", "flip", "noise", "empty", "insert", "remove"]):
        case "cut":
            del data[place:]
        case "flip":
            data[place - 1] ^= 1 << r.randrange(8)
        case "noise":
            data = bytearray(r.randbytes(len(data)))
        case "empty":
            data.clear()
        case "insert":
            data[place:place] = r.randbytes(size)
        case "remove":
            del data[place : place + size]
    file.write_bytes(data)


def replace_file(r: random.Random, files: list[Path]) -> None:
    """Replace a file by another one, or by something that is not a regular file."""
    file, other = r.choice(files), r.choice(files)
    mine = file.read_bytes()
    file.unlink()
    match r.choice(["swap", "folder", "pipe", "out", "loop", "hole", "zero"]):
        case "swap":
            file.write_bytes(mine if other == file else other.read_bytes())
            other.write_bytes(mine)
        case "folder":
            file.mkdir()
        case "pipe":
            os.mkfifo(file)
        case "out":
            file.symlink_to("/etc/passwd")
        case "loop":
            file.symlink_to(file.name)
        case "hole":
            file.touch()
            os.truncate(file, 2**40)
        case "zero":
            file.symlink_to("/dev/zero")


def change_parquet(r: random.Random, files: list[Path]) -> None:
    """Change a value or the type of a column in a parquet file, or drop the column."""
    file = r.choice([file for file in files if file.suffix == ".parquet"])
    table = pq.read_table(file)
    name = r.choice(table.column_names)
    place, rows = table.column_names.index(name), table[name].to_pylist()
    value = r.choice(VALUES)
    changes = [
        lambda: table.drop_columns(name),
        lambda: table.append_column(name, table[name]),
        lambda: table.slice(0, len(rows) // 2),
        lambda: table.set_column(place, name, pa.array(rows, r.choice(TYPES))),
        lambda: table.set_column(place, name, pa.array([value, *rows[1:]])),
        lambda: table.set_column(place, name, pa.array([value] * len(rows))),
    ]
    with contextlib.suppress(pa.ArrowException, OverflowError, ValueError, TypeError):
        pq.write_table(r.choice(changes)(), file)  # values that pyarrow cannot write need no test


def changed_array(r: random.Random, original: np.ndarray) -> np.ndarray:
    """Change the dtype, shape or values of an array."""
    minus = np.array(-1).astype(original.dtype)  # the largest value for unsigned integers
    with np.errstate(all="ignore"):
        changes = [
            lambda: original.astype(r.choice(["f2", "f8", ">f4", "i8", "?", "U5", "S3"])),
            lambda: np.where(
                np.arange(original.size).reshape(original.shape), original, r.choice([minus, 99])
            ),
            lambda: original.reshape(-1),
            lambda: original[:-1],
            lambda: original[:0],
            lambda: original[None],
            lambda: np.asfortranarray(original),
        ]
        return r.choice(changes)()


def change_cache(r: random.Random, files: list[Path]) -> None:
    """Change an array of a cache, usually together with its checksum."""
    file = r.choice([file for file in files if file.suffix == ".npy"])
    array = changed_array(r, np.load(file))
    np.save(file, array)
    header = file.parent / "cache.json"
    content = json.loads(header.read_text())
    if file.stem in content["crc32"] and r.random() < 0.8:
        content["crc32"][file.stem] = zlib.crc32(array.tobytes())
    header.write_text(json.dumps(_with_valid_digest(content)))


def change_npz(r: random.Random, files: list[Path]) -> None:
    """Change an array in an .npz file, or a value in its header."""
    (file,) = files
    with np.load(file) as archive:
        arrays: dict[str, Any] = dict(archive)
    name = r.choice(list(arrays))
    if name == "header":
        header = file.with_name("header.json")
        header.write_bytes(arrays[name].tobytes())
        change_json(r, [header])
        arrays[name] = np.frombuffer(header.read_bytes(), np.uint8)
        header.unlink()
    else:
        arrays[name] = changed_array(r, arrays[name])
    np.savez(file, **arrays)


def change_mjcf(r: random.Random, files: list[Path]) -> None:
    """Change an attribute in an MJCF file, or add or remove an element."""
    (file,) = files
    text = file.read_text()
    if r.random() < 0.5:
        start, end = r.choice(list(re.finditer(r'(?<==")[^"]*(?=")', text))).span()
        new = r.choice(NUMBERS)
    else:
        start, end = r.choice(list(re.finditer(r"<[^<>/]+/>", text))).span()
        new = r.choice(["", 2 * text[start:end], text[start:end] + r.choice(ELEMENTS)])
    file.write_text(text[:start] + new + text[end:])
