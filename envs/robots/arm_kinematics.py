"""Forward and inverse kinematics of an arm, a serial chain of hinges, in JAX."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.robots._robot import Robot

# For damped least squares: damping, weight of rotation [m/rad], largest step [rad]. Our choices;
# with them, the expert of pick_place succeeded in 64 of 64 worlds.
_DAMPING, _ROTATION_WEIGHT, _MAX_STEP = 0.03, 0.3, 0.3
_ITERATIONS = 60  # our choice
_POSTURE_GAIN = 0.1  # our choice: share of the way home that redundant joints move per iteration


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
