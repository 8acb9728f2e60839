"""Smaller LoRA-SP: `prune` drops directions that stay inactive, `distill` makes a mergeable LoRA.

Both look at a calibration set and report the error that they cause on it, of each layer on the
inputs that it has in the model as it came, and of the model's output. They work on every layer
that LoRA-SP works on, dense or einsum; an einsum's batch axes count as those of a stack.
"""

import dataclasses
import functools
import numbers
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.compress import calibration
from lorasp_jax.adapters.compress.calibration import Forward, Layer, Sums
from lorasp_jax.dense import AdaptedLayer, AdapterParam, validate
from lorasp_jax.peft import LoRA, Method
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import Params
from lorasp_jax.peft.lora_sp.bank import BankMethod, normalized_bank

Changed = dict[str, tuple[Method, Params]]


class Compaction(NamedTuple):
    """What became smaller, and what it costs on the calibration set.

    Attributes:
      ranks: directions needed by path, int [...], one for each layer of a stack.
      layer_errors: ‖Δy‖ / ‖y‖ by path, f32 [...]; y without its bias, norms over valid tokens.
      output_error: ‖Δ‖ / ‖output‖ of all that the model returns.
    """

    ranks: dict[str, np.ndarray]
    layer_errors: dict[str, np.ndarray]
    output_error: float


def prune(
    model: adaptation.Model,
    batches: Sequence[Any],
    tolerance: float = 0.0,
    *,
    forward: Forward = calibration.call,
) -> tuple[adaptation.Model, Compaction]:
    """Drops the directions of LoRA-SP layers that are hardly ever active.

    A direction goes if the share of the valid calibration tokens for which it is kept is at most
    `tolerance`. The bank's arrays shrink; the router still scores what is dropped, since E_k is a
    share of the energy of all. So a direction that was never active leaves every output as it was,
    ties included, and dropping one that was loses what it added and nothing else. All layers of a
    stack have one rank, the largest that one of them needs; the others keep more of their own.

    Args:
      model: not modified; the result shares its frozen arrays, and can be trained on.
      batches: calibration set.
      tolerance: largest share of tokens, in [0, 1), of what is dropped.
      forward: how to call the model on a batch; see `lorasp_jax.adapters.compress.calibration`.

    Raises:
      ValueError: a tolerance outside [0, 1), or a model without LoRA-SP.
    """
    if not (isinstance(tolerance, numbers.Real) and 0 <= tolerance < 1):
        raise ValueError(f"tolerance must lie in [0, 1), got {short(tolerance)}.")
    layers = _lora_sp_layers(model)
    sums = calibration.observe(model, batches, dict.fromkeys(layers, _usage), forward)
    changed: Changed = {}
    ranks = {}
    for path, layer in layers.items():
        used = np.asarray(sums[path]["usage"] / jnp.maximum(sums[path]["tokens"][..., None], 1))
        needed = np.asarray((used > tolerance).sum(-1))
        ranks[path] = needed
        changed[path] = _pruned(layer, used, max(int(needed.max()), 1))
    return _finished(model, batches, changed, ranks, forward)


def distill(
    model: adaptation.Model,
    batches: Sequence[Any],
    rank: int | None = None,
    *,
    forward: Forward = calibration.call,
) -> tuple[adaptation.Model, Compaction]:
    """Replaces LoRA-SP layers by LoRA layers, which can be merged.

    Of all updates of that rank, each layer gets the one with the least squared output error on the
    calibration set (reduced-rank regression of the delta on the input). The mean update E[ΔW(x)]
    would ignore that the scores depend on the very x that they multiply.

    Args:
      model: not modified.
      batches: calibration set; fewer tokens than a layer has inputs leave its update undetermined
        where the set has no energy, and there it is zero.
      rank: of the LoRA. None, or more than a bank has, is the bank's own, where the best of any
        rank is reached.
      forward: how to call the model on a batch; see `lorasp_jax.adapters.compress.calibration`.

    Raises:
      ValueError: a rank below 1, or a model without LoRA-SP.
    """
    if rank is not None and not (type(rank) is int and rank >= 1):
        raise ValueError(f"rank must be a whole number, at least 1, or None, got {short(rank)}.")
    layers = _lora_sp_layers(model)
    sums = calibration.observe(model, batches, dict.fromkeys(layers, _regression), forward)
    changed: Changed = {}
    ranks = {}
    for path, layer in layers.items():
        kernel = layer.kernel_matrices()
        r = min(rank or layer.method.rank, layer.method.rank, *kernel.shape[-2:])
        fit = adaptation.over_stack(functools.partial(_fitted, rank=r), kernel)
        u = adaptation.over_stack(layer.method.up, kernel)(layer.adapter.get_value())
        changed[path] = LoRA(rank=r, alpha=float(r)), fit(sums[path]["xx"], sums[path]["xz"], u)
        ranks[path] = np.full(kernel.shape[:-2], r)
    return _finished(model, batches, changed, ranks, forward)


def _lora_sp_layers(model: nnx.Module) -> dict[str, Any]:
    """The layers with a LoRA-SP adapter by path."""
    locations = paths.locate(nnx.List([validate.with_values(model)]), AdaptedLayer)
    found = {p.path: p.child for p in locations if isinstance(p.child.method, BankMethod)}
    if not found:
        raise ValueError("the model has no LoRA-SP layers.")
    return found


