"""Test that malformed inputs raise a one-line error of this project and are not modified."""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flax import nnx

from envs.datasets import rlds
from envs.datasets.episodes import Episodes
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io.hugging_face import load_peft
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.base.digest import with_digest
from lorasp_jax.data import cache
from lorasp_jax.data.opening import open_source
from lorasp_jax.peft import LoRASP
from tests import malformed
from tests.data.lerobots import GOLDEN, digest, golden
from tests.malformed import ABSENT, HUGE, TENSORS, Cases, Damage, check_refusal
from tests.runs import random_episodes

NAN = float("nan")
DATA = "data/**/*.parquet"


class Net(nnx.Module):
    """Network with the sizes of the golden PEFT adapter."""

    def __init__(self) -> None:
        sizes = ((24, 40), (40, 24), (24, 16))
        self.lin = nnx.List([nnx.Linear(i, o, rngs=nnx.Rngs(0)) for i, o in sizes])


def _lerobot(version: str) -> Cases:
    yield from malformed.files("info.json", "data/**/*.parquet", "*.mp4")
    info: dict[str, list[Any]] = {
        "fps": [ABSENT, 0, -10, NAN, HUGE, "ten", None, [10], 30],
        "codebase_version": [ABSENT, "v9", None, [2]],
        "features": [ABSENT, None, [], {}, "x"],
        "features/action": [ABSENT, None, 3],
        "features/action/shape": [ABSENT, [6], [], "x", None, [HUGE]],
        "features/observation.images.side/dtype": [ABSENT, "image"],
        "total_episodes": [3, "x"],
        "total_frames": [125, None],
        "data_path": [ABSENT, "{nope}", None, "a\0b", "."],
        "video_path": [ABSENT, "{nope}", [3], "a\0b", "."],
    }
    yield from malformed.fields("info.json", info)
    numbers = [ABSENT, None, "x", ["x"] * 7, 7 * [[0.0]], [0.0] * 6]
    numbers += [malformed.drop_last, malformed.with_nan, malformed.with_infinity]
    single = [ABSENT, None, "x", [0.0]]
    rows: dict[str, list[Any]] = {"observation.state": numbers, "action": numbers}
    for name in ("timestamp", "frame_index", "episode_index", "task_index"):
        rows[name] = single
    yield from malformed.columns(DATA, rows)
    yield (
        "mixed fps",
        dict(malformed.columns(DATA, {"timestamp": [0.35]}))[f"{DATA} timestamp 0.35"],
    )
    if version == "v21":
        yield from malformed.files("episodes.jsonl", "tasks.jsonl")
        yield from malformed.fields("info.json", {"chunks_size": [ABSENT, 0, "x", None]})
        lines = {"length": [ABSENT, 0, -1, NAN, HUGE, "x"], "episode_index": [ABSENT, 0, 7, None]}
        yield from malformed.fields("episodes.jsonl", lines, line=2)
        yield from malformed.fields("tasks.jsonl", {"task_index": [ABSENT, "x", HUGE]}, line=0)
    else:
        index = "meta/episodes/**/*.parquet"
        yield from malformed.files(index, "tasks.parquet")
        video = "videos/observation.images.side/"
        lines = {
            "length": [ABSENT, 0, -1, None, "x"],
            "episode_index": [ABSENT, 0, 7, None],
            "data/file_index": [ABSENT, 5, None],
            video + "file_index": [ABSENT, 5, None],
            video + "from_timestamp": [ABSENT, NAN, HUGE, -5.0, 1e300, 1e6, None],
        }
        yield from malformed.columns(index, lines, row=2)


def _rlds() -> Cases:
    yield from malformed.files("metadata.json", "features.json", "dataset_info.json")
    yield from malformed.files("*array_record*")
    metadata: dict[str, list[Any]] = {
        "format": [ABSENT, "x", None],
        "cameras": [ABSENT, 3, ["front"], [[]]],
        "control_dt": [ABSENT, "x", None, 0, -1, NAN, HUGE],
        "steps": [ABSENT, "x", HUGE],
        "instructions": [ABSENT, 3, []],
        "task": [ABSENT],
        "actions": [ABSENT, "x", 3],
    }
    yield from malformed.fields("metadata.json", metadata)
    step = "featuresDict/features/steps/sequence/feature/featuresDict/features/"
    shape = step + "action/tensor/shape/dimensions"
    yield from malformed.fields(
        "features.json", {shape: [["3"], ["x"], []], step + "action": [ABSENT]}
    )


