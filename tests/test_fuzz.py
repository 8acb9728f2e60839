"""Test randomly changed data: reading works or raises a one-line error, and leaves no files."""

import contextlib
import io
import random
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from flax import nnx
from rich.console import Console

from envs import mjcf
from envs.datasets import rlds
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io.hugging_face import load_peft
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.data import cache, inspection
from lorasp_jax.data.opening import open_source
from lorasp_jax.peft import LoRASP
from lorasp_jax.policies import statistics_files, tokenizer
from lorasp_jax.report.html import write_report
from tests import fuzzing
from tests.data.lerobots import GOLDEN, golden
from tests.envs.datasets.test_episodes import make
from tests.envs.user_arm import write
from tests.malformed import Net, check_refusal
from tests.runs import finish

SEEDS, SLOW_SEEDS = 12, 200
TOKENIZERS = {
    "tokenizer.json": "smolvlm_like_tokenizer.json",
    "tokenizer.model": "paligemma_like.model",
}
COST = {"mjcf": 4, "adapter": 2}  # relative run time of a kind


def read(folder: Path) -> None:
    source = open_source(folder)
    for number in range(len(source)):
        source.episode(number).validate()
    inspection.report(source, Console(file=io.StringIO()))


def resume(folder: Path) -> None:
    """Read the dataset as a resumed collection does."""
    rlds.ShardWriter(folder, {}).complete()


def show(folder: Path) -> None:
    """Write the report of a finished run."""
    write_report(folder)


def tokenize(folder: Path) -> None:
    """Tokenize a prompt as a policy does."""
    tokenizer.load_tokenizer(folder).encode(["push the button"], 16)


FILES: list[fuzzing.Change] = [fuzzing.change_bytes, fuzzing.replace_file]
KINDS: dict[str, tuple[Callable[[Path], Any], list[fuzzing.Change]]] = {
    "rlds": (read, [*FILES, *[fuzzing.change_json] * 4]),
    "rlds, resumed": (resume, [fuzzing.change_bytes, *[fuzzing.change_json] * 4]),
    "cache": (read, [*FILES, fuzzing.change_json, *[fuzzing.change_cache] * 2]),
    "npz": (lambda folder: read(folder / "episodes.npz"), [*FILES, *[fuzzing.change_npz] * 3]),
    "lerobot v21": (read, [*FILES, *[fuzzing.change_json] * 2, *[fuzzing.change_parquet] * 2]),
    "lerobot v3": (read, [*FILES, *[fuzzing.change_json] * 2, *[fuzzing.change_parquet] * 2]),
    "statistics": (statistics_files.read, [*FILES, fuzzing.change_json]),
    "tokenizer.json": (tokenize, [*FILES, *[fuzzing.change_json] * 2]),
    "tokenizer.model": (tokenize, [fuzzing.replace_file, *[fuzzing.change_bytes] * 4]),
    "run": (show, [*FILES, *[fuzzing.change_json] * 6]),
    "adapter": (lambda folder: load_adapters(folder, Net()), [*FILES, *[fuzzing.change_json] * 4]),
    "peft": (lambda folder: load_peft(folder, Net()), [*FILES, *[fuzzing.change_json] * 4]),
    "mjcf": (lambda folder: mjcf.load(folder / "arm.xml"), [*FILES, *[fuzzing.change_mjcf] * 4]),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Write a valid folder of each kind."""
    at = tmp_path_factory.mktemp("good")
    rlds.write(make(), at / "rlds")
    cache.write([open_source(at / "rlds")], at / "cache", lambda done, total: None)
    make().save(at / "npz" / "episodes.npz")
    for name, fill in (("mjcf", write), ("run", finish)):
        (at / name).mkdir()
        fill(at / name)
    folders = {name: at / name for name in ("rlds", "cache", "npz", "mjcf", "run")}
    for name, file in TOKENIZERS.items():
        (at / name).mkdir()
        folders[name] = shutil.copy(GOLDEN / "tokenizers" / file, at / name / name).parent
    model = adaptation.adapt(Net(), [(".*", LoRASP(rank=8, hidden_width=4))], rngs=nnx.Rngs(0))
    save_adapters(at / "adapter", model)
    folders |= {"adapter": at / "adapter", "peft": GOLDEN / "adapter_lora"}
    folders |= {"rlds, resumed": at / "rlds", "statistics": golden("v21") / "meta"}
    return folders | {f"lerobot {version}": golden(version) for version in ("v21", "v3")}


def check(kind: str, seeds: range, good: dict[str, Path], tmp_path: Path) -> None:
    reader, changes = KINDS[kind]
    for seed in seeds:
        folder = Path(shutil.copytree(good[kind], tmp_path / f"{seed}" / "input"))
        r = random.Random(f"{kind} {seed}")
        r.choice(changes)(r, sorted(path for path in folder.rglob("*") if path.is_file()))
        error = None
        with contextlib.suppress(IsADirectoryError):  # a folder is where a file should be written
            try:
                reader(folder)
            except Exception as raised:
                error = raised
        if error is not None:
            error.add_note(f"{kind} {seed}")
            check_refusal(error, str(folder))
        assert [path.name for path in folder.parent.iterdir()] == ["input"]
        shutil.rmtree(folder.parent)


@pytest.fixture(autouse=True)
def _offline(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: Any) -> None:
        raise AssertionError("network access")

    monkeypatch.setattr(socket.socket, "connect", refuse)


@pytest.mark.timeout(120)
@pytest.mark.filterwarnings("ignore:robot .* misses parts of the table", "ignore:MuJoCo:")
@pytest.mark.parametrize("kind", KINDS)
def test_changed_input_is_read_or_rejected(
    kind: str, good: dict[str, Path], tmp_path: Path
) -> None:
    check(kind, range(SEEDS // COST.get(kind, 1)), good, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.filterwarnings("ignore:robot .* misses parts of the table", "ignore:MuJoCo:")
@pytest.mark.parametrize("kind", KINDS)
def test_changed_input_with_many_seeds(kind: str, good: dict[str, Path], tmp_path: Path) -> None:
    check(kind, range(SEEDS, SLOW_SEEDS // COST.get(kind, 1)), good, tmp_path)
