"""The dense reward: that of success, and a potential's discounted difference between two steps.

    reward = success + discount * potential(after) - potential(before)

What is added up to the end of an episode depends on its start alone, so that what is optimal stays
optimal (Ng, Harada and Russell 1999, https://dl.acm.org/doi/10.5555/645528.657613). That asks for

- the learner's own discount, which `envs.make` is given;
- a potential of 0 in terminal states, here a success. Time limits and broken physics end no task:
  the learner bootstraps from the state that they leave, whose potential therefore counts;
- nothing across episodes: a done world earns 0 until it restarts, and a restart earns 0.
"""

import dataclasses
from typing import Literal, get_args

import jax
import jax.numpy as jnp

from envs.state import State

Reward = Literal["sparse", "dense"]
REWARDS: tuple[str, ...] = get_args(Reward)


def potential(stages: dict[str, jax.Array]) -> jax.Array:
    """How far a task has come, 0 to 1: the stages passed and a share of the next one.

    Args:
        stages: share of each that is done, f32 [...] in 0 to 1, first to last. A stage whose share
            is 1 is passed, and with it all before it.
    """
    shares = jnp.stack([*stages.values()])
    before = jnp.arange(len(shares)).reshape(-1, *[1] * (shares.ndim - 1))
    passed = jnp.max(jnp.where(shares >= 1, before + 1, 0), axis=0)
    share = jnp.sum(jnp.where(before == passed, shares, 0.0), axis=0)
    return (passed + share) / len(shares)


def started(state: State, stages: dict[str, jax.Array]) -> State:
    """One world at reset, with the metrics that `earned` gives."""
    zero = jnp.zeros((), jnp.float32)
    return _with_terms(state, stages, zero, zero)


def earned(before: State, after: State, stages: dict[str, jax.Array], discount: float) -> State:
    """One world after a step, with its dense reward and, in its metrics, what that is made of.

    Args:
        before, after: the world before and after the step.
        stages: of the world after it.
        discount: of the learner.
    """
    success = after.info["success"]
    left = jnp.where(success, 0.0, discount * potential(stages))
    shaping = jnp.where(before.done, 0.0, left - before.metrics["potential"])
    return _with_terms(after, stages, (success & ~before.done).astype(jnp.float32), shaping)


def _with_terms(
    state: State, stages: dict[str, jax.Array], success: jax.Array, shaping: jax.Array
) -> State:
    terms = {f"stage_{name}": share for name, share in stages.items()}
    terms |= {"potential": potential(stages), "reward_success": success, "reward_shaping": shaping}
    return dataclasses.replace(state, reward=success + shaping, metrics=state.metrics | terms)
