"""Flow matching (Lipman et al., arXiv 2210.02747) as in pi0: time 1 is noise, time 0 is data.

This is the convention of pi0's code and checkpoints. Time runs the other way in pi0's paper (arXiv
2410.24164, section IV).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

Velocity = Callable[[jax.Array, jax.Array], tuple[jax.Array, Any]]
"""(x_t `[B, C, A]`, flow_time `[B]` or `[B, C]`) -> (v_t `[B, C, A]`, aux)."""


@dataclass(frozen=True)
class Times:
    """The flow times of training.

    Attributes:
        shape: a of 0.999 Beta(a, 1) + 0.001, which excludes 0. Above 1 it favors noise; pi0 has
            1.5. As a grows, a policy of one step tends to the mean of the demonstrated actions.
        max_delay: D of training-time real-time chunking (arXiv 2512.05964). If above 0, the first
            d actions of a chunk have time 0: they are given without noise, as actions that the
            robot already executes while it waits for the rest. d is uniform in 0, ..., D.
    """

    shape: float = 1.5
    max_delay: int = 0


PI0_TIMES = Times()


def sample_time(key: jax.Array, batch: int, shape: float = Times.shape) -> jax.Array:
    """Sample flow times `[B]`; for `shape` see `Times`. Do not reuse `key`.

    Beta(a, 1) has the CDF t^a, so U^(1/a) with uniform U is an exact sample.
    """
    return 0.999 * jax.random.uniform(key, (batch,)) ** (1 / shape) + 0.001


def draw(
    key: jax.Array, actions: jax.Array, times: Times = PI0_TIMES
) -> tuple[jax.Array, jax.Array]:
    """Sample noise `[B, C, A]` f32 and flow times for actions `[B, C, A]`; do not reuse `key`.

    Returns:
        The noise, and times `[B]`, or `[B, C]` if `times.max_delay` is above 0.
    """
    noise_key, time_key = jax.random.split(key)
    noise = jax.random.normal(noise_key, actions.shape)
    time = sample_time(time_key, actions.shape[0], times.shape)
    if not times.max_delay:
        return noise, time
    delay = jax.random.randint(jax.random.fold_in(key, 2), time.shape, 0, times.max_delay + 1)
    return noise, jnp.where(first(delay, actions.shape[1]), 0, time[:, None])


def first(length: jax.Array, chunk: int) -> jax.Array:
    """Mask the first `length` actions of a chunk, bool `[..., C]` for lengths `[...]`."""
    return jnp.arange(chunk) < length[..., None]


def interpolate(
    noise: jax.Array, actions: jax.Array, flow_time: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Compute x_t = t noise + (1 - t) actions and its velocity u_t = noise - actions, `[B, C, A]`.

    t is `[B]`, or `[B, C]` with one time per action.
    """
    t = flow_time[:, None, None] if flow_time.ndim == 1 else flow_time[:, :, None]
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
    """Compute the squared error (v_t - u_t)^2 per element in fp32, without masks or reduction.

    Args:
        velocity: the velocity model.
        key: PRNG key to sample `noise` and `flow_time` if they are not given; do not reuse it.
        actions: `[B, C, A]` normalized.
        slots: bool broadcastable to `[B, C, A]`, False for unused slots, where x_t is zero. None
            uses all slots.
        noise: `[B, C, A]` standard normal.
        flow_time: `[B]`, or `[B, C]` with one time per action.

    Returns:
        `[B, C, A]` f32, and the model's aux.
    """
    actions = actions.astype(jnp.float32)
    if noise is None or flow_time is None:
        drawn_noise, drawn_time = draw(key, actions)
        noise = drawn_noise if noise is None else noise
        flow_time = drawn_time if flow_time is None else flow_time
    x_t, u_t = interpolate(noise, actions, flow_time)
    v_t, aux = velocity(_zero_unused(x_t, slots), flow_time)
    return jnp.square(v_t.astype(jnp.float32) - u_t), aux


def sample(
    velocity: Velocity, noise: jax.Array, *, num_steps: int, slots: jax.Array | None = None
) -> tuple[jax.Array, Any]:
    """Integrate x from time 1 to 0 with `num_steps` Euler steps, x <- x - v(x, t) / num_steps.

    Args:
        velocity: the velocity model.
        noise: `[B, C, A]`, which is x at time 1.
        num_steps: step k is at time 1 - k / num_steps.
        slots: see `loss`.

    Returns:
        `[B, C, A]` f32, and the model's aux with a leading step axis.
    """

    def step(x_t: jax.Array, k: jax.Array) -> tuple[jax.Array, Any]:
        flow_time = jnp.full(x_t.shape[:1], 1 - k / num_steps)
        v_t, aux = velocity(x_t, flow_time)
        return _zero_unused(x_t - v_t.astype(jnp.float32) / num_steps, slots), aux

    x_1 = _zero_unused(noise.astype(jnp.float32), slots)
    return jax.lax.scan(step, x_1, jnp.arange(num_steps))


def _zero_unused(x: jax.Array, slots: jax.Array | None) -> jax.Array:
    return x if slots is None else jnp.where(slots, x, 0)
