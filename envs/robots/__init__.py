"""Robot arms: one module per robot, found by the `ROBOT` that it defines.

Here are the parameters of an arm, its MJCF with primitive shapes, and its kinematics in JAX.

The MuJoCo bodies and the analytic kinematics both derive from one joint chain and cannot disagree.

All hands share one tool frame, the `tcp` (tool center point), so tasks and experts need not know
the robot. Its z axis points out of the hand, the fingers open along its y axis, and the finger tips
end at z = `TIP_LENGTH`.
"""

import dataclasses
import importlib
import importlib.util
from types import ModuleType
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

BASE = "base"  # name of the body at the robot's mount
TIP_LENGTH = 0.012  # m from the tcp to the end of the finger tips on every hand; our choice
TIP_RADIUS = 0.005  # m, of the sphere that collides at each finger tip; our choice

# The wrist camera sits on the outer side of the hand and looks along it, tilted 22 degrees toward
# the tips. Our choice: the tips are in the lower half of the image, the object above them.
WRIST_POSITION, WRIST_FOVY = (-0.08, 0.0, -0.093), 75.0  # m, deg
WRIST_AXES = (0.0, -1.0, 0.0, -0.9272, 0.0, 0.3746)  # x and y axes of the camera in the tcp frame

# For damped least squares: damping, weight of rotation [m/rad], largest step [rad]. Our choices;
# with them, the expert of pick_place succeeded in 64 of 64 worlds.
_DAMPING, _ROTATION_WEIGHT, _MAX_STEP = 0.03, 0.3, 0.3
_ITERATIONS = 60  # our choice
_POSTURE_GAIN = 0.1  # our choice: share of the way home that redundant joints move per iteration


def __getattr__(name: str) -> ModuleType:
    """Import a robot's module on access, so `envs.robots.piper` works after `import envs`."""
    if importlib.util.find_spec(f"envs.robots.{name}") is None:
        raise AttributeError(f"module 'envs.robots' has no attribute {name!r}")
    return importlib.import_module(f"envs.robots.{name}")


