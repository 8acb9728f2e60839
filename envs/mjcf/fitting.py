"""Approximate meshes by primitive shapes, for a renderer that does not draw triangles.

A mesh is cut into parts as long as a cut shrinks the total volume of their bounding boxes enough.
Each part is replaced by the box, cylinder or capsule closest to its surface.
"""

import dataclasses

import mujoco
import numpy as np

# Our choices.
_POINTS = 500  # points sampled on the surface of a mesh
_CUTS = np.arange(1, 6) / 6  # candidate cuts, as fractions of a part's extent
_MAX_VOLUME_RATIO = 0.85  # cut only if the total volume shrinks below this share
# Shortest extent along which a part may be cut [m]; in a 64 px side image, a pixel is 6 mm wide.
_MIN_EXTENT = 0.06
_MAX_DEPTH = 3  # maximum number of successive cuts
_MIN_POINTS = 10  # minimum number of points in a part
_OUTLIERS = 0.01  # share of the points on each side that a shape may leave out
_MIN_HALF_EXTENT = 0.0005  # m, smallest half-extent of a shape
_BOX, _CYLINDER, _CAPSULE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
)


@dataclasses.dataclass(frozen=True)
class Shape:
    """A primitive in the frame of the mesh geom that it replaces.

    Attributes:
        kind: MuJoCo's geom type: box, cylinder or capsule.
        size: [3] in MuJoCo's convention for that type [m].
        position, rotation: [3] in m and [3, 3].
        distance: mean distance of the part's points from the shape's surface [m].
    """

    kind: mujoco.mjtGeom
    size: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    distance: float


def fit(model: mujoco.MjModel, geom: int) -> list[Shape]:
    """Approximate a mesh geom by shapes along its inertia axes or the axes of its file."""
    mesh = model.geom_dataid[geom]
    file_axes = np.empty(9)
    mujoco.mju_quat2Mat(file_axes, model.mesh_quat[mesh])
    frames = [np.eye(3), file_axes.reshape(3, 3).T]
    orders = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    rotations = [frame[:, order] for frame in frames for order in orders]
    return _fit(_sample_surface(model, mesh), rotations, _MAX_DEPTH)


def _sample_surface(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    """Sample points [N, 3] uniformly on the triangles of a mesh."""
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :]
    a, b, c = vertices[model.mesh_face[first : first + count].T].astype(float)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rng = np.random.default_rng(0)
    chosen = rng.choice(count, _POINTS, p=area / area.sum())
    u, v = rng.random((2, _POINTS, 1))
    u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]


def _fit(points: np.ndarray, rotations: list[np.ndarray], depth: int) -> list[Shape]:
    whole, volume = _closest(points, rotations)
    best, parts = _MAX_VOLUME_RATIO * volume, None
    for axis in whole.rotation.T:
        along = points @ axis
        low, high = along.min(), along.max()
        if depth == 0 or high - low < _MIN_EXTENT:
            continue
        for fraction in _CUTS:
            below = along < low + fraction * (high - low)
            halves = points[below], points[~below]
            if min(map(len, halves)) < _MIN_POINTS:
                continue
            volume = sum(_closest(half, rotations)[1] for half in halves)
            if volume < best:
                best, parts = volume, halves
    if parts is None:
        return [whole]
    return [shape for half in parts for shape in _fit(half, rotations, depth - 1)]


def _closest(points: np.ndarray, rotations: list[np.ndarray]) -> tuple[Shape, float]:
    """Return the closest shape and the volume of the smallest box, both over these rotations."""
    shapes = []
    for rotation in rotations:
        local = points @ rotation
        low, high = np.quantile(local, (_OUTLIERS, 1 - _OUTLIERS), axis=0)
        middle = (low + high) / 2
        local, half = local - middle, np.maximum((high - low) / 2, _MIN_HALF_EXTENT)
        across, height = np.linalg.norm(local[:, :2], axis=1), np.abs(local[:, 2])
        radius = half[:2].mean()
        straight = max(half[2] - radius, _MIN_HALF_EXTENT)
        past_ends = np.stack([across - radius, height - half[2]], axis=1)
        round_ends = np.hypot(across, np.maximum(height - straight, 0)) - radius
        for kind, size, distance in (
            (_BOX, half, _signed(np.abs(local) - half)),
            (_CYLINDER, (radius, half[2], 0), _signed(past_ends)),
            (_CAPSULE, (radius, straight, 0), round_ends),
        ):
            mean = float(np.abs(distance).mean())
            shapes.append(Shape(kind, np.array(size), rotation @ middle, rotation, mean))
    best = min(shapes, key=lambda shape: shape.distance)
    return best, min(8 * float(np.prod(shape.size)) for shape in shapes if shape.kind == _BOX)


def _signed(past: np.ndarray) -> np.ndarray:
    """Compute signed distances [N] to a shape from those to its perpendicular sides [N, S]."""
    return np.linalg.norm(np.maximum(past, 0), axis=1) + np.minimum(past.max(axis=1), 0)
