"""Locate the hand of a user's robot: its frame, its fingers' motion and their collision shapes."""

import itertools
from typing import NamedTuple

import mujoco
import numpy as np

from envs.mjcf.reading import ArmIds
from envs.robots import TIP_LENGTH, TIP_RADIUS

_PARALLEL = 0.99  # smallest cosine between parallel directions (8 deg); our choice
_CORNERS = np.array(list(itertools.product((-1, 1), repeat=3)))


class Pad(NamedTuple):
    """Collision shapes of a finger in the frame of its body: a box, and a sphere at the tip [m]."""

    position: np.ndarray  # of the box
    rotation: np.ndarray
    size: np.ndarray  # half-extents of the box
    tip: np.ndarray  # center of the sphere


class Hand(NamedTuple):
    """The hand of an arm.

    If a finger's joint is at q, its pad is sign * q + shift [m] from the tcp: half the opening.
    """

    chain: np.ndarray  # [J, 4, 4] as in `Robot`
    tool: np.ndarray  # [4, 4]
    mount: np.ndarray  # [4, 4] pose of the body that carries the fingers, in the last link's frame
    signs: np.ndarray  # [2]
    shifts: np.ndarray  # [2] m
    stroke: float  # m
    pads: list[Pad]


def find(model: mujoco.MjModel, arm: ArmIds, tcp: str | None) -> Hand:
    """Locate the hand of an arm; `tcp` is as in `envs.mjcf.load`.

    Raises:
        ValueError: the fingers do not slide along one line, do not open far enough or have no
            colliding geom; or the site does not exist, or does not match the fingers; or there is
            no site, and the last joint's axis does not match them.
    """
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[arm.joints]] = 0
    signs, across = _open(model, data, arm)
    site = _site(model, tcp)
    axes = _axes(model, data, arm, across, site)
    left, right = _bounds(model, data, arm, axes)
    gap = left[0, 1] - right[1, 1]
    if gap < 2 * TIP_RADIUS:
        raise ValueError(f"the fingers open by only {1000 * gap:.0f} mm")
    pose = _pose(axes @ _center(data, axes, left, right, site), axes)
    carrier = model.body_parentid[model.jnt_bodyid[arm.fingers[0]]]
    frames = [np.eye(4), *(_frame(model, data, joint) for joint in arm.joints)]
    return Hand(
        chain=np.stack([np.linalg.solve(a, b) for a, b in itertools.pairwise(frames)]),
        tool=np.linalg.solve(frames[-1], pose),
        mount=np.linalg.solve(frames[-1], _pose(data.xpos[carrier], data.xmat[carrier])),
        signs=signs,
        shifts=gap / 2 - signs * data.qpos[model.jnt_qposadr[arm.fingers]],
        stroke=float(gap),
        pads=[
            _pad(data, model.jnt_bodyid[joint], pose, box)
            for joint, box in zip(arm.fingers, (left, right), strict=True)
        ],
    )


def _open(model: mujoco.MjModel, data: mujoco.MjData, arm: ArmIds) -> tuple[np.ndarray, np.ndarray]:
    """Open the fingers in `data`.

    Returns:
        The sign `[2]` of each joint's motion when the hand opens, and the direction `[3]` from the
        second finger to the first.
    """
    mujoco.mj_kinematics(model, data)
    line = data.xaxis[arm.fingers[0]]
    along = data.xaxis[arm.fingers] @ line
    if abs(along[1]) < _PARALLEL:
        raise ValueError(f"the fingers' axes are {_degrees(along[1])} deg apart, not on one line")
    address = model.jnt_qposadr[arm.fingers]
    points = [_points(model, data, joint) for joint in arm.fingers]
    out = np.mean([p.mean(axis=0) for p in points], axis=0) - data.xanchor[arm.joints[-1]]
    out -= (out @ line) * line
    out /= max(float(np.linalg.norm(out)), 1e-9)
    centers = [_near_end(p, p @ out).mean(axis=0) @ line for p in points]

    def offset(ends: tuple[float, ...]) -> float:
        first, second = centers + along * (ends - data.qpos[address])
        return first - second

    ends = max(itertools.product(*model.jnt_range[arm.fingers]), key=lambda e: abs(offset(e)))
    side = np.sign(offset(ends))
    data.qpos[address] = ends
    mujoco.mj_kinematics(model, data)
    return np.round(side * along * [1, -1]), side * line


