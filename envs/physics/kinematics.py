"""Where all bodies are, by a program that compiles in a sixth of the time of MJX's own.

MJX walks down the tree of bodies, and every level of it is compiled for itself, which was half of
all that was compiled for a step. Here all frames are handled at once: every body is one, and so is
every joint. Each starts with its pose in its parent, which becomes its pose in the frame two levels
up, then four, then eight: after log2(depth) rounds of the same few operations it is its pose in the
world.
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
# A product of quaternions is a sum over the numbers of the first one, each times the second one in
# this order and with these signs.
_ORDER = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGN = np.array([[1, 1, 1, 1], [-1, 1, -1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1]], np.float32)


class Kinematics:
    """What `mjx.kinematics` computes, for models without mocap bodies.

    A pose is a [3, 4] array: a rotation, and beside it a position in m.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Prepare a model."""
        self._joints = model.nbody + np.arange(model.njnt)  # their frames, after those of bodies
        self._bodies = np.arange(model.nbody)  # frames of bodies that all joints have moved
        self._parents = np.zeros(model.nbody + model.njnt, int)
        for body in range(1, model.nbody):
            self._parents[body] = self._bodies[model.body_parentid[body]]
            for joint in np.flatnonzero(model.jnt_bodyid == body):
                free = model.jnt_type[joint] == _FREE  # and so in the world
                self._parents[self._joints[joint]] = 0 if free else self._bodies[body]
                self._bodies[body] = self._joints[joint]
        self._hinged = (model.jnt_type == _HINGE)[:, None]
        self._slid = (model.jnt_type == _SLIDE)[:, None] * model.jnt_axis
        self._carried = [model.body_iquat, model.geom_quat, model.site_quat]

    def __call__(self, model: Any, data: Any) -> Any:
        """The data of MJX, all poses following from its `qpos`, for a model of MJX.

        Where the joint of a slide or of a free body is, which nothing asks for, is where it moved.
        """
        qpos, quats, shifts = self._own(model, data.qpos)
        frames = jnp.concatenate([_matrices(quats), shifts[..., None]], axis=-1)
        world, quats = self._in_world(frames, _compose), self._in_world(quats, _multiply)
        bodies, joints = world[self._bodies], world[self._joints]
        carriers = [np.arange(model.nbody), model.geom_bodyid, model.site_bodyid]
        shifts = jnp.concatenate([model.body_ipos, model.geom_pos, model.site_pos])
        turns = _matrices(np.concatenate(self._carried))
        own = jnp.concatenate([turns, shifts[..., None]], axis=-1)
        carried = _compose(bodies[np.concatenate(carriers)], own)
        inertias, geoms, sites = jnp.split(carried, np.cumsum([len(c) for c in carriers[:-1]]))
        return data.replace(
            qpos=qpos,
            xanchor=_turn(joints[..., :3], model.jnt_pos) + joints[..., 3],
            xaxis=_turn(joints[..., :3], model.jnt_axis),
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

    def _own(self, model: Any, qpos: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """qpos with unit quaternions; all frames in their parents, quaternions and shifts."""
        change = (qpos - model.qpos0)[model.jnt_qposadr][:, None]
        half = self._hinged * change / 2
        turns = jnp.concatenate([jnp.cos(half), jnp.sin(half) * model.jnt_axis], axis=-1)
        ends = change * self._slid
        for joint in np.flatnonzero(np.isin(model.jnt_type, (_FREE, _BALL))):
            start, free = model.jnt_qposadr[joint], model.jnt_type[joint] == _FREE
            number = start + (3 if free else 0) + np.arange(4)
            quat = qpos[number] / jnp.linalg.norm(qpos[number])
            qpos, turns = qpos.at[number].set(quat), turns.at[joint].set(quat)
            if free:
                ends = ends.at[joint].set(qpos[start : start + 3])
        shifts = ends + model.jnt_pos - _turn(_matrices(turns), model.jnt_pos)  # anchors stay
        return (
            qpos,
            jnp.concatenate([model.body_quat, turns]),
            jnp.concatenate([model.body_pos, shifts]),
        )

    def _in_world(
        self, frames: jax.Array, compose: Callable[[jax.Array, jax.Array], jax.Array]
    ) -> jax.Array:
        """Frames in their parents to frames in the world."""
        ancestors = self._parents
        while np.any(ancestors):
            frames = compose(frames[ancestors], frames)
            ancestors = ancestors[ancestors]
        return frames


def _compose(outer: jax.Array, inner: jax.Array) -> jax.Array:
    """Poses in the frames of poses; sums of three, which are exact enough on every device."""
    terms = [outer[..., :, i, None] * inner[..., i, None, :] for i in range(3)]
    return terms[0] + terms[1] + terms[2] + outer * np.array([0, 0, 0, 1], np.float32)


def _multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Products of quaternions [..., 4]."""
    terms = [a[..., i, None] * b[..., _ORDER[i]] * _SIGN[i] for i in range(4)]
    return terms[0] + terms[1] + terms[2] + terms[3]


def _turn(rotations: jax.Array, vectors: jax.Array) -> jax.Array:
    return jnp.sum(rotations * vectors[..., None, :], axis=-1)


def _matrices(quat: Any) -> jax.Array:
    """Rotations [..., 3, 3] of unit quaternions [..., 4]."""
    w, x, y, z = (quat[..., i] for i in range(4))
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2).astype(jnp.float32)
