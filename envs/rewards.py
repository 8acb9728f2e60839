"""Dense reward: success plus potential-based shaping.

    reward = success + discount * potential(after) - potential(before)

The discounted sum of the shaping terms depends only on the start of an episode, so optimal policies
stay optimal (Ng, Harada and Russell 1999, https://dl.acm.org/doi/10.5555/645528.657613). This needs

- the learner's own discount, passed to `envs.make`;
- a potential of 0 in terminal states. Only success is terminal: after a time limit or broken
  physics, the learner bootstraps from the last state, so its potential counts;
- no shaping across episodes. A done world gets 0 until it restarts, and a restart gets 0.
"""

import dataclasses
from typing import Literal, get_args

import jax
import jax.numpy as jnp

from envs.state import State

Reward = Literal["sparse", "dense"]
REWARDS: tuple[str, ...] = get_args(Reward)


def potential(stages: dict[str, jax.Array]) -> jax.Array:
    """Compute a task's progress: (stages passed + share of the next) / number of stages, in [0, 1].

    Args:
        stages: completed share of each stage, f32 [...] in [0, 1], first to last. A stage with
            share 1 is passed, and so are all before it.
    """
    shares = jnp.stack([*stages.values()])
    before = jnp.arange(len(shares)).reshape(-1, *[1] * (shares.ndim - 1))
    passed = jnp.max(jnp.where(shares >= 1, before + 1, 0), axis=0)
    share = jnp.sum(jnp.where(before == passed, shares, 0.0), axis=0)
    return (passed + share) / len(shares)


def at_reset(state: State, stages: dict[str, jax.Array]) -> State:
    """Add the metrics of `after_step` to one world at reset; its reward is 0."""
    zero = jnp.zeros((), jnp.float32)
    return _with_terms(state, stages, zero, zero)


def after_step(before: State, after: State, stages: dict[str, jax.Array], discount: float) -> State:
    """Give one world its dense reward after a step, with the reward's terms in its metrics.

    `stages` is as in `potential`, after the step.
    """
    success = after.info["success"]
    discounted = jnp.where(success, 0.0, discount * potential(stages))
    shaping = jnp.where(before.done, 0.0, discounted - before.metrics["potential"])
    return _with_terms(after, stages, (success & ~before.done).astype(jnp.float32), shaping)


def _with_terms(
    state: State, stages: dict[str, jax.Array], success: jax.Array, shaping: jax.Array
) -> State:
    terms = {f"stage_{name}": share for name, share in stages.items()}
    terms |= {"potential": potential(stages), "reward_success": success, "reward_shaping": shaping}
    return dataclasses.replace(state, reward=success + shaping, metrics=state.metrics | terms)
