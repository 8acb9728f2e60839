"""The scripted expert of every task and robot.

A plan is made once an episode: inverse kinematics at the task's waypoints, then a minimum-jerk
path through them in joint space, slowed down where a joint would be too fast. Acting only reads the
path: an action is what a policy gives, joint targets and gripper opening one control step ahead.
"""

import dataclasses

import jax
import jax.numpy as jnp

from envs import robots
from envs.env import Env, State
from envs.robots import Robot, multiply
from envs.tasks import Waypoints

# Damped least squares as in the facts' proof: damping, weight of rotation [m/rad], longest step.
_DAMPING, _ROTATION_WEIGHT, _MAX_STEP = 0.03, 0.3, 0.3
_ITERATIONS = 60
_POSTURE_GAIN = 0.1  # pull of spare joints towards home, a fraction of the way an iteration
_SPEED_FRACTION = 0.5  # of the robot's joint speed limits that the expert uses
_PEAK = 1.875  # top speed of a minimum-jerk move over its mean speed


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Plan:
    """Knots [W, P + 1, J + 1] in joint space and the seconds [W, P + 1] at which they are met."""

    knots: jax.Array
    times: jax.Array


def plan(env: Env, state: State, key: jax.Array) -> Plan:
    """A random way to do the task in every world, from where its robot is now.

    Waypoints in free space are moved by noise and every duration is scaled by 0.8-1.2.
    """
    keys = jax.random.split(key, env.num_envs)
    return jax.vmap(lambda info, key: _plan(env, info, key))(state.info, keys)


def act(env: Env, plan: Plan, state: State) -> jax.Array:
    """Actions [W, J + 1] for the coming control step; the last pose is held after the end."""
    seconds = (state.info["steps"] + 1).astype(jnp.float32) * env.control_dt
    return jax.vmap(_interpolate)(plan.knots, plan.times, seconds)


def inverse_kinematics(
    robot: Robot, position: jax.Array, rotation: jax.Array, start: jax.Array
) -> jax.Array:
    """Joint angles [J] within the limits that bring the tcp to a pose, found from `start` [J]."""
    lower, upper, home = (
        jnp.asarray(x, jnp.float32) for x in (robot.lower, robot.upper, robot.home)
    )
    weight = jnp.array([1.0] * 3 + [_ROTATION_WEIGHT] * 3)

    def body(q: jax.Array, _: None) -> tuple[jax.Array, None]:
        at, facing, jacobian = robots.tool_pose(robot, q)
        twist = multiply(rotation, facing.T)
        turn = 0.5 * jnp.array(
            [twist[2, 1] - twist[1, 2], twist[0, 2] - twist[2, 0], twist[1, 0] - twist[0, 1]]
        )
        jacobian = jacobian * weight[:, None]
        error = jnp.concatenate([position - at, turn]) * weight
        posture = _POSTURE_GAIN * (home - q) * (robot.num_joints > 6)
        square = multiply(jacobian, jacobian.T) + _DAMPING**2 * jnp.eye(6)
        solved = jnp.linalg.solve(square, error - multiply(jacobian, posture))
        step = posture + multiply(jacobian.T, solved)
        return jnp.clip(q + jnp.clip(step, -_MAX_STEP, _MAX_STEP), lower, upper), None

    return jax.lax.scan(body, start, None, length=_ITERATIONS)[0]


def leaning(robot: Robot, rotations: jax.Array) -> jax.Array:
    """Tool rotations [..., 3, 3] with the robot's lean: outwards where the tool points down."""
    # The tcp's x axis points back to the base, y is the fingers' own and stays level.
    return multiply(rotations, jnp.asarray(robots.rotation("y", -robot.lean)[:3, :3], jnp.float32))


def _plan(env: Env, info: dict, key: jax.Array) -> Plan:
    position_key, time_key = jax.random.split(key)
    way = env.task.waypoints(info["layout"])
    noise = jax.random.normal(position_key, way.position.shape) * way.spread[:, None]
    start = info["command"]
    knots = jnp.concatenate([start[None], _knots(env.robot, way, way.position + noise, start)])
    scale = jax.random.uniform(time_key, way.seconds.shape, minval=0.8, maxval=1.2)
    fastest = jnp.append(_SPEED_FRACTION * env.robot.speed, env.robot.gripper_speed)
    needed = jnp.max(_PEAK * jnp.abs(jnp.diff(knots, axis=0)) / fastest, axis=1)
    seconds = jnp.maximum(way.seconds * scale, needed)
    return Plan(knots, jnp.concatenate([jnp.zeros(1), jnp.cumsum(seconds)]))


def _knots(robot: Robot, way: Waypoints, positions: jax.Array, start: jax.Array) -> jax.Array:
    def body(q: jax.Array, target: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        q = inverse_kinematics(robot, *target, q)
        return q, q

    rotations = leaning(robot, way.rotation)
    joints = jax.lax.scan(body, start[:-1], (positions, rotations))[1]
    return jnp.concatenate([joints, way.opening[:, None]], axis=1)


def _interpolate(knots: jax.Array, times: jax.Array, seconds: jax.Array) -> jax.Array:
    i = jnp.clip(jnp.searchsorted(times, seconds) - 1, 0, len(times) - 2)
    s = jnp.clip((seconds - times[i]) / (times[i + 1] - times[i]), 0.0, 1.0)
    s = s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)  # minimum jerk
    return knots[i] + s * (knots[i + 1] - knots[i])
