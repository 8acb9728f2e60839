"""What a run of online learning consists of, besides what it learns."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

import envs
from envs.env import Env
from lorasp_jax.adapters import adaptation
from lorasp_jax.peft import AdaLoRA
from lorasp_jax.policies.policy import Policy
from lorasp_jax.reinforce import update
from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.reinforce.critic import Critic
from lorasp_jax.reinforce.update import Learner
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.guard import Guard
from lorasp_jax.training.optim import make_optimizer
from lorasp_jax.training.program import Frozen
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Run


class Setting(NamedTuple):
    """What does not change during a run.

    Attributes:
        environments: by task.
        start: the adapters at the start, from which the KL divergence is measured.
        policy: from adapters to the policy.
        shardings: of the state.
    """

    config: ReinforceConfig
    environments: Mapping[str, Env]
    programs: update.Programs
    frozen: Frozen
    start: Any
    policy: Callable[[Any], Policy]
    shardings: Learner


def prepare(run: Run) -> tuple[Setting, Learner, Any]:
    """Return the setting, the initial state, and the state's shapes."""
    config = run.config
    assert isinstance(config, ReinforceConfig)
    learning = config.online
    environments = {task: environment(config, task) for task in config.tasks}
    check_memory(config, environments)
    mesh = meshes.make_mesh(config.fsdp, run.devices)
    if learning.worlds % mesh.size:
        devices = f"the number of devices ({mesh.size})"
        raise ValueError(f"online.worlds must be a multiple of {devices}, got {learning.worlds}")
    graphdef, adapters, parameters = adaptation.split(run.policy.model)
    methods = adaptation.methods(run.policy.model).values()
    if any(isinstance(method, AdaLoRA) for method in methods):
        raise ValueError("ada_lora needs a number of steps, which reinforcement learning has not")
    rate = config.optim.learning_rate
    constant = dataclasses.replace(config.optim, final_learning_rate=rate, warmup_steps=0)
    optimizer = make_optimizer(constant, methods)
    zero, one = jnp.zeros((), jnp.int32), jnp.ones(())
    critics = _critics(config, environments)
    adapters = jax.tree.map(jnp.copy, adapters)
    state = Learner(zero, adapters, optimizer.init(adapters), Guard.initial(), critics, one)
    shardings = meshes.shardings(state, mesh)
    state = jax.device_put(state, shardings)
    processor = run.policy.processor
    frozen = Frozen(parameters, processor.shared())
    frozen = jax.device_put(frozen, meshes.shardings(frozen, mesh))
    start = jax.tree.map(jnp.copy, state.adapters)
    programs = update.Programs(config, graphdef, optimizer, shardings)

    def policy(adapters: Any) -> Policy:
        return Policy(nnx.merge(graphdef, adapters, frozen.parameters), processor)

    run.policy = policy(start)
    shapes = jax.tree.map(meshes.with_sharding, jax.eval_shape(lambda: state), shardings)
    setting = Setting(config, environments, programs, frozen, start, policy, shardings)
    return setting, state, shapes


def environment(config: ReinforceConfig, task: str) -> Env:
    """Make the worlds in which the policy explores a task."""
    return envs.make(
        task,
        robot=config.robot,
        num_envs=config.online.worlds,
        image_size=config.image_size,
        control_dt=config.control_dt,
        reward=config.online.reward,
        discount=config.online.discount,
    )


def check_memory(config: ReinforceConfig, environments: Mapping[str, Env]) -> None:
    """Raise ValueError if the pictures of an iteration exceed the memory of the devices."""
    calls = sum(-(-x.max_steps // config.evaluation.execute_steps) for x in environments.values())
    pictures = len(Env.cameras) * config.image_size**2 * 3
    copies = 2  # those of the calls, and joined
    needed = copies * calls * config.online.worlds * pictures / jax.local_device_count()
    if needed > (available := preflight.available_bytes()):
        raise ValueError(
            f"the pictures of {config.online.worlds} worlds (online.worlds) take "
            f"{needed / 2**30:.1f} GiB per device of {available / 2**30:.1f}: choose fewer worlds"
        )


def _critics(config: ReinforceConfig, environments: Mapping[str, Env]) -> dict[str, Critic]:
    return {
        task: Critic.init(
            RandomStream.CRITIC.key(config.seed, task),
            max(part.stop for part in env.full_state_layout.values()) + 1,
            config.online.critic_learning_rate,
        )
        for task, env in environments.items()
    }
