"""The policy imitates its teachers on the states that it reaches itself (DAgger, arXiv 1011.0686).

Its loss is that of imitation, flow matching, on the actions that it would execute. The rest of a
chunk, which nobody has judged, stays as it is.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from lorasp_jax.data.batches import Batch
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


class Lessons(NamedTuple):
    """N policy calls, whose actions are those that the policy should have chosen.

    Attributes:
        valid: `[N]` bool, whether the episode ran.
    """

    chunks: Chunks
    valid: jax.Array


def lessons(found: Experience, teacher: Teacher | None, processor: Processor) -> Lessons:
    """Say what a policy should have done in episodes without noise; without a teacher, the same."""
    chunks, valid = found.chunks, found.at_calls(~found.steps.done)
    if teacher is not None:
        better = teacher.network(found.at_calls(found.steps.state))
        length, slots = better.shape[1], noise.action_slots(processor)
        own = chunks.actions[:, :length]
        actions = chunks.actions.at[:, :length].set(jnp.where(slots, better, own))
        chunks = chunks._replace(actions=actions)
    return Lessons(chunks, valid)


def make_program(
    config: ReinforceConfig,
    graphdef: Any,
    optimizer: optax.GradientTransformation,
    shardings: Learner,
) -> Imitate:
    """Return the jitted scan over gradient steps; `shardings` are those of the state."""
    mesh, executed = shardings.step.mesh, config.evaluation.execute_steps
    weights = {name: getattr(config.auxiliary, name) for name in AUXILIARY_WEIGHTS}
    options = {
        "graphdef": graphdef,
        "optimizer": optimizer,
        "weights": {name: optax.constant_schedule(value) for name, value in weights.items()},
        "parts": config.optim.accumulate,
    }

    def body(
        state: TrainState, rows: tuple[jax.Array, jax.Array], frozen: Frozen, given: Lessons
    ) -> tuple[TrainState, Metrics]:
        index, key = rows
        rows = jax.tree.map(lambda x: x[index], given)
        rows = jax.lax.with_sharding_constraint(rows, meshes.batch_sharding(mesh))
        chunks, slots = rows.chunks, noise.action_slots(frozen.processor)
        judged = (np.arange(chunks.actions.shape[1]) < executed)[:, None] & slots
        mask = jnp.broadcast_to(judged, chunks.actions.shape)
        batch = Batch(
            frozen.processor.encode(chunks.observation, chunks.prompts), chunks.actions, mask
        )
        return train_step(state, frozen.parameters, batch, key, **options)

    def imitate(
        state: Learner, frozen: Frozen, given: Lessons, index: jax.Array, key: jax.Array
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


def order(valid: np.ndarray, steps: int, size: int, key: jax.Array) -> np.ndarray:
    """Return the rows of minibatches `[steps, size]`: all valid ones in turn, in random orders."""
    rng, rows = np.random.default_rng(np.asarray(jax.random.key_data(key))), np.flatnonzero(valid)
    passes = -(-steps * size // len(rows))
    orders = np.concatenate([rng.permutation(rows) for _ in range(passes)])
    return orders[: steps * size].reshape(steps, size)
