"""What a batch of worlds is between two steps, and what is kept of an episode."""

import dataclasses
from typing import Any, Self

import jax
import jax.numpy as jnp


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Data:
    """One world, or W worlds with a leading axis; names and units are MuJoCo's.

    Of all that MuJoCo has, only what a step reads and the poses that others look at.

    Attributes:
        qpos, qvel: positions and velocities of all joints.
        qacc_warmstart: where the constraint solver starts.
        xpos, xquat, xmat: `[bodies, 3]` in m, `[bodies, 4]`, `[bodies, 3, 3]`, in the world frame.
        geom_xpos, geom_xmat, site_xpos, site_xmat, cam_xpos, cam_xmat: the same of geoms, sites and
            cameras.
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array
    xpos: jax.Array
    xquat: jax.Array
    xmat: jax.Array
    geom_xpos: jax.Array
    geom_xmat: jax.Array
    site_xpos: jax.Array
    site_xmat: jax.Array
    cam_xpos: jax.Array
    cam_xmat: jax.Array

    def replace(self, **changes: Any) -> Self:
        """The same with other values of some fields."""
        return dataclasses.replace(self, **changes)


MOVING = ("qpos", "qvel", "qacc_warmstart")
"""The fields of `Data` that steps change; all others follow from them."""
Changes = dict[str, jax.Array]
"""Fields of the MuJoCo model that differ in one world, by MuJoCo's names."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """W worlds; every leaf has leading axis W.

    Attributes:
        data: positions, velocities and poses, up to date.
        reward: f32 [W], 1 where the task is done successfully.
        done: bool [W], latched; a done world stands still until `reset_done`.
        metrics: f32 [W] each, what the task measures.
        info: success bool [W]; steps int32 [W]; instruction int32 [W], index into
            `env.instructions`; command f32 [W, J + 1], the last targets sent to the robot [rad, m];
            earlier, those before; held int32 [W], consecutive control steps at the goal; broken
            bool [W], ended at its last good moment because physics was not finite after it; layout,
            body name -> [W, 4] at reset: x, y, z [m], turn about z [rad]; draw, what
            `envs.scene.randomization` drew for each world, or None.
    """

    data: Data
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]
    info: dict[str, Any]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Trajectory:
    """What W worlds went through in T control steps.

    Attributes:
        state: f32 [T, W, J + 1] joints [rad] and gripper opening [m] before each action.
        action: f32 [T, W, A].
        reward: f32 [T, W] after it.
        done: bool [T, W] after it.
    """

    state: jax.Array
    action: jax.Array
    reward: jax.Array
    done: jax.Array


def where(condition: jax.Array, yes: Any, no: Any) -> Any:
    """`jnp.where` over two trees; the condition's axes are the leading ones of every leaf."""

    def choose(a: jax.Array, b: jax.Array) -> jax.Array:
        shape = condition.shape + (1,) * (a.ndim - condition.ndim)
        return jnp.where(condition.reshape(shape), a, b)

    return jax.tree.map(choose, yes, no)
