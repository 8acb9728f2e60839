"""Rollouts from separate programs: tasks share those of a policy, policies those of a task.

Compiling a rollout takes longer than running it, and a jitted `make_rollout` compiles the policy
again for each task, and the physics again for each method.
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
from envs.scene.ranges import Randomization
from envs.state import Poses, State
from lorasp_jax.base import fast_cpu
from lorasp_jax.evaluation import rollout
from lorasp_jax.evaluation.rollout import Rollout, act, as_rollout, num_calls, predict
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import RawObservation
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.run import Run


@dataclasses.dataclass(frozen=True)
class SplitRollout:
    """A function like a jitted `make_rollout`, with equal results up to rounding.

    One program samples a policy's chunk; it is shared by all environments with as many worlds and
    equal cameras. Three programs reset, render and step the environment; they are shared by all
    policies. Several threads may call the function.
    """

    env: Env
    execute_steps: int
    denoise_steps: int
    ranges: Randomization | None

    def __call__(self, policy: Policy, key: jax.Array, calls: int | None = None) -> Rollout:
        """Run `env.num_envs` episodes of `calls` policy calls, by default of the most they need."""
        most = num_calls(self.env, policy, self.execute_steps)
        worlds = Worlds(self.env, policy, key, self.ranges)
        records = []
        for call in range(calls or most):
            actions, ranks = worlds.predict(call, denoise_steps=self.denoise_steps)
            records.append((worlds.act(actions, self.execute_steps), *ranks))
        state, records = jax.device_get((worlds.state, records))
        return as_rollout(state, *jax.tree.map(lambda *values: np.stack(values), *records))

    def compile(self, policy: Policy) -> None:
        """Compile all programs at once, whereas the first call compiles one after the other."""
        place = _placement(policy)
        worlds, slots = self.env.num_envs, policy.processor.robot_slots
        policy = _shareable(policy)
        key = jax.device_put(jax.random.key(0), place)
        blank = lambda x: jax.device_put(jnp.zeros(x.shape, x.dtype), place)  # noqa: E731
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
            predict = functools.partial(_predict(), denoise_steps=self.denoise_steps)
            # Called, because several threads' calls compile this shared program only once.
            compiling.append(pool.submit(predict, policy, key, np.int32(0), *inputs))
            actions = shape(worlds, self.execute_steps, len(slots), dtype="float32")
            compiling.append(pool.submit(_act.lower(self.env, state, actions).compile))
            for compiled in compiling:
                compiled.result()


def split_rollout(
    env: Env,
    *,
    execute_steps: int = 5,
    denoise_steps: int = 10,
    ranges: Randomization | None = None,
) -> SplitRollout:
    """Create a rollout from separate programs; see `SplitRollout` and `make_rollout`."""
    return SplitRollout(env, execute_steps, denoise_steps, ranges)


class Worlds:
    """The parallel worlds of one rollout, and the compiled programs that act in them.

    Attributes:
        state: the current state of the worlds.
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
        self._policy = _shareable(policy)
        # Programs are compiled again for arrays placed otherwise, so all follow the keys.
        self._place = _placement(policy)
        reset_key, self._sample_key = jax.device_put(tuple(jax.random.split(key)), self._place)
        self.state: State = _reset(env, reset_key, ranges)
        prompts = rows[np.asarray(self.state.info["instruction"])]
        self._prompts = jax.device_put(prompts, self._place)

    def predict(self, call: int, *, denoise_steps: int, **previous: Any) -> tuple[jax.Array, Any]:
        """Observe the worlds and sample a chunk in each; see `rollout.predict`."""
        observation, done = _observe(self._env, self.state), self.state.done
        inputs = (self._sample_key, np.int32(call), observation, self._prompts, done)
        actions, ranks = _predict()(self._policy, *inputs, denoise_steps=denoise_steps, **previous)
        return jax.device_put(actions, self._place), ranks

    def act(self, actions: jax.Array, execute_steps: int) -> Poses:
        """Execute the first actions of chunks `[W, C, J+1]`; see `rollout.act`."""
        self.state, poses = _act(self._env, self.state, actions[:, :execute_steps])
        return poses

    def hold(self, action: jax.Array, steps: int) -> None:
        """Execute the same action `[W, J+1]` for a number of control steps."""
        self.state = _hold(self._env, self.state, action, np.int32(steps))


def _shareable(policy: Policy) -> Policy:
    """Return the policy as `_predict` takes it, with a sampler and for rows of any prompt table."""
    return Policy(policy.with_sampler().model, policy.processor.shared())


def compiled_rollout(run: Run, task: str) -> tuple[Env, Callable[..., Rollout]]:
    """Return the environment of a task, shared by all runs of this process, and its rollout."""
    config, settings = run.config, run.config.evaluation
    sizes = settings.worlds, config.image_size, config.control_dt
    env = _environment(task, config.robot, *sizes)
    steps = {"execute_steps": settings.execute_steps, "denoise_steps": settings.denoise_steps}
    return env, split_rollout(env, ranges=config.ranges, **steps)


@functools.cache
def _environment(task: str, robot: str, worlds: int, image_size: int, control_dt: float) -> Env:
    return envs.make(
        task, robot=robot, num_envs=worlds, image_size=image_size, control_dt=control_dt
    )


_cached = functools.partial(traced.cached, files=(__file__, rollout.__file__))


@_cached
def _reset(env: Env, key: jax.Array, ranges: Randomization | None) -> State:
    return env.reset(key, ranges)


@_cached
def _observe(env: Env, state: State) -> RawObservation:
    return env.observe(state)


@_cached
def _act(env: Env, state: State, actions: jax.Array) -> tuple[State, Poses]:
    return act(env, state, actions, execute_steps=actions.shape[1])


@_cached
def _hold(env: Env, state: State, action: jax.Array, steps: jax.Array) -> State:
    return jax.lax.fori_loop(0, steps, lambda _, state: env.step(state, action), state)


@functools.cache
def _predict() -> Callable[..., Any]:
    """Return the jitted `predict`; not a constant, because its options start JAX's backend."""
    options = fast_cpu.without_simulation()
    return jax.jit(predict, static_argnames="denoise_steps", compiler_options=options)


def _placement(policy: Policy) -> Any:
    """Return the policy's device, or its mesh with everything replicated."""
    sharding = jax.tree.leaves(policy.model)[0].sharding
    if len(sharding.device_set) == 1:
        return jax.sharding.SingleDeviceSharding(*sharding.device_set)
    return meshes.replicated(sharding.mesh)
