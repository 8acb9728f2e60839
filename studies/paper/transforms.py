"""Policies made from trained ones without training, for `Derived` cells, as in

    lambda policy, results, _: cut(policy, results["lora_sp/s0"]["active_rank"]["mean"])
    lambda policy, _, episodes: pruned(policy, episodes)

Both return a new policy; the frozen arrays are shared.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import paths
from lorasp_jax.dense import AdaptedLayer, AdapterParam
from lorasp_jax.extras.deployment import variants
from lorasp_jax.peft import AdaLoRA, LoRA
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.demonstrations import Demonstrations
from lorasp_jax.training.fixed_batches import forward


def cut(policy: Policy, mean_rank: float, *, by_size: bool = False) -> Policy:
    """Cut a trained LoRA policy to a mean rank, by one threshold on singular values.

    The rival of choosing ranks while training: PARA (arXiv 2604.27796). The singular values of
    all updates ΔW = scale A B are pooled, and the largest ones kept. Each layer thus gets its best
    approximation of some rank, and the ranks differ.

    The mean rank is that of results.json, `active_rank.mean`: the average over all adapted linear
    layers, where each layer of a stack counts once and sizes do not matter. Of n layers, the
    round(n x `mean_rank`) largest values that are not zero are kept; of equal ones, those of the
    layers that come first. If there are fewer, all are kept and the mean rank is lower.

    Args:
        policy: not modified. All its LoRA layers, whose updates start at zero, are cut.
        mean_rank: at least 0.
        by_size: a layer counts I + O times, as its parameters do; sizes matter, and the largest
            values are kept that together have no more parameters than `mean_rank` in all layers.

    Returns:
        A policy whose updates are stored as AdaLoRA's triplets, s A diag(e) B with orthonormal A
        and B: evaluation then reports the ranks that were kept. The arrays of a stack are as large
        as its largest rank.
    """
    root = nnx.List([nnx.clone(policy.model)])
    locations = [p for p in paths.locate(root, AdaptedLayer) if type(p.child.method) is LoRA]
    updates = [_decomposed(*p.child.method_and_params()) for p in locations]
    costs = [u.left.shape[-2] + u.right.shape[-1] if by_size else 1 for u in updates]
    for location, update, kept in zip(
        locations, updates, _largest(updates, costs, mean_rank), strict=True
    ):
        location.child.method, params = _triplets(update, kept, location.child.stack_shape())
        location.child.adapter = AdapterParam(params)
    return dataclasses.replace(policy, model=root[0])


class _Decomposition(NamedTuple):
    """Singular value decomposition of the updates of a stack of L layers, f64."""

    left: np.ndarray
    """`[L, I, n]`, orthonormal columns."""
    values: np.ndarray
    """`[L, n]`, in descending order."""
    right: np.ndarray
    """`[L, n, O]`, orthonormal rows."""


def _decomposed(method: LoRA, params: Mapping[str, jax.Array]) -> _Decomposition:
    """Decompose scale A B through the QR decompositions of its factors, without forming it."""
    a, b = (np.asarray(params[name], np.float64) for name in ("lora_a", "lora_b"))
    a, b = (x.reshape(-1, *x.shape[-2:]) for x in (a, b))
    a_basis, a_factor = np.linalg.qr(a)
    b_basis, b_factor = np.linalg.qr(b.swapaxes(-1, -2))
    core = method.scale * a_factor @ b_factor.swapaxes(-1, -2)
    left, values, right = np.linalg.svd(core, full_matrices=False)
    return _Decomposition(a_basis @ left, values, right @ b_basis.swapaxes(-1, -2))


def _largest(updates: list[_Decomposition], costs: list[int], mean_rank: float) -> list[np.ndarray]:
    """Return which singular values to keep, bool `[L, n]` for each stack; see `cut`."""
    values = np.concatenate([update.values.ravel() for update in updates])
    # A product of rank r has more than r singular values in floating point: those are zero.
    values[values <= np.finfo(np.float32).eps * values.max(initial=0.0)] = 0.0
    cost = np.concatenate([np.full(u.values.size, c) for u, c in zip(updates, costs, strict=True)])
    budget = round(mean_rank * sum(len(u.values) * c for u, c in zip(updates, costs, strict=True)))
    order, kept = np.argsort(-values, kind="stable"), np.zeros(len(values), bool)
    kept[order[np.cumsum(cost[order]) <= budget]] = True
    kept &= values > 0
    ends = np.cumsum([update.values.size for update in updates])[:-1]
    parts = zip(np.split(kept, ends), updates, strict=True)
    return [part.reshape(update.values.shape) for part, update in parts]


def _triplets(
    update: _Decomposition, kept: np.ndarray, stack: tuple[int, ...]
) -> tuple[AdaLoRA, Any]:
    """Return the kept part of a stack's updates as AdaLoRA adapters."""
    rank = max(int(kept.sum(-1).max()), 1)  # an adapter has at least one triplet
    method = AdaLoRA(rank=rank, alpha=float(rank))
    arrays = {
        "lora_a": update.left[..., :rank],
        "lora_e": np.where(kept, update.values, 0.0)[..., :rank] / method.scale,
        "lora_b": update.right[:, :rank],
    }
    return method, {
        name: jnp.asarray(array.reshape(*stack, *array.shape[1:]), jnp.float32)
        for name, array in arrays.items()
    }


def pruned(policy: Policy, episodes: Demonstrations) -> Policy:
    """Prune a LoRA-SP policy to the directions in use on held-out episodes by task."""
    model, _ = lorasp_jax.prune(policy.model, variants.batches(policy, episodes), forward=forward)
    return dataclasses.replace(policy, model=model)
