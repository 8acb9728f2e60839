"""A ray caster over primitive geoms: pictures inside jit on any accelerator.

Geoms are sorted by kind when the model is built. One picture takes three steps:

1. one loop a kind over its geoms: how far is the geom along every pixel's ray? Distance and geom
   number share one int32 (the bits of a positive float sort like an integer; the lowest few hold
   the number), so the loop carries one array, which XLA makes one vectorised kernel a turn.
   Measured on two CPU cores, a table [geoms, pixels] with argmin is 3 to 5 times slower.
2. one gather of the winner's pose, size and colour per pixel, and one normal.
3. a second loop of the same shape for hard shadows: does another geom lie towards the light?

Light, colours and fields of view are traced (`Look`): they can differ from world to world.
Cameras follow MuJoCo (looking along -z, y up); inside a geom they look through it.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import intersections
from envs.intersections import BOX, CAPSULE, CYLINDER, PLANE, SPHERE, Geoms, dot, ray

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

# Pixels rendered together. CPU: the few arrays in use stay in a core's cache (measured at 64 and
# 128 px). Accelerators: about 200 bytes a pixel are alive, so this is about 1 GiB.
_PIXELS_ON_CPU, _PIXELS_ON_ACCELERATOR = 2**14, 2**22


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
    data_fields=["look", "scale", "half"],
    meta_fields=["geoms", "kinds", "cameras"],
)
@dataclass(frozen=True)
class RenderModel:
    """The visible geoms of a MuJoCo model, sorted by kind, and the cameras to render.

    Attributes:
        look: the model's own colours, light and fields of view.
        scale: `[V, 3]` half-extents that map each visible geom to its unit shape [m].
        half: `[V]` a capsule's half-length over its radius, else 0.
        geoms: V numbers of the visible geoms in the MuJoCo model.
        kinds: V kinds of `intersections`, ascending.
        cameras: K numbers of the cameras in the MuJoCo model.
    """

    look: Look
    scale: np.ndarray
    half: np.ndarray
    geoms: tuple[int, ...]
    kinds: tuple[int, ...]
    cameras: tuple[int, ...]


def build(mj_model: mujoco.MjModel, camera_names: Sequence[str]) -> RenderModel:
    """Sorts the visible geoms (alpha above 0, group below 3) of a model for rendering.

    Raises:
        ValueError: if a camera does not exist, a visible geom is not a primitive, or none is left.
    """
    cameras = {mj_model.camera(i).name: i for i in range(mj_model.ncam)}
    if unknown := set(camera_names) - set(cameras):
        raise ValueError(f"the model has no camera {unknown}, only {sorted(cameras)}")
    visible = np.flatnonzero((mj_model.geom_rgba[:, 3] > 0) & (mj_model.geom_group < 3)).tolist()
    if not visible:
        raise ValueError("the model has no visible geom (alpha above 0, group below 3)")
    types, sizes = mj_model.geom_type.tolist(), mj_model.geom_size
    for i in visible:
        if types[i] not in _SHAPES:
            raise ValueError(
                f"geom {mj_model.geom(i).name or i} cannot be drawn: only planes, spheres, "
                "ellipsoids, capsules, cylinders and boxes can (group 3 hides a geom)"
            )
    geoms = sorted(visible, key=lambda i: _SHAPES[types[i]][0])
    kinds = tuple(_SHAPES[types[i]][0] for i in geoms)
    scale = np.array([sizes[i, _SHAPES[types[i]][1]] for i in geoms], np.float32)
    scale[scale == 0] = _INFINITE
    half = np.where(np.array(kinds) == CAPSULE, sizes[geoms, 1] / scale[:, 0], 0)
    return RenderModel(
        look=_own_look(mj_model),
        scale=scale,
        half=half.astype(np.float32),
        geoms=tuple(geoms),
        kinds=kinds,
        cameras=tuple(cameras[name] for name in camera_names),
    )


def _own_look(mj_model: mujoco.MjModel) -> Look:
    """Colours, fields of view and first light of the model; the rest chosen by eye."""
    values = Look(
        rgba=mj_model.geom_rgba,
        light=-mj_model.light_dir[0] if mj_model.nlight else np.array([0.3, -0.4, 0.87]),
        ambient=np.array(0.35),
        headlight=np.array(0.25),
        diffuse=np.array(0.5),
        sky=np.array([[0.80, 0.84, 0.88], [0.45, 0.58, 0.75]]),
        checker=np.array([0.1, 0.12]),
        fovy=mj_model.cam_fovy,
    )
    return jax.tree.map(lambda x: np.asarray(x, np.float32), values)


@functools.partial(jax.jit, static_argnames=("height", "width"))
def render(
    model: RenderModel,
    geom_xpos: jax.Array,
    geom_xmat: jax.Array,
    cam_xpos: jax.Array,
    cam_xmat: jax.Array,
    *,
    height: int,
    width: int,
    look: Look | None = None,
) -> jax.Array:
    """Pictures of one world, uint8 `[K, height, width, 3]`, in the order of the camera names.

    Args:
        model: from `build`.
        geom_xpos, geom_xmat: `[G, 3]` positions [m] and `[G, 3, 3]` rotations of all geoms of the
            MuJoCo model.
        cam_xpos, cam_xmat: `[N, 3]` and `[N, 3, 3]`, the same of all its cameras.
        height, width: rows and columns [px].
        look: replaces the model's own look.
    """
    look = model.look if look is None else look

    def picture(view: _View) -> jax.Array:
        hit = intersections.nearest(view.geoms, model.kinds, view.x, view.y)
        pixels = (jnp.clip(_colour(model, look, view, *hit), 0, 1) * 255 + 0.5).astype(jnp.uint8)
        return pixels.T.reshape(height, width, 3)

    poses = (geom_xpos, geom_xmat, cam_xpos, cam_xmat)
    return jax.vmap(picture)(_views(model, look, poses, height, width))


def render_batch(
    model: RenderModel,
    geom_xpos: jax.Array,
    geom_xmat: jax.Array,
    cam_xpos: jax.Array,
    cam_xmat: jax.Array,
    *,
    height: int,
    width: int,
    look: Look | None = None,
) -> jax.Array:
    """`render` over a leading axis W of all arrays (those of `look` too), in bounded memory.

    Returns:
        uint8 `[W, K, height, width, 3]`.
    """
    pixels = _PIXELS_ON_CPU if jax.default_backend() == "cpu" else _PIXELS_ON_ACCELERATOR
    chunk = max(1, min(len(geom_xpos), pixels // (len(model.cameras) * height * width)))
    worlds = ((geom_xpos, geom_xmat, cam_xpos, cam_xmat), look)
    return jax.lax.map(
        lambda world: render(model, *world[0], height=height, width=width, look=world[1]),
        worlds,
        batch_size=chunk,
    )


@functools.partial(jax.jit, static_argnames=("height", "width"))
def cast(
    model: RenderModel,
    geom_xpos: jax.Array,
    geom_xmat: jax.Array,
    cam_xpos: jax.Array,
    cam_xmat: jax.Array,
    *,
    height: int,
    width: int,
) -> tuple[jax.Array, jax.Array]:
    """What each pixel of one world sees, with the model's own look; arguments as for `render`.

    Returns:
        Geom number in the MuJoCo model, int32 `[K, height, width]`, -1 for none; and depth along
        the camera's axis [m], f32 `[K, height, width]`, +inf for none. Depth is rounded down by
        less than 2^-16 of itself (up to 127 visible geoms): 15 micrometres at a metre.
    """

    def seen(view: _View) -> tuple[jax.Array, jax.Array]:
        number, depth = intersections.nearest(view.geoms, model.kinds, view.x, view.y)
        geom = jnp.where(jnp.isfinite(depth), jnp.array(model.geoms, jnp.int32)[number], -1)
        return geom.reshape(height, width), depth.reshape(height, width)

    poses = (geom_xpos, geom_xmat, cam_xpos, cam_xmat)
    return jax.vmap(seen)(_views(model, model.look, poses, height, width))


class _View(NamedTuple):
    """One camera: the geoms in its frame, its pose, and the slopes of its pixels' rays."""

    geoms: Geoms
    position: jax.Array  # [3]
    rotation: jax.Array  # [3, 3]
    x: jax.Array  # [P]
    y: jax.Array  # [P]


