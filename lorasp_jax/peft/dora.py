"""DoRA: LoRA adapts the direction of each kernel column; a trained magnitude sets its length.

Liu et al., arXiv 2402.09353. With V = W + scale A B and a trained magnitude m per output,

    y = x V · m / ‖V‖,

where ‖V‖ holds the L2 norm of each column. m is initialized to ‖W‖, so the layer initially computes
x W. As in Hugging Face PEFT, the gradient treats ‖V‖ as a constant (section 4.3 of the paper), and
the layer's bias is not rescaled.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from lorasp_jax.peft.auxiliary import Aux
from lorasp_jax.peft.lora import LoRA
from lorasp_jax.peft.method import Kernel, Mask, Params


@dataclasses.dataclass(frozen=True)
class DoRA(LoRA):
    """Fixed-rank adapter with a magnitude per output. Fields, scale and initialization are LoRA's.

    Parameters: lora_a [I, R], lora_b [R, O], magnitude [O]: (I + O) R + O in total.

    Raises:
        ValueError: a rank below 1, an unknown initialization, or a dropout outside [0, 1).
    """

    additive: ClassVar[bool] = False
    is_low_rank_sum: ClassVar[bool] = False

    def init(
        self, key: jax.Array, kernel: Kernel, *, statistics: Any = None
    ) -> tuple[Params, Kernel]:
        """Initialize LoRA's parameters, and the magnitude to the norms of the kernel's columns.

        See `Method.init` for the arguments and results.

        Raises:
            ValueError: the kernel has no values, or `LoRA.init` rejects an argument.
        """
        if isinstance(kernel, jax.ShapeDtypeStruct):
            raise ValueError(
                "DoRA's magnitude must be initialized from the kernel's values, got only "
                f"the shape {kernel.shape}"
            )
        params, residual = super().init(key, kernel, statistics=statistics)
        return params | {"magnitude": column_norms(kernel)}, residual

    def apply(
        self, params: Params, x: jax.Array, kernel: jax.Array, *, token_mask: Mask = None
    ) -> tuple[jax.Array, Aux]:
        """Eq. (5): (x W + scale x A B) · m / ‖V‖, [...tokens, O]. The kernel receives no gradient.

        The factor m / ‖V‖ is in fp32: rounding it to bf16 would change a column by up to 0.4 %.
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
    """m / ‖V‖, f32 [O], for magnitude [O] and V [I, O]. V receives no gradient.

    Expanding ‖w + s A b‖² for each column would avoid forming V. It would cost as much, I O R for
    WᵀA, and suffer from cancellation where V is much shorter than W.

    A zero column has no direction to rescale. Its factor is m + 1, which is initially 1, so B can
    learn even from a zero kernel.
    """
    norm = column_norms(jax.lax.stop_gradient(adapted))
    is_zero = norm == 0
    return (magnitude + is_zero) / (norm + is_zero)


def column_norms(kernel: Any) -> jax.Array:
    """L2 norms of the columns of a kernel [I, O], f32 [O]."""
    return jnp.linalg.norm(kernel.astype(jnp.float32), axis=0)
