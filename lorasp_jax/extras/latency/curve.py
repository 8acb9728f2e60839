"""Points of a latency curve: cells that evaluate a finished run under an execution and a delay."""

import dataclasses
import functools
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import lorasp_jax
from envs.env import Env
from lorasp_jax.evaluation.metrics import position_bias
from lorasp_jax.evaluation.programs import compiled_rollout
from lorasp_jax.extras.latency.execution import Execution, Rollout, Trace, delayed_rollout
from lorasp_jax.extras.latency.smoothness import action_delta, jerk
from lorasp_jax.extras.study import Derived
from lorasp_jax.extras.study.study import evaluated
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Run


def cells(
    run: Path,
    tasks: Iterable[str],
    executions: Iterable[Execution],
    delays: Iterable[int],
    episodes: int = 0,
    prefix: str = "",
) -> tuple[Derived, ...]:
    """Return a cell for every combination of task, execution and delay, such as "pour/naive/d2".

    Args:
        run: folder of a finished run.
        tasks: tasks of the run.
        executions: how the robot executes chunks.
        delays: delays [control steps].
        episodes: episodes per point, those of the run's final evaluation; 0: as many as there.
        prefix: what the names of the cells begin with.
    """
    found = []
    for task, execution, delay in itertools.product(tasks, executions, delays):
        changes = {"episodes": episodes, "execute_steps": execution.execute_steps}
        config = functools.partial(evaluated, tasks=(task,), **changes)
        settings: dict[str, Any] = {"execution": execution.name, "delay": delay}
        if execution.name == "guided":
            settings["guidance"] = execution.guidance
        name = f"{prefix}{task}/{execution.name}/d{delay}"
        evaluate = functools.partial(_evaluate, execution, delay)
        found.append(Derived(name, run, config=config, settings=settings, evaluate=evaluate))
    return tuple(found)


def _evaluate(execution: Execution, delay: int, run: Run) -> dict[str, Any]:
    """Evaluate a run's policy on its only task; see `measure_point`."""
    config, (task,) = run.config, run.config.tasks
    env, _ = compiled_rollout(run, task)
    play = delayed_rollout(
        env, execution, denoise_steps=config.evaluation.denoise_steps, ranges=config.ranges
    )
    key = RandomStream.FINAL_EVALUATION.key(config.seed, task)
    policy, episodes = run.policy.with_sampler(), config.evaluation.episodes
    point = measure_point(policy, env, play, key, episodes, delay)
    return {"outcomes": {task: point.pop("outcomes")}, "motion": point}


def measure_point(
    policy: lorasp_jax.policies.Policy,
    env: Env,
    rollout: Rollout,
    key: jax.Array,
    episodes: int,
    delay: int,
) -> dict[str, Any]:
    """Run episodes, a multiple of `env.num_envs`, at one delay.

    Returns:
        `outcomes`, "1" for each success and "0" for each failure; control `steps` per episode,
        `action_delta` [rad] and `jerk` [rad/s^3], see `smoothness`.

    Raises:
        ValueError: success depends on an episode's position in its batch, see `position_bias`.
    """
    keys = jax.random.split(key, episodes // env.num_envs)
    traces = [rollout(policy, batch_key, delay) for batch_key in keys]
    fields = (field.name for field in dataclasses.fields(Trace))
    trace = Trace(*(np.concatenate([getattr(t, name) for t in traces]) for name in fields))
    if bias := position_bias([trace.success.tolist()]):
        raise ValueError(bias)
    return {
        "outcomes": "".join("01"[int(succeeded)] for succeeded in trace.success),
        "steps": float(trace.steps.mean()),
        "action_delta": action_delta(trace),
        "jerk": jerk(trace, env.control_dt),
    }
