"""What an action means: one file for every convention, all of them turned into joint targets.

    joint         [J + 1] joint targets [rad], gripper opening [m]
    delta_joint   [J + 1] change of the joint targets [rad], gripper opening [m]
    end_effector  [7] change of the tcp's position [m] and its rotation vector [rad], both along the
                  axes of the base, gripper opening [m]

Changes are relative to the targets that were sent last, not to what was measured, so that servos
that lag behind do not make an arm creep.
"""

from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from envs import robots
from envs.robots import Robot, multiply
from envs.scene import scene

Mode = Literal["joint", "delta_joint", "end_effector"]
MODES: tuple[str, ...] = get_args(Mode)

TARGET_DT = 0.02
"""Joint targets are interpolated to this rate between two actions [s]."""

_TOOL_SPEED = np.array([0.5] * 3 + [2.0] * 3, np.float32)  # own choice [m/s, rad/s]


def bounds(mode: Mode, robot: Robot, control_dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest action, float32, of a robot that acts every `control_dt` seconds."""
    if mode == "joint":
        return robot.action_low, robot.action_high
    speed = _TOOL_SPEED if mode == "end_effector" else robot.action_speed[:-1]
    low = np.append(-speed * control_dt, robot.action_low[-1])
    return low.astype(np.float32), np.append(-low[:-1], robot.action_high[-1]).astype(np.float32)


def to_targets(mode: Mode, robot: Robot, command: jax.Array, action: jax.Array) -> jax.Array:
    """Joint targets and opening [J + 1] of one world's action, given the last targets [J + 1].

    An end-effector action out of reach gives the nearest pose that inverse kinematics finds.
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
    """The action that sends these targets [J + 1] after the last ones, `to_targets` turned round.

    Joints of an arm with more than six are not determined by an end-effector action.
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
    """Actuator targets [S, J + 1] of the S physics steps between two actions.

    Args:
        commands: [3, J + 1] targets of the last action but one, the last one and the new one.
        control_dt: seconds from one to the next, a multiple of `TARGET_DT`.
        latency: seconds, at most `control_dt`, by which they come late.
    """
    moves, repeats = round(control_dt / TARGET_DT), round(TARGET_DT / scene.PHYSICS_DT)
    fraction = jnp.arange(1, moves + 1, dtype=jnp.float32)[:, None] / moves
    # What is sent in this control step, after what was sent in the one before.
    path = commands[:-1, None] + fraction * jnp.diff(commands, axis=0)[:, None]
    path = path.at[..., -1].multiply(0.5)  # each finger makes half of the opening
    sent = jnp.repeat(path.reshape(2 * moves, -1), repeats, axis=0)
    late = jnp.round(latency / scene.PHYSICS_DT).astype(jnp.int32)
    return jax.lax.dynamic_slice_in_dim(sent, moves * repeats - late, moves * repeats)


def _rotation_vector(rotation: jax.Array) -> jax.Array:
    """Rotation vector [3] of a rotation [3, 3] by less than half a turn."""
    axis = robots.sine_axis(rotation)
    sine = jnp.linalg.norm(axis)
    angle = jnp.arctan2(sine, (jnp.trace(rotation) - 1) / 2)
    return axis * jnp.where(sine > 1e-6, angle / jnp.maximum(sine, 1e-6), 1.0)
