"""Prune LoRA-SP directions that are rarely active on a calibration set."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.compress import calibration, compaction
from lorasp_jax.adapters.compress.calibration import Forward, Layer, Sums
from lorasp_jax.peft import Method
from lorasp_jax.peft.lora_sp.bank import BankMethod
from lorasp_jax.peft.lora_sp.gpu_kernel import supported_size
from lorasp_jax.peft.method import Params


def prune(
    model: adaptation.Model,
    batches: Sequence[Any],
    tolerance: float = 0.0,
    *,
    rank: float | None = None,
    for_kernel: bool = False,
    forward: Forward = calibration.call,
) -> tuple[adaptation.Model, compaction.Compaction]:
    """Prune LoRA-SP directions that are rarely active.

    Drops each direction that is active for at most a fraction `tolerance` of the valid calibration
    tokens. The bank's arrays shrink, but the router still scores dropped directions, since a
    token's active rank depends on the energy of all directions. So a dropped direction loses its
    own contribution, but the layer's other directions stay active for the same tokens. All layers
    of a stack keep as many directions as the one that needs most.

    Args:
        model: not modified; the result shares its frozen arrays and can be trained further.
        batches: calibration set.
        tolerance: in [0, 1). With 0, outputs on the calibration set do not change.
        rank: number of directions to keep in each layer, the most used ones, instead of a
            tolerance, or below 1 the fraction of each bank. A smaller bank keeps all of its
            directions, and a layer at least one.
        for_kernel: keep more directions, 16, 32, 64, ... in all, as the fused kernel on NVIDIA GPUs
            needs; without it, a smaller bank can be slower.
        forward: how to call the model on a batch; see `lorasp_jax.adapters.compress.calibration`.

    Raises:
        ValueError: tolerance is outside [0, 1), rank is neither a positive integer nor a fraction,
            both are given, or the model has no LoRA-SP layers.
    """
    is_rank = rank is None or 0 < rank < 1 or (rank >= 1 and rank == int(rank))
    if not 0 <= tolerance < 1 or not is_rank or (rank is not None and tolerance):
        raise ValueError(f"set a tolerance in [0, 1) or a rank > 0, got {tolerance} and {rank}")
    layers = compaction.lora_sp_layers(model)
    shares = usage(model, batches, forward)
    replacements: compaction.Replacements = {}
    ranks = {}
    for path, layer in layers.items():
        in_use = np.asarray((shares[path] > tolerance).sum(-1))
        fixed = rank if rank is None or rank >= 1 else rank * layer.method.rank
        kept = max(int(in_use.max() if fixed is None else fixed), 1)
        if for_kernel:
            kept = supported_size(kept)
        kept = min(kept, layer.method.rank)
        ranks[path] = in_use if rank is None else np.full(in_use.shape, kept)
        replacements[path] = _pruned(layer, shares[path], kept)
    return compaction.replace_adapters(model, batches, replacements, ranks, forward)


def usage(
    model: nnx.Module, batches: Sequence[Any], forward: Forward = calibration.call
) -> dict[str, np.ndarray]:
    """Return the fraction of valid tokens for which each direction is active, `[..., R]` by path.

    Raises:
        ValueError: the model has no LoRA-SP layers; see also `calibration.observe`.
    """
    reports = dict.fromkeys(compaction.lora_sp_layers(model), _usage)
    sums = calibration.observe(model, batches, reports, forward)
    each = ((path, x["usage"], x["tokens"]) for path, x in sums.items())
    return {path: np.asarray(x / jnp.maximum(n[..., None], 1)) for path, x, n in each}


def _usage(layer: Layer) -> Sums:
    assert layer.aux.usage is not None  # LoRA-SP always reports it
    return {"usage": layer.aux.usage}


def _pruned(layer: Any, usage: np.ndarray, rank: int) -> tuple[Method, Params]:
    """Method and parameters with the `rank` most used directions, in their original order."""
    method = layer.method
    in_bank = np.arange(usage.shape[-1]) < method.rank  # directions dropped earlier stay dropped
    by_usage = np.argsort(np.where(in_bank, -usage, 1), axis=-1, kind="stable")
    order = np.concatenate([np.sort(by_usage[..., :rank]), np.sort(by_usage[..., rank:])], axis=-1)
    params = layer.adapter.get_value()
    reorder = functools.partial(_reordered, method=method, rank=rank)
    reorder_stack = adaptation.over_stack(reorder, layer.kernel_matrices())
    params = reorder_stack(params, jnp.asarray(order))
    smaller = dataclasses.replace(method, rank=rank, alpha=method.scale * rank)
    return smaller, params


def _reordered(params: Params, order: jax.Array, *, method: BankMethod, rank: int) -> Params:
    """Reorder one layer's directions; keep the first `rank` in the bank, and all scores."""
    bank, router = dict(params["bank"]), dict(params["router"])
    bank["u"], bank["v"] = bank["u"][order[:rank]], bank["v"][:, order[:rank]]
    router |= {name: router[name][..., order] for name in method.score_arrays if name in router}
    return {**params, "bank": bank, "router": router}
