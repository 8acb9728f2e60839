"""`LoRASP.bottleneck` as a single GPU kernel, for the default router and gate.

Layers with a shared input run in one launch.
"""

import dataclasses
import functools
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
    hidden_width: int
    energy_target: float
    scale: float
    interpret: bool = False
    """Run the kernels in interpret mode, which is slow but needs no GPU."""

    @property
    def is_supported(self) -> bool:
        """Whether Triton supports the sizes: powers of two, and at least 16 for its matmuls."""
        sizes = self.rank, self.hidden_width
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
            functools.partial(bottleneck_block, energy_target=self.energy_target, scale=self.scale),
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
      router: b1 [H], w2 [H, R], b2 [R].
      columns: V x [n, R] and x W1 [n, H], of the same dtype.
      valid: bool [n, 1], False for padding.
      mask: bool [n, R], the gate's mask. None in the forward pass, which computes it. No gradient.
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
    energy = kept_energy(scores, mask)[:, None]
    z = apply_masked_scores(v_x, scale * scores, mask, energy)
    active_rank = mask.astype(jnp.float32).sum(-1, keepdims=True)
    return z, loss_sums(scores, logits, mask, energy, valid), mask, [active_rank, energy]
