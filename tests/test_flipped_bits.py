"""Test that a flipped bit in any file of a run, policy or cache is harmless or raises an error."""

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from flax import nnx

from envs.datasets import rlds
from envs.datasets.episodes import Episodes
from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io.native import load_adapters, read_description, save_adapters
from lorasp_jax.data import cache
from lorasp_jax.data.opening import open_source
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRASP
from lorasp_jax.policies import statistics_files
from lorasp_jax.policies.statistics import Statistics
from lorasp_jax.training.base import TRAINING
from lorasp_jax.training.run_folder import read_json, write_json
from tests.models.random_models import random_backbone
from tests.runs import leaves, random_episodes

HEADERS = 200
"""Size of the header of a large file [bytes]."""


@functools.cache
def net() -> nnx.Module:
    return nnx.Dict(lin=nnx.Linear(3, 4, rngs=nnx.Rngs(0)))


def adapter(folder: Path) -> None:
    rules = [(".*", LoRASP(rank=4, hidden_width=2, energy_target=0.9))]
    model = adaptation.adapt(net(), rules, rngs=nnx.Rngs(1))
    metadata = {"instructions": ["press the button"], "statistics": {"state_mean": [0.25]}}
    save_adapters(folder, model, base="abc", metadata=metadata)


def read_adapter(folder: Path) -> Any:
    description = read_description(folder)
    model = load_adapters(folder, net(), base="abc")
    return (
        description,
        {path: str(m) for path, m in adaptation.methods(model).items()},
        leaves(model),
    )


def run(folder: Path) -> None:
    result = {"before": {"success": 0.5, "episodes": 8, "ci95": [0.2, 0.8]}}
    for name in ("config", "seconds", "dataset", "before", "results", "stopped"):
        write_json(folder / f"{name}.json", {"tasks": {"press": result}, "total": 7.5})


def read_run(folder: Path) -> Any:
    return {p.name: read_json(p) for p in folder.glob("*.json")}


def base(folder: Path) -> None:
    models.save(folder, random_backbone(Pi0Config.dummy()))
    state = np.random.default_rng(0).normal(size=(9, 7))
    statistics = Statistics.measure(state, state, np.ones(9, bool), slots=range(7), dim=8)
    (folder / "statistics.json").write_text(statistics.to_json() + "\n")
    write_json(folder / TRAINING, {"control_dt": 0.1, "tasks": ["press"]})


def read_base(folder: Path) -> Any:
    statistics = statistics_files.read(folder)
    model = models.load_config(folder), models.load(folder)
    return (
        str(model[0]),
        leaves(nnx.state(model[1])),
        leaves(statistics),
        read_json(folder / TRAINING),
    )


def dataset(folder: Path) -> None:
    rlds.write(random_episodes("press", 0), folder.parent / "rlds")
    folder.rmdir()
    cache.write([open_source(folder.parent / "rlds")], folder, lambda done, total: None)


def read_dataset(folder: Path) -> Any:
    source = cache.Cache(folder)
    source.verify_images()
    return (
        source.metadata,
        [leaves(source.episode(n)) for n in range(len(source))],
    )


def demonstrations(folder: Path) -> None:
    episodes = random_episodes("press", 0)
    small = {name: image[:, :, :4, :4] for name, image in episodes.image.items()}
    Episodes(**{**vars(episodes), "image": small}).save(folder / "press.npz")


def read_demonstrations(folder: Path) -> Any:
    loaded = Episodes.load(folder / "press.npz")
    return leaves(loaded), {
        k: v for k, v in vars(loaded).items() if isinstance(v, (str, int, float))
    }


KINDS: dict[str, tuple[Callable[[Path], None], Callable[[Path], Any], int]] = {
    "adapter": (adapter, read_adapter, 5),
    "run": (run, read_run, 3),
    "base": (base, read_base, 61),
    "cache": (dataset, read_dataset, 17),
    "demonstrations": (demonstrations, read_demonstrations, 5),
}
"""Writer, reader, and the distance between flipped bytes."""


def same(one: Any, other: Any) -> bool:
    first, second = (jax.tree.flatten(value) for value in (one, other))
    return first[1] == second[1] and all(map(np.array_equal, first[0], second[0]))


def positions(content: bytes, step: int) -> list[int]:
    """Return the bytes to flip; for a large file: its header, its end and a few in between."""
    if len(content) < 20_000:
        return list(range(0, len(content), step))
    middle = range(HEADERS, len(content), max(1, len(content) // 20))
    return [*range(0, HEADERS, step), *middle, len(content) - 1]


@pytest.mark.parametrize("kind", KINDS)
def test_flipped_bit_is_harmless_or_raises(kind, tmp_path):
    write, read, step = KINDS[kind]
    folder = tmp_path / kind
    folder.mkdir()
    write(folder)
    expected, messages = read(folder), []
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        for position in positions(content, step):
            flipped = bytearray(content)
            flipped[position] ^= 1 << (position // step % 8)
            path.write_bytes(flipped)
            try:
                loaded = read(folder)
            except ValueError as error:
                messages.append(str(error))
            else:
                assert same(loaded, expected), (
                    path.name,
                    position,
                    bytes(flipped[position - 20 :][:40]),
                )
        path.write_bytes(content)
    assert len(messages) > 20
    assert not [message for message in messages if "\n" in message]
    assert same(read(folder), expected)


def test_missing_digest_raises(tmp_path):
    adapter(tmp_path / "adapter")
    path = tmp_path / "adapter" / "adapter.json"
    description = json.loads(path.read_text())
    del description["digest"]
    path.write_text(json.dumps(description))
    with pytest.raises(ValueError, match="the digest is missing"):
        read_description(path.parent)
