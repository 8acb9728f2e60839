"""Floating-point operations of a JAX function: those of its matrix products, as it is traced.

Model FLOP utilisation is this number a second over the device's peak (Chowdhery et al., arXiv
2204.02311, appendix B). Trace the function without rematerialisation: what the backward pass
computes again does not count as work. Elementwise operations are left out.
"""

import math
from collections.abc import Callable
from typing import Any

import jax

from lorasp_jax import _compat

PEAK = {"NVIDIA H200": 989e12, "NVIDIA H100": 989e12, "NVIDIA A100": 312e12, "TPU v5p": 459e12}
"""Dense bf16 operations a second by how a device's name begins (NVIDIA's and Google's data sheets,
SXM and without sparsity)."""

_CUDNN = {"dot_product_attention_fwd_wrapper": 4, "dot_product_attention_bwd_wrapper": 8}
"""Operations of attention by cuDNN, B N T S H of them: two products forwards, four backwards (a
fifth repeats one)."""


def count(function: Callable, *arguments: Any) -> float:
    """Operations of one call, two for each multiplication and addition; none for what is not used.

    Args:
      function: what `jax.jit` takes.
      arguments: arrays, or `jax.ShapeDtypeStruct`s; only shapes are read.
    """
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    return _of_jaxpr(_compat.without_unused(jaxpr, [True] * len(jaxpr.outvars))[0])


def utilisation(operations: float, seconds: float) -> float | None:
    """Share of the first device's peak, or None where that is not known."""
    fastest = peak()
    return fastest and operations / seconds / fastest


def peak() -> float | None:
    """Operations a second that the first device can do, see `PEAK`; None where not known."""
    kind = jax.devices()[0].device_kind
    return next((value for name, value in PEAK.items() if kind.startswith(name)), None)


def _of_jaxpr(jaxpr: Any) -> float:
    return sum(_of_equation(equation) for equation in jaxpr.eqns)


def _of_equation(equation: Any) -> float:
    name, params = equation.primitive.name, equation.params
    if name == "dot_general":
        (contracted, _), _ = params["dimension_numbers"]
        left = equation.invars[0].aval.shape
        return 2.0 * equation.outvars[0].aval.size * math.prod(left[i] for i in contracted)
    if name in _CUDNN:
        query, key = (v.aval.shape for v in equation.invars[:2])
        batch, tokens, heads, size = query
        return float(_CUDNN[name] * batch * heads * tokens * key[1] * size)
    if name == "cond":
        return max(_of_jaxpr(branch.jaxpr) for branch in params["branches"])
    if name == "while":  # how often is not known: once
        return _of_jaxpr(params["body_jaxpr"].jaxpr)
    inner = [getattr(value, "jaxpr", value) for value in params.values()]
    once = sum(_of_jaxpr(jaxpr) for jaxpr in inner if hasattr(jaxpr, "eqns"))
    return once * (params["length"] if name == "scan" else 1)
