"""Forward kinematics of a MuJoCo model; it compiles in a sixth of the time of MJX's own.

MJX unrolls every level of the body tree, which made up half of a step's compiled code. Here all
frames, one per body and one per joint, are handled at once by pointer jumping. Each frame starts
with its pose in its parent, then gets its pose in the frame two levels up, then four, then eight.
After log2(depth) rounds, all poses are in the world frame.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

_FREE, _BALL, _SLIDE, _HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("FREE", "BALL", "SLIDE", "HINGE")
)
# For the quaternion product a b = sum_i a[i] * b[_ORDER[i]] * _SIGN[i].
_ORDER = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGN = np.array([[1, 1, 1, 1], [-1, 1, -1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1]], np.float32)


class Kinematics:
    """A replacement for `mjx.kinematics`, for models without mocap bodies.

    A pose is a [3, 4] array, rotation and position [m] side by side.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._joints = model.nbody + np.arange(model.njnt)  # joint frames follow body frames
        self._bodies = np.arange(model.nbody)  # frame of each body after all its joints
        self._parents = np.zeros(model.nbody + model.njnt, int)
        for body in range(1, model.nbody):
            self._parents[body] = self._bodies[model.body_parentid[body]]
            for joint in np.flatnonzero(model.jnt_bodyid == body):
                free = model.jnt_type[joint] == _FREE  # its pose is relative to the world
                self._parents[self._joints[joint]] = 0 if free else self._bodies[body]
                self._bodies[body] = self._joints[joint]
        self._hinged = (model.jnt_type == _HINGE)[:, None]
        self._slide_axes = (model.jnt_type == _SLIDE)[:, None] * model.jnt_axis
        self._fixed_quats = [model.body_iquat, model.geom_quat, model.site_quat]

    def __call__(self, model: Any, data: Any) -> Any:
        """Return MJX's data with all poses computed from `qpos`.

        `xanchor` of slide and free joints is the position after their motion; nothing reads it.
        """
        qpos, quats, positions = self._local(model, data.qpos)
        frames = jnp.concatenate([_matrices(quats), positions[..., None]], axis=-1)
        world, quats = self._in_world(frames, _compose), self._in_world(quats, _multiply)
        bodies, joints = world[self._bodies], world[self._joints]
        owners = [np.arange(model.nbody), model.geom_bodyid, model.site_bodyid]
        positions = jnp.concatenate([model.body_ipos, model.geom_pos, model.site_pos])
        rotations = _matrices(np.concatenate(self._fixed_quats))
        local = jnp.concatenate([rotations, positions[..., None]], axis=-1)
        fixed = _compose(bodies[np.concatenate(owners)], local)
        inertias, geoms, sites = jnp.split(fixed, np.cumsum([len(ids) for ids in owners[:-1]]))
        return data.replace(
            qpos=qpos,
            xanchor=_rotate(joints[..., :3], model.jnt_pos) + joints[..., 3],
            xaxis=_rotate(joints[..., :3], model.jnt_axis),
            xpos=bodies[..., 3],
            xquat=quats[self._bodies],
            xmat=bodies[..., :3],
            xipos=inertias[..., 3],
            ximat=inertias[..., :3],
            geom_xpos=geoms[..., 3],
            geom_xmat=geoms[..., :3],
            site_xpos=sites[..., 3],
            site_xmat=sites[..., :3],
        )

    def _local(self, model: Any, qpos: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return normalized qpos, and the quaternion and position of each frame in its parent."""
        change = (qpos - model.qpos0)[model.jnt_qposadr][:, None]
        half = self._hinged * change / 2
        rotations = jnp.concatenate([jnp.cos(half), jnp.sin(half) * model.jnt_axis], axis=-1)
        shifts = change * self._slide_axes
        for joint in np.flatnonzero(np.isin(model.jnt_type, (_FREE, _BALL))):
            start, free = model.jnt_qposadr[joint], model.jnt_type[joint] == _FREE
            address = start + (3 if free else 0) + np.arange(4)
            quat = qpos[address] / jnp.linalg.norm(qpos[address])
            qpos, rotations = qpos.at[address].set(quat), rotations.at[joint].set(quat)
            if free:
                shifts = shifts.at[joint].set(qpos[start : start + 3])
        # Joints rotate about their anchor, not about the origin of the frame.
        positions = shifts + model.jnt_pos - _rotate(_matrices(rotations), model.jnt_pos)
        return (
            qpos,
            jnp.concatenate([model.body_quat, rotations]),
            jnp.concatenate([model.body_pos, positions]),
        )

    def _in_world(
        self, frames: jax.Array, compose: Callable[[jax.Array, jax.Array], jax.Array]
    ) -> jax.Array:
        """Transform frames from their parents to the world."""
        ancestors = self._parents
        while np.any(ancestors):
            frames = compose(frames[ancestors], frames)
            ancestors = ancestors[ancestors]
        return frames


def _compose(outer: jax.Array, inner: jax.Array) -> jax.Array:
    """Compose poses by sums; in a matmul, some devices would round to TF32 or bf16."""
    terms = [outer[..., :, i, None] * inner[..., i, None, :] for i in range(3)]
    return terms[0] + terms[1] + terms[2] + outer * np.array([0, 0, 0, 1], np.float32)


def _multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Multiply quaternions [..., 4]."""
    terms = [a[..., i, None] * b[..., _ORDER[i]] * _SIGN[i] for i in range(4)]
    return terms[0] + terms[1] + terms[2] + terms[3]


def _rotate(rotations: jax.Array, vectors: jax.Array) -> jax.Array:
    return jnp.sum(rotations * vectors[..., None, :], axis=-1)


def _matrices(quat: Any) -> jax.Array:
    """Convert unit quaternions [..., 4] to rotation matrices [..., 3, 3]."""
    w, x, y, z = (quat[..., i] for i in range(4))
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2).astype(jnp.float32)
