"""Closed-loop rollouts: observe, predict a chunk, execute part of it, repeat.

Compiling takes longer than running, so policy and world have separate programs: tasks share those
of a policy, policies those of a task.
"""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import traced
from envs.env import Env
from envs.scene.randomization import Draw
from envs.scene.ranges import Randomization
from envs.state import Poses, State
from lorasp_jax.base import fast_cpu
from lorasp_jax.evaluation import metrics
from lorasp_jax.models.sampling import NUM_STEPS
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import RawObservation
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.run import Run

RECORDED_WORLDS = 8
"""Number of worlds whose poses are recorded; one of them becomes the video."""


@dataclasses.dataclass(frozen=True)
class Rollout:
    """One batch of episodes.

    Attributes:
        success: `[W]` bool.
        steps: `[W]` int32, control steps up to success or the time limit.
        running: `[calls]` int32, number of unfinished worlds.
        active_rank: `[calls, L]` per linear layer, mean over tokens and unfinished worlds.
        active_rank_histogram: `[calls, R + 1]` int32 per tower; see `metrics.rank_histogram`.
        poses: poses of the first worlds at every control step, leading axes `[time, worlds]`.
        draw: randomized values of these worlds, leading axis `[worlds]`; None without ranges.
    """

    success: jax.Array
    steps: jax.Array
    running: jax.Array
    active_rank: metrics.LayerRanks
    active_rank_histogram: dict[str, jax.Array]
    poses: Poses
    draw: Draw | None


@dataclasses.dataclass(frozen=True)
class SplitRollout:
    """A function (policy, key) that runs a batch of episodes; see `make_rollout`.

    One program samples a policy's chunk; it is shared by all environments with as many worlds and
    equal cameras. Three programs reset, render and step the environment; they are shared by all
    policies. Several threads may call the function.
    """

    env: Env
    execute_steps: int
    denoise_steps: int
    ranges: Randomization | None

    def __call__(self, policy: Policy, key: jax.Array, calls: int | None = None) -> Rollout:
        """Run `env.num_envs` episodes of `calls` policy calls, by default of the most they need.

        Raises:
            ValueError: chunks have fewer than `execute_steps` actions, or the policy has no prompt
                for one of the instructions.
        """
        chunk = policy.model.config.chunk
        if not 1 <= self.execute_steps <= chunk:
            raise ValueError(
                f"execute_steps must be from 1 to the chunk length ({chunk}), "
                f"got {self.execute_steps}"
            )
        most = -(-self.env.max_steps // self.execute_steps)
        worlds = Worlds(self.env, policy, key, self.ranges)
        records = []
        for call in range(calls or most):
            actions, ranks = worlds.predict(call, denoise_steps=self.denoise_steps)
            records.append((worlds.act(actions, self.execute_steps), *ranks))
        info, records = jax.device_get((worlds.state.info, records))
        poses, ranks, histogram, running = jax.tree.map(lambda *x: np.stack(x), *records)
        return Rollout(
            success=info["success"],
            steps=info["steps"],
            running=running,
            active_rank=ranks,
            active_rank_histogram=histogram,
            poses=jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), poses),
            draw=jax.tree.map(lambda x: x[:RECORDED_WORLDS], info["draw"]),
        )

    def compile(self, policy: Policy) -> None:
        """Compile all programs at once, whereas the first call compiles one after the other."""
        place = _placement(policy)
        worlds, slots = self.env.num_envs, policy.processor.action_slots
        policy = _shareable(policy)
        key = jax.device_put(jax.random.key(0), place)
        blank = lambda x: jax.device_put(np.zeros(x.shape, x.dtype), place)  # noqa: E731
        placed = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place)  # noqa: E731
        shape = lambda *axes, dtype: placed(jax.ShapeDtypeStruct(axes, dtype))  # noqa: E731
        with ThreadPoolExecutor() as pool:
            reset = _reset.lower(self.env, key, self.ranges)
            compiling = [pool.submit(reset.compile)]
            state = jax.tree.map(placed, reset.out_info)
            observe = _observe.lower(self.env, state)
            compiling.append(pool.submit(observe.compile))
            prompts, done = shape(worlds, dtype="int32"), shape(worlds, dtype="bool")
            inputs = jax.tree.map(blank, (observe.out_info, prompts, done))
            predict = functools.partial(_predict, denoise_steps=self.denoise_steps)
            # Called, because several threads' calls compile this shared program only once.
            compiling.append(pool.submit(predict, policy, key, np.int32(0), *inputs))
            actions = shape(worlds, self.execute_steps, len(slots), dtype="float32")
            compiling.append(pool.submit(_act.lower(self.env, state, actions).compile))
            for compiled in compiling:
                compiled.result()


def make_rollout(
    env: Env,
    *,
    execute_steps: int = 5,
    denoise_steps: int = NUM_STEPS,
    ranges: Randomization | None = None,
) -> SplitRollout:
    """Create a function (policy, key) that runs `env.num_envs` episodes.

    Every `execute_steps` control steps, the policy observes and samples a new chunk in
    `denoise_steps` Euler steps. `ranges` is passed to `env.reset`.
    """
    return SplitRollout(env, execute_steps, denoise_steps, ranges)


