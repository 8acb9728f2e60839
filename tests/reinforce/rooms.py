"""An environment without physics, and runs in it."""

import dataclasses
import functools
import io
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from envs.state import Data, State
from lorasp_jax.config import EvaluationConfig, OptimConfig
from lorasp_jax.policies.policy import Policy
from lorasp_jax.reinforce.config import Learning, ReinforceConfig
from lorasp_jax.training.run import Run
from tests.runs import CONFIG, make_run


@dataclasses.dataclass(frozen=True)  # equal rooms share programs
class Room:
    """A world succeeds when its first joint is commanded to a sum of more than `goal`.

    Its observation is the same in all layouts but for the first joint angle.
    """

    num_envs: int = 8
    max_steps: int = 4
    goal: float = 1.0
    instructions: tuple[str, ...] = ("press the button",)

    @property
    def full_state_layout(self):
        return {"joints": slice(0, 7)}

    def full_state(self, state):
        return state.data.qpos

    def proprio(self, state):
        return state.data.qpos

    def reset(self, key, ranges=None):
        zero = jnp.zeros(self.num_envs)
        count = zero.astype(jnp.int32)
        info = {"success": zero > 0, "steps": count, "instruction": count, "draw": None}
        qpos = 0.1 * jax.random.normal(key, (self.num_envs, 7))
        pose = jnp.zeros((self.num_envs, 2, 3))
        data = Data(**{field.name: pose for field in dataclasses.fields(Data)})
        return State(data.replace(qpos=qpos), zero, zero > 0, {}, info)

    def reset_done(self, state, key, ranges=None):
        def choose(new, old):
            done = state.done.reshape(-1, *[1] * (old.ndim - 1))
            return jnp.where(done, new, old)

        return jax.tree.map(choose, self.reset(key), state)

    def observe(self, state):
        image = jnp.full((self.num_envs, 32, 32, 3), 100, jnp.uint8)
        return {"image": {"side": image, "wrist": image}, "state": state.data.qpos}

    def step(self, state, action):
        running = ~state.done
        qpos = jnp.where(running[:, None], state.data.qpos + 0.3 * action, state.data.qpos)
        success = state.info["success"] | (qpos[:, 0] > self.goal)
        steps = state.info["steps"] + running
        info = state.info | {"success": success, "steps": steps}
        reward = (success & running).astype(jnp.float32)
        done = success | (steps >= self.max_steps)
        return State(state.data.replace(qpos=qpos), reward, done, {}, info)


def config(**changes) -> ReinforceConfig:
    fields = {field.name: getattr(CONFIG, field.name) for field in dataclasses.fields(CONFIG)}
    # Rarely does an episode succeed; a run with sparse reward would stop then.
    learn = Learning(
        method="ppo", worlds=8, teacher_worlds=8, std=0.2, reward="dense", epochs=2, max_kl=1.0
    )
    learn = dataclasses.replace(learn, rounds=2, gradient_steps=4)
    optim = OptimConfig(steps=4, batch_size=8, learning_rate=1e-3)
    evaluation = EvaluationConfig(episodes=8, num_envs=8, execute_steps=2, denoise_steps=2)
    targets = "q_proj", "action_out_proj"  # programs of more layers take longer to compile
    fields |= {"tasks": ("press",), "optim": optim, "evaluation": evaluation, "online": learn}
    fields |= {"targets": targets}
    return ReinforceConfig(**fields | {"log_every": 1, "checkpoint_every": 1} | changes)


def start(folder: Path, settings: ReinforceConfig, devices: int = 1) -> Run:
    """Return a run that begins with the same random policy for equal settings."""
    run = make_run(folder, settings, devices=devices)
    run.console = Console(file=io.StringIO())
    return run


_sample = jax.jit(functools.partial(Policy.sample, num_steps=2))


def outputs(policy: Policy) -> jax.Array:
    """Return actions in two random situations."""
    rng = np.random.default_rng(0)
    image = {n: rng.integers(0, 255, (2, 32, 32, 3), np.uint8) for n in ("side", "wrist")}
    raw = {"image": image, "state": rng.normal(size=(2, 7)).astype("f")}
    return _sample(policy, jax.random.key(0), raw, np.zeros(2, np.int32))
