"""Distill LoRA-SP adapters into LoRA adapters."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.compress import calibration, compaction
from lorasp_jax.adapters.compress.calibration import Forward, Layer, Sums
from lorasp_jax.dense import validate
from lorasp_jax.peft import LoRA
from lorasp_jax.peft.method import Params


def distill(
    model: adaptation.Model,
    batches: Sequence[Any],
    rank: int | None = None,
    *,
    forward: Forward = calibration.call,
) -> tuple[adaptation.Model, compaction.Compaction]:
    """Replace LoRA-SP adapters by LoRA adapters, which can be merged into the kernels.

    Each layer gets the rank-r update with the smallest squared output error on the calibration set
    (reduced-rank regression of the delta on the input). The mean update E[ΔW(x)] would be worse: it
    ignores that the scores in ΔW(x) x depend on the same x.

    Args:
        model: not modified.
        batches: calibration set. The update is zero along input directions that do not occur in it,
            for instance if it has fewer tokens than a layer has input features.
        rank: LoRA rank. None uses the bank's rank, which also caps `rank`, because a larger rank
            could not reduce the error.
        forward: how to call the model on a batch; see `lorasp_jax.adapters.compress.calibration`.

    Raises:
        ValueError: rank is below 1, or the model has no LoRA-SP layers.
    """
    layers = compaction.lora_sp_layers(model)
    sums = calibration.observe(model, batches, dict.fromkeys(layers, _regression_sums), forward)
    replacements: compaction.Replacements = {}
    ranks = {}
    for path, layer in layers.items():
        kernel = layer.kernel_matrices()
        largest = min(layer.method.rank, *kernel.shape[-2:])
        r = largest if rank is None else min(validate.size("rank", rank), largest)
        fit = adaptation.over_stack(functools.partial(_fitted, rank=r), kernel)
        u = adaptation.over_stack(layer.method.up, kernel)(layer.adapter.get_value())
        params = fit(sums[path]["xx"], sums[path]["xz"], u)
        replacements[path] = LoRA(rank=r, alpha=float(r)), params
        ranks[path] = np.full(kernel.shape[:-2], r)
    return compaction.replace_adapters(model, batches, replacements, ranks, forward)


def _regression_sums(layer: Layer) -> Sums:
    """Σ x xᵀ and Σ x zᵀ, where the delta is z U."""
    assert layer.method is not None  # only LoRA-SP layers are observed
    z, _ = layer.method.bottleneck_from_input(layer.params, layer.x, layer.valid)
    x, z = layer.rows(layer.x), layer.rows(z)
    return {"xx": x.T @ x, "xz": x.T @ z}


def _fitted(xx: jax.Array, xz: jax.Array, u: jax.Array, *, rank: int) -> Params:
    """A `[I, r]` and B `[r, O]` that minimize Σ ‖z U - x A B‖² over the calibration set.

    The full-rank optimum is M = (Σ x xᵀ)⁻¹ (Σ x zᵀ) U. The rank-r optimum projects M onto the r
    leading right singular vectors of the fitted outputs X M, where the rows of X are the inputs
    (Reinsel and Velu, Multivariate Reduced-Rank Regression, 1998, theorem 2.2). With the QR
    decomposition Uᵀ = Q T, these vectors are Q times those of the narrower X M Q.
    """
    values, vectors = jnp.linalg.eigh(xx)
    cutoff = len(values) * jnp.finfo(values.dtype).eps * values[-1]
    solved = vectors @ ((vectors.T @ xz) * jnp.where(values > cutoff, 1 / values, 0)[:, None])
    q, t = jnp.linalg.qr(u.T)
    narrow = solved @ t.T
    fitted = jnp.sqrt(jnp.maximum(values, 0))[:, None] * (vectors.T @ narrow)
    leading = jnp.linalg.svd(fitted, full_matrices=False)[2][:rank].T
    return {"lora_a": narrow @ leading, "lora_b": (q @ leading).T}
