"""The update of the adapters on the chunks of one iteration."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from lorasp_jax.peft.auxiliary import auxiliary_losses
from lorasp_jax.reinforce import flow_sde, noise, rollout
from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.reinforce.learner import Learner
from lorasp_jax.reinforce.rollout import Chunks
from lorasp_jax.reinforce.surrogate import Samples, adapted, clipped_surrogate
from lorasp_jax.training import compilation
from lorasp_jax.training import guard as guards
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.program import Frozen
from lorasp_jax.training.step import Metrics, active_ranks


class WeightedChunks(NamedTuple):
    """N chunks of C actions.

    Attributes:
        advantages: `[N, C]`, of mean 0 and variance 1.
        valid: `[N, C]` bool, the actions to learn from.
        means: `[N, C, A]` means of the policy that acted.
    """

    chunks: Chunks
    advantages: jax.Array
    valid: jax.Array
    means: jax.Array


Loss = Callable[..., tuple[jax.Array, Metrics]]
"""(adapters, frozen, batch, *, num_valid=None) -> loss and metrics."""


def make_loss(config: ReinforceConfig, graphdef: Any) -> Loss:
    """Return the loss that the config describes."""
    return functools.partial(surrogate_loss, config=config, graphdef=graphdef)


def surrogate_loss(
    adapters: Any,
    frozen: Frozen,
    batch: WeightedChunks,
    *,
    config: ReinforceConfig,
    graphdef: Any,
    num_valid: jax.Array | None = None,
) -> tuple[jax.Array, Metrics]:
    """Return the loss of the adapters, `clipped_surrogate` plus weighted auxiliary losses."""
    mean, aux = means(adapters, frozen, batch.chunks, graphdef, config)
    slots, noisy = noise.action_slots(frozen.processor), spread(config, batch.chunks.step)
    samples = Samples(batch.chunks.actions, batch.advantages, batch.valid, batch.means)
    total, metrics = clipped_surrogate(mean, samples, noisy, slots, config.online.clip, num_valid)
    losses = auxiliary_losses(aux)
    total += sum(getattr(config.auxiliary, name) * value for name, value in losses.items())
    return total, metrics | {"loss": total, **losses, **active_ranks(aux)}


def spread(config: ReinforceConfig, step: jax.Array | None) -> noise.Spread:
    """Return the distribution of the noise of chunks, given their `step`."""
    if step is None:
        return noise.Spread.of(config.online)
    return flow_sde.spread_of(step, config.evaluation.denoise_steps, config.online.noise_level)


def means(
    adapters: Any, frozen: Frozen, chunks: Chunks, graphdef: Any, config: ReinforceConfig
) -> tuple[jax.Array, Any]:
    """Return the means of the actions `[N, C, A]`, and the adapters' aux."""
    model = nnx.merge(graphdef, adapters, frozen.parameters)
    settings = config.evaluation.denoise_steps, config.online.noise_level
    mean, aux = rollout.means(model, frozen.processor, chunks, *settings)
    return mean[:, : chunks.actions.shape[1]], aux


