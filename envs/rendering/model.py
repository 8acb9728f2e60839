"""What a ray caster needs of a MuJoCo model: its visible geoms by kind, its cameras, its look."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.rendering.intersections import BOX, CAPSULE, CYLINDER, PLANE, SPHERE

# How pictures look where a model does not say it; chosen by eye. Shares of light, colours of the
# sky at the horizon and straight up, edge [m] and contrast of the squares on planes.
AMBIENT, HEADLIGHT, DIFFUSE = 0.35, 0.25, 0.5
SKY = ((0.80, 0.84, 0.88), (0.45, 0.58, 0.75))
SQUARE, CONTRAST = 0.1, 0.12

STAND_IN_GROUP = 5  # its geoms are drawn in place of meshes
_INFINITE = 1e4  # [m] half-extent drawn where a plane's size is 0, which means infinite
# MuJoCo geom type -> kind, and which numbers of its size are the half-extents along x, y, z.
_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): (PLANE, (0, 1, 2)),
    int(mujoco.mjtGeom.mjGEOM_SPHERE): (SPHERE, (0, 0, 0)),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): (SPHERE, (0, 1, 2)),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): (CAPSULE, (0, 0, 0)),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): (CYLINDER, (0, 0, 1)),
    int(mujoco.mjtGeom.mjGEOM_BOX): (BOX, (0, 1, 2)),
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Look:
    """What a picture looks like apart from geometry. Every field is traced.

    Attributes:
        rgba: `[G, 4]` colour of each geom of the MuJoCo model, 0 to 1; alpha is not used, `build`
            decides what is visible.
        light: `[3]` direction towards the light in world axes, of any length (the light is
            directional, like the sun).
        ambient: `[]` share of a geom's colour that is there without light.
        headlight: `[]` share lit from the camera, without shadows.
        diffuse: `[]` share lit by `light`, with shadows.
        sky: `[2, 3]` colour at the horizon and colour straight up.
        checker: `[2]` edge [m] and contrast (0 to 1) of the squares on planes.
        fovy: `[N]` vertical field of view of each camera of the MuJoCo model [deg].
    """

    rgba: jax.Array | np.ndarray
    light: jax.Array | np.ndarray
    ambient: jax.Array | np.ndarray
    headlight: jax.Array | np.ndarray
    diffuse: jax.Array | np.ndarray
    sky: jax.Array | np.ndarray
    checker: jax.Array | np.ndarray
    fovy: jax.Array | np.ndarray


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["look", "size"],
    meta_fields=["geoms", "kinds", "sides", "cameras"],
)
@dataclass(frozen=True)
class RenderModel:
    """The visible geoms of a MuJoCo model, sorted by kind, and the cameras to render.

    Attributes:
        look: the model's own colours, light and fields of view.
        size: `[G, 3]` size of each geom of the MuJoCo model [m].
        geoms: V numbers of the visible geoms in the MuJoCo model.
        kinds: V kinds of `intersections`, ascending.
        sides: V triples: which numbers of a geom's size are its half-extents along x, y, z.
        cameras: K numbers of the cameras in the MuJoCo model.
    """

    look: Look
    size: np.ndarray
    geoms: tuple[int, ...]
    kinds: tuple[int, ...]
    sides: tuple[tuple[int, int, int], ...]
    cameras: tuple[int, ...]


def build(mj_model: mujoco.MjModel, camera_names: Sequence[str]) -> RenderModel:
    """Sorts the visible geoms (alpha above 0, group below 3) of a model for rendering.

    Meshes are left out if the model has primitives in their place, in `STAND_IN_GROUP`.

    Raises:
        ValueError: if a camera does not exist, a visible geom is not a primitive, or none is left.
    """
    cameras = {mj_model.camera(i).name: i for i in range(mj_model.ncam)}
    if unknown := set(camera_names) - set(cameras):
        raise ValueError(f"the model has no camera {unknown}, only {sorted(cameras)}")
    drawn, stand_ins = is_visible(mj_model), mj_model.geom_group == STAND_IN_GROUP
    if stand_ins.any():
        drawn = drawn & (mj_model.geom_type != mujoco.mjtGeom.mjGEOM_MESH) | stand_ins
    visible = np.flatnonzero(drawn).tolist()
    if not visible:
        raise ValueError("the model has no visible geom (alpha above 0, group below 3)")
    types = mj_model.geom_type.tolist()
    for i in visible:
        if types[i] not in _SHAPES:
            raise ValueError(
                f"geom {mj_model.geom(i).name or i} cannot be drawn: only planes, spheres, "
                "ellipsoids, capsules, cylinders and boxes can (group 3 hides a geom)"
            )
    geoms = sorted(visible, key=lambda i: _SHAPES[types[i]][0])
    return RenderModel(
        look=_own_look(mj_model),
        size=mj_model.geom_size.astype(np.float32),
        geoms=tuple(geoms),
        kinds=tuple(_SHAPES[types[i]][0] for i in geoms),
        sides=tuple(_SHAPES[types[i]][1] for i in geoms),
        cameras=tuple(cameras[name] for name in camera_names),
    )


def is_visible(mj_model: mujoco.MjModel) -> np.ndarray:
    """Which geoms `[G]` of a model are to be seen: alpha above 0, group below 3."""
    return (mj_model.geom_rgba[:, 3] > 0) & (mj_model.geom_group < 3)


def unit_shapes(model: RenderModel, size: jax.Array | np.ndarray) -> tuple[jax.Array, jax.Array]:
    """How visible geoms of sizes `[G, 3]` come from their unit shapes.

    Returns:
        Half-extents `[V, 3]` that were scaled to 1 [m]; and a capsule's half-length over its
        radius `[V]`, else 0.
    """
    size = jnp.asarray(size)[np.array(model.geoms)]
    scale = jnp.take_along_axis(size, np.array(model.sides), axis=1)
    scale = jnp.where(scale == 0, _INFINITE, scale)
    return scale, jnp.where(np.array(model.kinds) == CAPSULE, size[:, 1] / scale[:, 0], 0)


def _own_look(mj_model: mujoco.MjModel) -> Look:
    """Colours, fields of view and first light of the model; the rest as above."""
    values = Look(
        rgba=mj_model.geom_rgba,
        light=-mj_model.light_dir[0] if mj_model.nlight else np.array([0.3, -0.4, 0.87]),
        ambient=np.array(AMBIENT),
        headlight=np.array(HEADLIGHT),
        diffuse=np.array(DIFFUSE),
        sky=np.array(SKY),
        checker=np.array([SQUARE, CONTRAST]),
        fovy=mj_model.cam_fovy,
    )
    return jax.tree.map(lambda x: np.asarray(x, np.float32), values)
