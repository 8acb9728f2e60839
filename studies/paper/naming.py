"""Names of the cells of the paper's study.

pi0/multi/lora_sp/s0          all tasks, one policy; backbone, training, method, seed
pi0/single/lora_sp/press/s0   one task
pi0/panda/full/s0             all tasks on the robot of pretraining
pi0/pilot/lora_sp/0.001       a learning rate, to choose among
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lorasp_jax.extras.study import statistics

Seeds = tuple[tuple[str, ...], ...]
"""Names of a method's cells: for each seed one, or one for each task."""
TOWERS = ("vision", "language", "action")


def seeds(names: Iterable[str], prefix: str) -> Seeds:
    """Return the cells of a method, such as "pi0/multi/lora_sp", by seed; empty if it has none."""
    found: dict[str, list[str]] = {}
    for name in names:
        if name.startswith(f"{prefix}/"):
            found.setdefault(name.rsplit("/", 1)[1], []).append(name)
    return tuple(tuple(found[seed]) for seed in sorted(found))


def methods(names: Iterable[str], backbone: str, training: str) -> list[str]:
    """Return the methods of a kind of training, in the order of the names."""
    parts = [name.split("/") for name in names]
    return list(dict.fromkeys(p[2] for p in parts if p[:2] == [backbone, training]))


def lora_ranks(names: Iterable[str], backbone: str) -> list[int]:
    """Return the ranks of LoRA for all tasks in ascending order."""
    stems = methods(names, backbone, "multi")
    return sorted(int(m.removeprefix("lora_r")) for m in stems if m.startswith("lora_r"))


def flat(*methods: Seeds) -> tuple[str, ...]:
    """Return the names of all cells of some methods."""
    return tuple(name for method in methods for seed in method for name in seed)


def outcomes(results: Mapping[str, Any], method: Seeds) -> np.ndarray:
    """Return the episodes of a method, bool `[S, T, N]`; see `statistics.outcomes`."""
    return statistics.outcomes([[results[name] for name in seed] for seed in method])


def per_seed(results: Mapping[str, Any], method: Seeds, *path: str) -> list[float]:
    """Return one number of each seed's cells, such as "active_rank", "mean"; the mean over tasks.

    Raises:
        KeyError: a cell lacks it.
    """

    def value(name: str) -> float:
        node: Any = results[name]
        for key in path:
            node = node[key]
        return float(node)

    return [float(np.mean([value(name) for name in seed])) for seed in method]


def by_depth(linears: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """Join the layers of a tower that SmolVLA stacks apart, in order of depth.

    In its action tower, self-attention and cross-attention alternate.
    """
    found: dict[str, list[Any]] = {}
    for name, layers in linears.items():
        kind = name.removeprefix("self_layer/")
        if name.startswith("cross_layer/"):
            continue
        pairs = zip(layers, linears.get(f"cross_layer/{kind}", ()), strict=True)
        found[kind] = [each for pair in pairs for each in pair] if kind != name else [*layers]
    return found


def short_kind(kind: str) -> str:
    """Return the name of a kind of linear layer on the page, such as "q" for "q_proj"."""
    return kind.removesuffix("_proj").replace("action_time_mlp", "time")


def label(method: str, rank: int) -> str:
    """Return a method's name on the page; `rank` is the bank's size R."""
    stem = method.removesuffix("_pruned")
    if stem.startswith("lora_r"):
        text = f"LoRA, r = {stem.removeprefix('lora_r')}"
    elif stem.startswith("lora_sp_eta_"):
        text = f"LoRA-SP, η = {stem.removeprefix('lora_sp_eta_')}"
    else:
        text = _LABELS[stem].format(rank=rank)
    return text + (", pruned" if method != stem else "")


_LABELS = {
    "lora_moe_top1": "LoRA-MoE, top-1",
    "lora_moe_weighted": "LoRA-MoE, weighted sum",
    "ada_lora": "AdaLoRA",
    "full": "full fine-tuning",
    "lora_sp": "LoRA-SP",
    "dora": "DoRA, r = {rank}",
    "lora_same_rank": "LoRA, r = LoRA-SP's rank",
    "lora_cut": "LoRA, r = {rank}, cut to LoRA-SP's rank",
    "lora_sp_no_spectral": "LoRA-SP without spectral loss",
}
