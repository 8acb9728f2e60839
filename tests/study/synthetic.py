"""Results of the paper's study that no run made, for tests of claims, tables, figures and page."""

import functools
import zlib
from pathlib import Path

import numpy as np

from lorasp_jax.study import Study, naming
from lorasp_jax.training import experiment_file
from tests import ROOT

PAPER = ROOT / "configs" / "studies" / "paper.py"
RATES = {
    "lora_sp": 0.9,
    "full": 0.92,
    "lora_moe_top1": 0.6,
    "lora_moe_weighted": 0.7,
    "ada_lora": 0.66,
    "dora": 0.9,
    "lora_same_rank": 0.84,
    "lora_cut": 0.8,
    "lora_sp_no_spectral": 0.9,
    "lora_sp_eta_0.5": 0.4,
    "lora_sp_eta_0.7": 0.7,
    "lora_sp_eta_0.8": 0.8,
    "lora_sp_eta_0.99": 0.905,
}
LAYERS = {
    "vision": {name: 4 for name in ("q_proj", "k_proj", "v_proj", "o_proj", "fc1", "fc2")},
    "language": {name: 6 for name in ("q_proj", "k_proj", "v_proj", "o_proj", "gate_proj")},
    "action": {name: 6 for name in ("q_proj", "k_proj", "v_proj", "gate_proj")} | {"out": 1},
}


@functools.cache
def study(scale: str = "accelerator") -> Study:
    return experiment_file.call(Path(PAPER), "get_study", scale)


@functools.cache
def results(scale: str = "accelerator", episodes: int = 32) -> dict:
    """Return plausible results of all cells."""
    tasks = (
        ("press", "pick_place") if scale == "smoke" else ("open_pot", "pour", "press", "pick_place")
    )
    return {cell.name: result(cell.name, tasks, episodes) for cell in study(scale).cells}


def result(name: str, tasks: tuple[str, ...], episodes: int) -> dict:
    _, training, method, *rest = name.split("/")
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    stem = method.removesuffix("_pruned")
    rank = int(stem.removeprefix("lora_r")) if stem.startswith("lora_r") else 24
    rate = RATES.get(stem, min(0.8, 0.3 + 0.1 * np.log2(rank)))
    rate += {"single": 0.04, "pilot": -0.02}.get(training, 0)
    tasks = (rest[0],) if training == "single" else tasks
    outcomes = {}
    for index, task in enumerate(tasks):
        success = rng.random(episodes) < rate + 0.02 * rng.standard_normal() - 0.03 * index
        outcomes[task] = "".join("01"[int(x)] for x in success)
    scale = 0.5 if "eta_0.5" in stem else 1.4 if "no_spectral" in stem else 1.0
    ranks = scale * (np.array([30, 11, 18]) + rng.normal(0, 0.3, 3))
    towers = dict(zip(naming.TOWERS, ranks, strict=True))
    active = {} if method == "full" else {**towers, "mean": float(np.mean([*towers.values()]))}
    evaluated = name.endswith("multi/lora_sp/s0")
    return {
        "outcomes": outcomes,
        **({"before": {task: "0001" for task in tasks}} if evaluated else {}),
        "active_rank": {key: float(value) for key, value in active.items()},
        "trainable_parameters": 90_000 * rank,
        "total_parameters": 9_877_128 + 90_000 * rank,
        "seconds": {"total": 30.0 if training == "single" else 110.0},
        "speed": {"samples_per_second": 14_000.0, "flops_per_sample": 2.1e9, "peak_bytes": 6e9},
        "measures": measures(training, method, rng),
    }


def measures(training: str, method: str, rng: np.random.Generator) -> dict:
    found = {}
    if method == "full":
        center = 0.4 if training == "panda" else 0.6
        share = lambda count: [round(float(x), 3) for x in rng.normal(center, 0.05, count)]  # noqa: E731
        found["spectral_rank"] = {
            tower: {name: share(count) for name, count in linears.items()}
            for tower, linears in LAYERS.items()
        }
        found["spectral_rank"]["language"]["q_proj"][-1] = None
    if method.startswith("lora_sp"):
        found["rank_boxes"] = {
            tower: {
                name: np.sort(rng.integers(4, 60 if tower == "vision" else 30, (count, 5))).tolist()
                for name, count in linears.items()
            }
            for tower, linears in LAYERS.items()
        }
    if method.endswith("_pruned"):
        found["smaller"] = {"bytes": [4e7, 2.5e7], "milliseconds": [5.0, 4.2]}
    return found
