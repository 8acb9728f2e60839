"""Train PPO on a task's privileged state, with physics and learning in one jitted step.

    python examples/ppo.py                                          # press, minutes on a CPU
    python examples/ppo.py --num-envs 2048 --learning-rate 3e-4     # every field is an option

PPO is Schulman et al. 2017 (arXiv 1707.06347), with generalized advantage estimation (arXiv
1506.02438). With this package's dense reward, pass the learner's discount to the environment. Only
success is terminal, so bootstrap from the last state of an episode that reaches the time limit.
"""

import dataclasses
import functools
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
import tyro

import envs
from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.base import messages
from lorasp_jax.base.files import check_local


@dataclasses.dataclass(frozen=True)
class Config:
    """Task and hyperparameters. The defaults (our choice) solve press in minutes on a CPU."""

    task: str = "press"
    robot: str = "piper"
    num_envs: int = 64  # parallel worlds W
    steps: int = 32  # T, steps per world between updates
    updates: int = 40
    epochs: int = 8  # passes over these T x W steps, each split into `minibatches`
    minibatches: int = 4
    learning_rate: float = 1e-3
    discount: float = 0.97
    trace: float = 0.9  # lambda of generalized advantage estimation
    clip: float = 0.2  # maximum deviation of the probability ratio from 1
    width: int = 64  # of the two hidden layers
    std: float = 0.5  # initial standard deviation of actions in [-1, 1]
    episodes: int = 256  # evaluation episodes
    seed: int = 0
    out: Path = Path("runs/ppo")


class Learner(NamedTuple):
    """Training state: networks, optimizer state, observation statistics, environment state."""

    params: Any
    opt_state: Any
    moments: dict[str, jax.Array]
    state: envs.State


class Batch(NamedTuple):
    """Recorded steps, [T, W, ...] in a rollout, flattened to [T W, ...] for the updates."""

    x: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    error: jax.Array  # temporal-difference error
    done: jax.Array
    success: jax.Array


def network(key: jax.Array, *sizes: int) -> list[tuple[jax.Array, jax.Array]]:
    """Initialize the weights and biases of an MLP, with the last layer near zero."""
    keys, scales = jax.random.split(key, len(sizes) - 1), [1.4] * (len(sizes) - 2) + [0.01]
    return [
        (jax.nn.initializers.orthogonal(scale)(k, (i, o)), jnp.zeros(o))
        for k, scale, i, o in zip(keys, scales, sizes[:-1], sizes[1:], strict=True)
    ]


def apply(layers: list[tuple[jax.Array, jax.Array]], x: jax.Array) -> jax.Array:
    """Apply an MLP to inputs [..., I]; return outputs [..., O]."""
    for weight, bias in layers[:-1]:
        x = jnp.tanh(x @ weight + bias)
    return x @ layers[-1][0] + layers[-1][1]


def observe(env: envs.Env, moments: dict[str, jax.Array], state: envs.State) -> jax.Array:
    """Return the full state [W, D], normalized by running mean and variance and clipped."""
    return jnp.clip(
        (env.full_state(state) - moments["mean"]) / jnp.sqrt(moments["variance"] + 1e-6), -5.0, 5.0
    )


def act(env: envs.Env, state: envs.State, action: jax.Array) -> envs.State:
    """Step the environment with actions [W, A] in [-1, 1], rescaled to its limits."""
    low, high = jnp.asarray(env.action_low), jnp.asarray(env.action_high)
    return env.step(state, low + (jnp.clip(action, -1.0, 1.0) + 1) / 2 * (high - low))


def log_prob(params: Any, x: jax.Array, action: jax.Array) -> jax.Array:
    """Compute the log-probability [...] of actions [..., A], up to a constant."""
    z = (action - apply(params["actor"], x)) / jnp.exp(params["log_std"])
    return -jnp.sum(z**2 / 2 + params["log_std"], axis=-1)


