"""LoRA-SP's bank of rank-one directions: U [R, O] and V [I, R] of ΔW = U Σ(x) V."""

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import exact_ratio
from lorasp_jax.peft._arguments import Shapes
from lorasp_jax.peft._method import Method, Params
from lorasp_jax.peft.lora_sp.router import clipped

Bank = dict[str, jax.Array]

LARGEST_READ = 2.0**120
"""|z| from which on it counts as this much: its sum over a bank has room below 2^128."""


def init_bank(key: jax.Array, v: jax.Array, d_out: int, *, normalized: bool) -> Bank:
    """The bank that starts with V [I, R] and a ΔW of exactly zero: U is zero, or its gain.

    Raises:
      ValueError: a normalised bank with more directions than either side.
    """
    d_in, rank = v.shape
    if not normalized:
        return {"u": jnp.zeros((rank, d_out)), "v": v}
    if rank > max(d_in, d_out):
        raise ValueError(
            f"a normalised bank of {rank} directions needs a kernel with a side of at least that, "
            f"got {d_in} x {d_out}."
        )
    return {"u": jax.random.normal(key, (rank, d_out)), "v": v, "gain": jnp.zeros(())}


def normalized_bank(bank: Bank) -> Bank:
    """The bank for which eq. (4) holds: the scores' energy is that of ΔW, c² Σ_i s_i².

    The rank-one terms u_i v_i are orthonormal in the Frobenius product, which is a product of two,
    (u_i u_j)(v_i v_j): it is enough that one factor is orthonormal, the one on the wider side, and
    the other of unit norm. So c is common to all, gain √O; with it the entries of U start to move
    as fast as those of a bank that is not normalised.

    Args:
      bank: u [R, O] and v [I, R], any of full rank, and gain [].

    Returns:
      u [R, O] and v [I, R] that take their place.
    """
    u, v = bank["u"], bank["v"]
    if v.shape[0] >= u.shape[1]:
        v, u = _orthonormal(v), u / jnp.linalg.norm(u, axis=1, keepdims=True)
    else:
        v, u = v / jnp.linalg.norm(v, axis=0), _orthonormal(u.T).T
    return {"u": bank["gain"] * u.shape[1] ** 0.5 * u, "v": v}


def _orthonormal(columns: jax.Array) -> jax.Array:
    """Gram-Schmidt of columns [n, R], R <= n: smooth, as no sign depends on LAPACK's choice."""
    orthonormal, triangular = jnp.linalg.qr(columns)
    return orthonormal * jnp.where(jnp.diagonal(triangular) < 0, -1.0, 1.0)


def apply_masked_scores(
    projected: jax.Array, scores: jax.Array, mask: jax.Array, energy: jax.Array
) -> jax.Array:
    """Eq. (11): Σ(x) V x with the pruned scores at zero, in the type of `projected` [..., n].

    Scores and mask may be wider; what is beyond n has no direction any more. NaN scores keep no
    direction, and show all the same: a row whose energy [..., 1] is NaN is all NaN.
    """
    here, dtype = projected.shape[-1], projected.dtype
    if here < scores.shape[-1]:
        scores, mask = scores[..., :here], mask[..., :here]
    largest = min(LARGEST_READ, float(jnp.finfo(dtype).max))
    product = clipped(projected.astype(jnp.float32) * scores, largest)
    return jnp.where(mask, product, 0 * jax.lax.stop_gradient(energy)).astype(dtype)


class BankMethod(Method):
    """What methods share whose router weighs the directions of a bank for each token.

    Parameters: bank.u [R, O], bank.v [I, R], bank.gain [] if the bank is normalised; router.w1
    [I, H] and what else the router has. Pruning drops directions from the bank alone: the router
    still scores them, behind the R others, as their energy counts in E_k.
    """

    rank: int
    energy_target: float
    alpha: float | None
    normalized_bank: bool

    def __post_init__(self) -> None:
        """Checks the fields."""
        super().__post_init__()
        exact_ratio(self.energy_target)
        if self.rank < 1:
            raise ValueError(f"rank must be at least 1, got {self.rank}.")

    @property
    def scale(self) -> float:
        """α/R."""
        return 2.0 if self.alpha is None else self.alpha / self.rank

    @property
    def score_arrays(self) -> tuple[str, ...]:
        """Names of the router's arrays whose last axis is that of the scores."""
        raise NotImplementedError

    def down(self, params: Params) -> jax.Array:
        """[V, W1]."""
        return jnp.concatenate([self._bank(params)["v"], params["router"]["w1"]], axis=1)

    def bottleneck_params(self, params: Params) -> Params:
        """The router but for W1, and what is neither bank nor router."""
        router = {name: p for name, p in params["router"].items() if name != "w1"}
        others = {name: p for name, p in params.items() if name not in ("bank", "router")}
        return {"router": router, **others}

    def up(self, params: Params) -> jax.Array:
        """U."""
        return self._bank(params)["u"]

    def _bank(self, params: Params) -> Params:
        return normalized_bank(params["bank"]) if self.normalized_bank else params["bank"]

    def shapes(self, made: Shapes, found: Shapes) -> Shapes:
        """`made`, but for a router that scores more directions than the bank has left."""
        scored = [f"router/{name}" for name in self.score_arrays]
        sides = [found[name][-1] for name in scored if found.get(name)]
        widest = max([self.rank, *sides])
        return made | {name: (*made[name][:-1], widest) for name in scored if name in made}

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """Raises: the delta depends on the input."""
        del params, kernel
        raise ValueError(
            "LoRA-SP chooses its directions per input and cannot be merged into one kernel; "
            "prune it (drop directions that stay inactive) or distill it into a LoRA first."
        )
