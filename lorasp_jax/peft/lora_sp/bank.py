"""LoRA-SP's bank of rank-one directions, U and V of ΔW = U Σ(x) V.

Inputs are rows here, so both are stored transposed: U as u [R, O] and V as v [I, R].
"""

from typing import ClassVar

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import exact_ratio
from lorasp_jax.peft.lora_sp.router import clip
from lorasp_jax.peft.method import Method, Params, Shapes

Bank = dict[str, jax.Array]

MAX_Z = 2.0**120
"""Bound to which |z| is clipped, so that a sum over the bank stays below fp32's 2^128."""


def init_bank(v: jax.Array, d_out: int) -> Bank:
    """Initialize a bank with V [I, R] and U = 0, so that ΔW is exactly zero."""
    return {"u": jnp.zeros((v.shape[1], d_out)), "v": v}


def apply_masked_scores(
    v_x: jax.Array, scores: jax.Array, mask: jax.Array, kept_energy: jax.Array
) -> jax.Array:
    """Eq. (11): Σ(x) V x, zero outside the mask, in the dtype of v_x = V x [..., n].

    Scores and mask may be wider than n; their trailing entries belong to pruned directions. NaN
    propagates through E_k, the kept energy [..., 1]: a row with NaN scores has an empty mask.
    """
    n, dtype = v_x.shape[-1], v_x.dtype
    if n < scores.shape[-1]:
        scores, mask = scores[..., :n], mask[..., :n]
    limit = min(MAX_Z, float(jnp.finfo(dtype).max))
    product = clip(v_x.astype(jnp.float32) * scores, limit)
    return jnp.where(mask, product, 0 * jax.lax.stop_gradient(kept_energy)).astype(dtype)


class BankMethod(Method):
    """Base of methods whose router scores the directions of a bank for each token.

    Parameters: bank.u [R, O], bank.v [I, R], router.w1 [I, H] and the router's other arrays.
    `lorasp_jax.prune` removes directions from the bank only. The router still scores them, after
    the R remaining ones, and their energy is part of E_k.
    """

    score_arrays: ClassVar[tuple[str, ...]]
    """Names of the router's arrays whose last axis indexes the scores."""

    rank: int
    energy_target: float
    alpha: float | None

    def __post_init__(self) -> None:
        super().__post_init__()
        exact_ratio(self.energy_target)
        if self.rank < 1:
            raise ValueError(f"rank must be at least 1, got {self.rank}")

    @property
    def scale(self) -> float:
        """α/R."""
        return 2.0 if self.alpha is None else self.alpha / self.rank

    def down(self, params: Params) -> jax.Array:
        """P = [V, W1]: one matmul projects x onto the bank and into the router's hidden layer."""
        return jnp.concatenate([params["bank"]["v"], params["router"]["w1"]], axis=1)

    def bottleneck_params(self, params: Params) -> Params:
        """The router without W1."""
        return {"router": {name: p for name, p in params["router"].items() if name != "w1"}}

    def up(self, params: Params) -> jax.Array:
        """U."""
        return params["bank"]["u"]

    def shapes(self, initial: Shapes, actual: Shapes) -> Shapes:
        """`initial`, except that the router may score more directions than the bank has left."""
        paths = [f"router/{name}" for name in self.score_arrays]
        num_scores = max([self.rank, *(actual[path][-1] for path in paths if actual.get(path))])
        return initial | {
            path: (*initial[path][:-1], num_scores) for path in paths if path in initial
        }

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """Raise ValueError: the delta depends on the input."""
        del params, kernel
        raise ValueError(
            "LoRA-SP chooses its directions per input and cannot be merged into the kernel; "
            "distill it into a LoRA first"
        )