def rollout(env: envs.Env, config: Config, learner: Learner, key: jax.Array) -> Any:
    """Take T steps in every world, restarting finished ones; return last state and all steps."""
    params, moments = learner.params, learner.moments

    def value(x: jax.Array) -> jax.Array:
        return apply(params["critic"], x)[:, 0]

    def body(state: envs.State, key: jax.Array) -> tuple[envs.State, Batch]:
        x = observe(env, moments, state)
        noise = jax.random.normal(key, (env.num_envs, len(env.action_low)))
        action = apply(params["actor"], x) + jnp.exp(params["log_std"]) * noise
        after = act(env, state, action)
        success = after.info["success"]
        next_value = jnp.where(success, 0.0, value(observe(env, moments, after)))
        error = after.reward + config.discount * next_value - value(x)
        step = Batch(x, action, log_prob(params, x, action), value(x), error, after.done, success)
        return env.reset_done(after, jax.random.fold_in(key, 1)), step

    return jax.lax.scan(body, learner.state, jax.random.split(key, config.steps))


def advantages(config: Config, batch: Batch) -> jax.Array:
    """Compute generalized advantages [T, W]: discounted sums of TD errors within each episode."""

    def body(later: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        error, done = step
        total = error + config.discount * config.trace * jnp.where(done, 0.0, later)
        return total, total

    steps = batch.error, batch.done
    return jax.lax.scan(body, jnp.zeros(config.num_envs), steps, reverse=True)[1]


def loss(params: Any, config: Config, batch: Batch, advantage: jax.Array) -> jax.Array:
    """Compute the critic's squared error minus PPO's clipped objective."""
    ratio = jnp.exp(log_prob(params, batch.x, batch.action) - batch.log_prob)
    scaled = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-6)
    clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    error = apply(params["critic"], batch.x)[:, 0] - batch.value - advantage
    return jnp.mean(error**2) - jnp.mean(jnp.minimum(ratio * scaled, clipped * scaled))


def optimizer(config: Config) -> optax.GradientTransformation:
    """Return Adam with global-norm gradient clipping."""
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(config.learning_rate))


@functools.partial(jax.jit, static_argnums=(0, 1))
def update(env: envs.Env, config: Config, learner: Learner, key: jax.Array) -> Any:
    """Run one PPO iteration; return the learner, and counts of finished and successful episodes."""
    rollout_key, order_key = jax.random.split(key)
    state, steps = rollout(env, config, learner, rollout_key)
    data = steps, advantages(config, steps)
    data = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), data)

    def body(carry: Any, rows: jax.Array) -> tuple[Any, None]:
        params, opt_state = carry
        minibatch = jax.tree.map(lambda x: x[rows], data)
        grads = jax.grad(loss)(params, config, *minibatch)
        updates, opt_state = optimizer(config).update(grads, opt_state)
        return (optax.apply_updates(params, updates), opt_state), None

    keys = jax.random.split(order_key, config.epochs)
    rows = jax.vmap(lambda k: jax.random.permutation(k, config.steps * config.num_envs))(keys)
    rows = rows.reshape(config.epochs * config.minibatches, -1)
    (params, opt_state), _ = jax.lax.scan(body, learner[:2], rows)
    moments = update_moments(learner.moments, env.full_state(state))
    return Learner(params, opt_state, moments, state), (steps.done.sum(), steps.success.sum())


def update_moments(moments: dict[str, jax.Array], new: jax.Array) -> dict[str, jax.Array]:
    """Update the count, mean and variance of observations with a batch of new ones [W, D]."""
    count = moments["count"] + len(new)
    weight, shift = len(new) / count, jnp.mean(new, axis=0) - moments["mean"]
    variance = (1 - weight) * (moments["variance"] + weight * shift**2)
    variance += weight * jnp.var(new, axis=0)
    return {"count": count, "mean": moments["mean"] + weight * shift, "variance": variance}


