"""The scripted expert of every task and robot.

Planning happens once per episode. It solves inverse kinematics at the task's waypoints, then joins
them by minimum-jerk moves in joint space, slowed down where a joint would be too fast. Acting reads
this path one control step ahead and returns an action in the environment's action mode.
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

_SPEED_FRACTION = 0.5  # share of the robot's joint speed limits that the expert uses; our choice
_PEAK = 1.875  # peak speed of a minimum-jerk move over its mean: 30 s²(1 - s)² at s = 1/2


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Plan:
    """Knots [W, P + 1, J + 1] in joint space, with times [W, P + 1] in s, for P waypoints."""

    knots: jax.Array
    times: jax.Array


def plan(env: Env, state: State, key: jax.Array) -> Plan:
    """Plan a random solution for every world, starting from the last command.

    Waypoints in free space get noise, and every duration is scaled by a random factor in [0.8, 1.2]
    (our choice).
    """
    keys = jax.random.split(key, env.num_envs)
    return jax.vmap(lambda info, key: _plan(env, info, key))(state.info, keys)


def act(env: Env, plan: Plan, state: State) -> jax.Array:
    """Return the actions [W, A] for the next control step; past the plan, hold its last pose."""
    seconds = (state.info["steps"] + 1).astype(jnp.float32) * env.control_dt
    targets = jax.vmap(interpolate)(plan.knots, plan.times, seconds)
    convert = functools.partial(actions.from_targets, env.actions, env.robot)
    return jax.vmap(convert)(state.info["command"], targets)


def tool_rotations(robot: Robot, waypoints: Waypoints) -> jax.Array:
    """Compute tool rotations [P, 3, 3] from the waypoints and the robot's lean and tilt side."""
    # The tcp's x axis points back to the base; y, along which the fingers open, stays level.
    angle = -(waypoints.lean * robot.lean + waypoints.tilt * robot.tilt_side)
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    turn = jnp.stack([c, zero, s, zero, one, zero, -s, zero, c], -1).reshape(-1, 3, 3)
    return multiply(waypoints.rotation, turn)


def _plan(env: Env, info: dict, key: jax.Array) -> Plan:
    position_key, time_key = jax.random.split(key)
    size = info["draw"].size if info["draw"] else 1.0
    # Objects grow from the table up: plan at size 1, then scale the heights.
    waypoints = env.task.waypoints({k: v.at[2].divide(size) for k, v in info["layout"].items()})
    noise = jax.random.normal(position_key, waypoints.position.shape) * waypoints.spread[:, None]
    start = info["command"]
    rotations = tool_rotations(env.robot, waypoints)
    heights = waypoints.position[:, 2] - waypoints.reach
    scaled = waypoints.position.at[:, 2].add((size - 1) * heights)
    positions = scaled + noise + waypoints.reach[:, None] * rotations[:, :, 2]
    if info["draw"]:  # the robot's inverse kinematics start at its mount, not at the table
        positions = positions.at[:, 2].add(info["draw"].table_height)
    joints = solve(env.robot, positions, rotations, start[:-1])
    knots = jnp.concatenate([joints, waypoints.opening[:, None]], axis=1)
    knots = jnp.concatenate([start[None], knots])
    scale = jax.random.uniform(time_key, waypoints.seconds.shape, minval=0.8, maxval=1.2)
    limits = jnp.append(_SPEED_FRACTION * env.robot.speed, env.robot.gripper_speed)
    shortest = jnp.max(_PEAK * jnp.abs(jnp.diff(knots, axis=0)) / limits, axis=1)
    seconds = jnp.maximum(waypoints.seconds * scale, shortest)
    return Plan(knots, jnp.concatenate([jnp.zeros(1), jnp.cumsum(seconds)]))


def solve(robot: Robot, positions: jax.Array, rotations: jax.Array, start: jax.Array) -> jax.Array:
    """Compute joint angles [P, J] at the waypoints, starting each search at the last solution."""

    def body(q: jax.Array, target: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        q = robots.inverse_kinematics(robot, *target, q)
        return q, q

    return jax.lax.scan(body, start, (positions, rotations))[1]


def interpolate(knots: jax.Array, times: jax.Array, seconds: jax.Array) -> jax.Array:
    """Return the pose [N] at a time [s] on the way through knots [P, N] at times [P], in s."""
    i = jnp.clip(jnp.searchsorted(times, seconds) - 1, 0, len(times) - 2)
    s = jnp.clip((seconds - times[i]) / (times[i + 1] - times[i]), 0.0, 1.0)
    s = s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)  # minimum jerk
    return knots[i] + s * (knots[i + 1] - knots[i])
