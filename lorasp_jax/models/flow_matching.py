"""Flow matching (Lipman et al., arXiv 2210.02747) as pi0 uses it: time 1 is noise, time 0 is data.

The pi0 paper (arXiv 2410.24164, section IV) lets time run the other way; this is the convention of
its published code and checkpoints.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

Velocity = Callable[[jax.Array, jax.Array], tuple[jax.Array, Any]]
"""(x_t `[B, C, A]`, flow_time `[B]`) -> (v_t `[B, C, A]`, aux)."""


def sample_time(key: jax.Array, batch: int) -> jax.Array:
    """`[B]` flow times, 0.999 Beta(1.5, 1) + 0.001: more noise than data, never exactly data.

    Beta(a, 1) has the distribution function t^a, so U^(1/a) is an exact draw. `key` is consumed.
    """
    return 0.999 * jax.random.uniform(key, (batch,)) ** (1 / 1.5) + 0.001


def draw(key: jax.Array, actions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Noise `[B, C, A]` f32 and flow times `[B]` for actions `[B, C, A]`; `key` is consumed."""
    noise_key, time_key = jax.random.split(key)
    noise = jax.random.normal(noise_key, actions.shape)
    return noise, sample_time(time_key, actions.shape[0])


def interpolate(
    noise: jax.Array, actions: jax.Array, flow_time: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The point x_t = t noise + (1 - t) actions and its velocity u_t = noise - actions.

    Args:
        noise: `[B, C, A]`.
        actions: `[B, C, A]`.
        flow_time: `[B]`.
    """
    t = flow_time[:, None, None]
    return t * noise + (1 - t) * actions, noise - actions


def loss(
    velocity: Velocity,
    key: jax.Array,
    actions: jax.Array,
    *,
    slots: jax.Array | None = None,
    noise: jax.Array | None = None,
    flow_time: jax.Array | None = None,
) -> tuple[jax.Array, Any]:
    """Squared error (v_t - u_t)^2 of every element in fp32, neither masked nor reduced.

    Args:
        velocity: the model.
        key: consumed for what of `noise` and `flow_time` is not given.
        actions: `[B, C, A]` normalised.
        slots: bool broadcastable to `[B, C, A]`; x_t is held at zero where False, so that what the
            model answers there cannot matter. None: all in use.
        noise: `[B, C, A]` standard normal.
        flow_time: `[B]`.

    Returns:
        `[B, C, A]` f32, and the model's aux.
    """
    actions = actions.astype(jnp.float32)
    if noise is None or flow_time is None:
        drawn = draw(key, actions)
        noise = drawn[0] if noise is None else noise
        flow_time = drawn[1] if flow_time is None else flow_time
    x_t, u_t = interpolate(noise, actions, flow_time)
    v_t, aux = velocity(_hold(x_t, slots), flow_time)
    return jnp.square(v_t.astype(jnp.float32) - u_t), aux


def sample(
    velocity: Velocity, noise: jax.Array, *, num_steps: int, slots: jax.Array | None = None
) -> tuple[jax.Array, Any]:
    """Integrate x from time 1 to 0 with `num_steps` Euler steps, x <- x - v(x, t) / num_steps.

    Args:
        velocity: the model.
        noise: `[B, C, A]` x at time 1.
        num_steps: Euler steps, the k-th at time 1 - k / num_steps.
        slots: as in `loss`.

    Returns:
        `[B, C, A]` f32, and the model's aux with a leading axis of steps.
    """

    def step(x_t: jax.Array, k: jax.Array) -> tuple[jax.Array, Any]:
        flow_time = jnp.full(x_t.shape[:1], 1 - k / num_steps)
        v_t, aux = velocity(x_t, flow_time)
        return _hold(x_t - v_t.astype(jnp.float32) / num_steps, slots), aux

    return jax.lax.scan(step, _hold(noise.astype(jnp.float32), slots), jnp.arange(num_steps))


def _hold(x: jax.Array, slots: jax.Array | None) -> jax.Array:
    return x if slots is None else jnp.where(slots, x, 0)
