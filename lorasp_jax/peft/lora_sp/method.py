"""LoRA-SP, Select-Prune (arXiv 2603.07404): a wide bank of rank-one directions, pruned per token.

A small router scores the R directions of a bank for each token. Only the smallest set whose squared
scores reach a fraction η of their sum stays active. `reference` implements the paper in sixty
lines. `LoRASP.bottleneck` computes the same result faster, from these functions:

    (10) scores       s(x) = router(x) >= 0                           `router.router_scores`
    (12) energy gate  smallest k with E_k(x) >= η                     `energy_gate`
    (11) update       ΔW(x) x = U Σ(x) V x: first Σ(x) V x            `bank.apply_masked_scores`
                      then U                                          `low_rank_matmul`
    (13) spectral     L_spec(x) = 1 - E_k(x)                          `losses.spectral_loss`
    (14) router       L_router: balance and z                         `balance_loss`, `z_loss`

The paper leaves the activation, initialization, scale and form of the router losses open. The
choices here are our own, documented where they are made.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import default_implementation, energy_gate, kept_energy
from lorasp_jax.kernels.low_rank_matmul import Bottleneck, Mask
from lorasp_jax.peft.auxiliary import Aux
from lorasp_jax.peft.lora_sp.bank import BankMethod, apply_masked_scores, init_bank
from lorasp_jax.peft.lora_sp.gpu_kernel import FusedBottleneck, supported_size
from lorasp_jax.peft.lora_sp.losses import Losses, loss_sums
from lorasp_jax.peft.lora_sp.router import RouterKind, init_output_layer, router_scores
from lorasp_jax.peft.method import Params, kaiming_uniform


@dataclasses.dataclass(frozen=True)
class LoRASP(BankMethod):
    """Adapter with an input-dependent active rank.

    Parameters: bank.u [R, O], bank.v [I, R]; router.w1 [I, H], w2 [H, R] and, unless the router is
    "softmax", b1 [H], b2 [R]. In total R (I + O) + H (I + R), plus H + R for the biases.

    Raises:
        ValueError: a rank or width below 1, or η outside (0, 1].
    """

    score_arrays: ClassVar[tuple[str, ...]] = ("w2", "b2")

    rank: int = 128
    """R, size of the bank; it may exceed I and O (128 throughout the paper)."""
    energy_target: float = 0.9
    """η, interpreted as an exact decimal fraction."""
    alpha: float | None = None
    """α of the scale α/R. None: 2 R."""
    hidden_width: int = 32
    """H, width of the router's hidden layer."""
    router: RouterKind = "gelu"
    """"gelu": GELU hidden layer with biases, softplus scores that are initially 1. "gelu_relu": the
    same with ReLU scores. "gelu_softmax": the same with R times the softmax over directions.
    "softmax": softmax hidden layer, no biases, 0/1 matrix as initial second layer (Table I)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hidden_width < 1:
            raise ValueError(f"hidden_width must be at least 1, got {self.hidden_width}")

    @classmethod
    def paper(cls, *, rank: int = 128, energy_target: float = 0.9) -> "LoRASP":
        """Configuration with the parameter count of Table I: router "softmax" of hidden width 4.

        The paper does not state the width; only 4 reproduces both percentages of the table.
        """
        return cls(rank=rank, energy_target=energy_target, hidden_width=4, router="softmax")

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """Initialize V and the router randomly and U to zero; the delta is zero."""
        input_key, score_key = jax.random.split(key)
        # V and W1 share a distribution: draw them together to compile once.
        inputs = kaiming_uniform(input_key, (d_in, self.rank + self.hidden_width))
        v, w1 = jnp.split(inputs, [self.rank], axis=1)
        output_layer = init_output_layer(score_key, self.router, self.hidden_width, self.rank)
        return {"bank": init_bank(v, d_out), "router": {"w1": w1, **output_layer}}

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: Mask
    ) -> tuple[jax.Array, Aux]:
        """Compute z = scale Σ(x) V x of eq. (9), and aux, from the rows x [V, W1]."""
        tokens = rows.shape[:-1]
        valid = jnp.ones(tokens, bool) if token_mask is None else token_mask
        v_x, hidden = jnp.split(rows.reshape(-1, rows.shape[-1]), [self.rank], axis=1)
        scores, logits = router_scores(params["router"], hidden, self.router)
        mask, _, _ = energy_gate(scores, self.energy_target)
        if scores.shape[-1] > self.rank:  # the others' directions were removed by pruning
            mask &= jnp.arange(scores.shape[-1]) < self.rank
        e_k = kept_energy(scores, mask)[:, None]
        z = apply_masked_scores(v_x, self.scale * scores, mask, e_k)
        sums = loss_sums(scores, logits, mask, e_k, valid.reshape(-1, 1))
        active_rank = mask.astype(jnp.float32).sum(-1).reshape(tokens)
        aux = Aux(active_rank, e_k.reshape(tokens), Losses(sums), usage=sums.active)
        return z.reshape(*tokens, self.rank), aux

    def implementation(self, params: Params) -> Bottleneck:
        """A fused kernel on an NVIDIA GPU, for the default router and sizes that it supports."""
        num_scores = params["router"]["w2"].shape[-1]
        if self.router != "gelu" or default_implementation(num_scores) != "pallas":
            return self
        sizes = self.rank, num_scores, self.hidden_width
        if any(size != supported_size(size) for size in sizes):
            return self
        return FusedBottleneck(*sizes, self.energy_target, self.scale)
