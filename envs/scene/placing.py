"""How a layout gets into a MuJoCo model: loose bodies by qpos, fixed ones by the model itself."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.state import Changes
from envs.tasks import Layout


def positions(model: mujoco.MjModel, layout: Layout, joints: jax.Array) -> jax.Array:
    """qpos of one world: the robot's own joints first, loose bodies as the layout says."""
    qpos = jnp.asarray(model.qpos0, jnp.float32).at[: len(joints)].set(joints)
    for name, place in layout.items():
        body = model.body(name)
        if body.jntnum[0]:
            start = model.jnt_qposadr[body.jntadr[0]]
            qpos = qpos.at[start : start + 7].set(_pose(place))
    return qpos


def fixed_bodies(model: mujoco.MjModel, layout: Layout, changes: Changes) -> Changes:
    """Poses of all bodies in their parents, the fixed ones of the layout where it says.

    Mocap bodies would be the usual way, but MJX leaves their children behind.
    """
    position = changes.get("body_pos", jnp.asarray(model.body_pos, jnp.float32))
    rotation = jnp.asarray(model.body_quat, jnp.float32)
    for name, place in layout.items():
        body, pose = model.body(name), _pose(place)
        if not body.jntnum[0]:
            position = position.at[body.id].set(pose[:3])
            rotation = rotation.at[body.id].set(pose[3:])
    return {"body_pos": position, "body_quat": rotation}


def placed(model: mujoco.MjModel, layout: Layout, world: int) -> mujoco.MjModel:
    """A copy of the model with its fixed bodies where one world of a batch has them."""
    model = copy.copy(model)
    own = {name: places[world] for name, places in layout.items()}
    for name, value in fixed_bodies(model, own, {}).items():
        getattr(model, name)[:] = np.asarray(value)
    return model


def _pose(place: jax.Array) -> jax.Array:
    """Position in m and unit quaternion [7] of a place of a layout."""
    half = place[3] / 2
    return jnp.stack([*place[:3], jnp.cos(half), 0.0 * half, 0.0 * half, jnp.sin(half)])
