"""Place a layout's bodies: free ones through qpos, fixed ones by changing the MuJoCo model."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.state import Changes
from envs.tasks import Layout


def positions(model: mujoco.MjModel, layout: Layout, joints: jax.Array) -> jax.Array:
    """Return the qpos of one world: first the robot's joints, then free bodies as in the layout."""
    qpos = jnp.asarray(model.qpos0, jnp.float32).at[: len(joints)].set(joints)
    for name, pose in layout.items():
        body = model.body(name)
        if body.jntnum[0]:
            start = model.jnt_qposadr[body.jntadr[0]]
            qpos = qpos.at[start : start + 7].set(_to_qpos(pose))
    return qpos


def fixed_bodies(model: mujoco.MjModel, layout: Layout, changes: Changes) -> Changes:
    """Return all bodies' poses relative to their parents, with fixed bodies placed by the layout.

    Mocap bodies would be the usual way, but MJX does not move their children.
    """
    position = changes.get("body_pos", jnp.asarray(model.body_pos, jnp.float32))
    rotation = jnp.asarray(model.body_quat, jnp.float32)
    for name, pose in layout.items():
        body, qpos = model.body(name), _to_qpos(pose)
        if not body.jntnum[0]:
            position = position.at[body.id].set(qpos[:3])
            rotation = rotation.at[body.id].set(qpos[3:])
    return {"body_pos": position, "body_quat": rotation}


def world_model(model: mujoco.MjModel, layout: Layout, world: int) -> mujoco.MjModel:
    """Copy the model with its fixed bodies placed as in one world of a batch."""
    model = copy.copy(model)
    own = {name: poses[world] for name, poses in layout.items()}
    for name, value in fixed_bodies(model, own, {}).items():
        getattr(model, name)[:] = np.asarray(value)
    return model


def _to_qpos(pose: jax.Array) -> jax.Array:
    """Convert a pose [4] of a layout to position [m] and unit quaternion, [7]."""
    half = pose[3] / 2
    return jnp.stack([*pose[:3], jnp.cos(half), 0.0 * half, 0.0 * half, jnp.sin(half)])
