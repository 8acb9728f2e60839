"""How a user's arm works above the table: its start pose, its lean, the side to which it tilts.

The robots of this package state these as numbers; here inverse kinematics tries out what works.
"""

import dataclasses
import functools
import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from envs import robots
from envs.robots import Robot, multiply
from envs.tasks import tool_down

_HOME = (0.34, 0.0, 0.18)  # m, where the tcp of every robot starts
_LEANS = np.deg2rad(np.arange(0, 50, 5)).astype(np.float32)
# m: corners of where things stand and are carried; where the hand is when it pours.
_TABLE = np.array([(x, y, z) for x in (0.28, 0.43) for y in (-0.18, 0.19) for z in (0.02, 0.15)])
_POUR = np.array([(x, y, 0.2) for x in (0.34, 0.40) for y in (0.09, 0.15)])
_TILTS = np.deg2rad([25, 94])  # when it carries a cup, then when it pours
_REACHED = 0.004  # m, a miss that does not count
_ARM = 0.1  # m, a miss by an angle counts as this times the angle
_ROOM = 0.05  # rad, kept free at both ends of each joint
_ROWS = 32  # poses that are solved at once
_TRIES, _SPREAD = 8, 0.4  # starts around the first guess, their standard deviation [rad]


def posed(robot: Robot) -> Robot:
    """The same robot with home, lean and tilt side; the tcp is turned about z if that is better.

    Args:
        robot: a robot whose home is a first guess.

    Raises:
        ValueError: if it cannot reach the common start pose.
    """
    turns = np.array([0, np.pi], np.float32)
    leans, turns = (grid.ravel() for grid in np.meshgrid(_LEANS, turns))
    inside = dataclasses.replace(robot, lower=robot.lower + _ROOM, upper=robot.upper - _ROOM)
    homes, misses, table = _lean(inside, leans, turns)
    if misses.min() > _REACHED:
        raise ValueError(
            f"the hand must reach x 0.34 m, y 0 m, z 0.18 m, pointing down or leaning outwards by "
            f"up to 45 deg, where episodes start; it misses that by {1000 * misses.min():.0f} mm"
        )
    reached = np.maximum(table, _REACHED)
    reached[misses > _REACHED] = np.inf
    # As little lean as possible; of two ways round, the one farther from the last joint's limits.
    room = np.abs(homes[:, -1:] - [robot.lower[-1], robot.upper[-1]]).min(axis=1)
    best = np.lexsort((-room, leans, reached))[0]
    if reached[best] > _REACHED:
        warnings.warn(
            f"robot {robot.name} misses parts of the table by up to {1000 * table[best]:.0f} mm: "
            "not every layout of the tasks can be done",
            stacklevel=3,
        )
    tool = robot.tool @ robots.rotation("z", float(turns[best]))
    robot = dataclasses.replace(robot, tool=tool, home=homes[best], lean=float(leans[best]))
    return dataclasses.replace(robot, tilt_side=_tilt_side(robot))


def _lean(robot: Robot, leans: np.ndarray, turns: np.ndarray) -> tuple[np.ndarray, ...]:
    """What N leans and turns of the tcp about z give: homes [N, J], by how much they miss the start
    pose [N], and by how much the worst point of the table is missed from there [N], in m.
    """
    rng = np.random.default_rng(0)
    spread = _SPREAD * rng.standard_normal((_TRIES, robot.num_joints))
    spread[0] = 0
    starts = np.clip(robot.home + spread, robot.lower, robot.upper).astype(np.float32)
    lean, turn = leans[:, None], turns[:, None]
    found, missed = _solve(robot, _HOME, lean, turn, starts, robot.home)
    near = missed <= np.maximum(missed.min(axis=1, keepdims=True), _REACHED)
    found = found[np.arange(len(leans)), near.argmax(axis=1)]  # the first of them
    # A spare joint follows the first guess, but not its last joint: that is a matter of `turns`.
    rest = np.tile(starts[0], (len(leans), 1))
    rest[:, -1] = found[:, -1]
    homes, missed = _solve(robot, _HOME, leans, turns, found, rest)
    _, missing = _solve(robot, _TABLE, lean, turn, homes[:, None], homes[:, None])
    return homes, missed, missing.max(axis=1)


def _tilt_side(robot: Robot) -> int:
    """The side, 1 or -1 as in `Robot`, to which the hand can tilt better while it pours."""
    carrying, pouring = np.array([[1.0], [-1.0]]) * _TILTS[:, None, None]
    found, _ = _solve(robot, _POUR, carrying, 0.0, robot.home, robot.home)
    _, missed = _solve(robot, _POUR, pouring, 0.0, found, robot.home)
    outwards, back = missed.max(axis=1)
    return 1 if outwards <= back else -1


def _solve(
    robot: Robot, at: ArrayLike, lean: ArrayLike, turn: ArrayLike, start: ArrayLike, home: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles [..., J] that bring the tcp near poses, and by how much they miss them [m].

    Args:
        robot: the arm.
        at: [..., 3] where [m].
        lean, turn: [...] how far outwards and about z from pointing down [rad].
        start, home: [..., J] where to begin, and what spare joints are drawn to [rad].
    """
    vectors = [np.asarray(x, np.float32) for x in (at, start, home)]
    angles = [np.asarray(x, np.float32) for x in (lean, turn)]
    shape = np.broadcast_shapes(*(x.shape[:-1] for x in vectors), *(x.shape for x in angles))
    rows = [np.broadcast_to(x, (*shape, x.shape[-1])).reshape(-1, x.shape[-1]) for x in vectors]
    rows += [np.broadcast_to(x, shape).ravel() for x in angles]
    count = math.prod(shape)
    padded = [np.resize(x, (-(-count // _ROWS) * _ROWS, *x.shape[1:])) for x in rows]
    arm = [np.asarray(x, np.float32) for x in (robot.chain, robot.tool, robot.lower, robot.upper)]
    blocks = zip(*(x.reshape(-1, _ROWS, *x.shape[1:]) for x in padded), strict=True)
    found, missed = zip(*(_solve_block(*arm, *block) for block in blocks), strict=True)
    q, miss = np.concatenate(found)[:count], np.concatenate(missed)[:count]
    return q.reshape(*shape, -1), miss.reshape(shape)


@jax.jit  # robots come as numbers: compiled once for all that have as many joints
@functools.partial(jax.vmap, in_axes=(None,) * 4 + (0,) * 5)
def _solve_block(
    chain: jax.Array,
    tool: jax.Array,
    lower: jax.Array,
    upper: jax.Array,
    at: jax.Array,
    start: jax.Array,
    home: jax.Array,
    lean: jax.Array,
    turn: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """`_solve` of one row of `_ROWS`."""
    arm = robots.Geometry(chain, tool, lower, upper, home)
    facing = multiply(multiply(tool_down(at), _about("y", -lean)), _about("z", turn))
    q = robots.inverse_kinematics(arm, at, facing, start)
    position, rotation, _ = robots.tool_pose(arm, q)
    cosine = (jnp.trace(multiply(facing.T, rotation)) - 1) / 2
    angle = jnp.arccos(jnp.clip(cosine, -1, 1))
    return q, jnp.linalg.norm(position - at) + _ARM * angle


def _about(axis: str, angle: jax.Array) -> jax.Array:
    """Rotation [3, 3] about "y" or "z"."""
    return robots.turn(angle * jnp.array({"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}[axis]))
