"""DoRA: a kernel's direction is adapted by LoRA, its columns' lengths on their own.

Liu et al., arXiv 2402.09353. With V = W + scale A B and a trained magnitude m per output,

    y = x V · m / ‖V‖,

‖V‖ being V's L2 norms over the input dimension, one per output. m starts as ‖W‖, so the map starts
as x W. The norm is a constant to the gradient (section 4.3 of the paper); the layer's bias is added
outside and not rescaled. Both are as in Hugging Face PEFT.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._method import Kernel, Params
from lorasp_jax.peft.lora import LoRA


@dataclasses.dataclass(frozen=True)
class DoRA(LoRA):
    """Fixed-rank adapter with a magnitude per output; fields, scale and initialisation of LoRA.

    Parameters: lora_a [I, R], lora_b [R, O], magnitude [O], (I + O) R + O numbers.

    Raises:
      ValueError: a rank below 1.
    """

    additive: ClassVar[bool] = False

    def init(
        self, key: jax.Array, kernel: Kernel, *, statistics: Any = None
    ) -> tuple[Params, Kernel]:
        """LoRA's parameters, and the norms of the kernel's columns as the magnitude.

        Arguments and results as for `Method.init`, but the kernel's values are read.

        Raises:
          ValueError: the kernel is not a matrix, or is a shape without values.
        """
        if isinstance(kernel, jax.ShapeDtypeStruct):
            raise ValueError(
                "DoRA starts from the norms of the kernel and so needs its values, got only "
                f"the shape {kernel.shape}."
            )
        params, rest = super().init(key, kernel, statistics=statistics)
        return params | {"magnitude": norms(kernel)}, rest

    def apply(
        self,
        params: Params,
        x: jax.Array,
        kernel: jax.Array,
        *,
        token_mask: jax.Array | None = None,
    ) -> tuple[jax.Array, Aux]:
        """Eq. (5): (x W + scale x A B) · m / ‖V‖, [...tokens, O]; no gradient reaches the kernel.

        The factor is applied in fp32: in bf16 it would be off by up to 0.4 % for a whole column.
        """
        y, aux = super().apply(params, x, kernel, token_mask=token_mask)
        factor = column_factor(params["magnitude"], self._adapted(params, kernel))
        return (y * factor).astype(x.dtype), aux

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """V · m / ‖V‖, computed in fp32."""
        adapted = self._adapted(params, kernel)
        return (adapted * column_factor(params["magnitude"], adapted)).astype(kernel.dtype)

    def _adapted(self, params: Params, kernel: jax.Array) -> jax.Array:
        """V = W + scale A B, f32 [I, O]."""
        return super().merge(params, kernel.astype(jnp.float32))


def column_factor(magnitude: jax.Array, adapted: jax.Array) -> jax.Array:
    """m / ‖V‖, f32 [O], for magnitude [O] and V [I, O], which is a constant to the gradient.

    V is formed to take its norms. ‖w‖² + 2 s (wᵀA) b + s² bᵀ(AᵀA) b for a column w + s A b would
    spare that, but costs as much, I O R for WᵀA, and cancels where V is much shorter than W.

    A column of zeros has no direction to rescale: its factor is 1 with m = 0, as it starts in a
    kernel of zeros, so that B can learn.
    """
    norm = norms(jax.lax.stop_gradient(adapted))
    empty = norm == 0
    return (magnitude + empty) / (norm + empty)


def norms(kernel: Any) -> jax.Array:
    """L2 norms over the input dimension of a kernel [I, O], f32 [O]."""
    return jnp.linalg.norm(kernel.astype(jnp.float32), axis=0)
