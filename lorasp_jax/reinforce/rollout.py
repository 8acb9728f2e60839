"""Episodes to learn from, in which the policy or another actor explores."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs import traced
from envs.env import Env
from envs.scene.ranges import Randomization
from envs.state import State
from lorasp_jax.base import fast_cpu
from lorasp_jax.evaluation.programs import Worlds
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.transformer.layers import ModelAux, merge_action_aux
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor, RawObservation
from lorasp_jax.reinforce import flow_sde, noise
from lorasp_jax.reinforce.noise import Spread
from lorasp_jax.training.distributed import mesh as meshes


class Chunks(NamedTuple):
    """What the policy saw and did in N policy calls.

    Attributes:
        observation: from `env.observe`, images in uint8.
        prompts: `[N]` int32, rows of the policy's prompt table.
        noise: `[N, C, A]` initial noise of the flow, or x_k of `flow_sde`.
        actions: `[N, C, A]` normalized actions: S that were executed, with noise, and the rest of
            the sampler's chunk; or x_{k+1} of `flow_sde`.
        step: `[N]` int32 k of `flow_sde`; None: the noise is that of `noise`.
    """

    observation: RawObservation
    prompts: jax.Array
    noise: jax.Array
    actions: jax.Array
    step: jax.Array | None = None


class Transitions(NamedTuple):
    """T control steps in W worlds.

    Attributes:
        state: `[T, W, D]` full state of the simulator before the step, and the elapsed share of the
            time limit.
        done: `[T, W]` bool, whether the episode was over before the step.
        ended: `[T, W]` bool, whether it was over after it.
        success: `[T, W]` bool, whether it had succeeded.
        reward: `[T, W]`.
    """

    state: jax.Array
    done: jax.Array
    ended: jax.Array
    success: jax.Array
    reward: jax.Array


class Experience(NamedTuple):
    """W worlds until the time limit of their first episodes; finished ones restart meanwhile.

    Attributes:
        chunks: what the actor says of its calls, N = calls x W, in this order.
        steps: T = calls x S. A world idles until the next call when its episode is over.
        last: `[W, D]` the last full state, as in `Transitions`.
        success: `[W]` bool, of the first episodes.
    """

    chunks: Any
    steps: Transitions
    last: jax.Array
    success: jax.Array

    def at_calls(self, x: jax.Array) -> jax.Array:
        """Return rows `[N, ...]` of the first step of each call, from `[T, W, ...]`."""
        calls = len(jax.tree.leaves(self.chunks)[0]) // x.shape[1]
        return x[:: len(x) // calls].reshape(-1, *x.shape[2:])


Actor = Callable[[jax.Array, Worlds], tuple[jax.Array, Any]]
"""(key, worlds) -> actions `[W, S, J+1]` [rad, m], and what it says of the call, rows `[W]`."""


def collect(
    env: Env,
    policy: Policy,
    key: jax.Array,
    spread: Spread,
    *,
    execute_steps: int,
    denoise_steps: int,
    sde: bool = False,
    ranges: Randomization | None = None,
) -> Experience:
    """Let a policy act, with noise; its calls are `Chunks`. For the arguments see `play`.

    Args:
        spread: distribution of the noise.
        denoise_steps: Euler steps.
        sde: whether the noise is that of `flow_sde`, at the level `spread.std`.
    """
    rows = jnp.asarray(policy.processor.prompts.rows(env.instructions))
    spread = Spread(*map(jnp.float32, spread))

    def act(key: jax.Array, worlds: Worlds) -> tuple[jax.Array, Chunks]:
        prompts = rows[worlds.state.info["instruction"]]
        inputs = key, worlds.observe(), prompts, spread, denoise_steps, execute_steps, sde
        return _explore(worlds.policy, *inputs)

    return play(env, policy, act, key, execute_steps=execute_steps, ranges=ranges)


def play(
    env: Env,
    policy: Policy,
    act: Actor,
    key: jax.Array,
    *,
    execute_steps: int,
    ranges: Randomization | None = None,
) -> Experience:
    """Act in every world until the time limit.

    Args:
        env: W worlds.
        policy: on one device, or sharded over a mesh, which then shares the worlds, too.
        act: who acts.
        key: determines layouts, start poses, instructions and noise.
        execute_steps: S, actions of a call.
        ranges: as in `env.reset`.
    """
    worlds, chunks, steps = Worlds(env, policy, key, ranges), [], []
    worlds.state = _over_devices(worlds.state, policy)
    for call in range(-(-env.max_steps // execute_steps)):
        now = jax.random.fold_in(worlds.sample_key, call)
        if call:
            worlds.state = _restart(env, worlds.state, now, ranges)
        actions, chunk = act(now, worlds)
        worlds.state, step = _act(env, worlds.state, actions)
        chunks.append(chunk)
        steps.append(Transitions(**step))
    return _experience(chunks, steps, full_state(env, worlds.state))


@jax.jit
def joined(parts: Sequence[Any]) -> Any:
    """Concatenate trees of arrays: one program, where eager calls compile one for each shape."""
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *parts)


@jax.jit
def _experience(chunks: Sequence[Any], parts: Sequence[Transitions], last: jax.Array) -> Experience:
    steps = joined(parts)
    end = jnp.argmax(steps.ended, axis=0)
    success = jnp.take_along_axis(steps.success, end[None], axis=0)[0]
    return Experience(joined(chunks), steps, last, success)


def _over_devices(tree: Any, policy: Policy) -> Any:
    """Spread worlds over the devices of the policy, if there are several."""
    sharding = jax.tree.leaves(policy.model)[0].sharding
    if len(sharding.device_set) == 1:
        return tree
    return jax.device_put(tree, meshes.batch_sharding(sharding.mesh))


def explore(
    policy: Policy,
    key: jax.Array,
    observation: RawObservation,
    prompts: jax.Array,
    spread: Spread,
    denoise_steps: int,
    execute_steps: int,
    sde: bool = False,
) -> tuple[jax.Array, Chunks]:
    """Return noisy actions `[W, S, J+1]` [rad, m] of the next chunks, and the chunks."""
    flow_key, action_key, _ = jax.random.split(key, 3)
    processor, config = policy.processor, policy.model.config
    initial = jax.random.normal(flow_key, (len(prompts), config.chunk, config.action_dim))
    flow = {"num_steps": denoise_steps, "slots": jnp.asarray(processor.flow_slots)}
    obs, slots = processor.encode(observation, prompts), noise.action_slots(processor)
    if sde:
        noisy = (np.arange(config.chunk) < execute_steps)[:, None] & slots
        inputs = policy.model.encode(obs)[0], initial, noisy, spread.std
        chunk, taken = flow_sde.sample(action_key, *inputs, **flow)
        actions, chunks = chunk[:, :execute_steps], Chunks(observation, prompts, *taken)
    else:
        mean = policy.model.sample_actions(None, obs, noise=initial, **flow)
        actions = noise.explore(action_key, mean[:, :execute_steps], spread, slots)
        whole = jnp.concatenate([actions, mean[:, execute_steps:]], axis=1)
        chunks = Chunks(observation, prompts, initial, whole)
    return processor.decode(actions, observation["state"]), chunks


_explore = fast_cpu.jit_policy(explore, static_argnums=(5, 6, 7))


def means(
    model: Backbone, processor: Processor, chunks: Chunks, num_steps: int, level: float
) -> tuple[jax.Array, ModelAux]:
    """Return the means of the actions `[N, C, A]` of chunks, differentiable, and the adapters' aux.

    They are what `sample_actions` returns, up to rounding, or the means of x_{k+1} of `flow_sde`
    where there is noise. `model` is the adapted one, not its sampler.
    """
    obs = processor.encode(chunks.observation, chunks.prompts)
    prefix, aux = model.run_prefix(obs)
    x, step = chunks.noise, chunks.step
    if step is None:
        flow = {"num_steps": num_steps, "slots": jnp.asarray(processor.flow_slots)}
        mean, action_aux = model.run_flow(prefix, obs, x, **flow)
    else:
        v, action_aux = model.run_suffix(prefix, obs, x, 1 - step / num_steps)
        mean = x - flow_sde.drift(x, v, step, num_steps, level) / num_steps
    return mean, merge_action_aux(aux, action_aux)


@functools.partial(traced.cached, files=(__file__,))
def _restart(env: Env, state: State, key: jax.Array, ranges: Randomization | None) -> State:
    return env.reset_done(state, jax.random.split(key, 3)[2], ranges)  # `explore` has the others


@functools.partial(traced.cached, files=(__file__,))
def _act(env: Env, state: State, actions: jax.Array) -> tuple[State, dict[str, jax.Array]]:
    """Execute `[W, S, J+1]`; return the worlds and the fields of `Transitions`."""

    def step(state: State, action: jax.Array) -> tuple[State, dict[str, jax.Array]]:
        before = {"state": full_state(env, state), "done": state.done}
        state = env.step(state, action)
        after = {"ended": state.done, "success": state.info["success"], "reward": state.reward}
        return state, before | after

    return jax.lax.scan(step, state, jnp.moveaxis(actions, 1, 0))


@functools.partial(jax.jit, static_argnums=0)
def full_state(env: Env, state: State) -> jax.Array:
    """Return `[W, D]`, as in `Transitions`."""
    elapsed = state.info["steps"] / env.max_steps
    return jnp.concatenate([env.full_state(state), elapsed[:, None]], axis=1)


def by_call(x: jax.Array, length: int) -> jax.Array:
    """Arrange steps `[calls x S, W]` by call, `[calls x W, S]`."""
    return jnp.moveaxis(x.reshape(-1, length, x.shape[1]), 1, 2).reshape(-1, length)