class Body(Protocol):
    """The simulated part of a robot: bodies, joints, geoms, actuators."""

    def mjcf(self, robot: "Robot", /) -> tuple[str, str]:
        """Return MJCF of the body tree, with its base at the origin, and of the position servos."""
        ...

    def attach(self, robot: "Robot", scene: mujoco.MjSpec) -> None:
        """Add to the scene what `mjcf` cannot express."""
        ...


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Robot:
    """One arm with J joints and a two-finger gripper. Positions are in m, angles in rad.

    Attributes:
        name: name of the robot's module, or path of a user's MJCF file.
        chain: [J, 4, 4] transform from the previous link (first the base) to each joint at angle 0;
            joints are hinges about z.
        tool: [4, 4] pose of the tcp in the last link.
        lower, upper: [J] joint limits [rad].
        speed: [J] joint speed limits [rad/s].
        home: [J] start pose [rad]: tcp at (.34, 0, .18) m, tool pointing down plus `lean`.
        lean: angle by which the hand leans outward when it works from above [rad], so that the
            wrist stays within its limits over the whole table in front of the robot.
        tilt_side: side to which the hand can tilt by 90 degrees from pointing down: 1 is outward,
            -1 is back toward the base.
        stroke: largest gripper opening, both fingers together [m].
        gripper_speed: maximum speed of the opening [m/s].
        body: the simulated part.
    """

    name: str
    chain: np.ndarray
    tool: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    home: np.ndarray
    lean: float
    tilt_side: int
    stroke: float
    gripper_speed: float
    body: Body

    def __repr__(self) -> str:
        return f"<Robot {self.name!r}: {self.num_joints} joints, opens {1000 * self.stroke:.0f} mm>"

    @property
    def num_joints(self) -> int:
        """Number of joints J, without the gripper."""
        return len(self.chain)

    @property
    def action_low(self) -> np.ndarray:
        """Lowest joint targets [rad] and gripper opening [m], float32 [J + 1]."""
        return np.append(self.lower, 0.0).astype(np.float32)

    @property
    def action_high(self) -> np.ndarray:
        """Highest joint targets [rad] and gripper opening [m], float32 [J + 1]."""
        return np.append(self.upper, self.stroke).astype(np.float32)

    @property
    def action_speed(self) -> np.ndarray:
        """Speed limits of the commands [rad/s, m/s], float32 [J + 1]."""
        return np.append(self.speed, self.gripper_speed).astype(np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class Primitives:
    """A robot's body, built from primitive shapes on the joint chain.

    Attributes:
        stiffness, damping: [J] gains of the position actuators [N m/rad, N m s/rad].
        armature: reflected motor inertia of every joint [kg m^2].
        base, links: MJCF geoms of the base and of each link, in the link's frame.
        hand, finger: MJCF geoms of the hand and of the closed finger at y > 0, in the tcp frame.
        tip_offset: y of the middle of a closed finger [m].
    """

    stiffness: np.ndarray
    damping: np.ndarray
    armature: float
    base: str
    links: tuple[str, ...]
    hand: str
    finger: str
    tip_offset: float

    def mjcf(self, robot: Robot, /) -> tuple[str, str]:
        """Return MJCF of the body tree, and of the servos: joints first, then the left finger."""
        return self._bodies(robot), self._actuators()

    def attach(self, robot: Robot, scene: mujoco.MjSpec) -> None:
        """Do nothing: `mjcf` is complete."""

    def _bodies(self, robot: Robot) -> str:
        xml, closing = f'<body name="{BASE}">{self.base}', "</body>"
        for i, (fixed, geoms) in enumerate(zip(robot.chain, self.links, strict=True)):
            xml += f'<body name="link{i + 1}" {pose(fixed)} gravcomp="1">'
            xml += f'<joint name="joint{i + 1}" range="{robot.lower[i]} {robot.upper[i]}" '
            xml += f'armature="{self.armature}"/>{geoms}'
            closing += "</body>"
        position, axes = (" ".join(map(str, x)) for x in (WRIST_POSITION, WRIST_AXES))
        xml += f'<body name="hand" {pose(robot.tool)} gravcomp="1"><site name="tcp"/>'
        xml += f'<camera name="wrist" pos="{position}" xyaxes="{axes}" fovy="{WRIST_FOVY}"/>'
        xml += self.hand
        tip = f'pos="0 {self.tip_offset} {TIP_LENGTH - TIP_RADIUS}" size="{TIP_RADIUS}"'
        for side, turn in (("left", "1 0 0 0"), ("right", "0 0 0 1")):
            xml += f'<body name="{side}" quat="{turn}" gravcomp="1"><joint name="{side}" '
            xml += f'class="finger" range="0 {robot.stroke / 2}"/>{self.finger}'
            xml += f'<geom class="tip" {tip}/></body>'
        return xml + "</body>" + closing

    def _actuators(self) -> str:
        xml = ""
        for i, (kp, kv) in enumerate(zip(self.stiffness, self.damping, strict=True)):
            xml += f'<position name="joint{i + 1}" joint="joint{i + 1}" kp="{kp}" kv="{kv}"/>'
        # The target is half the opening. kp and kv are our choices: they hold a 12 g grape without
        # slip, and the force stays below 20 N at full stroke.
        return xml + '<position name="gripper" joint="left" kp="400" kv="20"/>'


def pose(transform: np.ndarray) -> str:
    """Format a [4, 4] transform as the MJCF attributes `pos` and `xyaxes`."""
    rounded = np.round(transform, 12) + 0.0
    position, x, y = (" ".join(map(str, rounded[:3, i])) for i in (3, 0, 1))
    return f'pos="{position}" xyaxes="{x} {y}"'


class Geometry(NamedTuple):
    """The kinematic part of a `Robot`, as arrays that may be traced."""

    chain: jax.Array
    tool: jax.Array
    lower: jax.Array
    upper: jax.Array
    home: jax.Array

    @property
    def num_joints(self) -> int:
        """Number of joints J, without the gripper."""
        return len(self.chain)


def translation(x: float, y: float, z: float) -> np.ndarray:
    """Return the [4, 4] transform that moves by (x, y, z) meters."""
    transform = np.eye(4)
    transform[:3, 3] = x, y, z
    return transform


def rotation(axis: str, angle: float) -> np.ndarray:
    """Return the [4, 4] transform that rotates by `angle` rad about "x", "y" or "z"."""
    c, s = np.cos(angle), np.sin(angle)
    transform = np.eye(4)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    transform[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return transform


def forward_kinematics(chain: np.ndarray | jax.Array, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute the poses of all links of a chain of hinges about z.

    Args:
        chain: [J, 4, 4] as in `Robot.chain`.
        q: [..., J] joint angles [rad]; results have its dtype.

    Returns:
        Positions [..., J, 3] in m and rotations [..., J, 3, 3] of the links in the base frame.
    """
    fixed = jnp.asarray(chain, q.dtype)
    position = jnp.zeros((*q.shape[:-1], 3), q.dtype)
    rot = jnp.broadcast_to(jnp.eye(3, dtype=q.dtype), (*q.shape[:-1], 3, 3))
    positions, rotations = [], []
    for i in range(len(fixed)):
        position = position + multiply(rot, fixed[i, :3, 3:])[..., 0]
        x, y, z = jnp.unstack(multiply(rot, fixed[i, :3, :3]), axis=-1)
        c, s = jnp.cos(q[..., i, None]), jnp.sin(q[..., i, None])
        rot = jnp.stack([c * x + s * y, c * y - s * x, z], axis=-1)
        positions.append(position)
        rotations.append(rot)
    return jnp.stack(positions, axis=-2), jnp.stack(rotations, axis=-3)


def tool_pose(robot: Robot | Geometry, q: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the pose of the tcp and its Jacobian at joint angles q [J] in rad.

    Returns:
        Position [3] in m, rotation [3, 3], Jacobian [6, J]: three linear rows, then three angular.
    """
    positions, rotations = forward_kinematics(robot.chain, q)
    tool = jnp.asarray(robot.tool, q.dtype)
    position = positions[-1] + multiply(rotations[-1], tool[:3, 3:])[:, 0]
    axes = rotations[:, :, 2]
    linear = jnp.cross(axes, position - positions)
    jacobian = jnp.concatenate([linear, axes], axis=-1).T
    return position, multiply(rotations[-1], tool[:3, :3]), jacobian


def inverse_kinematics(
    robot: Robot | Geometry, position: jax.Array, rotation: jax.Array, start: jax.Array
) -> jax.Array:
    """Solve for joint angles [J] in rad, within the limits, that bring the tcp to a pose.

    Args:
        robot: the arm.
        position: [3] desired tcp position [m].
        rotation: [3, 3] desired tcp rotation.
        start: [J] initial joint angles [rad].
    """
    lower, upper, home = (
        jnp.asarray(x, jnp.float32) for x in (robot.lower, robot.upper, robot.home)
    )
    weight = jnp.array([1.0] * 3 + [_ROTATION_WEIGHT] * 3)

    def body(q: jax.Array, _: None) -> tuple[jax.Array, None]:
        tool_position, tool_rotation, jacobian = tool_pose(robot, q)
        turn = sine_axis(multiply(rotation, tool_rotation.T))
        jacobian = jacobian * weight[:, None]
        error = jnp.concatenate([position - tool_position, turn]) * weight
        posture = _POSTURE_GAIN * (home - q) * (robot.num_joints > 6)
        square = multiply(jacobian, jacobian.T) + _DAMPING**2 * jnp.eye(6)
        solved = jnp.linalg.solve(square, error - multiply(jacobian, posture))
        step = posture + multiply(jacobian.T, solved)
        return jnp.clip(q + jnp.clip(step, -_MAX_STEP, _MAX_STEP), lower, upper), None

    return jax.lax.scan(body, start, None, length=_ITERATIONS)[0]


def turn(vector: jax.Array) -> jax.Array:
    """Convert a rotation vector [3] to a matrix [3, 3] (Rodrigues)."""
    angle = jnp.sqrt(jnp.maximum(jnp.sum(vector * vector), 1e-16))
    x, y, z = vector / angle
    zero = jnp.zeros_like(x)
    cross = jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    return jnp.eye(3) + jnp.sin(angle) * cross + (1 - jnp.cos(angle)) * multiply(cross, cross)


def sine_axis(rotation: jax.Array) -> jax.Array:
    """Return the axis [3] of a rotation [3, 3], scaled by the sine of its angle."""
    r = rotation
    return 0.5 * jnp.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])


def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Compute a @ b in full precision; bf16 or TF32 would cost millimeters."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)
