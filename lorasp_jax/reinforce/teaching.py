"""Teachers learn from success, and the policy from them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.policies.policy import Policy
from lorasp_jax.reinforce import student
from lorasp_jax.reinforce import teacher as teachers
from lorasp_jax.reinforce.critic import Critic
from lorasp_jax.reinforce.learner import Learner
from lorasp_jax.reinforce.rollout import Experience, joined
from lorasp_jax.reinforce.setting import Setting
from lorasp_jax.reinforce.teacher import Teacher
from lorasp_jax.training.random_streams import RandomStream


def iterate(setting: Setting, state: Learner) -> tuple[Learner, dict[str, float]]:
    """Practise and imitate once; return the state and the metrics, with the environment `steps`.

    A teacher begins as a clone of the policy, and is imitated in its task while it is the better.
    In other tasks the policy goes on as it does, so that it does not unlearn them.
    """
    config, step = setting.config, int(state.step)
    policy = setting.policy(state.adapters).with_sampler()
    given, better, values = [], False, {"steps": 0.0}
    taught, critics = dict(state.teachers), dict(state.critics)
    for task in setting.environments:
        key = jax.random.fold_in(RandomStream.ROLLOUTS.key(config.seed, task), step)
        seen = setting.collect(task, policy, key, std=0.0)
        rate = float(jnp.mean(seen.success))
        values["steps"] += _steps(seen)
        if not step:
            taught[task], steps = _clone(setting, task, policy, key, seen, taught[task])
            values["steps"] += steps
        taught[task], critics[task], metrics = _practise(
            setting, task, policy, key, taught[task], critics[task]
        )
        values["steps"] += metrics.pop("steps")
        values |= {f"{name}/{task}": x for name, x in metrics.items()}
        success = float(taught[task].success)
        values |= {f"rollout/{task}": rate, f"teacher/{task}": success}
        leads = _leads(success, rate)
        better |= leads
        given.append(student.lessons(seen, taught[task] if leads else None, policy.processor))
    lessons = joined(given)
    state = dataclasses.replace(state, critics=critics, teachers=taught)
    state, rows = jax.device_put(state, setting.shardings), {}
    if better:
        key = jax.random.fold_in(RandomStream.TRAINING.key(config.seed), step)
        size, count = config.optim.batch_size, len(lessons.prompts)
        index = student.order(count, config.online.gradient_steps, size, key)
        state, metrics = setting.imitate(state, setting.frozen, lessons, index, key)
        rows = jax.device_get(metrics)
    values |= setting.summary(state, lessons, np.ones(len(lessons.prompts), bool), rows)
    state = dataclasses.replace(state, step=state.step + 1)
    return jax.device_put(state, setting.shardings), values


def _leads(teacher: float, policy: float) -> bool:
    """Whether the policy has something to learn, given both rates of success."""
    return teacher > policy


def _clone(
    setting: Setting, task: str, policy: Policy, key: jax.Array, seen: Experience, new: Teacher
) -> tuple[Teacher, float]:
    """Clone the policy from what was seen, and from as many episodes with noise; count these."""
    key = jax.random.fold_in(key, RandomStream.TEACHER)
    noisy = setting.collect(task, policy, key)
    length = setting.config.evaluation.execute_steps
    state, actions = joined(
        [(x.at_calls(x.steps.state), x.chunks.actions[:, :length]) for x in (seen, noisy)]
    )
    own, slots = jax.random.fold_in(key, RandomStream.TRAINING), policy.processor.action_slots
    return teachers.clone(new, state, actions, own, slots), _steps(noisy)


def _steps(found: Experience) -> float:
    """Return the number of environment steps."""
    return float(jnp.sum(~found.steps.done))


def _practise(
    setting: Setting, task: str, policy: Policy, key: jax.Array, teacher: Teacher, critic: Critic
) -> tuple[Teacher, Critic, dict[str, float]]:
    """Let a teacher practise for some rounds; return metrics of the last, with all `steps`."""
    config, values, steps = setting.config, {}, 0.0
    for number in range(config.online.rounds):
        if number and teacher.success >= teachers.ENOUGH:
            break
        own = jax.random.fold_in(jax.random.fold_in(key, RandomStream.RECORDING), number)
        where = setting.gyms[task], policy, own, config.online, config.ranges
        teacher, critic, metrics = teachers.practise(teacher, critic, *where)
        values = {"explained_variance": float(metrics["explained_variance"])}
        steps += float(metrics["steps"])
    return teacher, critic, values | {"steps": steps}
