"""LoRA-SP's bank of rank-one directions: U [R, O] and V [I, R] of ΔW = U diag(s) V."""

import jax
import jax.numpy as jnp

Bank = dict[str, jax.Array]


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
    """The bank whose scores' energy is that of ΔW: ‖Σ_i s_i u_i v_i‖² = c² Σ_i s_i².

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
