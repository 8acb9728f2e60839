"""LoRA-SP as in the paper (arXiv 2603.07404), in plain JAX. Start reading here.

    y = x W + ΔW(x) x,    ΔW(x) = U Σ(x) V                                        (9)

W is frozen. V projects the input onto R directions; U maps them to the output. For each token, a
small router scores the directions. Only the smallest set that holds a fraction η of the energy (the
squared scores) stays active. `lorasp_jax.peft.lora_sp.method` computes the same result faster.

T: tokens, I: input width, O: output width, R: directions, H: the router's hidden width.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp


def router_scores(router: dict[str, jax.Array], x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eq. (10): scores s(x) >= 0 and the logits before the softplus, both [T, R]."""
    hidden = jax.nn.gelu(x @ router["w1"] + router["b1"])
    logits = hidden @ router["w2"] + router["b2"]
    return jax.nn.softplus(logits), logits


def update(bank: dict[str, jax.Array], x: jax.Array, scores: jax.Array) -> jax.Array:
    """Eq. (11): U Σ(x) V x with Σ(x) = diag(scores), [T, O]."""
    return (scores * (x @ bank["v"])) @ bank["u"]


def energy_gate(scores: jax.Array, energy_target: float) -> tuple[jax.Array, jax.Array]:
    """Eq. (12): keep the k largest scores for the smallest k with E_k(x) >= η.

    Ties go to the lowest index. Returns the mask, bool [T, R] without gradient, and E_k(x), [T].
    """
    energy = scores**2
    order = jnp.argsort(-jax.lax.stop_gradient(energy), axis=-1)
    largest_first = jnp.take_along_axis(energy, order, axis=-1)
    energy_before = jnp.cumsum(largest_first, axis=-1) - largest_first
    keep = energy_before < energy_target * energy.sum(-1, keepdims=True)
    mask = jnp.take_along_axis(keep, jnp.argsort(order, axis=-1), axis=-1)
    return mask, (mask * energy).sum(-1) / energy.sum(-1)


def losses(scores: Any, logits: Any, mask: Any, kept_energy: Any) -> dict[str, jax.Array]:
    """Eq. (13), L_spec = 1 - E_k(x), and the balance and z terms of eq. (14), as token means."""
    frequency = mask.mean(0) / mask.mean(0).sum()  # share of all active directions
    share = jnp.mean(scores**2 / (scores**2).sum(-1, keepdims=True), axis=0)  # share of the energy
    num_directions = scores.shape[-1]
    log_mean_exp = jax.nn.logsumexp(logits, axis=-1) - math.log(num_directions)
    balance = num_directions * jnp.sum(frequency * share)
    z = jnp.mean(log_mean_exp**2)
    return {"spectral": jnp.mean(1 - kept_energy), "balance": balance, "z": z}


def lora_sp(
    params: Any, x: jax.Array, kernel: jax.Array, energy_target: float = 0.9, scale: float = 2.0
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Eqs. (9)-(14): y [T, O] for x [T, I] and W [I, O], and the losses of eqs. (13), (14)."""
    scores, logits = router_scores(params["router"], x)
    mask, kept_energy = energy_gate(scores, energy_target)
    y = x @ jax.lax.stop_gradient(kernel) + scale * update(params["bank"], x, mask * scores)
    return y, losses(scores, logits, mask, kept_energy)
