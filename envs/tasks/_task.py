"""What a manipulation task states, and what all tasks share.

A task says what lies on the table and where (`place`), what counts as success (`check`), how people
ask for it (`instructions`), how a hand does it (`waypoints`) and how far it has come on that way
(`stages`). It knows nothing of robots.

Contact masks of the scenes, one bit of contype for each part played: 1 objects that are carried,
2 finger tips, 4 what only finger pads hold, 8 feet that stand on something. Whatever they may touch
has the bit in its conaffinity, and no other pair is ever computed.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from envs.robots import TIP_LENGTH, multiply

_ALMOST = 0.99  # share of a stage that is not passed yet

Layout = dict[str, jax.Array]
"""Body name -> where it is at reset: [4], x, y, z in m and the turn about z in rad."""


@dataclasses.dataclass(frozen=True)
class View:
    """What a task sees of one simulated world, whose objects are `size` times their own size."""

    model: mujoco.MjModel
    data: Any
    size: float | jax.Array = 1.0

    def position(self, body: str) -> jax.Array:
        """Position [3] of a body in m."""
        return self.data.xpos[self.model.body(body).id]

    def above(self, body: str, height: float) -> jax.Array:
        """Point [3] in m, `height` [m] over a body's position where objects have their own size."""
        return self.position(body) + self.size * jnp.array([0.0, 0.0, height])

    def upright(self, body: str) -> jax.Array:
        """Cosine of the angle between a body's z axis and the vertical."""
        return self.data.xmat[self.model.body(body).id].reshape(3, 3)[2, 2]

    def on(self, body: str, height: float) -> jax.Array:
        """Point [3] in m of a body, `height` [m] up its own z axis."""
        axis = self.data.xmat[self.model.body(body).id].reshape(3, 3)[:, 2]
        return self.position(body) + self.size * height * axis

    def speed(self, body: str) -> jax.Array:
        """Linear speed of a free body in m/s."""
        start = self.model.jnt_dofadr[self.model.body(body).jntadr[0]]
        return jnp.linalg.norm(self.data.qvel[start : start + 3])

    def joint(self, name: str) -> jax.Array:
        """Position of a hinge [rad] or slide [m]."""
        return self.data.qpos[self.model.joint(name).qposadr[0]]

    def inside(self, body: str, box: str, half_width: float, height: float) -> jax.Array:
        """Whether a body's position lies in a square box that stands where another body is."""
        axes = self.data.xmat[self.model.body(box).id].reshape(3, 3)
        offset = multiply(self.position(body) - self.position(box), axes) / self.size
        return jnp.all(jnp.abs(offset[:2]) < half_width) & (offset[2] < height)

    def apart(self, body: str, other: str) -> jax.Array:
        """Distance of two bodies along the table in m."""
        return jnp.linalg.norm((self.position(body) - self.position(other))[:2])

    def released(self, grip: jax.Array, width: float, away: float = 0.06) -> jax.Array:
        """Whether the hand has let go of what is `width` [m] wide where it is held, at grip [3].

        A gripper that holds it is as wide as it and around it: within `away` [m].
        """
        wider = self.opening > width * self.size + 0.005
        return wider | (jnp.linalg.norm(grip - self.tcp) > away)

    def reaching(self, grip: jax.Array) -> jax.Array:
        """Share of a stage that ends with the tool centre at grip [3], within 15 mm."""
        return near(jnp.linalg.norm(grip - self.tcp), within=0.015)

    def grasping(self, grip: jax.Array, width: float) -> jax.Array:
        """Share of a stage that ends with the fingers closed around what is `width` [m] wide."""
        gap = self.opening - width * self.size
        return gate(self.reaching(grip) >= 1, near(gap, within=0.005, scale=0.02))

    def releasing(self, grip: jax.Array, width: float, away: float = 0.06) -> jax.Array:
        """Share of a stage that ends with `released`, whose arguments these are."""
        gap = width * self.size + 0.005 - self.opening
        share = jnp.minimum(near(gap, scale=0.02), _ALMOST)
        return jnp.where(self.released(grip, width, away), 1.0, share)

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

    A robot turns the rotation about the fingers' axis: by its own lean (`Robot.lean`) times `lean`,
    and by `tilt` to the side that its wrist prefers (`Robot.tilt_side`).

    Attributes:
        position: [P, 3] in m of a point on the hand's axis, `reach` behind the tcp.
        reach: [P] in m; 0 means the tcp itself. A hand turns about that point.
        rotation: [P, 3, 3] of the tcp before leaning and tilting.
        lean: [P] share of the robot's own lean.
        tilt: [P] in rad.
        opening: [P] of the gripper in m.
        seconds: [P] nominal time to get there from the one before.
        spread: [P] standard deviation of the noise on the position in m, 0 where it matters.
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
        stages: view -> name of each stage of that way, first to last, and the share of it that is
            done, f32 0 to 1; 1 passes it and all before it. Dense rewards are made of them, see
            `envs.rewards`.
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
    """Share of a stage that ends where a distance [m] is `within`; a third is left at `scale`."""
    return jnp.exp(-jnp.maximum(distance - within, 0.0) / scale)


