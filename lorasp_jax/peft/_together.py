"""Layers that read one input, which their adapters read once."""

import dataclasses
from collections.abc import Sequence

import jax

from lorasp_jax.kernels.low_rank_matmul import low_rank_matmul
from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._method import Method, Params

Adapted = tuple[Method, Params, jax.Array]
"""Method, parameters and kernel of a layer."""


def apply_together(
    layers: Sequence[Adapted], x: jax.Array, *, token_mask: jax.Array | None = None
) -> list[tuple[jax.Array, Aux]]:
    """`Method.apply` of several layers to one input.

    It is read once for all layers whose methods are `plain` and agree in `reads_in_fp32`; no
    gradient reaches their kernels.
    """
    groups: dict[bool, list[int]] = {}
    found: dict[int, tuple[jax.Array, Aux]] = {}
    for i, (method, params, kernel) in enumerate(layers):
        if method.plain:
            method.check(params, x, kernel)
            groups.setdefault(method.reads_in_fp32, []).append(i)
        else:
            found[i] = method.apply(params, x, kernel, token_mask=token_mask)
    for members in groups.values():
        together = _apply_plain([layers[i] for i in members], x, token_mask)
        found |= zip(members, together, strict=True)
    return [found[i] for i in range(len(layers))]


def _apply_plain(
    layers: Sequence[Adapted], x: jax.Array, token_mask: jax.Array | None
) -> list[tuple[jax.Array, Aux]]:
    fused = [method.fused(params) for method, params, _ in layers]
    methods = tuple(own or method for own, (method, _, _) in zip(fused, layers, strict=True))
    if len(layers) > 1 and fused[0] is not None and len(set(fused)) == 1:
        methods = fused[0]  # one kernel for all
    arrays = [method.low_rank_layer(params, kernel) for method, params, kernel in layers]
    found = low_rank_matmul(methods, layers[0][0].rows_dtype(x), arrays, x, token_mask)
    return [(y, dataclasses.replace(aux, token_mask=token_mask)) for y, aux in found]
