"""LoRA: ΔW = (α/R) A B of fixed rank (Hu et al., arXiv 2106.09685), with rsLoRA scaling on request.

Conventions and initialisation are those of Hugging Face PEFT: A Kaiming-uniform with a = √5, that
is U(±1/√I), B = 0; scale α/R, or α/√R for rsLoRA (Kalajdzievski, arXiv 2312.03732).
"""

import dataclasses

import jax
import jax.numpy as jnp

from lorasp_jax.peft.method import Aux, Method, Params, kaiming_uniform


@dataclasses.dataclass(frozen=True)
class LoRA(Method):
    """Fixed-rank adapter.

    Parameters: lora_a [I, R], lora_b [R, O], (I + O) R numbers.

    Raises:
      ValueError: a rank below 1.
    """

    rank: int = 128
    """R; it may exceed the kernel's sides. 128 is the paper's main baseline."""
    alpha: float | None = None
    """α; None is 2 R, the scale 2 of LoRA-SP's defaults."""
    rank_stabilized: bool = False
    """Scale by α/√R (rsLoRA) instead of α/R."""

    def __post_init__(self) -> None:
        """Checks the rank."""
        if self.rank < 1:
            raise ValueError(f"rank must be at least 1, got {self.rank}.")

    @property
    def scale(self) -> float:
        """α/R, or α/√R when rank-stabilized."""
        alpha = 2 * self.rank if self.alpha is None else self.alpha
        return alpha / (self.rank**0.5 if self.rank_stabilized else self.rank)

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """A uniform, B zero: the delta starts at exactly zero."""
        return {
            "lora_a": kaiming_uniform(key, (d_in, self.rank)),
            "lora_b": jnp.zeros((self.rank, d_out)),
        }

    def project(
        self, params: Params, x: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, jax.Array, Aux]:
        """z = scale x A, u = B; every token uses the whole rank."""
        z = self.scale * (x @ params["lora_a"].astype(x.dtype))
        active_rank = jnp.full(x.shape[:-1], self.rank, jnp.float32)
        return z, params["lora_b"].astype(x.dtype), Aux(active_rank, token_mask=token_mask)

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """W + scale A B, summed in fp32."""
        delta = self.scale * (params["lora_a"] @ params["lora_b"])
        return (kernel.astype(jnp.float32) + delta).astype(kernel.dtype)
