"""An actor learns which initial noise makes the frozen policy succeed (DSRL, arXiv 2506.15799).

The action is w of `models.noise_actor`, one for each chunk; its probability is exact. Only the
actor learns, from what the policy sees, by proximal policy optimization.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.base import fast_cpu
from lorasp_jax.evaluation.programs import Worlds
from lorasp_jax.models import flow_matching
from lorasp_jax.models.noise_actor import PATH
from lorasp_jax.models.perceptron import moments
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import RawObservation
from lorasp_jax.reinforce import descent, noise, ppo, rollout
from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.reinforce.descent import Descent, Learned
from lorasp_jax.reinforce.learner import Learner
from lorasp_jax.reinforce.rollout import Experience
from lorasp_jax.reinforce.setting import Setting
from lorasp_jax.reinforce.surrogate import Samples
from lorasp_jax.training.guard import Guard, check_step
from lorasp_jax.training.random_streams import RandomStream


class Shifts(NamedTuple):
    """N calls of an actor that explores.

    Attributes:
        seen: `[N, D]` x.
        mean: `[N, A]` m(x).
        chosen: `[N, A]` w.
        effect: `[N]` mean square of what the noise changes in the executed actions [normalized].
    """

    seen: jax.Array
    mean: jax.Array
    chosen: jax.Array
    effect: jax.Array


def iterate(setting: Setting, state: Learner) -> tuple[Learner, dict[str, float]]:
    """Collect and learn once; return the state and the metrics, with the environment `steps`.

    The first iteration measures what normalizes x, and trains only the critic.
    """
    found, critics, values = ppo.experience(setting, state, functools.partial(_collect, setting))
    seen, samples = rollout.joined([_samples(*x) for x in found])
    effects = jnp.concatenate([each.chunks.effect for each, _ in found])
    values["noise_effect"] = float(jnp.sqrt(jnp.mean(effects)))
    actor, guard = state.adapters[PATH].get_value(), state.guard
    learned, more = Learned(actor.network, state.opt_state, state.rate), {"updates": 0}
    if int(state.step):
        learned, guard, more = _improve(setting, state, learned, seen, samples)
    else:
        mean, std = moments(seen, samples.valid[:, 0])
        network = dataclasses.replace(actor.network, mean=mean, std=std)
        learned = learned._replace(network=network)
    leaves = jax.tree.leaves(learned.network)
    state = dataclasses.replace(
        state,
        step=state.step + 1,
        adapters=jax.tree.unflatten(jax.tree.structure(state.adapters), leaves),
        opt_state=learned.opt_state,
        guard=guard,
        critics=critics,
        rate=learned.rate,
    )
    values |= more | {"in_a_row": int(guard.in_a_row)}
    return jax.device_put(state, setting.shardings), values


def _samples(found: Experience, advantages: jax.Array) -> tuple[jax.Array, Samples]:
    """Return x of the calls, and w with the advantage of its first step, given `[T, W]`."""
    shifts: Shifts = found.chunks
    rows = shifts.chosen, found.at_calls(advantages), found.at_calls(~found.steps.done), shifts.mean
    return shifts.seen, Samples(*(x[:, None] for x in rows))


def _improve(
    setting: Setting, state: Learner, learned: Learned, seen: jax.Array, samples: Samples
) -> tuple[Learned, Guard, dict[str, float]]:
    """Return the result of an update, and metrics."""
    config = setting.config
    key = jax.random.fold_in(RandomStream.TRAINING.key(config.seed), int(state.step))
    slots = tuple(setting.frozen.processor.flow_slots.tolist())
    fixed = settings(config), config.online.std, slots
    learned, rows, start_kl = _descend(learned, seen, samples, key, *fixed)
    rows = jax.device_get(rows)
    taken = rows.pop("taken")
    _, guard = check_step(state.guard, rows["loss"].mean(), rows["grad_norm"].mean(), spike=0)
    values = {name: float(x[taken].mean()) for name, x in rows.items()} if taken.any() else {}
    rate = config.optim.learning_rate * float(learned.rate)
    more = {"updates": int(taken.sum()), "start_kl": float(start_kl), "learning_rate": rate}
    return learned, guard, values | more


def settings(config: ReinforceConfig) -> Descent:
    """Return the settings of an update."""
    optim, online = config.optim, config.online
    return Descent(optim.learning_rate, online.epochs, optim.batch_size, online.clip, online.max_kl)


@functools.partial(jax.jit, static_argnums=(4, 5, 6))
def _descend(
    learned: Learned,
    seen: jax.Array,
    samples: Samples,
    key: jax.Array,
    settings: Descent,
    std: float,
    slots: tuple[bool, ...],
) -> tuple[Learned, dict[str, jax.Array], jax.Array]:
    """Return what `descent.improve` does, and the mean divergence from m = 0 after it."""
    spread, mask = noise.Spread(std, 0.0), np.array(slots)
    learned, rows = descent.improve(learned, seen, samples, key, spread, mask, settings)
    mean = learned.network(seen)[:, None]
    kl = noise.divergence(mean, jnp.zeros_like(mean), spread, mask)
    return learned, rows, jnp.mean(kl, where=samples.valid)


def _collect(setting: Setting, task: str, policy: Policy, key: jax.Array) -> Experience:
    """Let the policy act in a task, with noise from the actor; its calls are `Shifts`."""
    env, evaluation = setting.environments[task], setting.config.evaluation
    rows = jnp.asarray(policy.processor.prompts.rows(env.instructions))
    counts = evaluation.denoise_steps, evaluation.execute_steps

    def act(key: jax.Array, worlds: Worlds) -> tuple[jax.Array, Shifts]:
        prompts = rows[worlds.state.info["instruction"]]
        return _explore(worlds.policy, key, worlds.observe(), prompts, *counts)

    ranges = setting.config.ranges
    return rollout.play(env, policy, act, key, execute_steps=counts[1], ranges=ranges)


def explore(
    policy: Policy,
    key: jax.Array,
    observation: RawObservation,
    prompts: jax.Array,
    denoise_steps: int,
    execute_steps: int,
) -> tuple[jax.Array, Shifts]:
    """Return the first actions `[W, S, J+1]` [rad, m] of chunks from w that are drawn, and w."""
    flow_key, shift_key, _ = jax.random.split(key, 3)  # restarts have the last one
    processor, actor = policy.processor, policy.model.noise_actor
    obs = processor.encode(observation, prompts)
    velocity, _ = policy.model.encode(obs)
    flow: Any = {"num_steps": denoise_steps, "slots": jnp.asarray(processor.flow_slots)}
    seen = actor.observe(velocity, obs, **flow)
    mean = actor(seen)
    chosen = mean + actor.std * jax.random.normal(shift_key, mean.shape)
    rest = jax.random.normal(flow_key, (len(mean), actor.chunk, mean.shape[1]))
    chunk, _ = flow_matching.sample(velocity, actor.mixed(chosen, rest), **flow)
    actions = processor.decode(chunk[:, :execute_steps], observation["state"])
    change = chunk - seen.reshape(len(mean), -1, mean.shape[1])[:, 1:]
    executed = change[:, :execute_steps, np.array(processor.action_slots)]
    effect = jnp.mean(jnp.square(executed), axis=(1, 2))
    return actions, Shifts(seen, mean, chosen, effect)


_explore = fast_cpu.jit_policy(explore, static_argnums=(4, 5))
