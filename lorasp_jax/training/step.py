"""The training step: pure functions from state and batch to state and metrics."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.data.batches import Batch
from lorasp_jax.models import flow_matching
from lorasp_jax.models.flow_matching import PI0_TIMES, Times
from lorasp_jax.peft.auxiliary import Aux, auxiliary_losses, masked_mean
from lorasp_jax.training import guard as guards
from lorasp_jax.training.guard import Guard

Metrics = dict[str, jax.Array]
Objective = Callable[[Any, Any, Batch, jax.Array, jax.Array], tuple[jax.Array, Any]]
"""What a run learns in place of the demonstrated actions, from the policy it starts with.

(model, model at the start, batch, noise `[B, C, A]`, flow time `[B]` or `[B, C]`) -> errors
`[B, C, A]` f32, and the adapters' aux. Equal ones must compare equal."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """Training state, without the frozen base.

    Attributes:
        step: `[]` int32, number of steps taken, including skipped ones.
        adapters: trainable parameters, an `nnx.State` of `AdapterParam`s.
        guard: statistics that decide which steps to skip.
        average: exponential moving average of the adapters, or None.
    """

    step: jax.Array
    adapters: Any
    opt_state: Any
    guard: Guard
    average: Any = None

    @property
    def eval_adapters(self) -> Any:
        """The adapters to evaluate and export: their moving average, if one is kept."""
        return self.adapters if self.average is None else self.average


def init_state(
    adapters: Any, optimizer: optax.GradientTransformation, *, ema: bool = False
) -> TrainState:
    """Return the initial state. It copies the adapters, because steps donate their buffers."""
    adapters = copied(adapters)
    average = copied(adapters) if ema else None
    step = jnp.zeros((), jnp.int32)
    return TrainState(step, adapters, optimizer.init(adapters), Guard.initial(), average)


@jax.jit
def copied(tree: Any) -> Any:
    """Copy the arrays of a tree: one program, where eager copies compile one for each shape."""
    return jax.tree.map(jnp.copy, tree)


def active_ranks(aux: dict[str, dict[str, Aux]]) -> Metrics:
    """Return active ranks averaged over valid tokens.

    Each tower gets a scalar and, per kind of linear layer, an array `[L]` over its layers.
    """
    metrics: Metrics = {}
    for tower, linears in aux.items():
        ranks = {
            f"active_rank/{tower}/{name}": _layer_ranks(a.active_rank, a.token_mask)
            for name, a in linears.items()
            if a.active_rank is not None
        }
        if ranks:
            mean = jnp.stack([rank.mean() for rank in ranks.values()]).mean()
            metrics |= {f"active_rank/{tower}": mean, **ranks}
    return metrics


def _layer_ranks(rank: jax.Array, mask: jax.Array | None) -> jax.Array:
    """Average ranks `[..., B, T]` over valid tokens, giving `[L]`; L is 1 without leading axes."""
    mask = jnp.ones((), bool) if mask is None else mask
    tokens = (x.reshape(-1, *rank.shape[-2:]) for x in (rank, jnp.broadcast_to(mask, rank.shape)))
    return jax.vmap(masked_mean)(*tokens)


def loss_fn(
    adapters: Any,
    frozen: Any,
    graphdef: Any,
    batch: Batch,
    key: jax.Array,
    weights: dict[str, jax.Array],
    *,
    num_valid: jax.Array | None = None,
    noise: jax.Array | None = None,
    flow_time: jax.Array | None = None,
    times: Times = PI0_TIMES,
    objective: Callable[..., Any] | None = None,
) -> tuple[jax.Array, Metrics]:
    """Return the flow-matching loss plus weighted auxiliary losses (arXiv 2603.07404, eq. 14).

    The task loss is the mean over the elements that `batch.action_mask` marks as valid, without
    given actions (see `flow_matching.draw`); `num_valid` overrides their number. `key` seeds the
    adapters' dropout and the sampling of noise and flow time; `noise` and `flow_time` override the
    samples. The metrics include the unweighted auxiliary losses. `objective`, an `Objective` that
    has its second model, replaces the flow-matching loss.
    """
    # with_dropout clones the model, so the merge needs no copy=True. Both uses of the key are safe:
    # with_dropout only folds layer paths into it, and flow_matching.draw splits it once.
    model = adaptation.with_dropout(nnx.merge(graphdef, adapters, frozen), key)
    if flow_time is None:
        drawn, flow_time = flow_matching.draw(key, batch.actions, times)
        noise = drawn if noise is None else noise
    mask = _scored(batch, flow_time)
    num_valid = jnp.sum(mask) if num_valid is None else num_valid
    if objective:
        per_element, aux = objective(model, batch, noise, flow_time)
    else:
        options = {"action_mask": batch.action_mask, "noise": noise, "flow_time": flow_time}
        per_element, aux = model.loss(key, batch.observation, batch.actions, **options)
    task = jnp.sum(per_element * mask) / jnp.maximum(num_valid, 1)
    losses = auxiliary_losses(aux) | adaptation.penalties(model)
    total = task + sum(weights[name] * value for name, value in losses.items())
    return total, {"loss": total, "task": task, **losses, **active_ranks(aux)}


def _scored(batch: Batch, flow_time: jax.Array | None) -> jax.Array:
    """Return the mask `[B, C, A]` of the task loss; times per action are 0 for given actions."""
    if flow_time is None or flow_time.ndim == 1:
        return batch.action_mask
    return batch.action_mask & (flow_time > 0)[..., None]


def gradients(
    adapters: Any,
    frozen: Any,
    graphdef: Any,
    batch: Batch,
    key: jax.Array,
    weights: dict[str, jax.Array],
    parts: int = 1,
    times: Times = PI0_TIMES,
    objective: Callable[..., Any] | None = None,
) -> tuple[Any, Metrics]:
    """Return the gradient and the metrics of `loss_fn`, accumulated over `parts` micro-batches.

    Up to rounding, the task loss is that of the whole batch. Auxiliary losses and active ranks are
    means over the micro-batches. For `times` see `flow_matching.draw`.
    """
    gradient = jax.grad(functools.partial(loss_fn, objective=objective), has_aux=True)
    if parts == 1:
        return gradient(adapters, frozen, graphdef, batch, key, weights, times=times)
    # Row i goes into micro-batch i % parts, so that no row moves to another device.
    split = lambda x: jnp.swapaxes(x.reshape(-1, parts, *x.shape[1:]), 0, 1)  # noqa: E731
    drawn = flow_matching.draw(key, batch.actions, times)
    num_valid = jnp.sum(_scored(batch, drawn[1])) / parts

    def add(total: Any, part: Any) -> tuple[Any, Metrics]:
        rows, (noise, flow_time), part_key = part
        overrides = {"num_valid": num_valid, "noise": noise, "flow_time": flow_time}
        grads, metrics = gradient(adapters, frozen, graphdef, rows, part_key, weights, **overrides)
        return jax.tree.map(jnp.add, total, grads), metrics

    zeros = jax.tree.map(jnp.zeros_like, adapters)
    micro_batches = jax.tree.map(split, (batch, drawn))
    total, metrics = jax.lax.scan(add, zeros, (*micro_batches, jax.random.split(key, parts)))
    mean = lambda tree: jax.tree.map(lambda x: x.mean(0), tree)  # noqa: E731
    return jax.tree.map(lambda x: x / parts, total), mean(metrics)


def train_step(
    state: TrainState,
    frozen: Any,
    batch: Batch,
    key: jax.Array,
    *,
    graphdef: Any,
    optimizer: optax.GradientTransformation,
    weights: dict[str, optax.Schedule],
    parts: int = 1,
    ema: float = 0.0,
    spike: float = 0.0,
    times: Times = PI0_TIMES,
    objective: Callable[..., Any] | None = None,
) -> tuple[TrainState, Metrics]:
    """Take one step on the global batch, split into `parts` micro-batches; do not reuse `key`.

    `ema` is the decay factor of the moving average, if one is kept. A step that `guard.check_step`
    rejects changes only the step count and the guard. For `times` see `flow_matching.draw`, for
    `objective` see `loss_fn`.
    """
    now = {name: jnp.asarray(schedule(state.step)) for name, schedule in weights.items()}
    inputs = state.adapters, frozen, graphdef, batch, key, now
    grads, metrics = gradients(*inputs, parts, times, objective)
    grad_norm = optax.tree.norm(grads)
    accept, guard = guards.check_step(state.guard, metrics["loss"], grad_norm, spike)
    updates, opt_state = optimizer.update(grads, state.opt_state, state.adapters)
    adapters = optax.apply_updates(state.adapters, updates)
    average = state.average
    if average is not None:
        average = optax.incremental_update(adapters, average, 1 - ema)
    metrics |= {
        "grad_norm": grad_norm,
        "update_norm": optax.tree.norm(updates),
        "in_a_row": guard.in_a_row,
    }
    after = TrainState(state.step + 1, adapters, opt_state, guard, average)
    before = dataclasses.replace(state, step=after.step, guard=guard)
    return guards.select(accept, after, before), metrics
