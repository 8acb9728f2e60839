"""Choose the start pose, lean and tilt side of a robot arm supplied by the user.

The built-in robots specify these; for other arms, they are found by inverse kinematics.
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

_HOME = (0.34, 0.0, 0.18)  # m, start position of every robot's tcp
_LEANS = np.deg2rad(np.arange(0, 50, 5)).astype(np.float32)
# Corners of the regions in which tasks place and carry objects, and in which they pour [m].
_TABLE = np.array([(x, y, z) for x in (0.28, 0.43) for y in (-0.18, 0.19) for z in (0.02, 0.15)])
_POUR = np.array([(x, y, 0.2) for x in (0.34, 0.40) for y in (0.09, 0.15)])
_TILTS = np.deg2rad([25, 94])  # in the task "pour": while carrying the cup, while pouring
# Our choices, not dictated by the tasks.
_TOLERANCE = 0.004  # m, largest error of a pose that counts as reached
_LEVER = 0.1  # m, converts an error in angle to one in position
_CENTERED = 0.05  # m from the z axis to the first hinge of an arm whose base is at the origin
_MARGIN = 0.05  # rad, minimum distance of each joint from its limits
_ROWS = 32  # poses solved at once
_TRIES, _SPREAD = 8, 0.4  # number of random starts, standard deviation around the guess [rad]


def complete(robot: Robot) -> Robot:
    """Set home, lean and tilt side; rotate the tcp by 180 degrees about z if that fits better.

    The home passed in is a first guess. Warn if the arm misses parts of the table.

    Raises:
        ValueError: the robot cannot reach the common start pose.
    """
    turns = np.array([0, np.pi], np.float32)
    leans, turns = (grid.ravel() for grid in np.meshgrid(_LEANS, turns))
    inside = dataclasses.replace(robot, lower=robot.lower + _MARGIN, upper=robot.upper - _MARGIN)
    homes, errors, table_errors = _try_leans(inside, leans, turns)
    if errors.min() > _TOLERANCE:
        raise ValueError(
            f"the hand must reach x 0.34 m, y 0 m, z 0.18 m (the start of every episode), pointing "
            f"down or leaning outward by up to 45 deg; it misses by {1000 * errors.min():.0f} mm"
            f"{_off_origin(robot)}"
        )
    cost = np.maximum(table_errors, _TOLERANCE)
    cost[errors > _TOLERANCE] = np.inf
    # At equal cost, prefer the smallest lean, then the largest margin of the last joint.
    margin = np.abs(homes[:, -1:] - [robot.lower[-1], robot.upper[-1]]).min(axis=1)
    best = np.lexsort((-margin, leans, cost))[0]
    if cost[best] > _TOLERANCE:
        warnings.warn(
            f"robot {robot.name} misses parts of the table by up to "
            f"{1000 * table_errors[best]:.0f} mm: it cannot solve every task layout"
            f"{_off_origin(robot)}",
            stacklevel=3,
        )
    tool = robot.tool @ robots.rotation("z", float(turns[best]))
    robot = dataclasses.replace(robot, tool=tool, home=homes[best], lean=float(leans[best]))
    return dataclasses.replace(robot, tilt_side=_tilt_side(robot))


def _off_origin(robot: Robot) -> str:
    """Say where the base is if it is not at the origin."""
    x, y = robot.chain[0, :2, 3]
    if math.hypot(x, y) <= _CENTERED:
        return ""
    return f"; its first hinge is at x {x:.3g} m, y {y:.3g} m: place the base at the origin"


def _try_leans(robot: Robot, leans: np.ndarray, turns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Try N leans and rotations of the tcp about z.

    Returns:
        Homes [N, J] in rad, their errors [N] in m at the start pose, and the largest errors [N] in
        m over the table.
    """
    rng = np.random.default_rng(0)
    spread = _SPREAD * rng.standard_normal((_TRIES, robot.num_joints))
    spread[0] = 0
    starts = np.clip(robot.home + spread, robot.lower, robot.upper).astype(np.float32)
    lean, turn = leans[:, None], turns[:, None]
    solutions, errors = _solve(robot, _HOME, lean, turn, starts, robot.home)
    good = errors <= np.maximum(errors.min(axis=1, keepdims=True), _TOLERANCE)
    first = solutions[np.arange(len(leans)), good.argmax(axis=1)]
    # Pull redundant joints toward the first guess, except the last joint, which depends on `turns`.
    rest = np.tile(starts[0], (len(leans), 1))
    rest[:, -1] = first[:, -1]
    homes, errors = _solve(robot, _HOME, leans, turns, first, rest)
    _, table_errors = _solve(robot, _TABLE, lean, turn, homes[:, None], homes[:, None])
    return homes, errors, table_errors.max(axis=1)


def _tilt_side(robot: Robot) -> int:
    """Return the tilt side, 1 or -1 as in `Robot`, with the smaller error when pouring."""
    carrying, pouring = np.array([[1.0], [-1.0]]) * _TILTS[:, None, None]
    solutions, _ = _solve(robot, _POUR, carrying, 0.0, robot.home, robot.home)
    _, errors = _solve(robot, _POUR, pouring, 0.0, solutions, robot.home)
    outward, back = errors.max(axis=1)
    return 1 if outward <= back else -1


def _solve(
    robot: Robot, at: ArrayLike, lean: ArrayLike, turn: ArrayLike, start: ArrayLike, home: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Solve inverse kinematics for poses of the tcp.

    Args:
        robot: the arm.
        at: [..., 3] positions [m].
        lean, turn: [...] angles outward from pointing down, and about the tcp's z axis [rad].
        start, home: [..., J] initial joint angles, and those redundant joints are pulled to [rad].

    Returns:
        Joint angles [..., J] in rad, and their errors [...] in m.
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
    solutions, errors = zip(*(_solve_block(*arm, *block) for block in blocks), strict=True)
    q, error = np.concatenate(solutions)[:count], np.concatenate(errors)[:count]
    return q.reshape(*shape, -1), error.reshape(shape)


@jax.jit  # the arm is traced, so arms with the same number of joints share a compilation
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
    """Solve one row of a block of `_ROWS`; see `_solve`."""
    arm = robots.Geometry(chain, tool, lower, upper, home)
    target = multiply(multiply(tool_down(at), _about("y", -lean)), _about("z", turn))
    q = robots.inverse_kinematics(arm, at, target, start)
    position, rotation, _ = robots.tool_pose(arm, q)
    cosine = (jnp.trace(multiply(target.T, rotation)) - 1) / 2
    angle = jnp.arccos(jnp.clip(cosine, -1, 1))
    return q, jnp.linalg.norm(position - at) + _LEVER * angle


def _about(axis: str, angle: jax.Array) -> jax.Array:
    """Return the rotation [3, 3] by `angle` rad about "y" or "z"."""
    return robots.turn(angle * jnp.array({"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}[axis]))