def _corners(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> np.ndarray:
    """Return the corners `[N, 8, 3]` of the bounding boxes of the N colliding geoms of a finger."""
    boxes = {geom: model.geom_aabb[geom].reshape(2, 3) for geom in _geoms(model, joint)}
    corners = {geom: center + half * _CORNERS for geom, (center, half) in boxes.items()}
    return np.stack([_in_world(data, geom, points) for geom, points in corners.items()])


def _points(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> np.ndarray:
    """Return the points `[N, 3]` of a finger: vertices of its meshes, corners of other geoms."""
    points = []
    for geom, corners in zip(_geoms(model, joint), _corners(model, data, joint), strict=True):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            corners = _in_world(data, geom, model.mesh_vert[first : first + count])
        points.append(corners)
    return np.concatenate(points)


def _geoms(model: mujoco.MjModel, joint: int) -> list[int]:
    """Return the colliding geoms of a finger."""
    finger, geoms = model.jnt_bodyid[joint], []
    for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity).tolist():
        body = model.geom_bodyid[geom]
        while body > finger:  # parents have smaller ids than their children
            body = model.body_parentid[body]
        if body == finger:
            geoms.append(geom)
    if not geoms:
        raise ValueError(f"finger {model.joint(joint).name} needs a geom with contype, conaffinity")
    return geoms


def _in_world(data: mujoco.MjData, geom: int, points: np.ndarray) -> np.ndarray:
    """Convert points `[N, 3]` of a geom to the world."""
    return data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T


def _site(model: mujoco.MjModel, tcp: str | None) -> str | None:
    names = [model.site(i).name for i in range(model.nsite)]
    if tcp is None:
        return "tcp" if "tcp" in names else None
    if tcp not in names:
        raise ValueError(f"unknown site {tcp}; sites in the file: {', '.join(names) or 'none'}")
    return tcp


def _axes(
    model: mujoco.MjModel, data: mujoco.MjData, arm: ArmIds, across: np.ndarray, site: str | None
) -> np.ndarray:
    """Compute the axes `[3, 3]` of the hand in the world, as columns; y is `across`."""
    last = arm.joints[-1]
    fingers = np.mean([_corners(model, data, f).mean(axis=(0, 1)) for f in arm.fingers], axis=0)
    reach = fingers - data.xanchor[last]
    if site:
        _, y, z = data.site(site).xmat.reshape(3, 3).T
        if abs(y @ across) < _PARALLEL:
            raise ValueError(f"the y axis of site {site} is not along the fingers' motion")
        if z @ reach < 0:
            raise ValueError(f"the z axis of site {site} must point out of the hand, not into it")
    else:
        z = data.xaxis[last] * (1 if data.xaxis[last] @ reach > 0 else -1)
        if abs(z @ across) > 1 - _PARALLEL:
            raise ValueError(
                "the last joint's axis is along the fingers' motion: add a site tcp whose z axis "
                "points out of the hand and whose y axis is along the fingers' motion"
            )
    z = z - (z @ across) * across
    z /= np.linalg.norm(z)
    return np.stack([np.cross(across, z), across, z], axis=1)


def _bounds(
    model: mujoco.MjModel, data: mujoco.MjData, arm: ArmIds, axes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds [2, 3] of both fingers along the hand's axes."""
    left, right = (_end(_corners(model, data, joint) @ axes) for joint in arm.fingers)
    tips = [_tip(_points(model, data, joint) @ axes) for joint in arm.fingers]
    gap, tip_gap = left[0, 1] - right[1, 1], tips[0][0, 1] - tips[1][1, 1]
    # A mesh may have a carriage behind its pad, even one that reaches over the middle.
    return (tips[0], tips[1]) if tip_gap > gap + 2 * TIP_RADIUS else (left, right)


def _end(corners: np.ndarray) -> np.ndarray:
    """Return the bounds [2, 3] of those boxes of a finger, [N, 8, 3], that reach near its end."""
    near = _near_end(corners, corners[:, :, 2].max(axis=1)).reshape(-1, 3)
    return np.stack([near.min(axis=0), near.max(axis=0)])


def _tip(points: np.ndarray) -> np.ndarray:
    """Return the bounds [2, 3] of the end of a finger, given its points [N, 3]."""
    near = _near_end(points, points[:, 2])
    low, high = near.min(axis=0), near.max(axis=0)
    low[2] = high[2] - 2 * TIP_LENGTH  # a straight finger has no vertices along its length
    return np.stack([low, high])


def _near_end(points: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Select those of `[N, ...]` points or boxes that reach, `[N]` in m, near a finger's end."""
    return points[reach > reach.max() - 2 * TIP_LENGTH]


def _center(
    data: mujoco.MjData, axes: np.ndarray, left: np.ndarray, right: np.ndarray, site: str | None
) -> np.ndarray:
    """Compute the tcp's coordinates `[3]` along the hand's axes."""
    x = np.mean([left[:, 0], right[:, 0]])
    if site:
        x = data.site(site).xpos @ axes[:, 0]
        if not max(left[0, 0], right[0, 0]) < x < min(left[1, 0], right[1, 0]):
            raise ValueError(f"the z axis of site {site} does not run between the fingers")
    end = max(left[1, 2], right[1, 2])
    return np.array([x, (left[0, 1] + right[1, 1]) / 2, end - TIP_LENGTH])


def _frame(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> np.ndarray:
    """Return the pose `[4, 4]` of a hinge in the world, with z along its axis."""
    z = data.xaxis[joint]
    body = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3)
    x = body[:, np.argmin(np.abs(z @ body))]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return _pose(data.xanchor[joint], np.stack([x, np.cross(z, x), z], axis=1))


def _pose(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), position
    return pose


def _pad(data: mujoco.MjData, body: int, pose: np.ndarray, box: np.ndarray) -> Pad:
    """Make a finger's pad from its bounds `[2, 3]` along the axes of the tcp's pose `[4, 4]`."""
    axes, origin = pose[:3, :3], pose[:3, 3]
    low, high = box - origin @ axes
    side = np.sign(low[1] + high[1])
    inner, outer = sorted((low[1], high[1]), key=abs)
    thick = max(abs(outer - inner), 2 * TIP_RADIUS)  # objects would tunnel through a thin pad
    center, half = (low + high) / 2, (high - low) / 2
    center[1], half[1] = inner + side * thick / 2, thick / 2
    tip = np.array([0.0, inner + side * TIP_RADIUS, TIP_LENGTH - TIP_RADIUS])
    turn = data.xmat[body].reshape(3, 3)
    position, tip = (turn.T @ (axes @ p + origin - data.xpos[body]) for p in (center, tip))
    return Pad(position, turn.T @ axes, half, tip)


def _degrees(cosine: float) -> float:
    """Return the angle between two lines, rounded to degrees."""
    return round(np.rad2deg(np.arccos(min(abs(cosine), 1.0))))
