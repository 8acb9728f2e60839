"""The scripted expert of every task and robot.

A plan is made once an episode: inverse kinematics at the task's waypoints, then a minimum-jerk
path through them in joint space, slowed down where a joint would be too fast. Acting only reads the
path: an action is what a policy gives, joint targets and gripper opening one control step ahead.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from envs import actions, robots
from envs.env import Env
from envs.robots import Robot, multiply
from envs.state import State
from envs.tasks import Waypoints

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
    """Actions [W, A] for the coming control step; the last pose is held after the end."""
    seconds = (state.info["steps"] + 1).astype(jnp.float32) * env.control_dt
    targets = jax.vmap(_interpolate)(plan.knots, plan.times, seconds)
    convert = functools.partial(actions.from_targets, env.actions, env.robot)
    return jax.vmap(convert)(state.info["command"], targets)


def leaning(robot: Robot, way: Waypoints) -> jax.Array:
    """Tool rotations [P, 3, 3] with the robot's lean and the tilt that is asked for."""
    # The tcp's x axis points back to the base, y is the fingers' own and stays level.
    angle = -(way.lean * robot.lean + way.tilt * robot.tilt_side)
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    turn = jnp.stack([c, zero, s, zero, one, zero, -s, zero, c], -1).reshape(-1, 3, 3)
    return multiply(way.rotation, turn)


def _plan(env: Env, info: dict, key: jax.Array) -> Plan:
    position_key, time_key = jax.random.split(key)
    size = info["draw"].size if info["draw"] else 1.0
    # Objects grow from the table up, and so do the heights at which they are held.
    way = env.task.waypoints({k: v.at[2].divide(size) for k, v in info["layout"].items()})
    noise = jax.random.normal(position_key, way.position.shape) * way.spread[:, None]
    start = info["command"]
    rotations = leaning(env.robot, way)
    grown = way.position.at[:, 2].add((size - 1) * (way.position[:, 2] - way.reach))
    positions = grown + noise + way.reach[:, None] * rotations[:, :, 2]
    joints = _joints(env.robot, positions, rotations, start[:-1])
    knots = jnp.concatenate([joints, way.opening[:, None]], axis=1)
    knots = jnp.concatenate([start[None], knots])
    scale = jax.random.uniform(time_key, way.seconds.shape, minval=0.8, maxval=1.2)
    fastest = jnp.append(_SPEED_FRACTION * env.robot.speed, env.robot.gripper_speed)
    needed = jnp.max(_PEAK * jnp.abs(jnp.diff(knots, axis=0)) / fastest, axis=1)
    seconds = jnp.maximum(way.seconds * scale, needed)
    return Plan(knots, jnp.concatenate([jnp.zeros(1), jnp.cumsum(seconds)]))


def _joints(
    robot: Robot, positions: jax.Array, rotations: jax.Array, start: jax.Array
) -> jax.Array:
    """Joint angles [P, J] at the waypoints, each found from the one before."""

    def body(q: jax.Array, target: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        q = robots.inverse_kinematics(robot, *target, q)
        return q, q

    return jax.lax.scan(body, start, (positions, rotations))[1]


def _interpolate(knots: jax.Array, times: jax.Array, seconds: jax.Array) -> jax.Array:
    i = jnp.clip(jnp.searchsorted(times, seconds) - 1, 0, len(times) - 2)
    s = jnp.clip((seconds - times[i]) / (times[i + 1] - times[i]), 0.0, 1.0)
    s = s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)  # minimum jerk
    return knots[i] + s * (knots[i + 1] - knots[i])
