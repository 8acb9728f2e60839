"""Runs of the expert."""

import functools
from collections.abc import Iterator

import jax
import numpy as np

import envs
from envs.experts import collection, expert

plan = jax.jit(expert.plan, static_argnums=0)
act = jax.jit(expert.act, static_argnums=0)


def demonstration(
    env: envs.Env, state: envs.State
) -> Iterator[tuple[envs.State, jax.Array, envs.State]]:
    """Yield the worlds before each of the expert's actions, the action, and the worlds after it."""
    planned = plan(env, state, jax.random.key(1))
    for _ in range(env.expert_steps):
        action = act(env, planned, state)
        before, state = state, env.step(state, action)
        yield before, action, state


def expert_success(task, robot, *, num_episodes, num_envs, ranges=None, **options) -> np.ndarray:
    """Return whether the expert solves each of `num_episodes` random layouts, bool `[E]`."""
    env = collection.make_repeatable(task, robot, num_envs=num_envs, **options)
    keys = jax.random.split(jax.random.key(1), num_episodes // num_envs)
    return np.concatenate([_success(env, key, ranges) for key in keys])


@functools.partial(jax.jit, static_argnums=0)
def _success(env, key, ranges):
    return collection.rollout(env, key, ranges=ranges)[-1]
