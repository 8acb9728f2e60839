"""Keep programs with LAPACK calls from hanging on CPU with JAX 0.10 and 0.11.0.

There, a call with many matrices shares them out among XLA's threads and waits for the results, on
one of these threads itself. When all threads wait, none is left to compute. A step of MJX makes two
such calls at once, so that pick_place hangs from 220 worlds on two cores, pour from 77. Programs of
symbolic shapes or for several devices stay as they are.
"""

import math
from typing import Any

import jax
from jax.lax import linalg

from lorasp_jax.base import _compat

_NEEDED = jax.__version_info__ < (0, 11, 1)  # newer versions do not share out matrices
_SHARED = 200_000  # JAX computes calls with fewer operations where they are
# What JAX divides the product of a matrix's size and its longest side by to estimate operations.
_DIVISORS = {linalg.cholesky_p: 3, linalg.lu_p: 1, linalg.triangular_solve_p: 1}


def split_calls() -> None:
    """Let JAX split the calls that MJX and our experts need until none is shared out."""
    if _NEEDED:
        for primitive in _DIVISORS:
            _split(primitive)


def _split(primitive: Any) -> None:
    whole = _compat.cpu_lowering(primitive)

    def lower(context: Any, *operands: Any, **parameters: Any) -> Any:
        sizes = [size for aval in context.avals_in for size in aval.shape]
        devices = getattr(context.module_context.axis_context, "num_devices", 1)
        if devices > 1 or not all(isinstance(size, int) and size for size in sizes):
            return whole(context, *operands, **parameters)
        *batch, rows, columns = context.avals_in[0].shape
        longest = max(context.avals_in[-1].shape[-2:])
        limit = math.ceil(_SHARED / (rows * columns * longest // _DIVISORS[primitive] or 1))
        if math.prod(batch) <= limit:
            return whole(context, *operands, **parameters)

        def parts(*arrays: jax.Array) -> Any:
            flat = [x.reshape(-1, *x.shape[-2:]) for x in arrays]
            results = jax.lax.map(
                lambda matrices: primitive.bind(*matrices, **parameters), flat, batch_size=limit
            )
            return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), results)

        return _compat.mlir.lower_fun(parts, primitive.multiple_results)(context, *operands)

    _compat.mlir.register_lowering(primitive, lower, platform="cpu")