def _views(
    model: RenderModel, look: Look, poses: tuple[jax.Array, ...], height: int, width: int
) -> _View:
    """The views of the model's cameras, leading axis K."""
    geom_xpos, geom_xmat, cam_xpos, cam_xmat = poses
    for name, given, count in (
        ("geom_xpos", geom_xpos, look.rgba.shape[0]),
        ("cam_xpos", cam_xpos, look.fovy.shape[0]),
    ):
        if given.shape != (count, 3):
            raise ValueError(f"{name} must have shape {(count, 3)}, not {given.shape}")
    product = functools.partial(jnp.einsum, precision="highest")
    visible, chosen = np.array(model.geoms), np.array(model.cameras)
    to_unit = jnp.swapaxes(geom_xmat[visible], -1, -2) / model.scale[:, :, None]
    fixed = {
        "number": jnp.arange(len(visible), dtype=jnp.int32),
        "light": product("vij,j->vi", to_unit, look.light / jnp.linalg.norm(look.light)),
        "shrink": jnp.asarray(1 / model.scale),
        "half": jnp.asarray(model.half),
        "kind": jnp.array(model.kinds, jnp.float32),
    }
    row, column = np.mgrid[:height, :width].astype(np.float32).reshape(2, -1)

    def view(position: jax.Array, rotation: jax.Array, fovy: jax.Array) -> _View:
        axes = product("vij,jk->vik", to_unit, rotation)
        eye = product("vij,vj->vi", to_unit, position - geom_xpos[visible])
        pixel = jnp.tan(jnp.deg2rad(fovy) / 2) / height  # half its edge, one metre away
        x, y = pixel * (2 * column + 1 - width), pixel * (height - 1 - 2 * row)
        return _View(Geoms(axes=axes, eye=eye, **fixed), position, rotation, x, y)

    return jax.vmap(view)(cam_xpos[chosen], cam_xmat[chosen], jnp.asarray(look.fovy)[chosen])


