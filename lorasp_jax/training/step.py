"""The training step: pure functions from state and batch to state and metrics."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx

from lorasp_jax import adaptation
from lorasp_jax.data.batches import Batch
from lorasp_jax.peft import Aux
from lorasp_jax.peft.method import masked_mean

Metrics = dict[str, jax.Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """What changes from step to step; the frozen base is not part of it.

    Attributes:
        step: `[]` int32, optimizer steps taken.
        adapters: trainable part of the model, an `nnx.State` of `AdapterParam`.
        opt_state: state of the optimizer.
    """

    step: jax.Array
    adapters: Any
    opt_state: Any


def init_state(adapters: Any, optimizer: optax.GradientTransformation) -> TrainState:
    """The state before the first step."""
    return TrainState(jnp.zeros((), jnp.int32), adapters, optimizer.init(adapters))


def auxiliary_losses(aux: Any) -> Metrics:
    """Each auxiliary loss averaged over the adapted layers that have it.

    `aux` is any tree of `Aux`; leaves stacked by a scan over depth hold one value a layer.
    """
    layers = [a for a in jax.tree.leaves(aux, is_leaf=lambda a: isinstance(a, Aux))]
    names = sorted({name for layer in layers for name in layer.losses})
    return {
        name: jnp.concatenate(
            [jnp.ravel(layer.losses[name]) for layer in layers if name in layer.losses]
        ).mean()
        for name in names
    }


def active_ranks(aux: dict[str, dict[str, Aux]]) -> Metrics:
    """Active rank averaged over valid tokens, as a mean by tower and as `[L]` by linear map."""
    found: Metrics = {}
    for tower, linears in aux.items():
        ranks = {
            f"active_rank/{tower}/{name}": _layer_ranks(a.active_rank, a.token_mask)
            for name, a in linears.items()
            if a.active_rank is not None
        }
        if ranks:
            found |= {f"active_rank/{tower}": jnp.stack([r.mean() for r in ranks.values()]).mean()}
            found |= ranks
    return found


def _layer_ranks(rank: jax.Array, mask: jax.Array | None) -> jax.Array:
    """`[L]` means over the valid tokens of `[..., B, T]`; L is 1 without leading axes."""
    mask = jnp.ones((), bool) if mask is None else mask
    tokens = (x.reshape(-1, *rank.shape[-2:]) for x in (rank, jnp.broadcast_to(mask, rank.shape)))
    return jax.vmap(masked_mean)(*tokens)


def loss_fn(
    adapters: Any, frozen: Any, graphdef: Any, batch: Batch, key: jax.Array, weights: Metrics
) -> tuple[jax.Array, Metrics]:
    """Eq. 14 of arXiv 2603.07404: flow-matching loss plus weighted auxiliary losses.

    The task loss is the mean over the elements that `batch.action_mask` marks as valid.
    """
    model = nnx.merge(graphdef, adapters, frozen)
    per_element, aux = model.loss(
        key, batch.observation, batch.actions, action_mask=batch.action_mask
    )
    mask = batch.action_mask
    task = jnp.sum(per_element * mask) / jnp.maximum(jnp.sum(mask), 1)
    losses = auxiliary_losses(aux) | adaptation.penalties(model)
    total = task + sum(weights[name] * value for name, value in losses.items())
    return total, {"loss": total, "task": task, **losses, **active_ranks(aux)}


def train_step(
    state: TrainState,
    frozen: Any,
    batch: Batch,
    key: jax.Array,
    *,
    graphdef: Any,
    optimizer: optax.GradientTransformation,
    weights: dict[str, optax.Schedule],
) -> tuple[TrainState, Metrics]:
    """One optimizer step on the global batch; `key` is consumed."""
    now = {name: jnp.asarray(schedule(state.step)) for name, schedule in weights.items()}
    gradient = jax.value_and_grad(loss_fn, has_aux=True)
    (_, metrics), grads = gradient(state.adapters, frozen, graphdef, batch, key, now)
    updates, opt_state = optimizer.update(grads, state.opt_state, state.adapters)
    adapters = optax.apply_updates(state.adapters, updates)
    metrics |= {"grad_norm": optax.tree.norm(grads), "update_norm": optax.tree.norm(updates)}
    return TrainState(state.step + 1, adapters, opt_state), metrics
