"""Exploration in the flow (Flow-SDE, arXiv 2510.25889): one of its K Euler steps is stochastic.

Step k leads from x_k, at time t = 1 - k/K, to

    x_{k+1} ~ N(x_k - δ (v + σ²/(2t) ε), δ σ²),   δ = 1/K,   σ² = a² t / max(1 - t, δ),

where v is the velocity, ε = x_k + (1 - t) v the noise that the policy estimates, and a (`level`)
the standard deviation of the first step's noise [normalized action units]. With every step
stochastic and K large, the chunks have the distribution that those of the ODE have. Here each world
draws one step per call, and the others are the ODE's: the probability of a call is that of this
step, and needs one velocity. Only the actions that the robot executes get noise.

Noise in an early step also moves the other actions of its chunk. The update ignores this: it weighs
the noise of an action by the advantage of that action alone, as if the step were the last.
"""

import jax
import jax.numpy as jnp

from lorasp_jax.models import flow_matching
from lorasp_jax.models.flow_matching import Velocity
from lorasp_jax.reinforce.noise import Spread


def spread_of(step: jax.Array, num_steps: int, level: float | jax.Array) -> Spread:
    """Return the distribution of the noise of steps k `[N]` of K; its std is `[N, 1]`."""
    t, rest = _times(step, num_steps)
    return Spread((level * jnp.sqrt(t / (num_steps * rest)))[:, None], 0.0)


def drift(
    x: jax.Array, v: jax.Array, step: jax.Array, num_steps: int, level: float | jax.Array
) -> jax.Array:
    """Return the velocity whose Euler step ends at the mean of x_{k+1}, from x_k and the flow's
    velocity `[N, C, A]` at steps k `[N]` of K."""
    t, rest = (each[:, None, None] for each in _times(step, num_steps))
    return v + jnp.square(level) / (2 * rest) * (x + (1 - t) * v)


def _times(step: jax.Array, num_steps: int) -> tuple[jax.Array, jax.Array]:
    """Return t and max(1 - t, δ) of steps k `[N]`."""
    return 1 - step / num_steps, jnp.maximum(step, 1) / num_steps


def sample(
    key: jax.Array,
    velocity: Velocity,
    noise: jax.Array,
    noisy: jax.Array,
    level: float | jax.Array,
    *,
    num_steps: int,
    slots: jax.Array | None = None,
) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
    """Sample chunks `[W, C, A]`, each with one stochastic step; do not reuse `key`.

    Args:
        key: draws the steps and their noise.
        velocity: of the flow.
        noise: `[W, C, A]` initial noise of the flow.
        noisy: bool broadcastable to `[W, C, A]`: what gets noise; the rest follows the ODE.
        level: a.
        num_steps: K, at least 2.
        slots: see `flow_matching.sample`.

    Returns:
        The chunks, and of their stochastic steps x_k, x_{k+1} `[W, C, A]` and k `[W]` int32.
    """
    step_key, noise_key = jax.random.split(key)
    step = jax.random.randint(step_key, noise.shape[:1], 0, num_steps)
    scales = spread_of(step, num_steps, level).scales(noise.shape[1])
    change = num_steps * scales * jax.random.normal(noise_key, noise.shape)

    def stochastic(x: jax.Array, flow_time: jax.Array) -> tuple[jax.Array, jax.Array]:
        v, _ = velocity(x, flow_time)
        here = jnp.round((1 - flow_time) * num_steps) == step
        moved = drift(x, v, step, num_steps, level) - change
        return jnp.where(here[:, None, None] & noisy, moved, v), x

    chunk, states = flow_matching.sample(stochastic, noise, num_steps=num_steps, slots=slots)
    states, rows = jnp.concatenate([states, chunk[None]]), jnp.arange(len(step))
    return chunk, (states[step, rows], states[step + 1, rows], step)
