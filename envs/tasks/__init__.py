"""Manipulation tasks: one file a task, found by its name.

A task says what lies on the table and where (`place`), what counts as success (`check`), how people
ask for it (`instructions`) and how a hand does it (`waypoints`). It knows nothing of robots.

Contact masks of the scenes: objects that are carried have contype 1, finger tips contype 2;
whatever they may touch has the bit in its conaffinity, and no other pair is ever computed.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from envs.robots import TIP_LENGTH

Layout = dict[str, jax.Array]  # body name -> position [3] in m at reset


@dataclasses.dataclass(frozen=True)
class View:
    """What a task sees of one simulated world."""

    model: mujoco.MjModel
    data: Any

    def position(self, body: str) -> jax.Array:
        """Position [3] of a body in m."""
        return self.data.xpos[self.model.body(body).id]

    def speed(self, body: str) -> jax.Array:
        """Linear speed of a free body in m/s."""
        start = self.model.jnt_dofadr[self.model.body(body).jntadr[0]]
        return jnp.linalg.norm(self.data.qvel[start : start + 3])

    def joint(self, name: str) -> jax.Array:
        """Position of a hinge [rad] or slide [m]."""
        return self.data.qpos[self.model.joint(name).qposadr[0]]

    @property
    def tcp(self) -> jax.Array:
        """Position [3] of the tool centre between the fingers in m."""
        return self.data.site_xpos[self.model.site("tcp").id]

    @property
    def tip(self) -> jax.Array:
        """Position [3] of the point between the ends of the finger tips in m."""
        rotation = self.data.site_xmat[self.model.site("tcp").id].reshape(3, 3)
        return self.tcp + TIP_LENGTH * rotation[:, 2]

    @property
    def opening(self) -> jax.Array:
        """Distance between the fingers in m."""
        return self.joint("left") + self.joint("right")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Waypoints:
    """Poses the hand goes through one after the other; P of them.

    Attributes:
        position: [P, 3] of the tcp in m.
        rotation: [P, 3, 3] of the tcp; a robot leans on top of that (`Robot.lean`).
        opening: [P] of the gripper in m.
        seconds: [P] nominal time to get there from the one before.
        spread: [P] standard deviation of the noise on the position in m, 0 where it matters.
    """

    position: jax.Array
    rotation: jax.Array
    opening: jax.Array
    seconds: jax.Array
    spread: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """A task, all functions being for one world and pure.

    Attributes:
        name: file name of the task.
        scene: MJCF of the bodies on the table; `place` moves those that are fixed or free.
        instructions: phrasings of the request, at most 8 words each.
        time_limit: seconds after which an episode ends.
        expert_time: seconds the expert is given.
        hold_steps: consecutive control steps for which `check` must hold.
        place: key -> random layout.
        check: view -> (bool scalar, metrics): the goal is met now.
        waypoints: layout -> the way a hand does it.
    """

    name: str
    scene: str
    instructions: tuple[str, ...]
    time_limit: float
    expert_time: float
    hold_steps: int
    place: Callable[[jax.Array], Layout]
    check: Callable[[View], tuple[jax.Array, dict[str, jax.Array]]]
    waypoints: Callable[[Layout], Waypoints]


def tool_down(position: jax.Array) -> jax.Array:
    """Rotations [..., 3, 3] of a tcp that points down, fingers opening across the line to the base.

    Args:
        position: [..., 3] where the tcp is; the arm's base stands at the origin.
    """
    yaw = jnp.arctan2(position[..., 1], position[..., 0])
    c, s, zero = jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw)
    columns = [jnp.stack([-c, -s, zero], -1), jnp.stack([-s, c, zero], -1)]
    down = jnp.broadcast_to(jnp.array([0.0, 0.0, -1.0]), columns[0].shape)
    return jnp.stack([*columns, down], axis=-1)


def route(*rows: tuple[jax.Array, tuple[float, float, float], float, float, float]) -> Waypoints:
    """Waypoints with the tool pointing down, from rows (anchor [3], offset, opening, s, spread)."""
    anchors, offsets, opening, seconds, spread = zip(*rows, strict=True)
    position = jnp.stack(anchors) + jnp.array(offsets)
    numbers = (jnp.array(column, jnp.float32) for column in (opening, seconds, spread))
    return Waypoints(position, tool_down(position), *numbers)
