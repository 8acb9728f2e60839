"""Count the FLOPs (floating-point operations) of the matrix products in a function's jaxpr.

Model FLOPs utilization is this count per second divided by the device's peak (Chowdhery et al.,
arXiv 2204.02311, appendix B). Elementwise operations are not counted. Trace the function without
rematerialization, because recomputation does not count as work.
"""

import math
from collections.abc import Callable
from typing import Any

import jax

from lorasp_jax.training import _compat

PEAK = {"NVIDIA H200": 989e12, "NVIDIA H100": 989e12, "NVIDIA A100": 312e12, "TPU v5p": 459e12}
"""Dense bf16 FLOP/s by prefix of the device name (NVIDIA's and Google's data sheets; SXM variants,
without sparsity)."""

_CPU = jax.sharding.AbstractMesh(
    (), (), abstract_device=jax.sharding.AbstractDevice("cpu", num_cores=None, platform="cpu")
)
"""Traced for it, a function has no GPU kernels, whose matrix products a jaxpr does not show."""


def count(function: Callable, *arguments: Any) -> float:
    """Count the FLOPs of one call, two per multiply-add.

    Operations with unused results are not counted. `function` must work with `jax.jit`;
    `arguments` are arrays or `jax.ShapeDtypeStruct`s.
    """
    with jax.sharding.use_abstract_mesh(_CPU):
        jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    return _jaxpr_flops(_compat.eliminate_dead_code(jaxpr, [True] * len(jaxpr.outvars))[0])


def utilization(flop_count: float, seconds: float) -> float | None:
    """Return the achieved fraction of the first device's peak; None if the peak is unknown."""
    peak_flops = peak()
    return peak_flops and flop_count / seconds / peak_flops


def peak() -> float | None:
    """Return the peak FLOP/s of the first device (see `PEAK`); None if unknown."""
    kind = jax.devices()[0].device_kind
    return next((value for name, value in PEAK.items() if kind.startswith(name)), None)


def _jaxpr_flops(jaxpr: Any) -> float:
    return sum(_equation_flops(equation) for equation in jaxpr.eqns)


def _equation_flops(equation: Any) -> float:
    name, params = equation.primitive.name, equation.params
    if name == "dot_general":
        (contracted, _), _ = params["dimension_numbers"]
        left = equation.invars[0].aval.shape
        return 2.0 * equation.outvars[0].aval.size * math.prod(left[i] for i in contracted)
    if name == "cond":
        return max(_jaxpr_flops(branch.jaxpr) for branch in params["branches"])
    if name == "while":  # the number of iterations is unknown: count one
        return _jaxpr_flops(params["body_jaxpr"].jaxpr)
    values = [getattr(value, "jaxpr", value) for value in params.values()]
    once = sum(_jaxpr_flops(value) for value in values if hasattr(value, "eqns"))
    return once * (params["length"] if name == "scan" else 1)
