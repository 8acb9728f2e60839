"""Optimizer and learning-rate schedule."""

import optax

from lorasp_jax.config import AuxiliaryConfig, OptimConfig


def learning_rate(config: OptimConfig) -> optax.Schedule:
    """Linear warm-up from zero, then cosine decay to `final_learning_rate`."""
    return optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=config.learning_rate,
        warmup_steps=config.warmup_steps,
        decay_steps=max(config.steps, config.warmup_steps + 1),
        end_value=config.final_learning_rate,
    )


def make_optimizer(config: OptimConfig) -> optax.GradientTransformation:
    """AdamW on gradients clipped to a global norm."""
    return optax.chain(
        optax.clip_by_global_norm(config.clip_norm),
        optax.adamw(learning_rate(config), b2=config.b2, weight_decay=config.weight_decay),
    )


def auxiliary_weights(config: AuxiliaryConfig, steps: int) -> dict[str, optax.Schedule]:
    """Weight of each auxiliary loss by step: a linear rise over the first `warmup` share."""
    rise = max(round(config.warmup * steps), 1)
    return {
        name: optax.linear_schedule(0.0, weight, rise)
        for name, weight in (
            ("spectral", config.spectral),
            ("balance", config.balance),
            ("z", config.z),
        )
    }
