"""Success, jerk and spread of one policy with every number of flow steps."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import Env
from envs.physics import physics
from lorasp_jax.evaluation import held_out
from lorasp_jax.evaluation.programs import compiled_rollout
from lorasp_jax.extras.latency.curve import measure_point
from lorasp_jax.extras.latency.execution import Execution, delayed_rollout
from lorasp_jax.extras.study.held_out import AllTasks
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.demonstrations import Demonstrations, map_threads
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Run
from studies.flow_steps.page import STEPS

_DRAWS, _WINDOWS, _EXECUTED = 16, 128, 5


def judge(run: Run, delay: int) -> dict[str, Any]:
    """Return outcomes and jerk [rad/s^3] by number of flow steps and task, such as "2/pour".

    With a delay [control steps], the chunks continue the previous ones, as learned in training.
    """
    policy, settings = run.policy.with_sampler(), run.config.evaluation
    execution = Execution("trained" if delay else "naive", settings.execute_steps)

    def one(case: tuple[int, str]) -> dict[str, Any]:
        steps, task = case
        env: Env = compiled_rollout(run, task)[0]
        play = delayed_rollout(env, execution, denoise_steps=steps)
        key = RandomStream.FINAL_EVALUATION.key(run.config.seed, task)
        return measure_point(policy, env, play, key, settings.episodes, delay)

    cases = [(steps, task) for task in run.config.tasks for steps in STEPS]
    # Warp is not thread-safe.
    run_all = map if physics.default_backend() == "warp" else map_threads
    found = dict(zip([f"{n}/{task}" for n, task in cases], run_all(one, cases), strict=True))
    return {name: {k: v[name] for k, v in found.items()} for name in ("outcomes", "jerk")}


def measure(run: Run, episodes: Demonstrations, _: Policy | None) -> dict[str, Any]:
    """Return how far chunks from one observation spread, by number of flow steps and task.

    The standard deviation over noise of the actions that are executed, relative to that of the
    demonstrated actions over the observations; the mean over dimensions.
    """
    policy, found = run.policy.with_sampler(), {}
    for task, group in episodes.items():
        source: Any = AllTasks({task: group})
        raw = held_out.windows(source, range(len(source)), run.policy, limit=_WINDOWS).raw
        scale = np.asarray(raw.actions[:, :_EXECUTED]).std((0, 1))
        for steps in STEPS:
            over_noise = np.asarray(_spread(policy, raw, steps))
            found[f"{steps}/{task}"] = float((over_noise / np.maximum(scale, 1e-6)).mean())
    return {"spread": found}


@functools.partial(jax.jit, static_argnames="steps")
def _spread(policy: Policy, raw: Any, steps: int) -> jax.Array:
    observation = {"image": raw.image, "state": raw.state}

    def sample(key: jax.Array) -> jax.Array:
        return policy.sample(key, observation, raw.instruction, num_steps=steps)[:, :_EXECUTED]

    chunks = jax.lax.map(sample, jax.random.split(jax.random.key(0), _DRAWS))
    return jnp.std(chunks, axis=0)