class Programs:
    """The jitted programs of an update. They take indices of chunks, `[n]`.

    The means of the policy that acted are computed as the update computes them, and not where it
    acted: probability ratios are then exactly 1 before the first update.
    """

    def __init__(
        self,
        config: ReinforceConfig,
        graphdef: Any,
        optimizer: optax.GradientTransformation,
        shardings: Learner,
    ) -> None:
        """`shardings` are those of the state."""
        mesh = shardings.step.mesh
        self.config: ReinforceConfig = config
        self._graphdef, self._optimizer, self._mesh = graphdef, optimizer, mesh
        self._gradient_of = jax.grad(make_loss(config, graphdef), has_aux=True)
        options = compilation.step_options(mesh.size)
        self.means: Callable[..., Any] = jax.jit(self._means, compiler_options=options)
        self.update: Callable[..., Any] = jax.jit(
            self._update,
            donate_argnames="state",
            out_shardings=(shardings, meshes.replicated(mesh)),
            compiler_options=options,
        )

    def _parts(self, index: jax.Array) -> jax.Array:
        """Split indices into those of micro-batches."""
        return index.reshape(self.config.optim.accumulate, -1)

    def _take(self, tree: Any, index: jax.Array) -> Any:
        rows = jax.tree.map(lambda x: x[index], tree)
        return jax.lax.with_sharding_constraint(rows, meshes.batch_sharding(self._mesh))

    def _means(self, adapters: Any, frozen: Frozen, chunks: Chunks, index: jax.Array) -> jax.Array:
        def part(index: jax.Array) -> jax.Array:
            rows = self._take(chunks, index)
            return means(adapters, frozen, rows, self._graphdef, self.config)[0]

        found = jax.lax.map(part, self._parts(index))
        return found.reshape(-1, *found.shape[2:])

    def divergence(
        self, mean: jax.Array, other: jax.Array, frozen: Frozen, chunks: Chunks, index: np.ndarray
    ) -> jax.Array:
        """Return the KL divergence of each action `[n, C]` between two means of chunks."""
        noisy = spread(self.config, jax.tree.map(lambda x: x[index], chunks.step))
        return noise.divergence(mean, other, noisy, noise.action_slots(frozen.processor))

    def _gradient(
        self, adapters: Any, frozen: Frozen, batch: WeightedChunks, index: jax.Array
    ) -> tuple[Any, Metrics]:
        """Return gradient and metrics, all valid actions of the micro-batches weighing the same.

        Auxiliary losses and active ranks are means over the micro-batches.
        """
        zeros, parts = jax.tree.map(jnp.zeros_like, adapters), self._parts(index)
        num_valid = jnp.sum(batch.valid[index]) / len(parts)

        def add(total: Any, index: jax.Array) -> tuple[Any, Metrics]:
            rows = self._take(batch, index)
            found, metrics = self._gradient_of(adapters, frozen, rows, num_valid=num_valid)
            return jax.tree.map(jnp.add, total, found), metrics

        total, metrics = jax.lax.scan(add, zeros, parts)
        gradient = jax.tree.map(lambda x: x / len(parts), total)
        return gradient, jax.tree.map(lambda x: x.mean(0), metrics)

    def _update(
        self, state: Learner, frozen: Frozen, batch: WeightedChunks, index: jax.Array
    ) -> tuple[Learner, Metrics]:
        gradient, metrics = self._gradient(state.adapters, frozen, batch, index)
        norm = optax.tree.norm(gradient)
        accept, guard = guards.check_step(state.guard, metrics["loss"], norm, spike=0)
        updates, opt_state = self._optimizer.update(gradient, state.opt_state, state.adapters)
        updates = jax.tree.map(lambda x: state.rate * x, updates)
        adapters = optax.apply_updates(state.adapters, updates)
        after = dataclasses.replace(state, adapters=adapters, opt_state=opt_state, guard=guard)
        before = dataclasses.replace(state, guard=guard)
        within = metrics["kl"] <= self.config.online.max_kl
        metrics |= {"grad_norm": norm, "in_a_row": guard.in_a_row, "within": within}
        return guards.select(accept & within, after, before), metrics


def improve(
    programs: Programs, state: Learner, frozen: Frozen, batch: WeightedChunks, key: jax.Array
) -> tuple[Learner, dict[str, np.ndarray]]:
    """Take gradient steps on minibatches of chunks until the policy has changed enough.

    The means of the chunks are computed first; `key` orders the chunks.

    Returns:
        The state, and the metrics of all steps; none if no action is valid.
    """
    config = programs.config
    size, rows = config.optim.batch_size, []
    useful = np.flatnonzero(np.any(batch.valid & (batch.advantages != 0), axis=1))
    if not len(useful):
        return state, {}
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    length = -(-len(useful) // size) * size
    for index in np.resize(useful, length).reshape(-1, size):
        found = programs.means(state.adapters, frozen, batch.chunks, index)
        batch = batch._replace(means=batch.means.at[index].set(found))
    epochs = [np.resize(rng.permutation(useful), length) for _ in range(config.online.epochs)]
    for index in np.concatenate(epochs).reshape(-1, size):
        state, metrics = programs.update(state, frozen, batch, index)
        rows.append(jax.device_get(metrics))
        if not rows[-1]["within"]:
            break
    taken = rows[-1]["within"] and not rows[-1]["in_a_row"]
    kl = _change(programs, state, frozen, batch, evenly(useful, size)) if taken else np.inf
    rate = adapted(state.rate, kl, config.online.max_kl)
    return dataclasses.replace(state, rate=rate), jax.tree.map(lambda *x: np.stack(x), *rows)


def evenly(rows: np.ndarray, count: int) -> np.ndarray:
    """Return `count` of the rows at equal distances."""
    return rows[np.linspace(0, len(rows) - 1, count).astype(int)]


def _change(
    programs: Programs, state: Learner, frozen: Frozen, batch: WeightedChunks, index: np.ndarray
) -> float:
    """Return the mean KL divergence of the valid actions from the policy that acted."""
    mean = programs.means(state.adapters, frozen, batch.chunks, index)
    kl = programs.divergence(mean, batch.means[index], frozen, batch.chunks, index)
    return float(jnp.mean(kl, where=batch.valid[index]))
