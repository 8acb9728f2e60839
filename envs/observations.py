"""What a learner may know of a world beside its pictures: one flat vector with a stated layout.

Positions and directions are along the axes of the robot's base, which are those of the world.
"""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.robots import multiply
from envs.scene.randomization import belonging
from envs.tasks import View

_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def parts(
    model: mujoco.MjModel, data: Any, command: jax.Array, bodies: Iterable[str]
) -> dict[str, jax.Array]:
    """What one world is like, f32 vectors by name.

    `joints` [J + 1] in rad and the opening in m, `joint_speeds` [J + 1] per second, `command`
    [J + 1] the last targets, `tool` [9] the position of the tcp and its x and y axes. Of each body:
    `<body>` [9] its position relative to the tcp and its x and y axes; if it moves freely,
    `<body>_speed` [6] in m/s and rad/s. Of each hinge or slide of such a body, `<body>/<joint>` [2]
    its position and speed.

    Args:
        model: the scene.
        data: one world, `envs.state.Data` or MuJoCo's own.
        command: [J + 1] last targets of joints and opening.
        bodies: names of the task's bodies.
    """
    view, count = View(model, data), len(command) - 1
    tool = data.site_xmat[model.site("tcp").id].reshape(3, 3)
    found = {
        "joints": _with_opening(data.qpos, count),
        "joint_speeds": _with_opening(data.qvel, count),
        "command": command,
        "tool": jnp.concatenate([view.tcp, tool[:, 0], tool[:, 1]]),
    }
    for name in sorted(bodies):
        body = model.body(name)
        axes = data.xmat[body.id].reshape(3, 3)
        found[name] = jnp.concatenate([view.position(name) - view.tcp, axes[:, 0], axes[:, 1]])
        if body.jntnum[0]:
            first = body.dofadr[0]
            turning = multiply(axes, data.qvel[first + 3 : first + 6])  # MuJoCo: along body's axes
            found[f"{name}_speed"] = jnp.concatenate([data.qvel[first : first + 3], turning])
        for joint in _joints(model, name):
            at = data.qpos[joint.qposadr[0]], data.qvel[joint.dofadr[0]]
            found[f"{name}/{joint.name}"] = jnp.stack(at)
    return found


def layout(model: mujoco.MjModel, joints: int, bodies: Iterable[str]) -> dict[str, slice]:
    """Name of each part -> where it lies in all of them, one after the other."""
    names: list[str] = []

    def values() -> list[jax.Array]:
        found = parts(model, mujoco.MjData(model), jnp.zeros(joints + 1), bodies)
        names.extend(found)  # a tree of JAX would not keep their order
        return [*found.values()]

    sizes = [part.size for part in jax.eval_shape(values)]
    ends = np.cumsum(sizes).tolist()
    return {n: slice(end - size, end) for n, size, end in zip(names, sizes, ends, strict=True)}


def _with_opening(values: jax.Array, count: int) -> jax.Array:
    """What the robot's joints have, and the sum of what its two fingers have."""
    return jnp.append(values[:count], values[count] + values[count + 1])


def _joints(model: mujoco.MjModel, name: str) -> list[Any]:
    """The hinges and slides of a body and of those that hang on it."""
    hanging = belonging(model, [name])
    every = [model.joint(i) for i in range(model.njnt)]
    return [joint for joint in every if joint.type[0] in _SCALAR and hanging[joint.bodyid[0]]]
