"""Rollouts in which a chunk arrives d control steps after the observation that it is based on.

With s = 4 control steps between observations and d = 2, the robot executes these actions:

    control step     0 1 2 3 4 5 6 7 8 9 ...
    first chunk      0 1 2 3 4 5              observed at step 0
    second chunk             . . 2 3 4 5      observed at step 4, arrives at step 6
    third chunk                      . . ...  observed at step 8

All executions but the synchronous one thus go on with the previous chunk until the new one arrives,
and enter the new one at index d. The clock starts when the first chunk has arrived.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lorasp_jax
from envs.env import Env
from envs.scene.ranges import Randomization
from lorasp_jax.evaluation.programs import Worlds

EXECUTIONS = {
    "synchronous": "the robot holds its last action until the chunk arrives",
    "naive": "the robot goes on with the previous chunk, which the new one ignores",
    "trained": "as naive, but the new chunk continues the previous one, as learned in training",
    "guided": "as naive, but guidance makes the new chunk continue the previous one",
}


@dataclass(frozen=True)
class Execution:
    """How a robot executes chunks.

    Attributes:
        name: one of `EXECUTIONS`.
        execute_steps: s, control steps between observations.
        guidance: β of guided execution, see `real_time_chunking.sample`.
    """

    name: str
    execute_steps: int = 5
    guidance: float = 10.0


@dataclass(frozen=True)
class Trace:
    """What W worlds did.

    Attributes:
        success: `[W]` bool.
        steps: `[W]` int, control steps up to success or the time limit.
        commands: `[W, T, J+1]` joint targets [rad] and gripper openings [m]; those from `steps` on
            were not executed.
    """

    success: np.ndarray
    steps: np.ndarray
    commands: np.ndarray


Rollout = Callable[[lorasp_jax.policies.Policy, jax.Array, int], Trace]
"""Runs episodes of a policy with a random key at a delay [control steps]."""


def check_delay(delay: int, execute_steps: int, chunk: int) -> None:
    """Check that chunks are long enough for a delay.

    Raises:
        ValueError: a robot would have nothing to execute, or no chunk would be executed.
    """
    longest = min(execute_steps, chunk - execute_steps)
    if not 0 <= delay <= longest:
        raise ValueError(
            f"with chunks of {chunk} actions, of which {execute_steps} are executed, the delay "
            f"must be from 0 to {longest} control steps, got {delay}"
        )


def delayed_rollout(
    env: Env, execution: Execution, *, denoise_steps: int, ranges: Randomization | None = None
) -> Rollout:
    """Create a function (policy, key, d) that runs `env.num_envs` episodes with a delay of d steps.

    No program depends on d. Without delay, synchronous and naive execution are the rollout of
    `evaluation.make_rollout`, bit for bit.

    Raises:
        ValueError: see `check_delay`, by the function that is returned.
    """
    steps, waits = execution.execute_steps, execution.name == "synchronous"

    def rollout(policy: lorasp_jax.policies.Policy, key: jax.Array, delay: int) -> Trace:
        check_delay(delay, steps, policy.model.config.chunk)
        worlds = Worlds(env, policy, key, ranges)
        chunk, _ = worlds.predict(0, denoise_steps=denoise_steps)
        worlds.act(chunk, steps)
        commands = [chunk[:, :steps]]
        period = steps + delay if waits else steps
        for call in range(1, 1 + math.ceil((env.max_steps - steps) / period)):
            previous = chunk[:, steps:]
            condition = _condition(execution, previous, delay)
            chunk, _ = worlds.predict(call, denoise_steps=denoise_steps, **condition)
            if waits:
                last = commands[-1][:, -1:]
                worlds.hold(last[:, 0], delay)
                commands += [last] * delay
            else:
                chunk = _switch(previous, chunk, np.int32(delay))
            worlds.act(chunk, steps)
            commands.append(chunk[:, :steps])
        info, commands = jax.device_get((worlds.state.info, commands))
        return Trace(info["success"], info["steps"], np.concatenate(commands, axis=1))

    return rollout


def _condition(execution: Execution, previous: jax.Array, delay: int) -> dict[str, Any]:
    """Return the options of `Policy.sample` with which a chunk continues the previous one."""
    if execution.name not in ("trained", "guided"):
        return {}
    condition: dict[str, Any] = {"previous": previous, "prefix_length": np.int32(delay)}
    guided = execution.name == "guided"
    return condition | ({"guidance": np.float32(execution.guidance)} if guided else {})


@jax.jit
def _switch(previous: jax.Array, new: jax.Array, delay: jax.Array) -> jax.Array:
    """Replace the first d actions of `new` `[W, C, J+1]` by those of `previous`."""
    rest = new.shape[1] - previous.shape[1]
    previous = jnp.pad(previous, ((0, 0), (0, rest), (0, 0)))
    is_first = jnp.arange(new.shape[1]) < delay
    return jnp.where(is_first[:, None], previous, new)
