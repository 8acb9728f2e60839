"""Privileged state of a world as one flat vector with a documented layout.

Positions and directions are in the world frame, whose origin is on the table. It is the robot's
base frame unless `Randomization.table_height` moves the robot.
"""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.robots import multiply
from envs.scene.randomization import in_subtrees
from envs.tasks import View

_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def parts(
    model: mujoco.MjModel, data: Any, command: jax.Array, bodies: Iterable[str]
) -> dict[str, jax.Array]:
    """Compute the parts of one world's privileged state (`Env.full_state`) by name, all f32.

    - `joints` [J + 1]: joint angles [rad] and gripper opening [m].
    - `joint_speeds` [J + 1]: their time derivatives [rad/s, m/s].
    - `command` [J + 1]: the last targets [rad, m].
    - `tool` [9]: position [m], x axis and y axis of the tcp.
    - `<body>` [9]: position relative to the tcp [m], x axis and y axis.
    - `<body>_speed` [6], of free bodies: linear [m/s] and angular [rad/s] velocity.
    - `<body>/<joint>` [2]: position and speed of each hinge [rad, rad/s] or slide [m, m/s].

    `data` is one world, as `envs.state.Data` or `mujoco.MjData`. `bodies` names the task's bodies.
    """
    view, count = View(model, data), len(command) - 1
    tool = data.site_xmat[model.site("tcp").id].reshape(3, 3)
    result = {
        "joints": _with_opening(data.qpos, count),
        "joint_speeds": _with_opening(data.qvel, count),
        "command": command,
        "tool": jnp.concatenate([view.tcp, tool[:, 0], tool[:, 1]]),
    }
    for name in sorted(bodies):
        body = model.body(name)
        axes = data.xmat[body.id].reshape(3, 3)
        result[name] = jnp.concatenate([view.position(name) - view.tcp, axes[:, 0], axes[:, 1]])
        if body.jntnum[0]:
            first = body.dofadr[0]
            angular = multiply(axes, data.qvel[first + 3 : first + 6])  # from the body frame
            result[f"{name}_speed"] = jnp.concatenate([data.qvel[first : first + 3], angular])
        for joint in _joints(model, name):
            values = data.qpos[joint.qposadr[0]], data.qvel[joint.dofadr[0]]
            result[f"{name}/{joint.name}"] = jnp.stack(values)
    return result


def layout(model: mujoco.MjModel, joints: int, bodies: Iterable[str]) -> dict[str, slice]:
    """Return the slice of each part in the concatenation of all `parts`."""
    names: list[str] = []

    def values() -> list[jax.Array]:
        by_name = parts(model, mujoco.MjData(model), jnp.zeros(joints + 1), bodies)
        names.extend(by_name)  # JAX would sort the keys of a dict
        return [*by_name.values()]

    sizes = [part.size for part in jax.eval_shape(values)]
    ends = np.cumsum(sizes).tolist()
    return {n: slice(end - size, end) for n, size, end in zip(names, sizes, ends, strict=True)}


def _with_opening(values: jax.Array, count: int) -> jax.Array:
    """Return the values of the first `count` joints, and the sum over both fingers."""
    return jnp.append(values[:count], values[count] + values[count + 1])


def _joints(model: mujoco.MjModel, name: str) -> list[Any]:
    """Return the hinges and slides in the subtree of a body."""
    in_subtree = in_subtrees(model, [name])
    joints = [model.joint(i) for i in range(model.njnt)]
    return [joint for joint in joints if joint.type[0] in _SCALAR and in_subtree[joint.bodyid[0]]]
