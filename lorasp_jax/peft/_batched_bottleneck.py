"""`Method.bottleneck` of several layers in one call: a fused GPU kernel, or `jax.vmap`.

A method need not provide a fused kernel. `lorasp_jax.peft._shared_input` and layers prepared for
inference make such calls.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.low_rank_matmul import Bottleneck
from lorasp_jax.peft._aux import Aux


class BatchedBottleneck:
    """`bottleneck` of n layers of one method.

    Instances are hashable; equal instances compute the same function.
    """

    def pack(self, params: Any) -> Any:
        """Convert a layer's `bottleneck_params` for `bottleneck_all`, once for many calls."""
        return params

    def bottleneck_all(
        self, params: Any, projected: jax.Array, columns: range, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """Apply `bottleneck` to n layers whose rows are concatenated along the last axis.

        Args:
          params: from `pack`, stacked [n, ...].
          projected: [...tokens, C], which includes x P of all layers.
          columns: range of the layers' start columns; its step is the width Q.
          token_mask: see `Method.delta`.

        Returns:
          z of all layers, concatenated to [...tokens, n R], and aux [n, ...] with token_mask unset.
        """
        raise NotImplementedError

    def bottleneck_each(
        self,
        params: Sequence[Any],
        projected: jax.Array,
        widths: Sequence[int],
        token_mask: jax.Array | None,
    ) -> list[tuple[jax.Array, Aux]]:
        """Return z and aux of each layer; see `BottleneckEach`. All widths must be equal."""
        n = len(params)
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(self.pack, params))
        columns = range(0, sum(widths), widths[0])
        z, aux = self.bottleneck_all(stacked, projected, columns, token_mask)
        layer_aux = [jax.tree.map(lambda a, i=i: a[i], aux) for i in range(n)]
        return list(zip(jnp.split(z, n, axis=-1), layer_aux, strict=True))

    def bottleneck(
        self, params: Any, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """`bottleneck` of a single layer."""
        return self.bottleneck_each([params], rows, [rows.shape[-1]], token_mask)[0]


@dataclasses.dataclass(frozen=True)
class VmapBottleneck(BatchedBottleneck):
    """Fallback for a method without a fused kernel: `jax.vmap` over the layers."""

    method: Bottleneck

    def bottleneck_all(
        self, params: Any, projected: jax.Array, columns: range, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """See `BatchedBottleneck.bottleneck_all`."""
        tokens, (n, width) = projected.shape[:-1], (len(columns), columns.step)
        rows = projected[..., columns.start : columns.stop].reshape(*tokens, n, width)

        def single_layer(params: Any, rows: jax.Array) -> tuple[jax.Array, Aux]:
            return self.method.bottleneck(params, rows, token_mask)

        z, aux = jax.vmap(single_layer, in_axes=(0, -2), out_axes=(-2, 0))(params, rows)
        return z.reshape(*tokens, n * z.shape[-1]), aux
