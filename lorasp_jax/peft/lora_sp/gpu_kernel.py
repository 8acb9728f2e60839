"""`LoRASP.bottleneck` as a single GPU kernel, for the default router.

Layers with a shared input run in one launch.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import kept_energy, kept_flags
from lorasp_jax.kernels.low_rank_matmul import Bottleneck, Mask
from lorasp_jax.kernels.packing import PackedTree
from lorasp_jax.kernels.rowwise_kernel import rowwise_kernel
from lorasp_jax.peft.auxiliary import Aux
from lorasp_jax.peft.lora_sp.bank import apply_masked_scores
from lorasp_jax.peft.lora_sp.losses import Losses, LossSums, loss_sums
from lorasp_jax.peft.lora_sp.router import router_scores


def supported_size(size: int) -> int:
    """Return the first size from `size` on that Triton's matmuls support: 16, 32, 64, ..."""
    return max(16, 1 << (size - 1).bit_length())


@dataclasses.dataclass(frozen=True)
class FusedBottleneck(Bottleneck):
    """`LoRASP.bottleneck` with router "gelu"."""

    rank: int
    num_scores: int
    """At least `rank`; the scores beyond it belong to pruned directions."""
    hidden_width: int
    energy_target: float
    scale: float
    interpret: bool = False
    """Run the kernels in interpret mode, which is slow but needs no GPU."""

    def pack(self, params: Any) -> Any:
        """Pack the router into one flat array."""
        return PackedTree.of(params["router"])

    def bottleneck(self, params: Any, rows: jax.Array, token_mask: Mask) -> tuple[jax.Array, Aux]:
        """Compute z and aux of a single layer."""
        return self.bottlenecks([params], rows, [rows.shape[-1]], token_mask)[0]

    def bottlenecks(
        self, params: Sequence[Any], projected: jax.Array, widths: Sequence[int], token_mask: Mask
    ) -> list[tuple[jax.Array, Aux]]:
        """Compute z and aux of each layer in one launch. All widths must be equal."""
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(self.pack, params))
        columns = range(0, sum(widths), widths[0])
        z, aux = self.stacked_bottlenecks(stacked, projected, columns, token_mask)
        layer_aux = [jax.tree.map(lambda a, i=i: a[i], aux) for i in range(len(params))]
        return list(zip(jnp.split(z, len(params), axis=-1), layer_aux, strict=True))

    def stacked_bottlenecks(
        self, params: Any, projected: jax.Array, columns: range, token_mask: Mask
    ) -> tuple[jax.Array, Aux]:
        """Compute z and aux of all layers; columns beyond theirs may hold anything."""
        tokens, n = projected.shape[:-1], len(columns)
        valid = jnp.ones(tokens, bool) if token_mask is None else token_mask
        z, sums, statistics = rowwise_kernel(
            _block(self.energy_target, self.scale),
            params,
            projected.reshape(-1, projected.shape[-1]),
            (self.rank, self.hidden_width),
            valid.reshape(-1, 1),
            start=columns.start,
            interpret=self.interpret,
        )
        active_rank, e_k = (column.T.reshape(n, *tokens) for column in statistics)
        aux = Aux(active_rank, e_k, Losses(sums), usage=sums.active)
        return z.reshape(*tokens, z.shape[-1]), aux


@functools.cache
def _block(energy_target: float, scale: float) -> Callable[..., tuple]:
    """Return the same object for the same values, so that layers share traced kernels."""
    return functools.partial(bottleneck_block, energy_target=energy_target, scale=scale)


def bottleneck_block(
    router: dict[str, jax.Array],
    columns: list[jax.Array],
    valid: jax.Array,
    mask: jax.Array | None,
    *,
    energy_target: float,
    scale: float,
) -> tuple[jax.Array, LossSums, jax.Array, list[jax.Array]]:
    """Compute the bottleneck for a block of n rows, inside the kernel.

    Args:
        router: b1 [H], w2 [H, S], b2 [S], with S >= R scores.
        columns: V x [n, R] and x W1 [n, H], of the same dtype.
        valid: bool [n, 1], False for padding.
        mask: int32 [n, S], 0 or 1, the gate's mask without gradient. None in the forward pass,
            which computes it.
        energy_target: η.
        scale: α/R.

    Returns:
        z [n, R], the losses' sums over rows, the mask, and [active rank, kept energy], f32 [n, 1]
        each.
    """
    v_x, hidden = columns
    matmul = _matmul if mask is None else _differentiable_matmul
    scores, logits = router_scores(router, hidden, "gelu", matmul)
    if mask is None:
        mask = kept_flags(scores, energy_target)
        in_bank = jax.lax.broadcasted_iota(jnp.int32, mask.shape, 1) < v_x.shape[1]
        mask &= in_bank.astype(jnp.int32)
    kept = mask.astype(jnp.float32)
    e_k = kept_energy(scores, kept)[:, None]
    scaled, is_kept = (_first(a, v_x.shape[1]) for a in (scale * scores, kept))
    z = apply_masked_scores(v_x, scaled, is_kept != 0, e_k)
    sums = loss_sums(scores, logits, kept, e_k, valid)
    return z, sums, mask, [kept.sum(-1, keepdims=True), e_k]


def _matmul(rows: jax.Array, matrix: jax.Array) -> jax.Array:
    """rows @ matrix, [n, R]. A single row uses a sum: Triton's matmul needs at least 16 rows."""
    return rows @ matrix if len(rows) > 1 else (rows.reshape(-1, 1) * matrix).sum(0)[None]


def _matmul_forward(rows: jax.Array, matrix: jax.Array) -> tuple[jax.Array, tuple]:
    rows = _computed_once(rows)
    return _matmul(rows, matrix), (rows, matrix)


def _matmul_gradient(
    residuals: tuple[jax.Array, jax.Array], d: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the gradients of rows and matrix for the cotangent d [n, R].

    JAX's own gradient of the matrix has the transposed d as its left operand. Triton would compute
    everything that leads to d twice, the second time in the transposed layout.
    """
    rows, matrix = residuals
    if len(rows) > 1:
        return d @ matrix.T, rows.T @ d
    return (d * matrix).sum(1)[None], rows.T * d


_differentiable_matmul = jax.custom_vjp(_matmul)
_differentiable_matmul.defvjp(_matmul_forward, _matmul_gradient)


def _computed_once(x: jax.Array) -> jax.Array:
    """Return x. Triton would compute it for each operand of a matmul, and by each warp.

    It does not look for what to compute again beyond a sum, here of x and zeros.
    """
    x_and_zero = jnp.broadcast_to(x[..., None], (*x.shape, 2))
    last = jax.lax.broadcasted_iota(jnp.int32, x_and_zero.shape, x.ndim)
    return jnp.where(last == 0, x_and_zero, 0).sum(-1)


def _first(x: jax.Array, n: int) -> jax.Array:
    """x[:, :n] for x [b, k n]. Triton cannot slice, so this sums over k with all others zeroed."""
    if x.shape[1] == n:
        return x
    x = x.reshape(len(x), -1, n)
    return jnp.where(jax.lax.broadcasted_iota(jnp.int32, x.shape, 1) == 0, x, 0).sum(1)