def _colour(
    model: RenderModel, look: Look, view: _View, number: jax.Array, depth: jax.Array
) -> jax.Array:
    """Colour of each pixel, `[3, P]`, from what its ray hits."""
    hit, depth = jnp.isfinite(depth), jnp.where(jnp.isfinite(depth), depth, 0)
    direction = ray(view.rotation, view.x, view.y)
    length = jnp.sqrt(dot(direction, direction))
    rgb = jnp.asarray(look.rgba)[np.array(model.geoms), :3]
    rgb, kind, to_light, to_eye = intersections.surface(
        view.geoms, rgb, view.x, view.y, number, depth
    )
    lit = (to_light > 0) & intersections.unshadowed(
        view.geoms, model.kinds, view.x, view.y, number, depth
    )
    shade = look.ambient + look.headlight * to_eye / length + look.diffuse * to_light * lit
    squares = [
        jnp.floor((view.position[i] + depth * direction[i]) / look.checker[0]) for i in range(2)
    ]
    dark = (kind == PLANE) & ((squares[0] + squares[1]) % 2 == 1)
    up = jnp.clip(direction[2] / length, 0, 1)
    sky = look.sky[0, :, None] * (1 - up) + look.sky[1, :, None] * up
    return jnp.where(hit, rgb * shade * (1 - look.checker[1] * dark), sky)
