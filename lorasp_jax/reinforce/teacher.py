"""A teacher: a small policy on the simulator's full state, which learns from success in minutes.

It begins as a clone of the policy and improves by proximal policy optimization. Its episodes need
neither pictures nor the policy, and its gradients no large model; what it has found, the policy
learns by imitation. (A teacher that sees more than the student: arXiv 1912.12294.)
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from envs.env import Env
from envs.scene.ranges import Randomization
from lorasp_jax.evaluation.programs import Worlds
from lorasp_jax.models.perceptron import Network, moments
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.reinforce import critic as critics
from lorasp_jax.reinforce import descent, noise, rollout
from lorasp_jax.reinforce.config import Learning
from lorasp_jax.reinforce.critic import Critic
from lorasp_jax.reinforce.descent import Descent, Learned
from lorasp_jax.reinforce.rollout import Experience
from lorasp_jax.reinforce.surrogate import Samples
from lorasp_jax.training.random_streams import RandomStream

_WIDTHS, _EPOCHS, _BATCH = (256, 256, 256), 8, 2048  # our choice, like the next ones
_MINIBATCHES = 8  # or more; fewer steps than these learn slowly
_CLONE_STEPS, _CLONE_BATCH, _CLONE_RATE = 3000, 512, 1e-3
ENOUGH = 0.98
"""A teacher that succeeds as often does not change any more."""
_QUIET = 4
"""One of so many worlds gets no noise: its success is the teacher's."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Teacher:
    """Acts in one task.

    Attributes:
        network: from full states to normalized actions `[S, A]`.
        rate: `[]` factor of the learning rate, which follows the KL divergence of the rounds.
        success: `[]` rate without noise in its latest round, before it learned from it.
    """

    network: Network
    opt_state: Any
    rate: jax.Array
    success: jax.Array

    @classmethod
    def init(cls, key: jax.Array, size: int, length: int, slots: int) -> "Teacher":
        """Create a teacher of states `[D]`, D = `size`, that has learned nothing."""
        network = Network.init(key, (size, *_WIDTHS), (length, slots))
        return cls(network, descent.optimizer().init(network.layers), jnp.ones(()), jnp.zeros(()))


class Practice(NamedTuple):
    """N calls of a teacher that practises.

    Attributes:
        state: `[N, D]` full state.
        mean: `[N, S, A]` the network's actions.
        actions: `[N, S, A]` the executed ones, with noise.
        noisy: `[N]` bool, whether they have noise.
    """

    state: jax.Array
    mean: jax.Array
    actions: jax.Array
    noisy: jax.Array


@functools.partial(jax.jit, static_argnums=4)
def clone(
    teacher: Teacher, state: jax.Array, actions: jax.Array, key: jax.Array, slots: Any
) -> Teacher:
    """Return a teacher that acts like the policy.

    Args:
        teacher: a new one.
        state: `[N, D]` full states before the policy's calls.
        actions: `[N, S, A]` its normalized actions, which may have noise.
        key: orders the calls.
        slots: numbers of the executed slots.
    """
    mean, std = moments(state, jnp.ones(len(state), bool))
    network = dataclasses.replace(teacher.network, mean=mean, std=std)
    optimizer = optax.adam(optax.cosine_decay_schedule(_CLONE_RATE, _CLONE_STEPS))

    def step(carry: Any, key: jax.Array) -> tuple[Any, None]:
        layers, opt_state = carry
        rows = jax.random.randint(key, (_CLONE_BATCH,), 0, len(state))

        def loss(layers: Any) -> jax.Array:
            error = dataclasses.replace(network, layers=layers)(state[rows]) - actions[rows]
            return jnp.mean(jnp.square(error[..., np.array(slots)]))

        updates, opt_state = optimizer.update(jax.grad(loss)(layers), opt_state)
        return (optax.apply_updates(layers, updates), opt_state), None

    first = network.layers, optimizer.init(network.layers)
    keys = jax.random.split(key, _CLONE_STEPS)
    layers = jax.lax.scan(step, first, keys)[0][0]
    return dataclasses.replace(teacher, network=dataclasses.replace(network, layers=layers))


