"""Success, jerk and spread of one policy with every number of flow steps."""

import dataclasses
import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from envs import Env
from lorasp_jax.distill_flow import command
from lorasp_jax.distill_flow.config import Distillation, DistillFlowConfig
from lorasp_jax.evaluation import held_out
from lorasp_jax.evaluation.programs import compiled_rollout
from lorasp_jax.evaluation.results import map_rollouts
from lorasp_jax.extras.latency.curve import measure_point
from lorasp_jax.extras.latency.execution import Execution, delayed_rollout
from lorasp_jax.extras.study.held_out import AllTasks
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import loop
from lorasp_jax.training.demonstrations import Demonstrations
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Run
from studies.flow_steps.page import STEPS

_DRAWS, _WINDOWS, _EXECUTED = 16, 128, 5
_TRAINED = 3000
"""Steps of distillation."""


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

    cases = [(steps, task) for task in run.config.tasks for steps in _steps(run)]
    found = dict(zip([f"{n}/{task}" for n, task in cases], map_rollouts(one, cases), strict=True))
    return {name: {k: v[name] for k, v in found.items()} for name in ("outcomes", "jerk")}


def judge_distilled(run: Run, loss: Literal["endpoint", "snapflow"], steps: int) -> dict[str, Any]:
    """Distill the policy of a run to a number of flow steps, then judge it with these."""
    config, optim = run.config, run.config.optim
    settings = vars(config) | {
        "evaluation": dataclasses.replace(config.evaluation, denoise_steps=steps),
        "optim": dataclasses.replace(
            optim, steps=min(_TRAINED, optim.steps), learning_rate=0.3 * optim.learning_rate
        ),
    }
    made = DistillFlowConfig(**settings, distill=Distillation(loss=loss))
    student = run.with_policy(run.policy, config=made, folder=run.folder / "distilled")
    student.folder.mkdir(exist_ok=True)
    loop.train(command.student(student), resume=True)
    run.policy, run.config = student.policy, made
    return judge(run, 0)


def _steps(run: Run) -> tuple[int, ...]:
    """Return the numbers of flow steps with which a policy is judged."""
    distilled = isinstance(run.config, DistillFlowConfig)
    return (run.config.evaluation.denoise_steps,) if distilled else STEPS


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
        for steps in _steps(run):
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
