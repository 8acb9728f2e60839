"""LoRA-MoE: E small LoRAs per kernel, mixed per token by a linear router.

    ΔW(x) = (α/R) Σ_i w_i(x) A_i B_i,    p(x) = softmax(x W_g)

"weighted" takes w = p, as LoRAMoE (Dou et al., arXiv 2312.09979); "top1" keeps the likeliest expert
alone, as Switch (Fedus et al., arXiv 2101.03961). Both are baselines of LoRA-SP (arXiv 2603.07404),
whose released code has 4 experts of rank 32 in every linear layer; those are the defaults here.
The router losses are Switch's and ST-MoE's; LoRAMoE's localised balancing, which needs the
type of each task, is left out as in that code.
"""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp

from lorasp_jax.peft._aux import Aux, masked_mean
from lorasp_jax.peft._method import Method, Params, kaiming_uniform
from lorasp_jax.peft.lora_sp.router import bounded


@dataclasses.dataclass(frozen=True)
class LoRAMoE(Method):
    """Mixture of E adapters of rank R each.

    Parameters: lora_a [I, E R], lora_b [E R, O], expert i in columns (rows) i R to (i + 1) R, and
    router [I, E]: (I + O) E R + I E numbers.

    Raises:
      ValueError: a count or rank below 1, an unknown routing or gate gradient, or "switch" without
        "top1".
    """

    experts: int = 4
    """E."""
    rank: int = 32
    """R of each expert."""
    alpha: float | None = None
    """α of the scale α/R; None is 2 R."""
    routing: Literal["weighted", "top1"] = "weighted"
    """"weighted": all experts by their probabilities. "top1": for each token its likeliest one."""
    gate_gradient: Literal["hard", "switch"] = "hard"
    """Only for "top1". "hard": the chosen expert counts 1, so the router learns from its losses
    alone, as in LoRA-SP's code. "switch": it counts p, through which the task's gradient comes."""

    def __post_init__(self) -> None:
        """Checks the fields."""
        super().__post_init__()
        if self.experts < 1 or self.rank < 1:
            raise ValueError(
                f"experts and rank must be at least 1, got {self.experts}, {self.rank}."
            )
        if self.gate_gradient == "switch" and self.routing != "top1":
            raise ValueError(f"gate_gradient 'switch' needs routing 'top1', got {self.routing!r}.")

    @property
    def down_in_fp32(self) -> bool:
        """True: the router's logits are sums in fp32."""
        return True

    @property
    def scale(self) -> float:
        """α/R."""
        return 2.0 if self.alpha is None else self.alpha / self.rank

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """A and the router uniform, B zero: the delta starts at exactly zero."""
        width = self.experts * self.rank
        # A and the router both read x and share one distribution: one draw, which compiles once.
        inputs = kaiming_uniform(key, (d_in, width + self.experts))
        lora_a, router = jnp.split(inputs, [width], axis=1)
        return {"lora_a": lora_a, "lora_b": jnp.zeros((width, d_out)), "router": router}

    def down(self, params: Params) -> jax.Array:
        """[A, W_g]."""
        return jnp.concatenate([params["lora_a"], params["router"]], axis=1)

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """Eq. (2) of LoRA-SP's paper: z = scale w(x) x A, a weight for each expert's R columns."""
        del params
        projected, logits = jnp.split(rows, [self.experts * self.rank], axis=-1)
        logits = bounded(logits)
        probabilities = jax.nn.softmax(logits)
        columns = jnp.repeat(self.scale * self._weights(probabilities), self.rank, axis=-1)
        z = projected * columns
        active = self.rank * (1 if self.routing == "top1" else self.experts)
        losses = {
            "balance": balance_loss(probabilities, token_mask),
            "z": z_loss(logits, token_mask),
        }
        return z, Aux(jnp.full(rows.shape[:-1], active, jnp.float32), None, losses)

    def up(self, params: Params) -> jax.Array:
        """B."""
        return params["lora_b"]

    def _weights(self, probabilities: jax.Array) -> jax.Array:
        """w [..., E] of probabilities [..., E]."""
        if self.routing == "weighted":
            return probabilities
        chosen = _chosen(probabilities)
        return chosen if self.gate_gradient == "hard" else chosen * probabilities

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """Raises: the delta depends on the input."""
        del params, kernel
        raise ValueError(
            "LoRA-MoE's delta depends on the input and cannot be merged into one kernel: keep its "
            "adapter beside the base."
        )


def _chosen(probabilities: jax.Array) -> jax.Array:
    """1 at the largest of probabilities [..., E], the first if several are; it has no gradient."""
    return jax.nn.one_hot(probabilities.argmax(-1), probabilities.shape[-1])


def balance_loss(probabilities: jax.Array, valid: jax.Array | None) -> jax.Array:
    """Load balancing, E Σ_i f_i P_i: 1 where all experts are used alike, at most E.

    Fedus et al. (arXiv 2101.03961, eq. 4): f_i is the fraction of valid tokens whose likeliest
    expert is i (no gradient), P_i the mean of p_i over valid tokens. All valid tokens are pooled,
    as in the paper; Hugging Face's Switch averages one such loss per sequence instead.

    Args:
      probabilities: the router's softmax, f32 [...tokens, E].
      valid: bool [...tokens], False for padding; None means all are valid.

    Returns:
      f32 scalar, 0 without valid tokens.
    """
    mean = jax.vmap(masked_mean, in_axes=(-1, None))
    fractions, shares = mean(_chosen(probabilities), valid), mean(probabilities, valid)
    return len(shares) * jnp.sum(fractions * shares)


def z_loss(logits: jax.Array, valid: jax.Array | None) -> jax.Array:
    """Mean of logsumexp(logits)² over the valid tokens, which keeps logits small.

    Zoph et al. (arXiv 2202.08906, eq. 5), with the ln E that zero logits give.

    Args:
      logits: f32 [...tokens, E].
      valid: bool [...tokens], False for padding; None means all are valid.

    Returns:
      f32 scalar, 0 without valid tokens.
    """
    return masked_mean(jnp.square(jax.nn.logsumexp(logits, axis=-1)), valid)
