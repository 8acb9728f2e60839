"""State of a batch of worlds, and trajectories."""

import dataclasses
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Data:
    """One world, or W worlds with a leading axis; names and units are MuJoCo's.

    Holds only what the next step reads, and poses for rendering and tasks.

    Attributes:
        qpos, qvel: positions and velocities of all joints.
        qacc_warmstart: initial guess of the constraint solver.
        xpos, xquat, xmat: poses of bodies in the world frame, `[bodies, 3]` in m, `[bodies, 4]`,
            `[bodies, 3, 3]`.
        geom_xpos, geom_xmat, site_xpos, site_xmat, cam_xpos, cam_xmat: poses of geoms, sites and
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
        """Return a copy with some fields replaced."""
        return dataclasses.replace(self, **changes)


class Poses(NamedTuple):
    """Poses of all G geoms and N cameras of a scene, in the world frame, with any leading axes.

    Attributes:
        geom_xpos: `[G, 3]` positions of the geoms [m].
        geom_xmat: `[G, 3, 3]` rotations of the geoms.
        cam_xpos: `[N, 3]` positions of the cameras [m].
        cam_xmat: `[N, 3, 3]` rotations of the cameras, which look along their -z, y up.
    """

    geom_xpos: jax.Array
    geom_xmat: jax.Array
    cam_xpos: jax.Array
    cam_xmat: jax.Array

    @classmethod
    def of(cls, data: Data) -> Self:
        """Take the poses from the data of a state."""
        return cls(data.geom_xpos, data.geom_xmat, data.cam_xpos, data.cam_xmat)


MOVING = ("qpos", "qvel", "qacc_warmstart")
"""Fields of `Data` that physics steps update; all others are computed from them."""
Changes = dict[str, jax.Array]
"""Fields of the MuJoCo model that differ between worlds, by MuJoCo's names."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """W worlds; every leaf has leading axis W.

    Attributes:
        data: positions, velocities and poses.
        reward: f32 [W], of the last step; the sparse reward is 1 on success, else 0.
        done: bool [W]; a done world stays frozen until `reset_done`.
        metrics: f32 [W] each, the task's measurements and the terms of a dense reward.
        info: more about each world, by name:

            - `success` bool [W], `steps` int32 [W];
            - `instruction` int32 [W]: index into `env.instructions`;
            - `command` f32 [W, J + 1]: last targets sent to the robot [rad, m];
            - `earlier` f32 [W, J + 1]: the targets before `command`;
            - `held` int32 [W]: consecutive control steps at the goal;
            - `broken` bool [W]: physics diverged, and the world is frozen at its last finite state;
            - `layout`: body name -> f32 [W, 4] at reset: x, y, z [m] and yaw [rad];
            - `draw`: randomized values from `envs.scene.randomization`, or None.
    """

    data: Data
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]
    info: dict[str, Any]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Trajectory:
    """T control steps of W worlds.

    Attributes:
        state: f32 [T, W, J + 1] joints [rad] and gripper opening [m] before each action.
        action: f32 [T, W, A].
        reward: f32 [T, W] after the action.
        done: bool [T, W] after the action.
    """

    state: jax.Array
    action: jax.Array
    reward: jax.Array
    done: jax.Array


def where(condition: jax.Array, yes: Any, no: Any) -> Any:
    """Apply `jnp.where` to two trees; the condition's axes are the leading axes of every leaf."""

    def choose(a: jax.Array, b: jax.Array) -> jax.Array:
        shape = condition.shape + (1,) * (a.ndim - condition.ndim)
        return jnp.where(condition.reshape(shape), a, b)

    return jax.tree.map(choose, yes, no)
