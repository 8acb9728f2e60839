"""Named LoRAs made into one, and merged kernels taken apart again.

`fuse` gives one LoRA that is the weighted sum of several: exact, of all their ranks together, or
the best one of a smaller rank, with the error that this makes. `unmerge` is the inverse of `merge`.
"""

import re
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
from lorasp_jax.peft import FullFineTuning, LoRA
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import Params


class Fused(NamedTuple):
    """A model with one LoRA a layer, and what it costs to have only one.

    Attributes:
      model: adapted by plain LoRA of scale 1, fit to train, save and merge.
      errors: ‖ΔW − ΔW'‖ / ‖ΔW‖ by path, Frobenius, of a whole stack at once: what the layer's delta
        is off by, relative to itself, for inputs that are as long in every direction.
    """

    model: nnx.Module
    errors: dict[str, float]


def fuse(model: nnx.Module, weights: Mapping[str, float], *, rank: int | None = None) -> Fused:
    """The weighted sum of some of a combined model's LoRAs as one LoRA.

    Args:
      model: from `combine`; not modified.
      weights: w_i by name, of any sign.
      rank: None: their ranks together, which is exact. Else at most that, by singular values.

    Raises:
      ValueError: as for `choose`; no weight, a rank below 1, or a method that is no LoRA.
    """
    if rank is not None:
        validate.size("rank", rank)
    if not isinstance(weights, Mapping) or not weights:
        raise ValueError(f"fuse needs weights by name, at least one, got {short(weights)}.")
    named.weights(model, weights)  # raises for an unknown name or a weight that is no number
    fused, errors = {}, {}
    for path, _, _, layer in named.sets(model):
        found = []
        for name, weight in weights.items():
            method, params = named.member(layer, name)
            if method is not None and type(method) is not LoRA:
                raise ValueError(f"cannot fuse {name} at {path}: {method} is no LoRA.")
            if method is not None:
                found.append((params["lora_a"], weight * method.scale * params["lora_b"]))
        if found:
            method, params, errors[path] = _one(found, rank)
            fused[path] = layer, method, params
    return Fused(named.with_adapters(named.bare(model), fused), errors)


def unmerge(merged: Model, adapted: nnx.Module) -> Model:
    """The adapted model that `merge` made the merged one of, from the adapters alone.

    What they added is subtracted in fp32 and rounded to the kernel's type, so that a kernel comes
    back up to eps/2 (|W + ΔW| + |W|), entry by entry (eps 1.2e-7 in fp32, 7.8e-3 in bf16). Weights
    that train in full, biases for instance, are those of the adapted model and train again.

    Args:
      merged: from `merge`; not modified.
      adapted: a model with the adapters, of which nothing else is read: for a saved adapter,
        `load_adapters(folder, merged, any_base=True)`, unless it holds a part of its kernel.

    Raises:
      ValueError: the merged model has adapters, lacks a layer or has one of another class, or an
        adapter that did not just add a constant: DoRA rescaled the kernel, and what it was before
        is not in the result.
    """
    validate.with_values(merged)
    if named.sets(validate.with_values(adapted)):
        raise ValueError("the model to unmerge by has named adapters: extract one of them.")
    adapters = named.own_adapters(adapted)
    own = {p.path: p.child.get_value() for p in paths.locate(nnx.List([adapted]), AdapterParam)}
    freed = [path for path in adaptation.methods(adapted) if path not in adapters]
    if has := adaptation.methods(merged):
        raise ValueError(f"{min(has)} of the merged model has an adapter.")
    root = nnx.List([nnx.merge(*adaptation.split(merged))])

    def taken_apart(location: paths.Location) -> AdaptedLayer | None:
        if location.path not in adapters:
            return None
        try:
            return _unmerged(location.child, adapters[location.path])
        except (ValueError, TypeError) as error:
            raise ValueError(f"cannot unmerge {location.path}: {error}") from error

    found = paths.locate(root, nnx.Module)
    paths.replace(found, taken_apart)
    if beyond := adapters.keys() - {location.path for location in found}:
        raise ValueError(f"the merged model has no layer {min(beyond)}.")
    full = [(f"^{re.escape(path)}$", FullFineTuning()) for path in freed]
    for i in set(range(len(full))) - adaptation.unfreeze(root, full):
        raise ValueError(f"the merged model has no parameter {freed[i]}.")
    for location in paths.locate(root, AdapterParam):
        if location.path in freed:
            location.child.set_value(own[location.path])
    return root[0]


def _unmerged(layer: nnx.Module, adapted: AdaptedLayer) -> AdaptedLayer:
    """The layer with the adapter of the adapted one, less what it had added."""
    method, params = adapted.method_and_params()
    if not method.additive:
        raise ValueError(f"{method} did not just add to its base.")
    layer = nnx_layers.make_adaptable_like(layer, adapted)
    kernel = layer.kernel_matrices()
    delta = adaptation.over_stack(method.merge, kernel)(params, jnp.zeros(kernel.shape))
    base = (kernel.astype(jnp.float32) - delta).astype(kernel.dtype)
    layer.set_kernel_matrices(base)
    layer.method, layer.adapter = method, AdapterParam(params)
    return layer


def _one(found: list[tuple[jax.Array, jax.Array]], rank: int | None) -> tuple[LoRA, Params, float]:
    """One LoRA of scale 1 with Σ A_i B_i, and its relative error."""
    a = jnp.concatenate([a for a, _ in found], axis=-1)
    b = jnp.concatenate([b for _, b in found], axis=-2)
    error = 0.0
    if rank is not None and rank < a.shape[-1]:
        a, b, error = truncated(a, b, rank)
    params: Params = {"lora_a": a, "lora_b": b}
    return LoRA(rank=a.shape[-1], alpha=a.shape[-1]), params, error


def truncated(a: jax.Array, b: jax.Array, rank: int) -> tuple[jax.Array, jax.Array, float]:
    """The best A', B' of a smaller rank for A [..., I, R] and B [..., R, O], with ‖A‖ = ‖B‖.

    A B = Q_a (R_a R_bᵀ) Q_bᵀ by QR of A and Bᵀ, so only a matrix of R x R is decomposed. The
    singular values go to both sides in halves; the error is sqrt(Σ left out² / Σ all²).
    """
    (qa, ra), (qb, rb) = jnp.linalg.qr(a), jnp.linalg.qr(jnp.swapaxes(b, -1, -2))
    left, values, right = jnp.linalg.svd(ra @ jnp.swapaxes(rb, -1, -2), full_matrices=False)
    root = jnp.sqrt(values[..., :rank])
    a = qa @ left[..., :rank] * root[..., None, :]
    b = root[..., None] * right[..., :rank, :] @ jnp.swapaxes(qb, -1, -2)
    total = jnp.linalg.norm(values)
    lost = jnp.linalg.norm(values[..., rank:])
    return a, b, float(jnp.where(total > 0, lost / total, 0.0))
