"""LoRA-SP as implemented in its public code, which differs from the paper's equations.

Use this method only to compare with results of that code, github.com/dhkim-furiosa/LoRA-SP at
dfbf57d (PyTorch). This is an independent implementation, based only on facts about that code.
Differences from the paper (`lora_sp`):

- Scores may be negative and are ranked by signed value.
- The gate keeps the largest set whose energy does *not exceed* η, and at least one direction, so
  E_k is usually below η.
- The spectral loss is 1 minus the ratio of kept to total energy, both summed over tokens.
- The balance loss is that of Switch Transformer, on a softmax over all scores with the inactive
  ones set to 0.
- The z-loss is ln(1 + lse), where lse is logsumexp(scores) clipped to [-1, 10]. It is -inf at
  lse = -1.

Unlike in the public code, padding is excluded, everything is in fp32, and the router has no dropout
(5 % there) and no hidden layer (`router_projection` there).
"""

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import kept_energy
from lorasp_jax.peft.auxiliary import Aux, masked_mean
from lorasp_jax.peft.lora_sp.bank import BankMethod, apply_masked_scores, init_bank
from lorasp_jax.peft.lora_sp.router import cast_and_clip
from lorasp_jax.peft.method import Mask, Params, kaiming_uniform


@dataclasses.dataclass(frozen=True)
class LoRASPRelease(BankMethod):
    """Adapter with an input-dependent active rank, for comparison with the public code only.

    Parameters: bank.u [R, O], bank.v [I, R], router.w1 [I, R].

    Raises:
        ValueError: a rank below 1, or η outside (0, 1].
    """

    score_arrays: ClassVar[tuple[str, ...]] = ("w1",)

    rank: int = 128
    """R, size of the bank; it may exceed I and O."""
    energy_target: float = 0.9
    """η."""
    alpha: float | None = None
    """α of the scale α/R. None: 2 R."""

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """Initialize V and W1 randomly and U to zero; the delta is zero."""
        v, w1 = jnp.split(kaiming_uniform(key, (d_in, 2 * self.rank)), 2, axis=1)
        return {"bank": init_bank(v, d_out), "router": {"w1": w1}}

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: Mask
    ) -> tuple[jax.Array, Aux]:
        """Compute z = scale Σ(x) V x and aux from the rows x [V, W1]."""
        del params
        valid = jnp.ones(rows.shape[:-1], bool) if token_mask is None else token_mask
        v_x, hidden = jnp.split(rows, [self.rank], axis=-1)
        scores = cast_and_clip(hidden)  # x W1, signed
        mask = release_gate(scores, self.energy_target)
        # Scores after the first R belong to directions that `lorasp_jax.prune` removed.
        mask &= jnp.arange(mask.shape[-1]) < self.rank
        usage = (mask & valid[..., None]).reshape(-1, mask.shape[-1]).astype(jnp.float32).sum(0)
        e_k = kept_energy(scores, mask)
        z = apply_masked_scores(v_x, self.scale * scores, mask, e_k[..., None])
        active_rank = mask.astype(jnp.float32).sum(-1)
        return z, Aux(active_rank, e_k, release_losses(scores, mask, valid), usage=usage)


def release_gate(scores: jax.Array, energy_target: float) -> jax.Array:
    """Keep the k largest scores, for the largest k with E_k <= η, but at least one: bool [..., R].

    Ties go to the lowest index. No gradient.
    """
    constant = jax.lax.stop_gradient(scores)
    order = jnp.argsort(-constant, axis=-1, stable=True)
    energy = jnp.square(jnp.take_along_axis(constant, order, axis=-1))
    keep = jnp.cumsum(energy, axis=-1) <= energy_target * energy.sum(-1, keepdims=True)
    keep |= jnp.arange(scores.shape[-1]) == 0
    return jnp.take_along_axis(keep, jnp.argsort(order, axis=-1), axis=-1)


def release_losses(scores: jax.Array, mask: jax.Array, valid: jax.Array) -> dict[str, jax.Array]:
    """Spectral, balance and z-loss of the public code, f32 scalars over the valid tokens.

    Args:
        scores: f32 [...tokens, R].
        mask: bool [...tokens, R], from `release_gate`.
        valid: bool [...tokens], False for padding.
    """
    mean = functools.partial(masked_mean, mask=valid)
    mean_per_direction = jax.vmap(mean, in_axes=-1)
    energy = jnp.square(scores).sum(-1)
    kept = jnp.square(jnp.where(mask, scores, 0)).sum(-1)
    share = mean(kept) / (mean(energy) + 1e-9)
    gates = jax.nn.softmax(jnp.where(mask, scores, 0))
    top = jax.nn.one_hot(gates.argmax(-1), scores.shape[-1])
    lse = jnp.clip(jax.nn.logsumexp(scores, axis=-1), -1, 10)
    return {
        "spectral": 1 - jnp.clip(share, 0, 1),
        "balance": scores.shape[-1] * jnp.sum(mean_per_direction(top) * mean_per_direction(gates)),
        "z": mean(jnp.log1p(lse)),
    }
