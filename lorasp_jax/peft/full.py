"""Full fine-tuning as a method: train the base weights themselves."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from lorasp_jax.peft.auxiliary import Aux
from lorasp_jax.peft.method import Kernel, Mask, Method, Params


@dataclasses.dataclass(frozen=True)
class FullFineTuning(Method):
    """Train the kernel.

    Parameters: {"kernel": [I, O]}. The NNX and Linen wrappers train the layer's own weights, not
    a copy.
    """

    trains_base: ClassVar[bool] = True
    additive: ClassVar[bool] = False
    is_low_rank_sum: ClassVar[bool] = False

    def init(
        self, key: jax.Array, kernel: Kernel, *, statistics: Any = None
    ) -> tuple[Params, Kernel]:
        """Use the kernel itself as the parameter."""
        del key, statistics
        return {"kernel": kernel}, kernel

    def apply(
        self, params: Params, x: jax.Array, kernel: jax.Array, *, token_mask: Mask = None
    ) -> tuple[jax.Array, Aux]:
        """x @ params["kernel"], [...tokens, O]."""
        del kernel
        return x @ params["kernel"].astype(x.dtype), Aux(token_mask=token_mask)

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """The trained kernel in the dtype of `kernel`."""
        return jnp.asarray(params["kernel"], kernel.dtype)
