"""Results of the paper's study that no run made, for tests of claims, tables, figures and page.

They have the shape and size of real ones.
"""

import dataclasses
import functools
import itertools
import zlib
from pathlib import Path

import numpy as np

from lorasp_jax.extras.study import Derived, Study
from lorasp_jax.extras.study.status import describe_config
from lorasp_jax.training import experiment_file
from studies.paper import naming
from tests import ROOT

PAPER = ROOT / "studies" / "paper" / "study.py"
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
ATTENTION = ("q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj")
SINGLE = ("action_in_proj", "action_out_proj", "action_time_mlp_in", "action_time_mlp_out")
VISION = {name: 4 for name in ("q_proj", "k_proj", "v_proj", "out_proj", "fc1", "fc2")} | {
    "head": 1,
    "patch_embed": 1,
}
LANGUAGE = dict.fromkeys(ATTENTION, 6)
ACTION = dict.fromkeys((*SINGLE, "state_proj"), 1)
HALVES = [f"{half}_layer/{name}" for half in ("cross", "self") for name in ATTENTION]
LAYERS = {
    "pi0": {"vision": VISION, "language": LANGUAGE, "action": LANGUAGE | ACTION},
    "smolvla": {
        "vision": VISION,
        "language": LANGUAGE,
        "action": dict.fromkeys(HALVES, 3) | ACTION,
    },
}
"""Linear layers of the small backbones by tower, and the depth of their stacks."""
SPEED = {"samples_per_second": 14_000.0, "flops_per_sample": 2.1e9, "peak_bytes": 6e9}
RANKS = {"vision": 30, "language": 11, "action": 18}


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


@functools.cache
def cells(scale: str = "accelerator", episodes: int = 32) -> dict:
    """Return the same with the cells' configs, as in cell.json."""
    found, configs = {}, {}
    for cell in study(scale).cells:
        if isinstance(cell, Derived):
            config = configs[cell.source]
        else:
            config = cell.config(found) if callable(cell.config) else cell.config
            config = dataclasses.replace(config, name=Path(cell.name).name)
        configs[cell.name] = config
        made = results(scale, episodes)[cell.name]
        found[cell.name] = {"config": describe_config(cell, config), **made}
    return found


def result(name: str, tasks: tuple[str, ...], episodes: int) -> dict:
    backbone, training, method, *rest = name.split("/")
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
    measured = training in ("multi", "panda")
    evaluated = name.endswith(("multi/lora_sp/s0", "panda/full/s0"))
    return {
        "outcomes": outcomes,
        **({"before": {task: "0001" for task in tasks}} if evaluated else {}),
        **active_ranks(backbone, stem, rank, rng),
        "trainable_parameters": 90_000 * rank,
        "total_parameters": 9_877_128 + 90_000 * rank,
        "seconds": {"total": 30.0 if training == "single" else 110.0},
        "speed": SPEED if measured else {},
        "measures": measures(backbone, training, method, tasks, rng) if measured else {},
    }


def active_ranks(backbone: str, stem: str, rank: int, rng: np.random.Generator) -> dict:
    """Return what results record about active ranks."""
    if stem == "full":
        return {"active_rank": {}, "layer_active_rank": {}, "active_rank_histogram": {}}
    adaptive = stem.startswith("lora_sp")
    scale = 0.5 if "eta_0.5" in stem else 1.4 if "no_spectral" in stem else 1.0
    towers = {t: scale * r + rng.normal(0, 0.3) for t, r in RANKS.items()} if adaptive else {}
    towers = towers or dict.fromkeys(RANKS, float(rank))
    noise = (lambda count: rng.normal(0, 3, count)) if adaptive else np.zeros
    return {
        "active_rank": {**towers, "mean": float(np.mean([*towers.values()]))},
        "layer_active_rank": {
            tower: {name: (towers[tower] + noise(n)).tolist() for name, n in linears.items()}
            for tower, linears in LAYERS[backbone].items()
        },
        "active_rank_histogram": {
            tower: rng.integers(0, 10**9, 65).tolist() if adaptive else [0] * rank + [10**9]
            for tower in RANKS
        },
    }


def measures(
    backbone: str, training: str, method: str, tasks: tuple[str, ...], rng: np.random.Generator
) -> dict:
    found = {}
    if method == "full":
        center = 0.4 if training == "panda" else 0.6
        share = lambda count: [round(float(x), 3) for x in rng.normal(center, 0.05, count)]  # noqa: E731
        found["spectral_rank"] = {
            tower: {name: share(count) for name, count in linears.items()}
            for tower, linears in LAYERS[backbone].items()
        }
        found["spectral_rank"]["language"]["q_proj"][-1] = None
    if method.startswith("lora_sp"):
        found["rank_boxes"] = {
            tower: {name: boxes(RANKS[tower], n, rng) for name, n in linears.items()}
            for tower, linears in LAYERS[backbone].items()
        }
        if pairs := [*itertools.combinations(tasks, 2)]:
            found["direction_overlap"] = {"|".join(pair): overlap(rng) for pair in pairs}
    if method.endswith("_pruned") or method == "lora_cut":
        found["smaller"] = {"bytes": [4e7, 2.5e7], "milliseconds": [5.0, 4.2]}
    elif len(tasks) > 1:
        found["gradient_cosine"] = {
            "|".join(pair): cosines(0.5 if pair[0] == pair[1] else 0.1, rng)
            for pair in itertools.combinations_with_replacement(tasks, 2)
        }
    return found


def boxes(center: int, count: int, rng: np.random.Generator) -> list[list[int]]:
    """Return five-number summaries of the ranks in `count` layers."""
    middle = rng.normal(center, center / 5, (count, 1))
    ranks = middle + center * np.array([-0.7, -0.2, 0, 0.25, 1.0]) + rng.normal(0, 1, (count, 5))
    return np.sort(ranks.round().clip(1, 64)).astype(int).tolist()


def overlap(rng: np.random.Generator) -> dict[str, list[float]]:
    """Return index and index by chance of a pair of tasks, by tower."""
    centers = {"vision": (0.85, 0.5), "language": (0.45, 0.3), "action": (0.65, 0.35)}
    centers["all"] = (0.7, 0.4)
    return {
        tower: [round(center + rng.normal(0, 0.04), 2) for center in pair]
        for tower, pair in centers.items()
    }


def cosines(center: float, rng: np.random.Generator) -> dict[str, float]:
    """Return cosines of a pair of tasks, by tower."""
    return {t: round(center + rng.normal(0, 0.05), 3) for t in (*naming.TOWERS, "all")}
