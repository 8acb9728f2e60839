"""Test that malformed files are refused in one line and not modified."""

import hashlib
import json
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import safetensors.numpy
from flax import nnx

from envs.datasets import rlds
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io.hugging_face import load_peft
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.base.digest import DIGEST, with_digest
from lorasp_jax.data import cache
from lorasp_jax.data.opening import open_source
from lorasp_jax.peft import LoRASP
from lorasp_jax.policies import statistics_files, tokenizer
from lorasp_jax.report.html import write_report
from tests.data.lerobots import GOLDEN, digest, golden
from tests.envs.datasets.test_episodes import make
from tests.malformed import Net, check_refusal
from tests.runs import finish

NAN, HUGE = float("nan"), 1e999
Damage = Callable[[Path], None]
DATA, INDEX = "data/**/*.parquet", "meta/episodes/**/*.parquet"
TENSORS = ("adapter.safetensors", "adapter_model.safetensors")


def first(folder: Path, pattern: str) -> Path:
    return sorted(folder.rglob(pattern))[0]


def cut(pattern: str) -> Damage:
    return lambda folder: first(folder, pattern).write_bytes(
        first(folder, pattern).read_bytes()[:30]
    )


def missing(pattern: str) -> Damage:
    return lambda folder: first(folder, pattern).unlink()


def field(pattern: str, path: str, value: Any) -> Damage:
    """Set a field such as a/b/c of a JSON file, or of the first line of a JSONL file; keep digests.

    In names, ~ stands for a slash.
    """

    def damage(folder: Path) -> None:
        file = first(folder, pattern)
        lines = file.read_text().splitlines() if file.suffix == ".jsonl" else [file.read_text()]
        content = owner = json.loads(lines[0])
        *parents, key = (name.replace("~", "/") for name in path.split("/"))
        for name in parents:
            owner = owner[name]
        owner[key] = value
        lines[0] = json.dumps(with_digest(content) if content.pop(DIGEST, None) else content)
        file.write_text("\n".join(lines))

    return damage


def column(pattern: str, name: str, value: Any) -> Damage:
    """Set a column of a parquet file to one value."""

    def damage(folder: Path) -> None:
        table = pq.read_table(file := first(folder, pattern))
        place, values = table.column_names.index(name), pa.array([value] * table.num_rows)
        pq.write_table(table.set_column(place, name, values), file)

    return damage


def array(name: str, value: Any) -> Damage:
    """Set an array of the .npz file."""

    def damage(folder: Path) -> None:
        with np.load(file := first(folder, "*.npz")) as archive:
            arrays: dict[str, Any] = dict(archive)
        np.savez(file, **arrays | {name: np.asarray(value)})

    return damage


