"""LoRA-SP as the paper writes it (arXiv 2603.07404), in plain JAX: read this first.

    y = x W + ΔW(x) x,    ΔW(x) = U Σ(x) V

W is frozen. V reads R directions from the input and U writes them to the output. Per token, a small
router scores the directions, and only the fewest that hold a share η of the energy stay active.
`lorasp_jax.peft.lora_sp.method` computes the same, faster; a test holds it to this file.

T tokens, I inputs, O outputs, R directions, H the router's hidden width.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp


def router_scores(router: dict[str, jax.Array], x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eq. (10): s(x) >= 0, one score per direction. Returns scores and logits, both [T, R]."""
    hidden = jax.nn.gelu(x @ router["w1"] + router["b1"])
    logits = hidden @ router["w2"] + router["b2"]
    return jax.nn.softplus(logits), logits


def energy_gate(scores: jax.Array, energy_target: float) -> jax.Array:
    """Eq. (12): keep the k largest scores, k the smallest with E_k(x) >= η. Mask, bool [T, R]."""
    energy = jax.lax.stop_gradient(scores) ** 2
    order = jnp.argsort(-energy, axis=-1)
    largest_first = jnp.take_along_axis(energy, order, axis=-1)
    energy_before = jnp.cumsum(largest_first, axis=-1) - largest_first
    keep = energy_before < energy_target * energy.sum(-1, keepdims=True)
    rank_of = jnp.argsort(order, axis=-1)
    return jnp.take_along_axis(keep, rank_of, axis=-1)


def kept_energy(scores: jax.Array, mask: jax.Array) -> jax.Array:
    """E_k(x): the kept directions' share of the energy, [T]."""
    return (mask * scores**2).sum(-1) / (scores**2).sum(-1)


def update(
    bank: dict[str, jax.Array], x: jax.Array, scores: jax.Array, mask: jax.Array, scale: float
) -> jax.Array:
    """Eq. (11): U Σ(x) V x, where Σ(x) holds the kept scores and zeros. [T, O]."""
    return (scale * mask * scores * (x @ bank["v"])) @ bank["u"]


def spectral_loss(scores: jax.Array, mask: jax.Array) -> jax.Array:
    """Eq. (13): the energy that was pruned, 1 - E_k(x), averaged over tokens."""
    return jnp.mean(1 - kept_energy(scores, mask))


def balance_loss(scores: jax.Array, mask: jax.Array) -> jax.Array:
    """Eq. (14), balance: R Σ_i f_i P_i, with f_i how often direction i is kept, P_i its energy."""
    frequency = mask.mean(0) / mask.mean(0).sum()
    share = jnp.mean(scores**2 / (scores**2).sum(-1, keepdims=True), axis=0)
    return scores.shape[-1] * jnp.sum(frequency * share)


def z_loss(logits: jax.Array) -> jax.Array:
    """Eq. (14), z: (logsumexp(logits) - ln R)², averaged over tokens."""
    return jnp.mean((jax.nn.logsumexp(logits, axis=-1) - math.log(logits.shape[-1])) ** 2)


def lora_sp(
    params: dict[str, Any], x: jax.Array, energy_target: float = 0.9, scale: float = 2.0
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The whole adapter: ΔW(x) x [T, O] for x [T, I], and the three losses."""
    scores, logits = router_scores(params["router"], x)
    mask = energy_gate(scores, energy_target)
    delta = update(params["bank"], x, scores, mask, scale)
    losses = {"spectral": spectral_loss(scores, mask), "balance": balance_loss(scores, mask)}
    return delta, {**losses, "z": z_loss(logits)}
