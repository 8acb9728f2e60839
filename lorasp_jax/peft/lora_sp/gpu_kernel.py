"""`LoRASP.bottleneck` as a single GPU kernel, for the default router and gate.

Layers with a shared input run in one launch.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import energy_gate, kept_energy
from lorasp_jax.kernels.packing import PackedTree
from lorasp_jax.kernels.rowwise_kernel import rowwise_kernel
from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._batched_bottleneck import BatchedBottleneck
from lorasp_jax.peft.lora_sp.bank import apply_masked_scores
from lorasp_jax.peft.lora_sp.losses import Losses, LossSums, loss_sums
from lorasp_jax.peft.lora_sp.router import router_scores


@dataclasses.dataclass(frozen=True)
class FusedBottleneck(BatchedBottleneck):
    """`LoRASP.bottleneck` with router "gelu", one mask per token and a constant η."""

    rank: int
    num_scores: int
    """At least `rank`; the scores beyond it belong to pruned directions."""
    hidden_width: int
    energy_target: float
    scale: float
    interpret: bool = False
    """Run the kernels in interpret mode, which is slow but needs no GPU."""

    @property
    def is_supported(self) -> bool:
        """Whether Triton supports the sizes: powers of two, and at least 16 for its matmuls."""
        sizes = self.rank, self.num_scores, self.hidden_width
        return all(size >= 16 and size.bit_count() == 1 for size in sizes)

    def pack(self, params: Any) -> Any:
        """Pack the router into one flat array."""
        return PackedTree.of(params["router"])

    def bottleneck_all(
        self, params: Any, projected: jax.Array, columns: range, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """See `BatchedBottleneck.bottleneck_all`."""
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
        active_rank, energy = (column.T.reshape(n, *tokens) for column in statistics)
        aux = Aux(active_rank, energy, Losses(sums), usage=sums.kept)
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
      mask: bool [n, S], the gate's mask. None in the forward pass, which computes it. No gradient.
      energy_target: η.
      scale: α/R.

    Returns:
      z [n, R], the losses' sums over rows, the mask, and [active rank, kept energy], f32 [n, 1]
      each.
    """
    v_x, hidden = columns
    scores, logits = router_scores(router, hidden, "gelu")
    if mask is None:
        mask = energy_gate(scores, energy_target, implementation="block")[0]
        mask &= jax.lax.broadcasted_iota(jnp.int32, mask.shape, 1) < v_x.shape[1]
    energy = kept_energy(scores, mask)[:, None]
    in_bank = [_first(a, v_x.shape[1]) for a in (scale * scores, mask.astype(jnp.float32))]
    z = apply_masked_scores(v_x, in_bank[0], in_bank[1] != 0, energy)
    active_rank = mask.astype(jnp.float32).sum(-1, keepdims=True)
    return z, loss_sums(scores, logits, mask, energy, valid), mask, [active_rank, energy]


def _first(x: jax.Array, n: int) -> jax.Array:
    """x[:, :n] for x [b, k n]. Triton cannot slice, so this sums over k with all others zeroed."""
    if x.shape[1] == n:
        return x
    x = x.reshape(len(x), -1, n)
    return jnp.where(jax.lax.broadcasted_iota(jnp.int32, x.shape, 1) == 0, x, 0).sum(1)
