"""Fuse named LoRAs into one, and unmerge adapters from merged kernels."""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.adaptation import Model
from lorasp_jax.adapters.combine import named
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdaptedLayer, AdapterParam, validate
from lorasp_jax.peft import LoRA
from lorasp_jax.peft.method import Params


class FusedAdapters(NamedTuple):
    """A model with one LoRA per layer, and the approximation errors.

    Attributes:
        model: adapted with plain LoRA of scale 1.
        errors: relative error ‖ΔW − ΔW'‖ / ‖ΔW‖ by path, where ΔW is the weighted sum and ΔW' the
            delta of the fused LoRA. The Frobenius norm is taken over all layers of a stack. For
            isotropic inputs, this is also the relative RMS error of x ΔW'.
    """

    model: nnx.Module
    errors: dict[str, float]


def fuse(
    model: nnx.Module, weights: Mapping[str, float], *, rank: int | None = None
) -> FusedAdapters:
    """Fuse LoRAs of a combined model into one LoRA that computes their weighted sum.

    Args:
        model: from `combine`; not modified.
        weights: weight of each LoRA by name; may be negative.
        rank: maximum rank of the fused LoRA in each layer. If the LoRAs' ranks add up to more, the
            result is the best approximation of that rank. None keeps the sum, so the result is
            exact.

    Raises:
        ValueError: as for `choose`, or rank is below 1, or a named adapter is not plain LoRA.
    """
    if rank is not None:
        validate.size("rank", rank)
    named.weights(model, weights)  # raises for an unknown name
    fused, errors = {}, {}
    for path, _, _, layer in named.adapter_sets(model):
        factors = []
        for name, weight in weights.items():
            method, params = named.get_adapter(layer, name)
            if method is not None and type(method) is not LoRA:
                raise ValueError(f"cannot fuse {name} at {path}: {method} is not plain LoRA")
            if method is not None:
                factors.append((params["lora_a"], weight * method.scale * params["lora_b"]))
        if factors:
            method, params, errors[path] = _fused_lora(factors, rank)
            fused[path] = layer, method, params
    return FusedAdapters(named.with_adapters(named.strip_adapters(model), fused), errors)


def unmerge(merged: Model, adapted: nnx.Module) -> Model:
    """Invert `merge`: restore the adapted model from the merged one and the adapters.

    The delta is subtracted in fp32 and the result rounded to the kernel's dtype. Each entry of W is
    restored to within eps/2 (|W + ΔW| + |W|), where eps is 1.2e-7 in fp32 and 7.8e-3 in bf16.

    Args:
        merged: from `merge`; not modified.
        adapted: model with the adapters; its base is not used. For saved adapters that do not split
            kernels, pass `load_adapters(folder, merged, any_base=True)`.

    Raises:
        ValueError: the merged model has adapters, lacks a layer or has one of a different class,
            the adapted model is from `combine` or also trains base weights, or a method cannot be
            merged or is not additive (DoRA).
    """
    validate.with_values(merged)
    adapters = named.adapters_by_path("the adapted model", validate.with_values(adapted))
    if has := adaptation.methods(merged):
        raise ValueError(f"the merged model must have no adapters, but {min(has)} has one")
    root = nnx.List([nnx.merge(*adaptation.split(merged))])

    def unmerge_layer(location: paths.Location) -> AdaptedLayer | None:
        if location.path not in adapters:
            return None
        with paths.naming("unmerge", location.path):
            return _unmerged_layer(location.child, adapters[location.path])

    modules = paths.locate(root, nnx.Module)
    paths.replace(modules, unmerge_layer)
    if missing := adapters.keys() - {location.path for location in modules}:
        raise ValueError(f"the merged model has no layer {min(missing)}")
    return root[0]


def _unmerged_layer(layer: nnx.Module, adapted: AdaptedLayer) -> AdaptedLayer:
    """Subtract the adapted layer's delta from the kernel and attach its adapter."""
    method, params = adapted.method_and_params()
    if not method.additive:
        raise ValueError(f"{method} is not additive, so its merge cannot be undone")
    layer = nnx_layers.make_adaptable_like(layer, adapted)
    kernel = layer.kernel_matrices()
    delta = adaptation.over_stack(method.merge, kernel)(params, jnp.zeros(kernel.shape))
    base = (kernel.astype(jnp.float32) - delta).astype(kernel.dtype)
    layer.set_kernel_matrices(base)
    layer.method, layer.adapter = method, AdapterParam(params)
    return layer


def _fused_lora(
    factors: list[tuple[jax.Array, jax.Array]], rank: int | None
) -> tuple[LoRA, Params, float]:
    """LoRA of scale 1 that computes Σ A_i B_i of the factors (A_i, B_i), truncated to `rank`.

    Returns its method, parameters and relative error.
    """
    a = jnp.concatenate([a for a, _ in factors], axis=-1)
    b = jnp.concatenate([b for _, b in factors], axis=-2)
    error = 0.0
    if rank is not None and rank < a.shape[-1]:
        a, b, error = truncated(a, b, rank)
    params: Params = {"lora_a": a, "lora_b": b}
    return LoRA(rank=a.shape[-1], alpha=a.shape[-1]), params, error


def truncated(a: jax.Array, b: jax.Array, rank: int) -> tuple[jax.Array, jax.Array, float]:
    """Factors A' and B' of the best approximation of A B at the given rank, and its relative error.

    A is [..., I, R] and B is [..., R, O]. With the QR decompositions A = Q_a R_a and Bᵀ = Q_b R_b,
    A B = Q_a (R_a R_bᵀ) Q_bᵀ. So an SVD of R_a R_bᵀ, no larger than R x R, suffices. A' and B' each
    contain the square roots of the singular values, so that ‖A'‖ = ‖B'‖. The relative error is the
    norm of the discarded singular values over the norm of all of them.
    """
    (qa, ra), (qb, rb) = jnp.linalg.qr(a), jnp.linalg.qr(jnp.swapaxes(b, -1, -2))
    left, values, right = jnp.linalg.svd(ra @ jnp.swapaxes(rb, -1, -2), full_matrices=False)
    root = jnp.sqrt(values[..., :rank])
    a = qa @ left[..., :rank] * root[..., None, :]
    b = root[..., None] * right[..., :rank, :] @ jnp.swapaxes(qb, -1, -2)
    total = jnp.linalg.norm(values)
    lost = jnp.linalg.norm(values[..., rank:])
    return a, b, float(jnp.where(total > 0, lost / total, 0.0))
