"""What a run of online learning consists of, besides what it learns."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

import envs
from envs.env import Env
from envs.physics.physics import Backend
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import OptimConfig
from lorasp_jax.models import noise_actor
from lorasp_jax.models.noise_actor import PATH, NoiseActor
from lorasp_jax.peft import AdaLoRA, FullFineTuning
from lorasp_jax.peft.fields import require
from lorasp_jax.policies.policy import Policy
from lorasp_jax.reinforce import descent, noise, rollout, student, update
from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.reinforce.critic import Critic
from lorasp_jax.reinforce.learner import Learner
from lorasp_jax.reinforce.rollout import Chunks, Experience
from lorasp_jax.reinforce.teacher import Teacher
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.guard import Guard, summarize
from lorasp_jax.training.optim import make_optimizer
from lorasp_jax.training.program import Frozen
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Run
from lorasp_jax.training.step import copied

_WIDTHS = 128, 128
"""Of the hidden layers of an actor of the noise; our choice."""


class Setting(NamedTuple):
    """What does not change during a run.

    Attributes:
        environments: by task.
        start: the adapters at the start, from which the KL divergence is measured.
        policy: from adapters to the policy.
        shardings: of the state.
        imitate: the program of `student`, for the method teacher.
        gyms: by task, the worlds in which teachers practise.
    """

    config: ReinforceConfig
    environments: Mapping[str, Env]
    programs: update.Programs
    frozen: Frozen
    start: Any
    policy: Callable[[Any], Policy]
    shardings: Learner
    imitate: student.Imitate
    gyms: Mapping[str, Env]

    def collect(
        self, task: str, policy: Policy, key: jax.Array, std: float | None = None
    ) -> Experience:
        """Let the policy act in a task; `std` overrides the standard deviation of its noise."""
        spread = noise.Spread.of(self.config.online)
        return rollout.collect(
            self.environments[task],
            policy,
            key,
            spread if std is None else spread._replace(std=std),
            execute_steps=self.config.evaluation.execute_steps,
            denoise_steps=self.config.evaluation.denoise_steps,
            sde=self.config.online.exploration == "sde",
            ranges=self.config.ranges,
        )

    def summary(
        self, state: Learner, chunks: Chunks, valid: np.ndarray, rows: dict[str, np.ndarray]
    ) -> dict[str, float]:
        """Return the means of the metrics of gradient steps, and the divergence from the start.

        Args:
            state: after these steps.
            chunks: N that the policy has executed.
            valid: `[N]` bool, which of them count; they are measured at equal distances.
            rows: metrics of the steps; empty if there was none.
        """
        if not rows:
            return {"updates": 0, "in_a_row": 0}
        values = {n: float(x.mean()) for n, x in summarize(rows).items() if x.ndim == 0}
        index = update.evenly(np.flatnonzero(valid), self.config.optim.batch_size)
        now, start = (
            self.programs.means(x, self.frozen, chunks, index) for x in (state.adapters, self.start)
        )
        kl = self.programs.divergence(now, start, self.frozen, chunks, index)
        executed = kl[:, : self.config.evaluation.execute_steps]
        extra = {"start_kl": float(jnp.mean(executed)), "in_a_row": float(rows["in_a_row"][-1])}
        return values | extra | {"updates": len(rows["loss"])}


def prepare(run: Run) -> tuple[Setting, Learner, Any]:
    """Return the setting, the initial state, and the state's shapes."""
    config = run.config
    assert isinstance(config, ReinforceConfig)
    learning = config.online
    environments = {task: environment(config, task, learning.worlds) for task in config.tasks}
    mesh = meshes.make_mesh(config.fsdp, run.devices)
    gyms = _gyms(config, mesh.size)
    check_memory(config, environments)
    for name in ("worlds", "teacher_worlds") if gyms else ("worlds",):
        rule = f"online.{name} must be a multiple of the number of devices ({mesh.size})"
        require((count := getattr(learning, name)) % mesh.size == 0, rule, count)
    if run.policy.model.noise_actor is not None:
        raise ValueError("the policy has learned its initial noise: start from an earlier one")
    if learning.method == "noise":
        run.trained, run.policy = f"^{PATH}", _steered(config, run.policy)
    graphdef, adapters, parameters = run.split()
    optimizer = _optimizer(config, run.policy)
    learned = adapters[PATH].get_value().network.layers if run.trained else adapters
    zero, one = jnp.zeros((), jnp.int32), jnp.ones(())
    critics, taught = _critics(config, environments), _teachers(config, gyms, run.policy)
    adapters, guard = copied(adapters), Guard.initial()
    opt_state = jax.jit(optimizer.init)(learned)
    state = Learner(zero, adapters, opt_state, guard, critics, one, taught)
    shardings = meshes.shardings(state, mesh)
    state = jax.device_put(state, shardings)
    processor = run.policy.processor
    frozen = Frozen(parameters, processor.shared())
    frozen = jax.device_put(frozen, meshes.shardings(frozen, mesh))
    start = copied(state.adapters)
    programs = update.Programs(config, graphdef, optimizer, shardings)
    imitate = student.make_program(config, graphdef, optimizer, shardings)

    def policy(adapters: Any) -> Policy:
        return Policy(nnx.merge(graphdef, adapters, frozen.parameters), processor)

    run.policy = policy(start)
    shapes = jax.tree.map(meshes.with_sharding, jax.eval_shape(lambda: state), shardings)
    fixed = config, environments, programs, frozen, start, policy, shardings, imitate, gyms
    return Setting(*fixed), state, shapes


