"""Real-time chunking: sample a chunk that continues the one that the robot is executing.

While a policy samples a chunk, the robot executes d more actions of the previous one. The new chunk
must agree with them, or the robot jumps when it switches. There are two ways:

- trained, "Training-Time Action Conditioning for Efficient Real-Time Chunking" (arXiv 2512.05964):
  the d actions enter the flow without noise, at flow time 0. It needs a policy that has learned
  this, see `flow_matching.draw`, and costs nothing.
- guided, "Real-Time Execution of Action Chunking Flow Policies" (arXiv 2506.07339): a gradient
  pulls each flow step toward the previous chunk. It works with any flow policy, and costs one
  vector-Jacobian product of the action expert per flow step.

Equations have the numbers of the second paper. Its time τ runs from noise to data, here t = 1 - τ
runs from data to noise, so that its velocity is -v.
"""

from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.models import flow_matching
from lorasp_jax.models.flow_matching import Velocity, first


def sample(
    velocity: Velocity,
    noise: jax.Array,
    *,
    prefix: jax.Array,
    length: jax.Array,
    guidance: float | None,
    num_steps: int,
    slots: jax.Array | None = None,
    overlap: jax.Array | int | None = None,
) -> tuple[jax.Array, Any]:
    """Like `flow_matching.sample`, but continue the previous chunk.

    Args:
        velocity: the velocity model; without guidance, it must accept one time per action.
        noise: `[B, C, A]`.
        prefix: `[B, P, A]`, the previous chunk's remaining actions, P from 1 to C.
        length: d, `[]` or `[B]` int32, number of actions that the robot will have executed before
            it switches to the new chunk, from 0 to P.
        guidance: β, the limit of the guidance weight; None: the policy is trained for prefixes, and
            the result starts with the first d actions of `prefix`.
        num_steps: Euler steps.
        slots: see `flow_matching.loss`.
        overlap: `[]` or `[B]` int32, number of actions in `prefix` that are not padding; None: all.

    Raises:
        ValueError: the prefix does not fit the noise.
    """
    (batch, chunk, dim), size = noise.shape, prefix.shape[1]
    if prefix.shape != (batch, size, dim) or not 1 <= size <= chunk:
        raise ValueError(f"prefix must be ({batch}, 1 to {chunk}, {dim}), got {prefix.shape}")
    previous = jnp.pad(prefix.astype(jnp.float32), ((0, 0), (0, chunk - size), (0, 0)))
    options = {"num_steps": num_steps, "slots": slots}
    if guidance is not None:
        overlap = jnp.asarray(size if overlap is None else overlap)
        weights = soft_mask(jnp.asarray(length), overlap, chunk)[..., None]
        weights = weights if slots is None else jnp.where(slots, weights, 0)
        guided = guided_velocity(velocity, previous, weights, guidance)
        return flow_matching.sample(guided, noise, **options)
    given = first(jnp.asarray(length), chunk)
    conditioned = conditioned_velocity(velocity, previous, given)
    actions, aux = flow_matching.sample(conditioned, noise, **options)
    return jnp.where(given[..., None], previous, actions), aux


def conditioned_velocity(velocity: Velocity, previous: jax.Array, given: jax.Array) -> Velocity:
    """Return the velocity at x_t in which the given actions are those of `previous`, at time 0.

    Args:
        velocity: accepts one time per action.
        previous: `[B, C, A]`.
        given: bool `[C]` or `[B, C]`.
    """

    def conditioned(x_t: jax.Array, flow_time: jax.Array) -> tuple[jax.Array, Any]:
        x_t = jnp.where(given[..., None], previous, x_t)
        return velocity(x_t, jnp.where(given, 0, flow_time[:, None]))

    return conditioned


def guided_velocity(
    velocity: Velocity, previous: jax.Array, weights: jax.Array, limit: float
) -> Velocity:
    """Return the velocity guided toward Y = `previous`, eqs. (2) and (3).

        v - min(β, t / ((1 - t) r^2)) g    with g = (Y - Â)^T diag(W) ∂Â/∂x_t

    Args:
        velocity: v, called with x_t `[B, C, A]` and t `[B]`.
        previous: Y, `[B, C, A]`.
        weights: W, broadcastable to `[B, C, A]`.
        limit: β.
    """

    def guided(x_t: jax.Array, flow_time: jax.Array) -> tuple[jax.Array, Any]:
        t = flow_time[:, None, None]

        def predict(x_t: jax.Array) -> tuple[jax.Array, tuple[jax.Array, Any]]:
            v_t, aux = velocity(x_t, flow_time)
            return x_t - t * v_t, (v_t, aux)  # eq. 3: Â, the chunk at the end of a straight flow

        predicted, vjp, (v_t, aux) = jax.vjp(predict, x_t, has_aux=True)
        (gradient,) = vjp(weights * (previous - predicted))
        return v_t - guidance_weight(t, limit) * gradient, aux

    return guided


def guidance_weight(flow_time: jax.Array, limit: float) -> jax.Array:
    """Compute min(β, t / ((1 - t) r^2)), eq. 2, with r^2 = t^2 / (t^2 + (1 - t)^2), eq. 4."""
    t, tau = flow_time, 1 - flow_time
    return jnp.minimum(limit, (t**2 + tau**2) / (t * tau))  # infinite at t = 1


def soft_mask(length: jax.Array, overlap: jax.Array, chunk: int) -> jax.Array:
    """Compute W `[..., C]`, eq. 5: 1 for the d executed actions, then decaying to 0.

        W_i = c_i (e^(c_i) - 1) / (e - 1)    with c_i = (P - i) / (P - d + 1), for d <= i < P

    Args:
        length: d, `[...]` int.
        overlap: P = H - s, `[...]` int, number of actions that both chunks have.
        chunk: C.
    """
    i, d, overlap = jnp.arange(chunk), length[..., None], jnp.asarray(overlap)[..., None]
    c = (overlap - i) / jnp.maximum(overlap - d + 1, 1)
    decay = jnp.where(i < overlap, c * jnp.expm1(c) / jnp.expm1(1.0), 0)
    return jnp.where(i < d, 1, decay)