def gate(condition: jax.Array, share: jax.Array) -> jax.Array:
    """Share of a stage that begins where a condition holds."""
    return jnp.where(condition, share, 0.0)


def azimuth(position: jax.Array) -> jax.Array:
    """Direction [...] in rad in which the base, at the origin, sees positions [..., 3]."""
    return jnp.arctan2(position[..., 1], position[..., 0])


def tool_down(position: jax.Array) -> jax.Array:
    """Rotations [..., 3, 3] of a tcp that points down, fingers opening across the line to the base.

    Args:
        position: [..., 3] where the tcp is; the arm's base stands at the origin.
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
    """Waypoints with the tool pointing down, from rows (anchor, offset, opening, s, spread).

    Args:
        rows: one a waypoint; an anchor is a place of the layout, or a position [3].
        lean, reach: as in `Waypoints`, the same for all.
        tilt: as in `Waypoints`, one a row [rad]; none tilts.
    """
    anchors, offsets, opening, seconds, spread = zip(*rows, strict=True)
    position = jnp.stack(anchors)[:, :3] + jnp.array(offsets)
    columns = [jnp.array(c, jnp.float32) for c in (opening, seconds, spread)]
    same = jnp.ones(len(rows))
    angles = jnp.array(tilt or [0.0] * len(rows), jnp.float32)
    return Waypoints(position, reach * same, tool_down(position), lean * same, angles, *columns)


def scatter(key: jax.Array, centre: tuple, spread: tuple) -> jax.Array:
    """Random place [4] on the table, uniform within `spread` [m] of `centre` [m], not turned."""
    shift = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0) * jnp.array(spread)
    return jnp.concatenate([jnp.array(centre) + shift, jnp.zeros(2)])


def raised(place: jax.Array, height: float) -> jax.Array:
    """A place [4] moved up by a height in m."""
    return place.at[2].add(height)


def open_box(inside: float, wall: float, height: float, *, floor: str, walls: str) -> str:
    """MJCF of a square box without a lid that stands at z = 0.

    Args:
        inside, wall, height: half the inner width, half the walls' thickness, their height [m].
        floor, walls: MJCF attributes of the floor (4 mm) and of every wall.
    """
    look, side, middle, long = walls, inside + wall, height / 2, inside + 2 * wall
    return f"""
  <geom type="box" {floor} size="{inside} {inside} .002" pos="0 0 .002"/>
  <geom type="box" {look} size="{wall} {long} {middle}" pos="{side} 0 {middle}"/>
  <geom type="box" {look} size="{wall} {long} {middle}" pos="{-side} 0 {middle}"/>
  <geom type="box" {look} size="{inside} {wall} {middle}" pos="0 {side} {middle}"/>
  <geom type="box" {look} size="{inside} {wall} {middle}" pos="0 {-side} {middle}"/>"""
