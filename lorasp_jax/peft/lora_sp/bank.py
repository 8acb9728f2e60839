"""LoRA-SP's bank of rank-one directions, U and V of ΔW = U Σ(x) V.

Inputs are rows here, so both are stored transposed: U as u [R, O] and V as v [I, R].
"""

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import exact_ratio
from lorasp_jax.peft._method import Method, Params
from lorasp_jax.peft._validate import Shapes
from lorasp_jax.peft.lora_sp.router import clip

Bank = dict[str, jax.Array]

MAX_Z = 2.0**120
"""Bound to which |z| is clipped, so that a sum over the bank stays below fp32's 2^128."""


def init_bank(key: jax.Array, v: jax.Array, d_out: int, *, normalized: bool) -> Bank:
    """Initialize a bank with V [I, R] and ΔW exactly zero: U = 0, or gain = 0 if normalized.

    Raises:
      ValueError: a normalized bank with R > max(I, O).
    """
    d_in, rank = v.shape
    if not normalized:
        return {"u": jnp.zeros((rank, d_out)), "v": v}
    if rank > max(d_in, d_out):
        raise ValueError(
            f"a normalized bank needs rank <= max(I, O), got rank {rank} for a kernel "
            f"[{d_in}, {d_out}]"
        )
    return {"u": jax.random.normal(key, (rank, d_out)), "v": v, "gain": jnp.zeros(())}


def normalized_bank(bank: Bank) -> Bank:
    """Normalize a bank so that ‖ΔW(x)‖² = c² Σ_i s_i(x)², from which eq. (4) follows.

    The rank-one terms u_i v_i must be orthonormal under the Frobenius inner product, which is
    (u_i · u_j)(v_i · v_j). It suffices that the factor on the wider side of the kernel has
    orthonormal vectors and the other factor unit vectors. All terms share c = gain √O, so that the
    entries of U initially change as fast as in a bank that is not normalized.

    Args:
      bank: u [R, O] and v [I, R], both of full rank, and gain [].

    Returns:
      The normalized u [R, O], scaled by c, and v [I, R].
    """
    u, v = bank["u"], bank["v"]
    if v.shape[0] >= u.shape[1]:
        v, u = _orthonormal(v), u / jnp.linalg.norm(u, axis=1, keepdims=True)
    else:
        v, u = v / jnp.linalg.norm(v, axis=0), _orthonormal(u.T).T
    return {"u": bank["gain"] * u.shape[1] ** 0.5 * u, "v": v}


def _orthonormal(columns: jax.Array) -> jax.Array:
    """Orthonormalize columns [n, R], R <= n. Fix their signs, which LAPACK may flip."""
    orthonormal, triangular = jnp.linalg.qr(columns)
    return orthonormal * jnp.where(jnp.diagonal(triangular) < 0, -1.0, 1.0)


def apply_masked_scores(
    v_x: jax.Array, scores: jax.Array, mask: jax.Array, energy: jax.Array
) -> jax.Array:
    """Eq. (11): Σ(x) V x, zero outside the mask, in the dtype of v_x = V x [..., n].

    Scores and mask may be wider than n; their trailing entries belong to pruned directions. NaN
    propagates through the energy [..., 1], since the mask of a row with NaN scores is empty.
    """
    n, dtype = v_x.shape[-1], v_x.dtype
    if n < scores.shape[-1]:
        scores, mask = scores[..., :n], mask[..., :n]
    limit = min(MAX_Z, float(jnp.finfo(dtype).max))
    product = clip(v_x.astype(jnp.float32) * scores, limit)
    return jnp.where(mask, product, 0 * jax.lax.stop_gradient(energy)).astype(dtype)


class BankMethod(Method):
    """Base of methods whose router scores the directions of a bank for each token.

    Parameters: bank.u [R, O], bank.v [I, R], bank.gain [] if the bank is normalized; router.w1
    [I, H] and the router's other arrays. `lorasp_jax.prune` removes directions from the bank only.
    The router still scores them, after the R remaining ones, and their energy is part of E_k.
    """

    rank: int
    energy_target: float
    alpha: float | None
    normalized_bank: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        exact_ratio(self.energy_target)
        if self.rank < 1:
            raise ValueError(f"rank must be at least 1, got {self.rank}")

    @property
    def scale(self) -> float:
        """α/R."""
        return 2.0 if self.alpha is None else self.alpha / self.rank

    @property
    def score_arrays(self) -> tuple[str, ...]:
        """Names of the router's arrays whose last axis indexes the scores."""
        raise NotImplementedError

    def down(self, params: Params) -> jax.Array:
        """[V, W1]."""
        return jnp.concatenate([self._bank(params)["v"], params["router"]["w1"]], axis=1)

    def bottleneck_params(self, params: Params) -> Params:
        """The router without W1, and everything outside bank and router."""
        router = {name: p for name, p in params["router"].items() if name != "w1"}
        others = {name: p for name, p in params.items() if name not in ("bank", "router")}
        return {"router": router, **others}

    def up(self, params: Params) -> jax.Array:
        """U."""
        return self._bank(params)["u"]

    def _bank(self, params: Params) -> Params:
        return normalized_bank(params["bank"]) if self.normalized_bank else params["bank"]

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
