"""Action modes, and their conversion to joint targets.

J is the number of joints without the gripper, and A is the length of an action.

    joint         [J + 1] joint targets [rad], gripper opening [m]
    delta_joint   [J + 1] change of the joint targets [rad], gripper opening [m]
    end_effector  [7] translation [m] and rotation vector [rad] of the tcp (tool center point),
                  both in the base frame, gripper opening [m]

Changes are relative to the last targets, not to measured positions, so that servo lag does not make
an arm creep.
"""

import jax
import jax.numpy as jnp
import numpy as np

from envs import robots
from envs.names import Mode
from envs.robots import Robot, multiply
from envs.scene import scene

TARGET_DT = 0.02
"""Time between interpolated joint targets [s]; our choice (50 Hz)."""

_TOOL_SPEED = np.array([0.5] * 3 + [2.0] * 3, np.float32)  # speed limits, our choice [m/s, rad/s]


def bounds(mode: Mode, robot: Robot, control_dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest action, float32 [A]; `control_dt` is in s."""
    if mode == "joint":
        return robot.action_low, robot.action_high
    speed = _TOOL_SPEED if mode == "end_effector" else robot.action_speed[:-1]
    low = np.append(-speed * control_dt, robot.action_low[-1])
    return low.astype(np.float32), np.append(-low[:-1], robot.action_high[-1]).astype(np.float32)


def to_targets(mode: Mode, robot: Robot, command: jax.Array, action: jax.Array) -> jax.Array:
    """Convert one world's action [A] to targets [J + 1], given its last targets `command` [J + 1].

    An end-effector pose that is out of reach becomes the closest one that inverse kinematics finds.
    """
    if mode == "joint":
        return action
    if mode == "delta_joint":
        return action.at[:-1].add(command[:-1])
    position, rotation, _ = robots.tool_pose(robot, command[:-1])
    goal = position + action[:3], multiply(robots.turn(action[3:6]), rotation)
    joints = robots.inverse_kinematics(robot, *goal, command[:-1])
    return jnp.append(joints, action[6])


def from_targets(mode: Mode, robot: Robot, command: jax.Array, targets: jax.Array) -> jax.Array:
    """Invert `to_targets`: return the action [A] that leads from `command` to `targets`.

    For an arm with more than six joints, an end-effector action does not determine the targets.
    """
    if mode == "joint":
        return targets
    if mode == "delta_joint":
        return targets.at[:-1].add(-command[:-1])
    (start, before, _), (end, after, _) = (
        robots.tool_pose(robot, q[:-1]) for q in (command, targets)
    )
    turn = _rotation_vector(multiply(after, before.T))
    return jnp.concatenate([end - start, turn, targets[-1:]])


def interpolate(commands: jax.Array, control_dt: float, latency: float | jax.Array) -> jax.Array:
    """Interpolate actuator targets [S, J + 1] for the S physics steps of one control step.

    Args:
        commands: [3, J + 1] targets of the last two actions and the new one, oldest first.
        control_dt: control period [s], a multiple of `TARGET_DT`.
        latency: delay of the targets [s], at most `control_dt`.
    """
    moves, repeats = round(control_dt / TARGET_DT), round(TARGET_DT / scene.PHYSICS_DT)
    fraction = jnp.arange(1, moves + 1, dtype=jnp.float32)[:, None] / moves
    # The targets of the previous control step, followed by those of this one.
    path = commands[:-1, None] + fraction * jnp.diff(commands, axis=0)[:, None]
    path = path.at[..., -1].multiply(0.5)  # each finger moves by half the opening
    targets = jnp.repeat(path.reshape(2 * moves, -1), repeats, axis=0)
    delay = jnp.round(latency / scene.PHYSICS_DT).astype(jnp.int32)
    return jax.lax.dynamic_slice_in_dim(targets, moves * repeats - delay, moves * repeats)


def _rotation_vector(rotation: jax.Array) -> jax.Array:
    """Convert a rotation matrix [3, 3] to a rotation vector [3] of less than 180 degrees."""
    axis = robots.sine_axis(rotation)
    sine = jnp.linalg.norm(axis)
    angle = jnp.arctan2(sine, (jnp.trace(rotation) - 1) / 2)
    return axis * jnp.where(sine > 1e-6, angle / jnp.maximum(sine, 1e-6), 1.0)