def _cache() -> Cases:
    names = [f"{name}.npy" for name in (*cache.ROWS, "image_side")]
    yield from malformed.files(cache.HEADER, cache.STATISTICS, *names)
    yield from malformed.flips("state.npy", (0, 8, 40, -3))
    metadata: dict[str, list[Any]] = {
        "format": [ABSENT, "x", [1]],
        "cameras": [ABSENT, [], {"side": 3}, {"front": [8, 8]}, {"side": [8]}, {"side": "xy"}],
        "control_dt": [ABSENT, "x", 0.0, -1.0, NAN, HUGE],
        "steps": [ABSENT, 0, 1, HUGE],
        "numbers": [0, 5, "x"],
        "crc32": [{}, []],
        "crc32/state": [1, "x"],
        "tasks": [[], "x", [3]],
        "instructions": [[], [None]],
    }
    yield from malformed.fields(cache.HEADER, metadata)


def _npz() -> Cases:
    yield from malformed.files("*.npz")
    yield from malformed.flips("*.npz", (0, 30, 3000, -30))
    changes: dict[str, Any] = {
        "state": [None, "x", np.zeros(3), np.full((3, 9, 7), NAN, np.float32)],
        "action": [None, np.zeros((3, 9, 7)), np.zeros((3, 9, 6), np.float32)],
        "length": [None, np.array([5, 0, 7]), np.array([5, 10, 7]), np.array([5, 9, 7.5])],
        "image/side": [np.zeros((3, 9, 8, 8, 3)), np.zeros((3, 8, 8, 8, 3), np.uint8)],
    }
    for name, values in changes.items():
        for number, value in enumerate(values):

            def spoil(folder: Path, name: str = name, value: Any = value) -> None:
                path = malformed.first(folder, "*.npz")
                with np.load(path) as file:
                    arrays: dict[str, Any] = dict(file)
                del arrays[name]
                if value is not None:
                    arrays[name] = np.asarray(value)
                np.savez(path, **arrays)

            yield f"*.npz {name} {number}", spoil


def _rehashed(damage: Damage) -> Damage:
    """Update the checksums after the damage, so that they do not hide the error."""

    def spoil(folder: Path) -> None:
        damage(folder)
        description = json.loads((folder / "adapter.json").read_text())
        data = (folder / "adapter.safetensors").read_bytes()
        del description["digest"]
        description["sha256"] = hashlib.sha256(data).hexdigest()
        (folder / "adapter.json").write_text(json.dumps(with_digest(description)))

    return spoil


def _adapter() -> Cases:
    yield from malformed.files("adapter.json", "adapter.safetensors")
    yield from malformed.flips("adapter.safetensors", (0, 9, 60, -1))
    cases = [*malformed.tensors("adapter.safetensors", TENSORS)]
    cases += [*malformed.files("adapter.safetensors")][1:]
    cases += malformed.flips("adapter.safetensors", (0, 9, 60))
    yield from ((f"{name}, rehashed", _rehashed(damage)) for name, damage in cases)
    values: dict[str, list[Any]] = {
        "format": [ABSENT, 3],
        "version": [ABSENT, 1, "2"],
        "base": [ABSENT, 3],
        "weights": [ABSENT, []],
        "sha256": [ABSENT, None],
        "methods": [ABSENT, [], None, {}, {"lin/0": None}, {"lin/0": {}}, {"nowhere": {}}],
        "methods/lin~0": [ABSENT],
        "methods/lin~0/method": [ABSENT, "lorra", 3, None, []],
        "methods/lin~0/rank": ["8", None, 0, -1, 1.5, NAN, [8], 4, 10**9],
        "methods/lin~0/energy_target": ["x", NAN, 2.0, None],
        "methods/lin~0/router": ["x", None, []],
        "methods/lin~0/schedule": ["x", 1, {"start": 0.5}],
        "methods/lin~0/unknown": [1],
    }
    yield from _escaped(values)


