"""LoRA-MoE: E small LoRAs per kernel, mixed per token by a linear router.

    ΔW(x) = (α/R) Σ_i w_i(x) A_i B_i,    p(x) = softmax(x W_g)

"weighted" uses w = p, as in LoRAMoE (Dou et al., arXiv 2312.09979). "top1" keeps only the most
likely expert, as in Switch (Fedus et al., arXiv 2101.03961). Both are baselines of LoRA-SP (arXiv
2603.07404). LoRA-SP's public code has 4 experts of rank 32 in every linear layer, the defaults
here. The router losses are those of Switch and ST-MoE. LoRAMoE's localized balancing needs a type
label for every task; it is omitted here, as in LoRA-SP's code.
"""

import dataclasses
import functools
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp

from lorasp_jax.peft.auxiliary import Aux, masked_mean
from lorasp_jax.peft.lora_sp.router import cast_and_clip
from lorasp_jax.peft.method import Mask, Method, Params, kaiming_uniform


@dataclasses.dataclass(frozen=True)
class LoRAMoE(Method):
    """Mixture of E adapters of rank R each.

    Parameters: lora_a [I, E R], lora_b [E R, O] and router [I, E]: (I + O) E R + I E in total.
    Expert i has columns i R to (i + 1) R of lora_a and the same rows of lora_b.

    Raises:
        ValueError: `experts` or `rank` below 1, an unknown routing or gate gradient, or "switch"
            without "top1".
    """

    down_in_fp32: ClassVar[bool] = True  # the router's logits

    experts: int = 4
    """Number of experts, E."""
    rank: int = 32
    """Rank R of each expert."""
    alpha: float | None = None
    """α of the scale α/R. None: 2 R."""
    routing: Literal["weighted", "top1"] = "weighted"
    """"weighted": all experts, weighted by probability. "top1": each token's most likely expert."""
    gate_gradient: Literal["hard", "switch"] = "hard"
    """For "top1" only. "hard": the chosen expert has weight 1, so the router learns only from its
    own losses, as in LoRA-SP's code. "switch": its weight is p, which passes the task gradient
    on to the router."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.experts < 1 or self.rank < 1:
            raise ValueError(
                f"experts and rank must be at least 1, got {self.experts}, {self.rank}"
            )
        if self.gate_gradient == "switch" and self.routing != "top1":
            raise ValueError(f"gate_gradient 'switch' needs routing 'top1', got {self.routing!r}")

    @property
    def scale(self) -> float:
        """α/R."""
        return 2.0 if self.alpha is None else self.alpha / self.rank

    @property
    def largest_active_rank(self) -> int:
        """R of the chosen expert, or that of all experts."""
        return self.rank * (1 if self.routing == "top1" else self.experts)

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """Initialize A and the router uniformly and B to zero; the delta is exactly zero."""
        width = self.experts * self.rank
        # A and the router share a distribution: draw them together to compile once.
        inputs = kaiming_uniform(key, (d_in, width + self.experts))
        lora_a, router = jnp.split(inputs, [width], axis=1)
        return {"lora_a": lora_a, "lora_b": jnp.zeros((width, d_out)), "router": router}

    def down(self, params: Params) -> jax.Array:
        """[A, W_g]."""
        return jnp.concatenate([params["lora_a"], params["router"]], axis=1)

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: Mask
    ) -> tuple[jax.Array, Aux]:
        """Eq. (2) of the LoRA-SP paper: z = scale · w(x) ⊙ (x A); each w_i scales R columns."""
        del params
        expert_inputs, logits = jnp.split(rows, [self.experts * self.rank], axis=-1)
        logits = cast_and_clip(logits)
        probabilities = softmax(logits)
        columns = jnp.repeat(self.scale * self._weights(probabilities), self.rank, axis=-1)
        z = expert_inputs * columns
        losses = {
            "balance": balance_loss(probabilities, token_mask),
            "z": z_loss(logits, token_mask),
        }
        active_rank = jnp.full(rows.shape[:-1], self.largest_active_rank, jnp.float32)
        return z, Aux(active_rank, None, losses)

    def up(self, params: Params) -> jax.Array:
        """B."""
        return params["lora_b"]

    def _weights(self, probabilities: jax.Array) -> jax.Array:
        """Expert weights w [..., E] from probabilities [..., E]."""
        if self.routing == "weighted":
            return probabilities
        one_hot = _one_hot_argmax(probabilities)
        return one_hot if self.gate_gradient == "hard" else one_hot * probabilities

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """Raise ValueError: the delta depends on the input."""
        del params, kernel
        raise ValueError(
            "LoRA-MoE's delta depends on the input and cannot be merged into the kernel: keep the "
            "adapter separate"
        )


def softmax(logits: jax.Array) -> jax.Array:
    """Softmax of [..., E] over E, expert by expert.

    XLA fuses the reductions of `jax.nn.softmax` into one kernel (jax-ml/jax#39486). With four
    experts, on an H100 with JAX 0.11.2, three of four rows of a policy came out wrong by 5 %.
    """
    columns = [logits[..., i] for i in range(logits.shape[-1])]
    largest = jax.lax.stop_gradient(functools.reduce(jnp.maximum, columns))
    exponentials = [jnp.exp(column - largest) for column in columns]
    return jnp.stack([e / sum(exponentials) for e in exponentials], axis=-1)


def _one_hot_argmax(probabilities: jax.Array) -> jax.Array:
    """One-hot argmax of probabilities [..., E], ties to the lowest index. No gradient."""
    return jax.nn.one_hot(probabilities.argmax(-1), probabilities.shape[-1])


def balance_loss(probabilities: jax.Array, valid: Mask) -> jax.Array:
    """Load-balancing loss, E Σ_i f_i P_i: 1 if all experts are used equally, at most E.

    Fedus et al. (arXiv 2101.03961, eq. 4): f_i is the fraction of valid tokens whose most likely
    expert is i (no gradient), and P_i is the mean of p_i over valid tokens. Both pool the tokens of
    all sequences, unlike in Hugging Face's Switch.

    Args:
        probabilities: the router's softmax, f32 [...tokens, E].

    Returns:
        f32 scalar, 0 if no token is valid.
    """
    mean = jax.vmap(masked_mean, in_axes=(-1, None))
    fractions = mean(_one_hot_argmax(probabilities), valid)
    mean_probabilities = mean(probabilities, valid)
    return len(fractions) * jnp.sum(fractions * mean_probabilities)


def z_loss(logits: jax.Array, valid: Mask) -> jax.Array:
    """Mean of logsumexp(logits)² over the valid tokens; it keeps the logits small.

    As in Zoph et al. (arXiv 2202.08906, eq. 5), with no offset: zero logits give (ln E)².

    Args:
        logits: f32 [...tokens, E].

    Returns:
        f32 scalar, 0 if no token is valid.
    """
    return masked_mean(jnp.square(jax.nn.logsumexp(logits, axis=-1)), valid)