def _gyms(config: ReinforceConfig, devices: int) -> dict[str, Env]:
    """Return by task the worlds in which teachers practise; none without teachers."""
    if config.online.method != "teacher":
        return {}
    # The engine would simulate all worlds once for each of several devices.
    backend = "mujoco" if jax.default_backend() == "cpu" and devices == 1 else None
    sizes = config.online.teacher_worlds, backend
    return {task: environment(config, task, *sizes) for task in config.tasks}


def _steered(config: ReinforceConfig, policy: Policy) -> Policy:
    """Return the policy with a new actor of its noise, which alone is trained."""
    key, model = RandomStream.NOISE_ACTOR.key(config.seed), policy.model
    actor = NoiseActor.init(key, model.config, std=config.online.std, widths=_WIDTHS)
    rules = [(f"^{PATH}$", FullFineTuning())]
    model = adaptation.adapt(noise_actor.attach(model, actor), rules, rngs=nnx.Rngs(0))
    return dataclasses.replace(policy, model=model)


def _optimizer(config: ReinforceConfig, policy: Policy) -> optax.GradientTransformation:
    """Return the optimizer of what the method trains."""
    if config.online.method == "noise":
        return descent.optimizer()
    methods = adaptation.methods(policy.model).values()
    if any(isinstance(method, AdaLoRA) for method in methods):
        raise ValueError(
            "ada_lora needs a number of steps, which reinforcement learning has not: "
            "choose another method"
        )
    return make_optimizer(_optim(config), methods)


def _optim(config: ReinforceConfig) -> OptimConfig:
    """Return settings without a warm-up.

    The rate of PPO follows the KL divergence, that of imitation decays over as many gradient steps
    as the run may take.
    """
    optim, steps = config.optim, config.optim.steps * config.online.gradient_steps
    if config.online.method == "ppo":
        return dataclasses.replace(optim, final_learning_rate=optim.learning_rate, warmup_steps=0)
    return dataclasses.replace(optim, steps=steps, warmup_steps=0)


def environment(
    config: ReinforceConfig, task: str, worlds: int, backend: Backend | None = None
) -> Env:
    """Make the worlds of a task."""
    return envs.make(
        task,
        robot=config.robot,
        num_envs=worlds,
        image_size=config.image_size,
        control_dt=config.control_dt,
        reward=config.online.reward,
        discount=config.online.discount,
        backend=backend,
    )


def check_memory(config: ReinforceConfig, environments: Mapping[str, Env]) -> None:
    """Raise ValueError if the pictures of an iteration exceed the memory of the devices."""
    calls = [-(-x.max_steps // config.evaluation.execute_steps) for x in environments.values()]
    held = 2 * sum(calls)  # those of the calls, and joined
    if config.online.method == "teacher":  # which clones one task after another
        held = max(held, sum(calls) + 2 * max(calls))
    elif config.online.method == "noise":  # which keeps none
        held = 2
    pictures = len(Env.cameras) * config.image_size**2 * 3
    needed = held * config.online.worlds * pictures / jax.local_device_count()
    if needed > (available := preflight.available_bytes()):
        raise ValueError(
            f"the pictures of {config.online.worlds} worlds (online.worlds) take "
            f"{needed / 2**30:.1f} GiB per device of {available / 2**30:.1f}: choose fewer worlds"
        )


def _critics(config: ReinforceConfig, environments: Mapping[str, Env]) -> dict[str, Critic]:
    rate, init = config.online.critic_learning_rate, jax.jit(Critic.init, static_argnums=(1, 2))
    return {
        task: init(RandomStream.CRITIC.key(config.seed, task), _size(env), rate)
        for task, env in environments.items()
    }


def _teachers(
    config: ReinforceConfig, gyms: Mapping[str, Env], policy: Policy
) -> dict[str, Teacher]:
    shape = config.evaluation.execute_steps, policy.processor.statistics.dim
    init = jax.jit(Teacher.init, static_argnums=(1, 2, 3))
    return {
        task: init(RandomStream.TEACHER.key(config.seed, task), _size(env), *shape)
        for task, env in gyms.items()
    }


def _size(env: Env) -> int:
    """Return the length of full states, with the elapsed time."""
    return max(part.stop for part in env.full_state_layout.values()) + 1