def _usage(layer: Layer) -> Sums:
    assert layer.aux.usage is not None  # LoRA-SP always has it
    return {"usage": layer.aux.usage}


def _pruned(layer: Any, used: np.ndarray, rank: int) -> tuple[Method, Params]:
    """The method and parameters with the `rank` most used directions, in their old order."""
    method = layer.method
    own = np.arange(used.shape[-1]) < method.rank  # dropped ones stay dropped
    best = np.argsort(np.where(own, -used, 1), axis=-1, kind="stable")
    order = np.concatenate([np.sort(best[..., :rank]), np.sort(best[..., rank:])], axis=-1)
    params = layer.adapter.get_value()
    reorder = functools.partial(_reordered, method=method, rank=rank)
    each = adaptation.over_stack(reorder, layer.kernel_matrices())
    params = each(params, jnp.asarray(order))
    smaller = dataclasses.replace(method, rank=rank, alpha=method.scale * rank)
    return smaller, params


def _reordered(params: Params, order: jax.Array, *, method: BankMethod, rank: int) -> Params:
    """One layer's parameters: the bank's first `rank` directions in a new order, all scores."""
    bank, router = dict(params["bank"]), dict(params["router"])
    if method.normalized_bank:  # what is orthonormal as a whole is so in part
        unit = jnp.asarray(bank["u"].shape[1] ** -0.5)
        bank |= normalized_bank(bank | {"gain": unit})
    bank["u"], bank["v"] = bank["u"][order[:rank]], bank["v"][:, order[:rank]]
    router |= {name: router[name][..., order] for name in method.score_arrays if name in router}
    return {**params, "bank": bank, "router": router}


def _regression(layer: Layer) -> Sums:
    """Σ x xᵀ and Σ x zᵀ, where the delta is z U."""
    assert layer.method is not None  # only layers with LoRA-SP are asked
    z, _ = layer.method.bottleneck_from_input(layer.params, layer.x, layer.valid)
    x, z = layer.rows(layer.x), layer.rows(z)
    return {"xx": x.T @ x, "xz": x.T @ z}


def _fitted(xx: jax.Array, xz: jax.Array, u: jax.Array, *, rank: int) -> Params:
    """A [I, r] and B [r, O] that minimise Σ ‖z U - x A B‖² over the calibration set.

    The best map of any rank is M = (Σ x xᵀ)⁻¹ (Σ x zᵀ) U; the best of rank r keeps the r leading
    right singular vectors of its fitted outputs X M (Reinsel and Velu, Multivariate Reduced-Rank
    Regression, 1998, theorem 2.2). With Uᵀ = Q T they are Q times those of X M Q, which is narrow.
    """
    values, vectors = jnp.linalg.eigh(xx)
    cutoff = len(values) * jnp.finfo(values.dtype).eps * values[-1]
    solved = vectors @ ((vectors.T @ xz) * jnp.where(values > cutoff, 1 / values, 0)[:, None])
    q, t = jnp.linalg.qr(u.T)
    narrow = solved @ t.T
    fitted = jnp.sqrt(jnp.maximum(values, 0))[:, None] * (vectors.T @ narrow)
    leading = jnp.linalg.svd(fitted, full_matrices=False)[2][:rank].T
    return {"lora_a": narrow @ leading, "lora_b": (q @ leading).T}


def _finished(
    model: adaptation.Model,
    batches: Sequence[Any],
    changed: Changed,
    ranks: dict[str, np.ndarray],
    forward: Forward,
) -> tuple[adaptation.Model, Compaction]:
    """The model with its new adapters, and what they cost."""
    root = nnx.List([nnx.clone(model)])
    for location in paths.locate(root, AdaptedLayer):
        if location.path in changed:
            location.child.method, params = changed[location.path]
            location.child.adapter = AdapterParam(params)
    smaller = root[0]
    return smaller, Compaction(ranks, *_errors(model, smaller, batches, changed, forward))


def _errors(
    model: nnx.Module,
    smaller: nnx.Module,
    batches: Sequence[Any],
    changed: Changed,
    forward: Forward,
) -> tuple[dict[str, np.ndarray], float]:
    """Relative errors by layer, and of the output."""
    reports = dict.fromkeys(changed, _difference)
    sums = calibration.observe(model, batches, reports, forward, changed)
    layers = {
        path: np.sqrt(np.asarray(s["error"]) / np.maximum(s["norm"], np.finfo(np.float32).tiny))
        for path, s in sums.items()
    }
    before, after = (calibration.outputs(m, forward) for m in (model, smaller))
    error = norm = 0.0
    for batch in batches:
        for a, b in zip(before(batch), after(batch), strict=True):
            a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
            error, norm = error + np.square(b - a).sum(), norm + np.square(a).sum()
    return layers, float(np.sqrt(error / max(norm, np.finfo(np.float32).tiny)))


def _difference(layer: Layer) -> Sums:
    assert layer.other is not None  # every changed layer has its new adapter beside it
    y, other = layer.rows(layer.y), layer.rows(layer.other)
    return {"error": jnp.square(other - y).sum(), "norm": jnp.square(y).sum()}