def practise(
    teacher: Teacher,
    critic: Critic,
    env: Env,
    policy: Policy,
    key: jax.Array,
    learning: Learning,
    ranges: Randomization | None = None,
) -> tuple[Teacher, Critic, dict[str, jax.Array]]:
    """Let a teacher act in worlds without pictures, and learn from its success.

    Args:
        teacher: of the task, not a new one.
        critic: of the task; a new one learns alone.
        env: W worlds of the task.
        policy: whose robot and devices the teacher uses.
        key: determines the episodes, and the order in which it learns from them.
        learning: the settings.
        ranges: as in `env.reset`.

    Returns:
        The teacher and the critic after learning, and metrics, with the environment `steps`.
    """
    spread, processor = noise.Spread.of(learning), policy.processor.shared()
    length = teacher.network.layers[-1][1].shape[0]

    def act(key: jax.Array, worlds: Worlds) -> tuple[jax.Array, Practice]:
        seen = rollout.full_state(env, worlds.state), env.proprio(worlds.state)
        own = jax.random.split(key, 3)[1]  # restarts have the last one
        return _act(teacher.network, own, *seen, spread, processor)

    found = rollout.play(env, policy, act, key, execute_steps=length, ranges=ranges)
    own, other = jax.random.split(jax.random.fold_in(key, RandomStream.CRITIC))
    advantages, learned, metrics = critics.jitted_learn(
        critic, found.steps, found.last, own, learning
    )
    slots = tuple(noise.action_slots(policy.processor).tolist())
    teacher = _improve(teacher, critic, found, advantages, other, learning, slots)
    return teacher, learned, metrics | {"steps": jnp.sum(~found.steps.done)}


@jax.jit
def _act(
    network: Network,
    key: jax.Array,
    state: jax.Array,
    robot: jax.Array,
    spread: noise.Spread,
    processor: Processor,
) -> tuple[jax.Array, Practice]:
    """Return actions `[W, S, J+1]` [rad, m], and the calls, for full states and the robot's."""
    mean, slots = network(state), noise.action_slots(processor)
    noisy = jnp.arange(len(state)) % _QUIET > 0
    explored = noise.explore(key, mean, spread, slots)
    calls = Practice(state, mean, jnp.where(noisy[:, None, None], explored, mean), noisy)
    return processor.decode(calls.actions, robot), calls


@functools.partial(jax.jit, static_argnums=(5, 6))
def _improve(
    teacher: Teacher,
    critic: Critic,
    found: Experience,
    advantages: jax.Array,
    key: jax.Array,
    learning: Learning,
    slots: tuple[bool, ...],
) -> Teacher:
    """Take gradient steps on minibatches of calls until the teacher has changed enough.

    A teacher that succeeds often enough stays as it is, and so does one whose critic was new.
    """
    calls, executed = found.chunks, np.array(slots)
    by_call = lambda x: rollout.by_call(x, calls.actions.shape[1])  # noqa: E731
    valid = by_call(~found.steps.done) & calls.noisy[:, None]
    samples = Samples(calls.actions, by_call(advantages), valid, calls.mean)
    rate, spread = learning.teacher_learning_rate, noise.Spread.of(learning)
    size = min(_BATCH, len(calls.state) // _MINIBATCHES)
    settings = Descent(rate, _EPOCHS, size, learning.clip, learning.max_kl)
    before = Learned(teacher.network, teacher.opt_state, teacher.rate)
    after, _ = descent.improve(before, calls.state, samples, key, spread, executed, settings)
    success = jnp.mean(found.success, where=~calls.noisy[: len(found.success)])
    new = jnp.all(critic.network.std == 0)
    keep = new | (success >= ENOUGH)  # then what was measured does not change
    network, opt_state, rate = jax.tree.map(lambda x, y: jnp.where(keep, x, y), before, after)
    return Teacher(network, opt_state, rate, success)
