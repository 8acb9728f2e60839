"""Optimizer and learning-rate schedule."""

from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import optax

from lorasp_jax.config import AuxiliaryConfig, OptimConfig
from lorasp_jax.models.flow_matching import Times
from lorasp_jax.peft import AdaLoRA, Method
from lorasp_jax.peft.auxiliary import AUXILIARY_WEIGHTS


def make_optimizer(
    config: OptimConfig, methods: Collection[Method] = (), fixed: Any = None
) -> optax.GradientTransformation:
    """Create AdamW with gradient clipping and the transformations of the adapter methods.

    The learning rate rises linearly from zero and decays by a cosine to `final_learning_rate`.
    `fixed` are the parameters that stay, from `protect.fixed`, if any do.

    Raises:
        ValueError: AdaLoRA layers, which share one rank budget, have different settings.
    """
    schedule = optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=config.learning_rate,
        warmup_steps=config.warmup_steps,
        decay_steps=max(config.steps, config.warmup_steps + 1),
        end_value=config.final_learning_rate,
    )
    optimizer = optax.adamw(schedule, b2=config.b2, weight_decay=config.weight_decay)
    budgets = {method for method in methods if isinstance(method, AdaLoRA)}
    if len(budgets) > 1:
        raise ValueError(
            "all AdaLoRA layers share one rank budget and must have the same settings, got "
            f"{len(budgets)} different settings"
        )
    for method in dict.fromkeys(methods):
        optimizer = method.transform(optimizer, config.steps)
    optimizer = optax.chain(optax.clip_by_global_norm(config.clip_norm), optimizer)
    return optimizer if fixed is None else _leaving(optimizer, fixed)


def _leaving(optimizer: optax.GradientTransformation, fixed: Any) -> optax.GradientTransformation:
    """Return the optimizer of all but the fixed parameters, which keep every bit.

    The state holds `fixed`, so that the program does not depend on it.
    """

    def init(params: Any) -> Any:
        return jax.tree.map(jnp.array, fixed), optimizer.init(params)

    def update(updates: Any, state: Any, params: Any = None) -> Any:
        kept, state = state
        with_value = lambda value, tree: jax.tree.map(  # noqa: E731
            lambda keep, x: jnp.where(keep, jnp.asarray(value, x.dtype), x), kept, tree
        )
        updates, state = optimizer.update(with_value(0.0, updates), state, params)
        return with_value(-0.0, updates), (kept, state)  # adding +0 would change -0

    return optax.GradientTransformation(init, update)


def flow_times(config: OptimConfig) -> Times:
    """Return how a run samples its flow times."""
    return Times(config.time_shape, config.rtc_max_delay)


def auxiliary_weights(config: AuxiliaryConfig, steps: int) -> dict[str, optax.Schedule]:
    """Return the weight schedule of each auxiliary loss: linear warm-up from zero."""
    warmup_steps = max(round(config.warmup * steps), 1)
    return {
        name: optax.linear_schedule(0.0, getattr(config, name), warmup_steps)
        for name in AUXILIARY_WEIGHTS
    }