def tensors(change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> Damage:
    """Change the tensors of an adapter, and its checksum."""

    def damage(folder: Path) -> None:
        file = next(folder / name for name in TENSORS if (folder / name).exists())
        file.write_bytes(safetensors.numpy.save(change(safetensors.numpy.load_file(file))))
        if file.name == TENSORS[0]:
            checksum = hashlib.sha256(file.read_bytes()).hexdigest()
            field("adapter.json", "sha256", checksum)(folder)

    return damage


def on_first(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    return tensors(lambda a: a | {min(a): np.ascontiguousarray(change(a[min(a)]))})


BAD_TENSORS = [
    tensors(lambda arrays: {}),
    tensors(lambda arrays: arrays | {"other": np.zeros(3, np.float32)}),
    on_first(lambda x: x[..., :-1]),
    on_first(lambda x: x.astype(np.int32)),
    on_first(lambda x: x * np.float32(np.nan)),
]
INFO = {"fps": [0, NAN, "ten", 30], "codebase_version": ["v9"], "features": [None, {}]}
INFO |= {"features/action/shape": [[6], "x"], "total_frames": [125], "data_path": ["{nope}", None]}
LEROBOT = [
    *[missing("info.json"), cut("info.json"), cut(DATA), cut("*.mp4")],
    *[field("info.json", name, bad) for name, values in INFO.items() for bad in values],
    *[column(DATA, "action", bad) for bad in ("x", [0.0] * 6, [NAN] * 7)],
    *[column(DATA, name, None) for name in ("timestamp", "frame_index", "task_index")],
    column(DATA, "timestamp", 0.35),
]
METADATA = {"format": ["x"], "cameras": [3, ["front"]], "control_dt": ["x", 0, NAN], "steps": ["x"]}
METADATA |= {"instructions": [3, []], "actions": ["x"]}
HEADER = {
    "format": ["x", None],
    "cameras": [{"front": [8, 8]}, {"side": "xy"}, {"x/../../side": [8, 8]}],
    "control_dt": [0.0, HUGE],
    "steps": [0, HUGE],
    "crc32": [{}],
    "crc32/state": [1],
    "tasks": [[], "x"],
}
METHODS = {"": [[], {}, {"nowhere": {}}], "/lin~0/method": ["lorra", None], "/lin~0/unknown": [1]}
METHODS |= {"/lin~0/rank": ["8", 0, NAN, 4, 10**9], "/lin~0/router": ["x"]}
PEFT = {"peft_type": [None, "LOHA"], "lora_alpha": ["x", 0, HUGE], "use_dora": [True, "x"]}
PEFT |= {"alpha_pattern": [{"(": 3}], "bias": ["all", 3], "init_lora_weights": ["pissa"]}
DAMAGE: dict[str, list[Damage]] = {
    "lerobot v21": [
        *LEROBOT,
        *[missing("episodes.jsonl"), cut("tasks.jsonl"), field("info.json", "chunks_size", 0)],
        *[field("episodes.jsonl", "length", bad) for bad in (0, NAN, "x")],
        *[field("episodes.jsonl", "episode_index", bad) for bad in (7, None)],
    ],
    "lerobot v3": [
        *[*LEROBOT, missing(INDEX), cut("tasks.parquet")],
        *[column(INDEX, name, bad) for name in ("length", "episode_index") for bad in (0, "x")],
        column(INDEX, "videos/observation.images.side/from_timestamp", -5.0),
    ],
    "rlds": [
        *[missing("metadata.json"), missing("dataset_info.json"), cut("*array_record*")],
        *[field("metadata.json", name, bad) for name, values in METADATA.items() for bad in values],
    ],
    "cache": [
        *[missing("state.npy"), cut(cache.HEADER), cut("image_side.npy")],
        *[field(cache.HEADER, name, bad) for name, values in HEADER.items() for bad in values],
    ],
    "npz": [
        *[missing("*.npz"), cut("*.npz"), array("state", np.full((3, 4, 7), NAN, np.float32))],
        *[array("action", np.zeros((3, 4, 6), np.float32)), array("length", [5, 0, 7])],
        array("image/side", np.zeros((3, 8, 8, 8, 3), np.uint8)),
    ],
    "statistics": [cut("stats.json"), field("stats.json", "action/mean", [HUGE])],
    "tokenizer": [missing("*.json"), cut("*.json"), field("*.json", "model/vocab", None)],
    "run": [cut("results.json"), cut("config.json")],
    "adapter": [
        *[missing("adapter.json"), cut("adapter.json"), cut(TENSORS[0]), *BAD_TENSORS],
        *[field("adapter.json", "version", 1), field("adapter.json", "sha256", None)],
        *[field("adapter.json", f"methods{n}", bad) for n, bads in METHODS.items() for bad in bads],
    ],
    "peft": [
        *[
            missing("adapter_config.json"),
            cut("adapter_config.json"),
            cut(TENSORS[1]),
            *BAD_TENSORS,
        ],
        *[field("adapter_config.json", name, bad) for name, bads in PEFT.items() for bad in bads],
    ],
}


def read(folder: Path) -> None:
    source = open_source(folder)
    for number in range(len(source)):
        source.episode(number).validate()


READERS: dict[str, Callable[[Path], Any]] = {
    "npz": lambda folder: read(folder / "episodes.npz"),
    "adapter": lambda folder: load_adapters(folder, Net()),
    "peft": lambda folder: load_peft(folder, Net()),
    "run": write_report,
    "statistics": statistics_files.read,
    "tokenizer": tokenizer.load_tokenizer,
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Write a valid folder of each kind."""
    at = tmp_path_factory.mktemp("good")
    rlds.write(make(), at / "rlds")
    cache.write([open_source(at / "rlds")], at / "cache", lambda done, total: None)
    make().save(at / "npz" / "episodes.npz")
    model = adaptation.adapt(Net(), [(".*", LoRASP(rank=8, hidden_width=4))], rngs=nnx.Rngs(0))
    save_adapters(at / "adapter", model)
    folders = {name: at / name for name in ("rlds", "cache", "npz", "adapter")}
    for name in ("run", "tokenizer"):
        folders[name] = at / name
        folders[name].mkdir()
    finish(at / "run")
    file = GOLDEN / "tokenizers" / "smolvlm_like_tokenizer.json"
    shutil.copy(file, at / "tokenizer" / "tokenizer.json")
    folders["statistics"] = golden("v3") / "meta"
    folders |= {f"lerobot {version}": golden(version) for version in ("v21", "v3")}
    return folders | {"peft": GOLDEN / "adapter_lora"}


@pytest.fixture(autouse=True)
def _offline(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: Any) -> None:
        raise AssertionError("network access")

    monkeypatch.setattr(socket.socket, "connect", refuse)


@pytest.mark.parametrize("kind", DAMAGE)
def test_malformed_input_is_refused(kind: str, good: dict[str, Path], tmp_path: Path) -> None:
    reader = READERS.get(kind, read)
    for number, damage in enumerate(DAMAGE[kind]):
        folder = Path(shutil.copytree(good[kind], tmp_path / str(number) / "input"))
        damage(folder)
        before = digest(folder)
        with pytest.raises(Exception) as caught:  # noqa: PT011 (check_refusal checks the type)
            reader(folder)
        caught.value.add_note(f"{kind} {number}")
        check_refusal(caught.value, str(folder))
        assert digest(folder) == before
