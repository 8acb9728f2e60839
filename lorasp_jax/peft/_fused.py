"""What a method may offer to whoever runs it on a GPU: its `between` as one kernel.

The maths of a method does not need this; `lorasp_jax.peft._together` and layers that are prepared
for inference ask for it.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.low_rank_matmul import Between
from lorasp_jax.peft._aux import Aux


class Fused:
    """`between` of n layers of one method at once; hashable, equal ones do the same."""

    def pack(self, params: Any) -> Any:
        """What `between_all` takes in place of a layer's `middle`: work done once for all calls."""
        return params

    def between_all(
        self, params: Any, read: jax.Array, columns: range, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """`between` of n layers whose rows lie side by side.

        Args:
          params: from `pack`, stacked [n, ...].
          read: [...tokens, C], which holds the rows.
          columns: the first column of each layer's Q.
          token_mask: as for `Method.delta`.

        Returns:
          z of all layers side by side [...tokens, n R], and aux [n, ...] without its token_mask.
        """
        raise NotImplementedError

    def between_each(
        self,
        params: Sequence[Any],
        read: jax.Array,
        widths: Sequence[int],
        token_mask: jax.Array | None,
    ) -> list[tuple[jax.Array, Aux]]:
        """z and aux of each layer, see `BetweenEach`; all widths are the same."""
        count = len(params)
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(self.pack, params))
        z, aux = self.between_all(stacked, read, range(0, sum(widths), widths[0]), token_mask)
        of_each = [jax.tree.map(lambda a, i=i: a[i], aux) for i in range(count)]
        return list(zip(jnp.split(z, count, axis=-1), of_each, strict=True))

    def between(
        self, params: Any, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """`between` of one layer."""
        return self.between_each([params], rows, [rows.shape[-1]], token_mask)[0]


@dataclasses.dataclass(frozen=True)
class Mapped(Fused):
    """The same for a method without a kernel, by `jax.vmap`."""

    method: Between

    def between_all(
        self, params: Any, read: jax.Array, columns: range, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """As `Fused.between_all`."""
        tokens, (n, width) = read.shape[:-1], (len(columns), columns.step)
        rows = read[..., columns.start : columns.stop].reshape(*tokens, n, width)

        def one(params: Any, rows: jax.Array) -> tuple[jax.Array, Aux]:
            return self.method.between(params, rows, token_mask)

        z, aux = jax.vmap(one, in_axes=(0, -2), out_axes=(-2, 0))(params, rows)
        return z.reshape(*tokens, n * z.shape[-1]), aux
