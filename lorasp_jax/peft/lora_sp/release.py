"""The rule of LoRA-SP's public code, which differs from the paper's equations.

For parity with results made by that code, github.com/dhkim-furiosa/LoRA-SP at dfbf57d, PyTorch;
only facts about it are used here. Against the paper (`router`): scores may be negative and are
ranked with their signs; the gate keeps the most directions whose energy stays *within* η, and
always one, so E_k mostly falls short of η; the spectral loss is a ratio of sums over tokens;
balance is Switch's on a softmax over all scores with the pruned ones at 0; the z-loss is ln(1 +
lse), cut to lse in [-1, 10], which is -inf at the lower end.

Unlike there, padding stays out and everything is in fp32.
"""

import functools

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import kept_energy
from lorasp_jax.peft._aux import masked_mean
from lorasp_jax.peft.lora_sp.router import Routed, bounded, select


def release_route(
    router: dict[str, jax.Array],
    columns: list[jax.Array],
    counts: jax.Array,
    *,
    energy_target: float,
    scale: float,
) -> Routed:
    """Everything between the two matrix products with the bank.

    Args:
      router: w2 [H, R], or empty.
      columns: V x [...tokens, n], where n < R once directions were pruned, and W1 x.
      counts: bool [...tokens], False for padding.
      energy_target: η.
      scale: α/R.
    """
    projected, hidden = columns
    scores = release_scores(router, hidden)
    mask = release_gate(scores, energy_target)
    mask &= jnp.arange(mask.shape[-1]) < projected.shape[-1]
    usage = (mask & counts[..., None]).reshape(-1, mask.shape[-1]).astype(jnp.float32).sum(0)
    energy = kept_energy(scores, mask)
    statistics = [mask.astype(jnp.float32).sum(-1), energy]
    z = select(projected, scale * scores, mask, energy[..., None])
    return z, release_losses(scores, mask, counts), usage, statistics


def release_scores(router: dict[str, jax.Array], hidden: jax.Array) -> jax.Array:
    """Signed scores f32 [..., R]: x W1 itself, or softmax(x W1) W2 where there is a w2 [H, R]."""
    hidden = bounded(hidden)
    return jax.nn.softmax(hidden) @ router["w2"] if "w2" in router else hidden


def release_gate(scores: jax.Array, energy_target: float) -> jax.Array:
    """The mask, bool [..., R]: the longest run of the largest scores with E_k <= η, at least one.

    Ties by lowest index. No gradient.
    """
    constant = jax.lax.stop_gradient(scores)
    order = jnp.argsort(-constant, axis=-1, stable=True)
    energy = jnp.square(jnp.take_along_axis(constant, order, axis=-1))
    within = jnp.cumsum(energy, axis=-1) <= energy_target * energy.sum(-1, keepdims=True)
    within |= jnp.arange(scores.shape[-1]) == 0
    return jnp.take_along_axis(within, jnp.argsort(order, axis=-1), axis=-1)


def release_losses(scores: jax.Array, mask: jax.Array, valid: jax.Array) -> dict[str, jax.Array]:
    """Spectral, balance and z of the public code, f32 scalars over the valid tokens.

    Args:
      scores: f32 [...tokens, R].
      mask: bool [...tokens, R], from `release_gate`.
      valid: bool [...tokens], False for padding.
    """
    mean = functools.partial(masked_mean, mask=valid)
    by_direction = jax.vmap(mean, in_axes=-1)
    energy = jnp.square(scores).sum(-1)
    kept = jnp.square(jnp.where(mask, scores, 0)).sum(-1)
    share = mean(kept) / (mean(energy) + 1e-9)
    gates = jax.nn.softmax(jnp.where(mask, scores, 0))
    first = jax.nn.one_hot(gates.argmax(-1), scores.shape[-1])
    size = jnp.clip(jax.nn.logsumexp(scores, axis=-1), -1, 10)
    return {
        "spectral": 1 - jnp.clip(share, 0, 1),
        "balance": scores.shape[-1] * jnp.sum(by_direction(first) * by_direction(gates)),
        "z": mean(jnp.log1p(size)),
    }
