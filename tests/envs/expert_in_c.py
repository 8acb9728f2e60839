"""Run experts in MuJoCo's own engine, without compiling a scene."""

import functools
import types
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import actions
from envs.experts import expert
from envs.tasks import View

FIELDS = ("qpos", "qvel", "xpos", "xmat", "site_xpos", "site_xmat")  # that tasks read


def world(scene, key: int = 0) -> mujoco.MjData:
    """Return MuJoCo data of a random layout, robot at home; moves fixed bodies of the model."""
    return _placed(scene, layout(scene, key))


def episode(scene, key: int = 0) -> Iterator[mujoco.MjData]:
    """Yield the same data at the start and after each control step of the expert, until success."""
    places = layout(scene, key)
    data = _placed(scene, places)
    command = np.array([*scene.robot.home, 0.04], np.float32)  # m, gripper
    data.qpos[scene.num_joints : scene.num_joints + 2] = 0.02
    mujoco.mj_forward(scene.model, data)
    yield data
    knots, times = _plan(scene, places, command, jax.random.key(key))
    commands, held = [command, command], 0
    for step in range(1, scene.expert_steps + 1):
        commands.append(_target(knots, times, step * scene.control_dt))
        for control in _controls(np.stack(commands[-3:]), scene.control_dt):
            data.ctrl[:] = control
            mujoco.mj_step(scene.model, data)
        mujoco.mj_forward(scene.model, data)
        yield data
        held = held + 1 if measure(scene, data)[0] else 0
        if held >= scene.task.hold_steps:
            return
    raise AssertionError("the expert did not succeed")


@functools.cache
def layout(scene, key: int) -> dict[str, jax.Array]:
    """Return a random layout."""
    return jax.jit(scene.task.place)(jax.random.key(key))


def measure(scene, data, size: float = 1.0) -> tuple[bool, np.ndarray]:
    """Return whether the goal is reached, and the shares of all stages."""
    reached, stages = _measure(scene, {name: getattr(data, name) for name in FIELDS}, size)
    return bool(reached), np.asarray(stages)


@functools.partial(jax.jit, static_argnums=0)
def _measure(scene, fields, size):
    view = View(scene.model, types.SimpleNamespace(**fields), size)
    return scene.task.check(view)[0], jnp.stack([*scene.task.stages(view).values()])


def _placed(scene, layout) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    data.qpos[: scene.num_joints] = scene.robot.home
    for name, (*position, yaw) in layout.items():
        body = scene.model.body(name)
        turn = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
        if body.jntnum[0]:
            start = scene.model.jnt_qposadr[body.jntadr[0]]
            data.qpos[start : start + 7] = *position, *turn
        else:
            scene.model.body_pos[body.id], scene.model.body_quat[body.id] = position, turn
    mujoco.mj_forward(scene.model, data)
    return data


@functools.partial(jax.jit, static_argnums=0)
def _plan(scene, layout, command, key):
    plan = expert._plan(scene, {"layout": layout, "command": command, "draw": None}, key)
    return plan.knots, plan.times


_target = jax.jit(expert.interpolate)


@functools.partial(jax.jit, static_argnums=1)
def _controls(commands, control_dt):
    return actions.interpolate(commands, control_dt, 0.0)
