"""Manipulation tasks: one module per task, found by the `TASK` that it defines.

A task defines the objects on the table (`scene`, `place`), success (`check`), phrasings of the
request (`instructions`), a solution as poses of the hand (`waypoints`) and the progress along it
(`stages`). It does not depend on the robot.

In contact masks, each role is one bit of `contype`: 1 for carried objects, 2 for finger tips, 4 for
surfaces that only finger pads touch, 8 for feet. A geom that may touch a role has that role's bit
in `conaffinity`.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from envs.robots import TIP_LENGTH, multiply

_ALMOST = 0.99  # maximum progress of a stage that is not passed yet; our choice

Layout = dict[str, jax.Array]
"""Body name -> pose [4] at reset: x, y, z [m] and yaw [rad]."""


@dataclasses.dataclass(frozen=True)
class View:
    """Measurements of one simulated world, whose objects are scaled by `size`."""

    model: mujoco.MjModel
    data: Any
    size: float | jax.Array = 1.0

    def position(self, body: str) -> jax.Array:
        """Return the position [3] of a body [m]."""
        return self.data.xpos[self.model.body(body).id]

    def above(self, body: str, height: float) -> jax.Array:
        """Return the point [3] that lies `height` * `size` above a body's position [m]."""
        return self.position(body) + self.size * jnp.array([0.0, 0.0, height])

    def upright(self, body: str) -> jax.Array:
        """Return the cosine of the angle between a body's z axis and the vertical."""
        return self.data.xmat[self.model.body(body).id].reshape(3, 3)[2, 2]

    def on(self, body: str, height: float) -> jax.Array:
        """Return the point [3] that lies `height` * `size` along a body's own z axis [m]."""
        axis = self.data.xmat[self.model.body(body).id].reshape(3, 3)[:, 2]
        return self.position(body) + self.size * height * axis

    def speed(self, body: str) -> jax.Array:
        """Return the linear speed of a free body [m/s]."""
        start = self.model.jnt_dofadr[self.model.body(body).jntadr[0]]
        return jnp.linalg.norm(self.data.qvel[start : start + 3])

    def joint(self, name: str) -> jax.Array:
        """Return the position of a hinge [rad] or slide [m]."""
        return self.data.qpos[self.model.joint(name).qposadr[0]]

    def inside(self, body: str, box: str, half_width: float, height: float) -> jax.Array:
        """Return whether a body's position is inside another body, a square box.

        `half_width` is half the box's inner width; both lengths are at size 1 [m].
        """
        axes = self.data.xmat[self.model.body(box).id].reshape(3, 3)
        offset = multiply(self.position(body) - self.position(box), axes) / self.size
        return jnp.all(jnp.abs(offset[:2]) < half_width) & (offset[2] < height)

    def apart(self, body: str, other: str) -> jax.Array:
        """Return the horizontal distance between two bodies [m]."""
        return jnp.linalg.norm((self.position(body) - self.position(other))[:2])

    def released(self, grip: jax.Array, width: float, away: float = 0.06) -> jax.Array:
        """Return whether the hand has let go of an object by opening wider or by moving away.

        Args:
            grip: [3] point at which the object is held [m].
            width: width of the object there, at size 1 [m].
            away: distance from `grip` beyond which the tcp has moved away [m].
        """
        wider = self.opening > width * self.size + 0.005
        return wider | (jnp.linalg.norm(grip - self.tcp) > away)

    def reaching(self, grip: jax.Array) -> jax.Array:
        """Progress of a stage that ends with the tcp within 15 mm of `grip` [3]."""
        return near(jnp.linalg.norm(grip - self.tcp), within=0.015)

    def grasping(self, grip: jax.Array, width: float) -> jax.Array:
        """Progress of a stage that ends with fingers closed around `width` [m] at `grip` [3]."""
        gap = self.opening - width * self.size
        return gate(self.reaching(grip) >= 1, near(gap, within=0.005, scale=0.02))

    def releasing(self, grip: jax.Array, width: float, away: float = 0.06) -> jax.Array:
        """Progress of a stage that ends with `released`; same arguments."""
        gap = width * self.size + 0.005 - self.opening
        share = jnp.minimum(near(gap, scale=0.02), _ALMOST)
        return jnp.where(self.released(grip, width, away), 1.0, share)

    @property
    def tcp(self) -> jax.Array:
        """Position [3] of the tool center point between the fingers [m]."""
        return self.data.site_xpos[self.model.site("tcp").id]

    @property
    def tip(self) -> jax.Array:
        """Position [3] midway between the ends of the finger tips [m]."""
        rotation = self.data.site_xmat[self.model.site("tcp").id].reshape(3, 3)
        return self.tcp + TIP_LENGTH * rotation[:, 2]

    @property
    def opening(self) -> jax.Array:
        """Distance between the fingers [m]."""
        return self.joint("left") + self.joint("right")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Waypoints:
    """A sequence of P poses of the hand.

    Each robot rotates these poses about the axis along which its fingers open: by `lean` times its
    own lean (`Robot.lean`), and by `tilt` to the side that its wrist allows (`Robot.tilt_side`).

    Attributes:
        position: [P, 3] pivot of these rotations, a point on the hand's axis behind the tcp [m].
        reach: [P] distance from the pivot to the tcp [m].
        rotation: [P, 3, 3] rotation of the tcp before leaning and tilting.
        lean: [P] share of the robot's own lean.
        tilt: [P] angle [rad].
        opening: [P] gripper opening [m].
        seconds: [P] nominal time from the previous pose [s].
        spread: [P] standard deviation of noise on the position [m], 0 where precision matters.
    """

    position: jax.Array
    reach: jax.Array
    rotation: jax.Array
    lean: jax.Array
    tilt: jax.Array
    opening: jax.Array
    seconds: jax.Array
    spread: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """A task; all functions are pure and take one world.

    Attributes:
        name: name of the task's module.
        scene: MJCF of the bodies on the table, fixed or free; `place` positions them.
        instructions: phrasings of the request, at most 8 words each.
        time_limit: time after which an episode ends [s].
        expert_time: time after which the expert stops [s].
        hold_steps: consecutive control steps for which `check` must hold.
        place: key -> random layout.
        check: view -> (whether the goal is reached now, bool scalar; metrics).
        waypoints: layout -> a solution as poses of the hand.
        stages: view -> completed share of each stage of that solution, f32 in [0, 1], by name,
            first to last. A share of 1 passes the stage and all before it; see `envs.rewards`.
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
    stages: Callable[[View], dict[str, jax.Array]]


def near(distance: jax.Array, within: float = 0.0, scale: float = 0.1) -> jax.Array:
    """Progress of a stage that ends with distance <= `within` [m]: exp(-excess / scale)."""
    return jnp.exp(-jnp.maximum(distance - within, 0.0) / scale)


def gate(condition: jax.Array, share: jax.Array) -> jax.Array:
    """Progress of a stage that cannot begin before a condition holds."""
    return jnp.where(condition, share, 0.0)


def azimuth(position: jax.Array) -> jax.Array:
    """Return the direction [...] of positions [..., 3] from the base at the origin [rad]."""
    return jnp.arctan2(position[..., 1], position[..., 0])


def tool_down(position: jax.Array) -> jax.Array:
    """Return tcp rotations [..., 3, 3] that point down, at positions [..., 3] from the base.

    The fingers open across the line to the base.
    """
    yaw = azimuth(position)
    c, s, zero = jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw)
    columns = [jnp.stack([-c, -s, zero], -1), jnp.stack([-s, c, zero], -1)]
    down = jnp.broadcast_to(jnp.array([0.0, 0.0, -1.0]), columns[0].shape)
    return jnp.stack([*columns, down], axis=-1)


def route(
    *rows: tuple[jax.Array, tuple[float, float, float], float, float, float],
    lean: float = 1.0,
    reach: float = 0.0,
    tilt: Sequence[float] = (),
) -> Waypoints:
    """Make waypoints with the tool pointing down.

    Args:
        rows: (anchor, offset, opening, seconds, spread) of each waypoint. The anchor is a pose of
            the layout or a position [3]; the offset [m] is added to it.
        lean, reach: as in `Waypoints`, the same for all.
        tilt: as in `Waypoints`, one per row [rad]; empty: no tilt.
    """
    anchors, offsets, opening, seconds, spread = zip(*rows, strict=True)
    position = jnp.stack(anchors)[:, :3] + jnp.array(offsets)
    columns = [jnp.array(c, jnp.float32) for c in (opening, seconds, spread)]
    same = jnp.ones(len(rows))
    angles = jnp.array(tilt or [0.0] * len(rows), jnp.float32)
    return Waypoints(position, reach * same, tool_down(position), lean * same, angles, *columns)


def scatter(key: jax.Array, center: tuple[float, ...], spread: tuple[float, ...]) -> jax.Array:
    """Sample a pose [4] on the table, uniform within `spread` [m] of `center` [m], with yaw 0."""
    shift = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0) * jnp.array(spread)
    return jnp.concatenate([jnp.array(center) + shift, jnp.zeros(2)])


def raised(pose: jax.Array, height: float) -> jax.Array:
    """Move a pose [4] up by a height [m]."""
    return pose.at[2].add(height)


def open_box(inside: float, wall: float, height: float, *, floor: str, walls: str) -> str:
    """Return MJCF of a square box without a lid, standing at z = 0.

    Args:
        inside, wall, height: half the inner width, half the walls' thickness, their height [m].
        floor, walls: MJCF attributes of the floor (4 mm thick) and of every wall.
    """
    side, middle, long = inside + wall, height / 2, inside + 2 * wall
    return f"""
  <geom type="box" {floor} size="{inside} {inside} .002" pos="0 0 .002"/>
  <geom type="box" {walls} size="{wall} {long} {middle}" pos="{side} 0 {middle}"/>
  <geom type="box" {walls} size="{wall} {long} {middle}" pos="{-side} 0 {middle}"/>
  <geom type="box" {walls} size="{inside} {wall} {middle}" pos="0 {side} {middle}"/>
  <geom type="box" {walls} size="{inside} {wall} {middle}" pos="0 {-side} {middle}"/>"""
