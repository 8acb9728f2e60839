"""The bisection of the energy gate as a Triton kernel of its own."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl

from lorasp_jax.kernels.energy_gate import Boundary, Ratio, bisected_boundary


def pallas_boundary(scores: jax.Array, ratio: Ratio, *, interpret: bool = False) -> Boundary:
    """`bisected_boundary` of scores [..., R]; R is padded with zeros, which are never kept."""
    from jax.experimental.pallas import triton  # absent from builds without NVIDIA support

    *leading, rank = scores.shape
    width = max(pl.next_power_of_2(rank), 2)
    rows = jnp.pad(scores.reshape(-1, rank), ((0, 0), (0, width - rank)))
    column = pl.BlockSpec((1, 1), lambda i: (i, 0))
    score, index = pl.pallas_call(
        functools.partial(_boundary_kernel, ratio=ratio),
        grid=(len(rows),),  # one row and one warp to a program: the fastest measured
        in_specs=[pl.BlockSpec((1, width), lambda i: (i, 0))],
        out_specs=[column, column],
        out_shape=[jax.ShapeDtypeStruct((len(rows), 1), t) for t in (jnp.float32, jnp.int32)],
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="energy_gate",
    )(rows)
    return Boundary(score.reshape(*leading, 1), index.reshape(*leading, 1))


def _boundary_kernel(scores: Any, score: Any, index: Any, *, ratio: Ratio) -> None:
    """One program: references to scores [rows, width] in, to the two columns of `Boundary` out."""
    score[...], index[...] = bisected_boundary(scores[...], ratio, is_block=True)