class Worlds:
    """The parallel worlds of one rollout, and the compiled programs that act in them.

    Attributes:
        state: the current state of the worlds.
        policy: the policy, prepared for programs that all policies share.
        sample_key: key of the policy's noise.
    """

    def __init__(
        self, env: Env, policy: Policy, key: jax.Array, ranges: Randomization | None = None
    ) -> None:
        """Reset the worlds; `key` determines them and the policy's noise.

        Raises:
            ValueError: the policy has no prompt for one of the instructions.
        """
        rows = policy.processor.prompts.rows(env.instructions)
        self._env = env
        self.policy: Policy = _shareable(policy)
        # Programs are compiled again for arrays placed otherwise, so all follow the keys.
        self._place = _placement(policy)
        reset_key, self.sample_key = jax.device_put(tuple(jax.random.split(key)), self._place)
        self.state: State = _reset(env, reset_key, ranges)
        prompts = rows[np.asarray(self.state.info["instruction"])]
        self._prompts = jax.device_put(prompts, self._place)

    def observe(self) -> RawObservation:
        """Render and measure what the policy observes."""
        return _observe(self._env, self.state)

    def predict(self, call: int, *, denoise_steps: int, **previous: Any) -> tuple[jax.Array, Any]:
        """Observe the worlds and sample a chunk in each; see `predict`."""
        observation, done = self.observe(), self.state.done
        inputs = (self.sample_key, np.int32(call), observation, self._prompts, done)
        actions, ranks = _predict(self.policy, *inputs, denoise_steps=denoise_steps, **previous)
        return jax.device_put(actions, self._place), ranks

    def act(self, actions: jax.Array, execute_steps: int) -> Poses:
        """Execute the first actions of chunks `[W, C, J+1]`; return poses, see `_act`."""
        self.state, poses = _act(self._env, self.state, actions[:, :execute_steps])
        return poses

    def hold(self, action: jax.Array, steps: int) -> None:
        """Execute the same action `[W, J+1]` for a number of control steps."""
        self.state = _hold(self._env, self.state, action, np.int32(steps))


def predict(
    policy: Policy,
    key: jax.Array,
    call: jax.Array,
    observation: RawObservation,
    prompts: jax.Array,
    done: jax.Array,
    *,
    denoise_steps: int,
    **previous: Any,
) -> tuple[jax.Array, tuple[metrics.LayerRanks, dict[str, jax.Array], jax.Array]]:
    """Sample a chunk in every world, with a new key for each call.

    Args:
        policy: the policy, with a sampler.
        key: key of the rollout.
        call: `[]` int32, index of the policy call.
        observation: from `env.observe`.
        done: `[W]` bool.
        denoise_steps: Euler steps.
        previous: `previous`, `prefix_length` and `guidance` of `Policy.sample`, if any.

    Returns:
        `[W, C, J+1]` actions, and (active ranks, their histogram, number of unfinished worlds).
    """
    call_key = jax.random.fold_in(key, call)
    actions, aux = policy.sample(
        call_key, observation, prompts, num_steps=denoise_steps, return_aux=True, **previous
    )
    ranks = metrics.layer_ranks(aux, ~done)
    histogram = metrics.rank_histogram(aux, ~done, _max_rank(policy))
    return actions, (ranks, histogram, jnp.sum(~done))


_predict = fast_cpu.jit_policy(predict, static_argnames="denoise_steps")


def _shareable(policy: Policy) -> Policy:
    """Return the policy as `_predict` takes it, with a sampler and for rows of any prompt table."""
    return Policy(policy.with_sampler().model, policy.processor.shared())


def compiled_rollout(run: Run, task: str) -> tuple[Env, Callable[..., Rollout]]:
    """Return the environment of a task, shared by all runs of this process, and its rollout."""
    config, settings = run.config, run.config.evaluation
    sizes = settings.worlds, config.image_size, config.control_dt
    env = environment(task, config.robot, *sizes)
    steps = {"execute_steps": settings.execute_steps, "denoise_steps": settings.denoise_steps}
    return env, make_rollout(env, ranges=config.ranges, **steps)


@functools.cache
def environment(task: str, robot: str, worlds: int, image_size: int, control_dt: float) -> Env:
    """Return the environment of a task, shared by all runs of this process."""
    return envs.make(
        task, robot=robot, num_envs=worlds, image_size=image_size, control_dt=control_dt
    )


_cached = functools.partial(traced.cached, files=(__file__,))


@_cached
def _reset(env: Env, key: jax.Array, ranges: Randomization | None) -> State:
    return env.reset(key, ranges)


@_cached
def _observe(env: Env, state: State) -> RawObservation:
    return env.observe(state)


@_cached
def _act(env: Env, state: State, actions: jax.Array) -> tuple[State, Poses]:
    """Execute `[W, S, J+1]`; poses of the recorded worlds have leading axes `[S, worlds]`."""

    def step(state: State, action: jax.Array) -> tuple[State, Poses]:
        state = env.step(state, action)
        return state, jax.tree.map(lambda x: x[:RECORDED_WORLDS], Poses.of(state.data))

    return jax.lax.scan(step, state, jnp.moveaxis(actions, 1, 0))


@_cached
def _hold(env: Env, state: State, action: jax.Array, steps: jax.Array) -> State:
    return jax.lax.fori_loop(0, steps, lambda _, state: env.step(state, action), state)


def _placement(policy: Policy) -> Any:
    """Return the policy's device, or its mesh with everything replicated."""
    sharding = jax.tree.leaves(policy.model)[0].sharding
    if len(sharding.device_set) == 1:
        return jax.sharding.SingleDeviceSharding(*sharding.device_set)
    return meshes.replicated(sharding.mesh)


def _max_rank(policy: Policy) -> int:
    """Return the largest possible active rank; 0 if no method has a rank."""
    return max((method.largest_active_rank for method in policy.model.methods), default=0)
