"""The update: proximal policy optimization of the adapters on the chunks of one iteration."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from lorasp_jax.peft.auxiliary import auxiliary_losses
from lorasp_jax.reinforce import noise
from lorasp_jax.reinforce.config import Learning
from lorasp_jax.reinforce.critic import Critic
from lorasp_jax.reinforce.rollout import Chunks
from lorasp_jax.training import compilation
from lorasp_jax.training import guard as guards
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.guard import Guard
from lorasp_jax.training.program import Frozen
from lorasp_jax.training.step import Metrics, active_ranks


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Learner:
    """What a run saves and resumes from.

    Attributes:
        step: `[]` int32, number of iterations.
        adapters: trainable parameters, an `nnx.State`.
        guard: statistics that decide which updates to skip.
        critics: by task; empty without critics.
    """

    step: jax.Array
    adapters: Any
    opt_state: Any
    guard: Guard
    critics: dict[str, Critic]


class Batch(NamedTuple):
    """N chunks, of which S actions each were executed.

    Attributes:
        means: `[N, S, A]` means of the policy that acted.
        advantages: `[N, S]`, of mean 0 and variance 1.
        valid: `[N, S]` bool, False after the end of an episode.
    """

    chunks: Chunks
    means: jax.Array
    advantages: jax.Array
    valid: jax.Array


def surrogate(ratio: jax.Array, advantages: jax.Array, clip: float) -> jax.Array:
    """Return PPO's clipped objective (arXiv 1707.06347, eq. 7), which is to rise."""
    return jnp.minimum(ratio * advantages, jnp.clip(ratio, 1 - clip, 1 + clip) * advantages)


def loss_fn(
    adapters: Any,
    frozen: Frozen,
    graphdef: Any,
    batch: Batch,
    learning: Learning,
    denoise_steps: int,
    weights: dict[str, float],
) -> tuple[jax.Array, Metrics]:
    """Return the loss over the executed actions, with one probability ratio per action."""
    mean, aux = _means(adapters, frozen, graphdef, batch.chunks, denoise_steps)
    slots, std = noise.action_slots(frozen.processor), learning.std
    new, old = (noise.log_prob(x, batch.chunks.actions, std, slots) for x in (mean, batch.means))
    ratio = jnp.exp(new - old)
    average = lambda x: jnp.sum(x * batch.valid) / jnp.maximum(jnp.sum(batch.valid), 1)  # noqa: E731
    policy = -average(surrogate(ratio, batch.advantages, learning.clip))
    losses = auxiliary_losses(aux)
    total = policy + sum(weights[name] * value for name, value in losses.items())
    metrics = {
        "loss": total,
        "kl": average(noise.divergence(mean, batch.means, std, slots)),
        "clipped": average(jnp.abs(ratio - 1) > learning.clip),
        "ratio": average(ratio),
        **losses,
        **active_ranks(aux),
    }
    return total, metrics


def _means(
    adapters: Any, frozen: Frozen, graphdef: Any, chunks: Chunks, denoise_steps: int
) -> tuple[jax.Array, Any]:
    """Return the means of the executed actions `[N, S, A]`, and the adapters' aux."""
    model = nnx.merge(graphdef, adapters, frozen.parameters)
    inputs = chunks.observation, chunks.prompts, chunks.noise
    mean, aux = noise.means(model, frozen.processor, *inputs, denoise_steps)
    return mean[:, : chunks.actions.shape[1]], aux


class Programs:
    """The jitted programs of an update. All take indices of chunks, `[n]`.

    The means of the policy that acted are computed as the update computes them, and not where it
    acted: probability ratios are then exactly 1 before the first update.
    """

    def __init__(
        self,
        graphdef: Any,
        optimizer: optax.GradientTransformation,
        learning: Learning,
        denoise_steps: int,
        weights: dict[str, float],
        spike: float,
        shardings: Learner,
    ) -> None:
        """`shardings` are those of the state; `spike` as in `guard.check_step`."""
        mesh = shardings.step.mesh
        rows = meshes.batch_sharding(mesh)
        take = lambda tree, index: jax.lax.with_sharding_constraint(  # noqa: E731
            jax.tree.map(lambda x: x[index], tree), rows
        )

        def means(adapters: Any, frozen: Frozen, chunks: Chunks, index: jax.Array) -> jax.Array:
            return _means(adapters, frozen, graphdef, take(chunks, index), denoise_steps)[0]

        def update(
            state: Learner, frozen: Frozen, batch: Batch, index: jax.Array
        ) -> tuple[Learner, Metrics]:
            options = (frozen, graphdef, take(batch, index), learning, denoise_steps, weights)
            gradient, metrics = jax.grad(loss_fn, has_aux=True)(state.adapters, *options)
            norm = optax.tree.norm(gradient)
            accept, guard = guards.check_step(state.guard, metrics["loss"], norm, spike)
            updates, opt_state = optimizer.update(gradient, state.opt_state, state.adapters)
            adapters = optax.apply_updates(state.adapters, updates)
            after = dataclasses.replace(state, adapters=adapters, opt_state=opt_state, guard=guard)
            before = dataclasses.replace(state, guard=guard)
            within = metrics["kl"] <= learning.max_kl
            metrics |= {"grad_norm": norm, "in_a_row": guard.in_a_row, "within": within}
            return guards.select(accept & within, after, before), metrics

        options = compilation.step_options(mesh.size)
        self.means: Callable = jax.jit(means, compiler_options=options)
        self.update: Callable = jax.jit(
            update,
            donate_argnames="state",
            out_shardings=(shardings, meshes.replicated(mesh)),
            compiler_options=options,
        )


def improve(
    programs: Programs,
    state: Learner,
    frozen: Frozen,
    batch: Batch,
    rng: np.random.Generator,
    size: int,
    epochs: int,
) -> tuple[Learner, Batch, dict[str, np.ndarray]]:
    """Take gradient steps on minibatches of chunks until the policy has changed enough.

    Args:
        batch: chunks with any means.
        rng: orders the chunks.
        size: chunks per gradient step.
        epochs: most passes over the chunks.

    Returns:
        The state, the batch with the means of the policy that acted, and the metrics of all steps.
    """
    # Finished worlds idle, and equal advantages of 0 teach nothing.
    useful = np.flatnonzero(np.any(batch.valid & (batch.advantages != 0), axis=1))
    if not len(useful):
        return state, batch, {}
    padded = np.resize(useful, -(-len(useful) // size) * size)
    means = batch.means
    for index in padded.reshape(-1, size):
        found = programs.means(state.adapters, frozen, batch.chunks, index)
        means = means.at[index].set(found)
    batch, rows = batch._replace(means=means), []
    for _ in range(epochs):
        order = np.resize(rng.permutation(useful), len(padded))
        for index in order.reshape(-1, size):
            state, metrics = programs.update(state, frozen, batch, index)
            rows.append(jax.device_get(metrics))
            if not rows[-1]["within"]:
                return state, batch, _stack(rows)
    return state, batch, _stack(rows)


def _stack(rows: list[Metrics]) -> dict[str, np.ndarray]:
    return jax.tree.map(lambda *x: np.stack(x), *rows)
