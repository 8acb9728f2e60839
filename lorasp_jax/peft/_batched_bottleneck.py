"""Compute `Method.bottleneck` of several layers in one call.

Used for layers with a shared input, in training and in models prepared for inference.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.low_rank_matmul import Bottleneck
from lorasp_jax.peft._aux import Aux


class BatchedBottleneck:
    """Computes `bottleneck` of n layers of one method.

    Instances must be hashable, and equal instances must compute the same function.
    """

    def pack(self, params: Any) -> Any:
        """Convert a layer's `bottleneck_params` to the form that `bottleneck_all` expects."""
        return params

    def bottleneck_all(
        self, params: Any, projected: jax.Array, columns: range, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """Apply `bottleneck` to n layers whose rows are concatenated along the last axis.

        Args:
          params: from `pack`, stacked [n, ...].
          projected: [...tokens, C], contains the rows x P of all layers.
          columns: start column of each layer in `projected`. The step is the width Q of x P.
          token_mask: see `Method.delta`.

        Returns:
          z of all layers, concatenated to [...tokens, n R], and their aux, stacked to [n, ...] with
          token_mask unset.
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
        """Apply `Method.bottleneck` of a single layer."""
        return self.bottleneck_each([params], rows, [rows.shape[-1]], token_mask)[0]


@dataclasses.dataclass(frozen=True)
class VmapBottleneck(BatchedBottleneck):
    """Applies `jax.vmap` to the `bottleneck` of a method without a fused kernel."""

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
