"""Extract from a MuJoCo model what the ray caster needs: visible geoms, cameras, appearance."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.rendering.intersections import BOX, CAPSULE, CYLINDER, PLANE, SPHERE

# Defaults, chosen by eye, for what a MuJoCo model does not specify; see `Appearance`.
AMBIENT, HEADLIGHT, DIFFUSE = 0.35, 0.25, 0.5
SKY = ((0.80, 0.84, 0.88), (0.45, 0.58, 0.75))
SQUARE, CONTRAST = 0.1, 0.12  # checker on planes: edge [m] and contrast

STAND_IN_GROUP = 5  # geom group of primitives that are drawn in place of meshes
_INFINITE = 1e4  # m, half-extent given to an infinite plane, whose size is 0 in MuJoCo
# MuJoCo geom type -> kind, and where a geom's size holds its half-extents in x, y, z.
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
class Appearance:
    """Everything except geometry that an image depends on. Every field is traced.

    Attributes:
        rgba: `[G, 4]` color of each geom of the MuJoCo model, 0 to 1. Alpha is ignored, since
            `build` decides what is visible.
        light: `[3]` direction to the light in world axes, of any length.
        ambient: `[]` share of a geom's color that shows without any light.
        headlight: `[]` share lit from the camera, without shadows.
        diffuse: `[]` share lit by `light`, with shadows.
        sky: `[2, 3]` color at the horizon and at the zenith.
        checker: `[2]` edge [m] and contrast (0 to 1) of the checker on planes.
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
    data_fields=["appearance", "size"],
    meta_fields=["geoms", "kinds", "sides", "cameras"],
)
@dataclass(frozen=True)
class RenderModel:
    """The visible geoms of a MuJoCo model, sorted by kind, and the cameras to render.

    Attributes:
        appearance: the model's own colors, light and fields of view.
        size: `[G, 3]` size of each geom of the MuJoCo model [m].
        geoms: ids of the V visible geoms in the MuJoCo model.
        kinds: V kinds, as in `intersections`, ascending.
        sides: where each visible geom's size holds its half-extents in x, y, z.
        cameras: ids of the K cameras in the MuJoCo model.
    """

    appearance: Appearance
    size: np.ndarray
    geoms: tuple[int, ...]
    kinds: tuple[int, ...]
    sides: tuple[tuple[int, int, int], ...]
    cameras: tuple[int, ...]


def build(mj_model: mujoco.MjModel, camera_names: Sequence[str]) -> RenderModel:
    """Collect the visible geoms (alpha > 0, group < 3) of a model, sorted by kind.

    If the model has primitives in `STAND_IN_GROUP`, they are drawn in place of all meshes.

    Raises:
        ValueError: a visible geom is not a primitive, or no geom is visible.
    """
    cameras = {mj_model.camera(i).name: i for i in range(mj_model.ncam)}
    drawn, stand_ins = is_visible(mj_model), mj_model.geom_group == STAND_IN_GROUP
    if stand_ins.any():
        drawn = drawn & (mj_model.geom_type != mujoco.mjtGeom.mjGEOM_MESH) | stand_ins
    visible = np.flatnonzero(drawn).tolist()
    if not visible:
        raise ValueError("the model has no visible geom (alpha > 0 and group < 3)")
    types = mj_model.geom_type.tolist()
    for i in visible:
        if types[i] not in _SHAPES:
            name = mj_model.geom(i).name or i
            raise ValueError(f"geom {name} is not a primitive, so rays cannot draw it: hide it")
    geoms = sorted(visible, key=lambda i: _SHAPES[types[i]][0])
    return RenderModel(
        appearance=_default_appearance(mj_model),
        size=mj_model.geom_size.astype(np.float32),
        geoms=tuple(geoms),
        kinds=tuple(_SHAPES[types[i]][0] for i in geoms),
        sides=tuple(_SHAPES[types[i]][1] for i in geoms),
        cameras=tuple(cameras[name] for name in camera_names),
    )


def is_visible(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return which geoms of a model are visible (alpha > 0, group < 3), bool `[G]`."""
    return (mj_model.geom_rgba[:, 3] > 0) & (mj_model.geom_group < 3)


def unit_shapes(model: RenderModel, size: jax.Array | np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Compute the shape parameters of visible geoms from the sizes `[G, 3]` of all geoms [m].

    Returns:
        Half-extents `[V, 3]` [m], which become 1 in the unit frame. Half-length over radius `[V]`
        of capsules, 0 for other kinds.
    """
    size = jnp.asarray(size)[np.array(model.geoms)]
    scale = jnp.take_along_axis(size, np.array(model.sides), axis=1)
    scale = jnp.where(scale == 0, _INFINITE, scale)
    return scale, jnp.where(np.array(model.kinds) == CAPSULE, size[:, 1] / scale[:, 0], 0)


def _default_appearance(mj_model: mujoco.MjModel) -> Appearance:
    """Take colors, fields of view and the first light from the model, the rest from defaults."""
    values = Appearance(
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
