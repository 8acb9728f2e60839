"""Apply several adapted layers to a shared input with one down-projection."""

import dataclasses
from collections.abc import Sequence

import jax

from lorasp_jax.kernels.low_rank_matmul import low_rank_matmul
from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._method import Method, Params

AdaptedKernel = tuple[Method, Params, jax.Array]
"""Method, parameters and kernel of a layer."""


def apply_shared_input(
    layers: Sequence[AdaptedKernel], x: jax.Array, *, token_mask: jax.Array | None = None
) -> list[tuple[jax.Array, Aux]]:
    """Compute `Method.apply` of several layers for the same input.

    Layers with `Method.is_low_rank_sum` and the same `down_in_fp32` share one matmul for their
    down-projections. Kernels receive no gradient.
    """
    groups: dict[bool, list[int]] = {}
    results: dict[int, tuple[jax.Array, Aux]] = {}
    for i, (method, params, kernel) in enumerate(layers):
        if method.is_low_rank_sum:
            method.check(params, x, kernel)
            groups.setdefault(method.down_in_fp32, []).append(i)
        else:
            results[i] = method.apply(params, x, kernel, token_mask=token_mask)
    for members in groups.values():
        group = _apply_low_rank_sums([layers[i] for i in members], x, token_mask)
        results |= zip(members, group, strict=True)
    return [results[i] for i in range(len(layers))]


def _apply_low_rank_sums(
    layers: Sequence[AdaptedKernel], x: jax.Array, token_mask: jax.Array | None
) -> list[tuple[jax.Array, Aux]]:
    fused = [method.fused_kernel(params) for method, params, _ in layers]
    methods = tuple(kernel or method for kernel, (method, _, _) in zip(fused, layers, strict=True))
    if len(layers) > 1 and fused[0] is not None and len(set(fused)) == 1:
        methods = fused[0]  # one GPU kernel for all layers
    arrays = [method.low_rank_layer(params, kernel) for method, params, kernel in layers]
    results = low_rank_matmul(methods, layers[0][0].rows_dtype(x), arrays, x, token_mask)
    return [(y, dataclasses.replace(aux, token_mask=token_mask)) for y, aux in results]
