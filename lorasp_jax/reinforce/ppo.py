"""The adapters learn from success themselves, by proximal policy optimization."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.policies.policy import Policy
from lorasp_jax.reinforce import critic, rollout, update
from lorasp_jax.reinforce.critic import Critic
from lorasp_jax.reinforce.learner import Learner
from lorasp_jax.reinforce.rollout import Experience
from lorasp_jax.reinforce.setting import Setting
from lorasp_jax.reinforce.update import WeightedChunks
from lorasp_jax.training.random_streams import RandomStream


def iterate(setting: Setting, state: Learner) -> tuple[Learner, dict[str, float]]:
    """Collect and learn once; return the state and the metrics, with the environment `steps`."""
    config, step = setting.config, int(state.step)
    execute = config.evaluation.execute_steps
    found, critics, values = experience(setting, state, setting.collect)
    batches = [_batch(each, advantages, ~each.steps.done, execute) for each, advantages in found]
    batch = rollout.joined(batches)
    key = jax.random.fold_in(RandomStream.TRAINING.key(config.seed), step)
    rows = {}
    if step:  # a critic that has learned nothing only adds noise
        state, rows = update.improve(setting.programs, state, setting.frozen, batch, key)
    valid = np.any(batch.valid, axis=1)
    values |= setting.summary(state, batch.chunks, valid, rows)
    if rows:
        values["learning_rate"] = config.optim.learning_rate * float(state.rate)
    state = dataclasses.replace(state, step=state.step + 1, critics=critics)
    return jax.device_put(state, setting.shardings), values


def experience(
    setting: Setting, state: Learner, collect: Callable[[str, Policy, jax.Array], Experience]
) -> tuple[list[tuple[Experience, jax.Array]], dict[str, Critic], dict[str, float]]:
    """Collect in every task, and let its critic learn.

    Returns:
        Of each task, what was found and its advantages `[T, W]`; the critics; and metrics.
    """
    config, step = setting.config, int(state.step)
    policy = setting.policy(state.adapters).with_sampler()
    parts, critics, values = [], {}, {"steps": 0.0}
    for task in setting.environments:
        key = jax.random.fold_in(RandomStream.ROLLOUTS.key(config.seed, task), step)
        found = collect(task, policy, key)
        own = jax.random.fold_in(key, RandomStream.CRITIC)  # the rollout has split the key
        inputs = state.critics[task], found.steps, found.last, own, config.online
        advantages, critics[task], metrics = critic.jitted_learn(*inputs)
        values |= {f"{name}/{task}": float(x) for name, x in metrics.items()}
        parts.append((found, advantages))
        values[f"rollout/{task}"] = float(jnp.mean(found.success))
        values["steps"] += float(jnp.sum(~found.steps.done))
    return parts, critics, values


def _batch(
    found: Experience, advantages: jax.Array, valid: jax.Array, execute_steps: int
) -> WeightedChunks:
    """Arrange steps `[calls x S, W]` as chunks `[calls x W, C]`; the rest is invalid."""
    rest = found.chunks.actions.shape[1] - execute_steps

    def arrange(x: jax.Array) -> jax.Array:
        return jnp.pad(rollout.by_call(x, execute_steps), ((0, 0), (0, rest)))

    means = jnp.zeros_like(found.chunks.actions)
    return WeightedChunks(found.chunks, arrange(advantages), arrange(valid), means)