def init(env: envs.Env, config: Config, key: jax.Array) -> Learner:
    """Initialize the learner and reset the environment."""
    reset_key, actor_key, critic_key = jax.random.split(key, 3)
    state = env.reset(reset_key)
    observation, actions = env.full_state(state), len(env.action_low)
    sizes = observation.shape[1], config.width, config.width
    params = {
        "actor": network(actor_key, *sizes, actions),
        "critic": network(critic_key, *sizes, 1),
        "log_std": jnp.full(actions, jnp.log(config.std), jnp.float32),
    }
    empty = {
        "count": jnp.float32(0),
        "mean": jnp.zeros(sizes[0]),
        "variance": jnp.ones(sizes[0]),
    }
    moments = update_moments(empty, observation)
    return Learner(params, optimizer(config).init(params), moments, state)


@functools.partial(jax.jit, static_argnums=0)
def evaluate(
    env: envs.Env, params: Any, moments: dict[str, jax.Array], key: jax.Array
) -> jax.Array:
    """Return whether the policy without noise solves each of W unseen layouts, bool [W]."""

    def body(state: envs.State, _: None) -> tuple[envs.State, None]:
        return act(env, state, apply(params["actor"], observe(env, moments, state))), None

    return jax.lax.scan(body, env.reset(key), None, env.max_steps)[0].info["success"]


def train(config: Config) -> tuple[Learner, np.ndarray]:
    """Train; return the learner and (steps, seconds, episodes, successes) for each update."""
    env = make(config, config.num_envs, reward="dense", discount=config.discount)
    key, start = jax.random.key(config.seed), time.perf_counter()
    learner, rows = init(env, config, key), []
    calls = messages.Calls(config.task)
    for number in range(1, config.updates + 1):
        key_now = jax.random.fold_in(key, number)
        with calls.first("an update"):
            learner, (finished, succeeded) = update(env, config, learner, key_now)
        steps, seconds = number * config.steps * config.num_envs, time.perf_counter() - start
        rows.append((steps, seconds, int(finished), int(succeeded)))
        print(
            f"{steps:9,} steps, {seconds:5.0f} s: {succeeded} of {finished} episodes succeeded",
            flush=True,
        )
    return learner, np.array(rows)


def make(config: Config, num_envs: int, **options: Any) -> envs.Env:
    """Create an environment with end-effector actions."""
    return envs.make(
        config.task, config.robot, num_envs=num_envs, actions="end_effector", **options
    )


def draw(config: Config, curve: np.ndarray) -> None:
    """Plot the learning curve: success rate over windows of three updates.

    Shorter windows would be biased: successes end early, failures only at the time limit.
    """
    steps, _, *counts = curve.T
    finished, succeeded = (np.convolve(x, np.ones(3))[2 : len(x)] for x in counts)
    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    axes.plot(steps[2:], 100 * succeeded / np.maximum(finished, 1), marker=".")
    axes.set(xlabel="environment steps", ylabel="success rate [%]", ylim=(0, 102))
    axes.set_title(f"{config.task}, {config.robot}: PPO from the full state")
    axes.grid(alpha=0.3)
    config.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(config.out / "curve.png", dpi=150)


def main(config: Config) -> float:
    """Train, plot the learning curve and evaluate on unseen layouts; return the success rate."""
    check_local(config.out)
    learner, curve = train(config)
    draw(config, curve)
    key = jax.random.key(config.seed + 1_000_000)
    env = make(config, config.episodes)
    with messages.announce(f"the evaluation of {config.task}"):
        success = float(np.mean(evaluate(env, learner.params, learner.moments, key)))
    print(
        f"solved {success:.1%} of {config.episodes} unseen layouts; "
        f"{time.process_time():.0f} CPU seconds"
    )
    return success


if __name__ == "__main__":
    cache.enable()
    main(tyro.cli(Config, description=__doc__))