def _escaped(values: dict[str, list[Any]]) -> Cases:
    """Like `malformed.fields` for adapter.json, where ~ stands for a slash within a name."""
    for field, bad in values.items():
        for value in bad:

            def spoil(folder: Path, field: str = field, value: Any = value) -> None:
                path = folder / "adapter.json"
                content = json.loads(path.read_text())
                del content["digest"]
                *parents, key = (name.replace("~", "/") for name in field.split("/"))
                owner = content
                for name in parents:
                    owner = owner[name]
                owner[key] = value
                if value is ABSENT:
                    del owner[key]
                path.write_text(json.dumps(with_digest(content)))

            yield f"{field} {'absent' if value is ABSENT else value!r}", spoil


def _peft() -> Cases:
    config, weights = "adapter_config.json", "adapter_model.safetensors"
    yield from malformed.files(config, weights)
    yield from malformed.flips(weights, (0, 9, 60))
    yield from malformed.tensors(weights, TENSORS)
    values: dict[str, list[Any]] = {
        "peft_type": [ABSENT, None, 3, [], "LOHA"],
        "lora_alpha": [ABSENT, "x", None, 0, NAN, HUGE, [8]],
        "alpha_pattern": [["x"], "x", {"(": 3}, {"lin.0": "x"}],
        "bias": ["all", 3],
        "init_lora_weights": ["pissa", 3, []],
        "use_dora": [True],
    }
    yield from malformed.fields(config, values)


KINDS: dict[str, tuple[Callable[[], Cases], Callable[[Path], Any]]]


def _episodes() -> Episodes:
    episodes = random_episodes("press", 0)
    images = {n: np.ascontiguousarray(x[:, :, :8, :8]) for n, x in episodes.image.items()}
    return dataclasses.replace(episodes, image=images)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Write a valid folder of each kind."""
    at = tmp_path_factory.mktemp("good")
    rlds.write(_episodes(), at / "rlds")
    cache.write([open_source(at / "rlds")], at / "cache", lambda done, total: None)
    (at / "npz").mkdir()
    _episodes().save(at / "npz" / "episodes.npz")
    model = adaptation.adapt(Net(), [(".*", LoRASP(rank=8, hidden_width=4))], rngs=nnx.Rngs(0))
    save_adapters(at / "adapter", model)
    folders = {name: at / name for name in ("rlds", "cache", "adapter", "npz")}
    folders |= {f"lerobot {version}": golden(version) for version in ("v21", "v3")}
    return folders | {"peft": GOLDEN / "adapter_lora"}


def _read(folder: Path) -> None:
    source = open_source(folder)
    for number in range(len(source)):
        source.episode(number).validate()


KINDS = {
    "lerobot v21": (lambda: _lerobot("v21"), _read),
    "lerobot v3": (lambda: _lerobot("v3"), _read),
    "rlds": (_rlds, _read),
    "cache": (_cache, _read),
    "npz": (_npz, lambda folder: _read(folder / "episodes.npz")),
    "adapter": (_adapter, lambda folder: load_adapters(folder, Net())),
    "peft": (_peft, lambda folder: load_peft(folder, Net())),
}
CASES = [(kind, name, damage) for kind, (make, _) in KINDS.items() for name, damage in make()]
FAST_EVERY = 12
"""Every n-th case runs with the fast tests, the others with the slow ones."""


def _marked(cases: list[Any], every: int) -> list[Any]:
    return [
        pytest.param(*case, id=f"{case[0]} {case[1]}", marks=[pytest.mark.slow] * (n % every > 0))
        for n, case in enumerate(cases)
    ]


@pytest.mark.parametrize(("kind", "name", "damage"), _marked(CASES, FAST_EVERY))
def test_malformed_input_raises_a_one_line_error(
    kind: str, name: str, damage: Damage, good: dict[str, Path], tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(good[kind], tmp_path / "input"))
    damage(folder)
    before = digest(folder)
    with pytest.raises(Exception) as caught:  # noqa: PT011 (check_refusal checks the type)
        KINDS[kind][1](folder)
    check_refusal(caught.value, str(folder))
    assert digest(folder) == before
