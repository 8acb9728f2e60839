"""The policy imitates its teachers on the states that it reaches itself (DAgger, arXiv 1011.0686).

Its loss is that of imitation, flow matching, on the actions that it executes. The rest of a chunk,
which nobody has judged, does not count.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from lorasp_jax.data.batches import Batch
from lorasp_jax.models.perceptron import Network
from lorasp_jax.peft.auxiliary import AUXILIARY_WEIGHTS
from lorasp_jax.policies.processor import Processor
from lorasp_jax.reinforce import noise
from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.reinforce.learner import Learner
from lorasp_jax.reinforce.rollout import Chunks, Experience
from lorasp_jax.reinforce.teacher import Teacher
from lorasp_jax.training import compilation
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.program import Frozen
from lorasp_jax.training.step import Metrics, TrainState, train_step

Imitate = Callable[..., tuple[Learner, Metrics]]
"""(state, frozen, lessons, index `[steps, B]`, key) -> state and metrics of all steps."""


def lessons(found: Experience, teacher: Teacher | None, processor: Processor) -> Chunks:
    """Return what a policy should have done in episodes without noise.

    Without a teacher, that is what it did.
    """
    chunks = found.chunks
    if teacher is None:
        return chunks
    actions = _corrected(found, teacher.network, noise.action_slots(processor))
    return chunks._replace(actions=actions)


@jax.jit
def _corrected(found: Experience, network: Network, slots: np.ndarray) -> jax.Array:
    """Return the chunks' actions, with those of a teacher where they are executed."""
    better = network(found.at_calls(found.steps.state))
    own, length = found.chunks.actions, better.shape[1]
    return own.at[:, :length].set(jnp.where(slots, better, own[:, :length]))


def make_program(
    config: ReinforceConfig,
    graphdef: Any,
    optimizer: optax.GradientTransformation,
    shardings: Learner,
) -> Imitate:
    """Return the jitted scan over gradient steps; `shardings` are those of the state."""
    mesh = shardings.step.mesh
    weights = {name: getattr(config.auxiliary, name) for name in AUXILIARY_WEIGHTS}
    options = {
        "graphdef": graphdef,
        "optimizer": optimizer,
        "weights": {name: optax.constant_schedule(value) for name, value in weights.items()},
        "parts": config.optim.accumulate,
    }

    def body(
        state: TrainState, rows: tuple[jax.Array, jax.Array], frozen: Frozen, given: Chunks
    ) -> tuple[TrainState, Metrics]:
        index, key = rows
        chunks = jax.tree.map(lambda x: x[index], given)
        chunks = jax.lax.with_sharding_constraint(chunks, meshes.batch_sharding(mesh))
        executed = np.arange(chunks.actions.shape[1]) < config.evaluation.execute_steps
        mask = executed[:, None] & frozen.processor.flow_slots
        mask = jnp.broadcast_to(mask, chunks.actions.shape)
        observation = frozen.processor.encode(chunks.observation, chunks.prompts)
        batch = Batch(observation, chunks.actions, mask)
        return train_step(state, frozen.parameters, batch, key, **options)

    def imitate(
        state: Learner, frozen: Frozen, given: Chunks, index: jax.Array, key: jax.Array
    ) -> tuple[Learner, Metrics]:
        first = TrainState(state.step, state.adapters, state.opt_state, state.guard)
        rows = index, jax.random.split(key, len(index))
        last, metrics = jax.lax.scan(lambda x, row: body(x, row, frozen, given), first, rows)
        learned = {name: getattr(last, name) for name in ("adapters", "opt_state", "guard")}
        return dataclasses.replace(state, **learned), metrics

    return jax.jit(
        imitate,
        donate_argnames="state",
        out_shardings=(shardings, meshes.replicated(mesh)),
        compiler_options=compilation.step_options(mesh.size),
    )


def order(count: int, steps: int, size: int, key: jax.Array) -> np.ndarray:
    """Return the rows of minibatches `[steps, size]`: all rows in turn, in random orders."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    orders = [rng.permutation(count) for _ in range(-(-steps * size // count))]
    return np.concatenate(orders)[: steps * size].reshape(steps, size)
