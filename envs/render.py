"""A ray caster over primitive geoms: pictures inside jit on any accelerator.

Geoms are sorted by kind when the model is built. One picture takes three steps:

1. one loop a kind over its geoms: how far is the geom along every pixel's ray? Distance and geom
   number share one int32 (the bits of a positive float sort like an integer; the lowest few hold
   the number), so the loop carries one array, which XLA makes one vectorised kernel a turn.
   Measured on two CPU cores, a table [geoms, pixels] with argmin is 3 to 5 times slower.
2. one gather of the winner's pose, size and colour per pixel, and one normal.
3. a second loop of the same shape for hard shadows: does another geom lie towards the light?

`samples` asks for several rays a pixel, for smooth edges; all steps then run once for each.
Light, colours and fields of view are traced (`Look`): they can differ from world to world.
Cameras follow MuJoCo (looking along -z, y up); inside a geom they look through it.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs import intersections
from envs.intersections import PLANE, Geoms, dot, ray
from envs.render_model import Look, RenderModel, build

__all__ = ["Look", "RenderModel", "build", "cast", "render", "render_batch"]

# Pixels rendered together. CPU: the few arrays in use stay in a core's cache (measured at 64 and
# 128 px). Accelerators: about 200 bytes a pixel are alive, so this is about 1 GiB.
_PIXELS_ON_CPU, _PIXELS_ON_ACCELERATOR = 2**14, 2**22


@functools.partial(jax.jit, static_argnames=("height", "width", "samples"))
def render(
    model: RenderModel,
    geom_xpos: jax.Array,
    geom_xmat: jax.Array,
    cam_xpos: jax.Array,
    cam_xmat: jax.Array,
    *,
    height: int,
    width: int,
    samples: int = 1,
    look: Look | None = None,
) -> jax.Array:
    """Pictures of one world, uint8 `[K, height, width, 3]`, in the order of the camera names.

    Args:
        model: from `build`.
        geom_xpos, geom_xmat: `[G, 3]` positions [m] and `[G, 3, 3]` rotations of all geoms of the
            MuJoCo model.
        cam_xpos, cam_xmat: `[N, 3]` and `[N, 3, 3]`, the same of all its cameras.
        height, width: rows and columns [px].
        samples: n for the mean of n x n rays a pixel, evenly spread; n squared times the work.
        look: replaces the model's own look.
    """
    look = model.look if look is None else look

    def picture(view: _View) -> jax.Array:
        pixels = (_mean_colour(model, look, view, samples) * 255 + 0.5).astype(jnp.uint8)
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
    samples: int = 1,
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
        lambda world: render(
            model, *world[0], height=height, width=width, samples=samples, look=world[1]
        ),
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
        less than 2^-16 of itself (up to 127 visible geoms): 15 micrometres at a metre. Single
        precision adds more where a geom is far for its size: measured, 0.1 mm on a sphere of
        radius 4 mm a metre away.
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
    edge: jax.Array  # [] width and height of a pixel in x and y


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
        return _View(Geoms(axes=axes, eye=eye, **fixed), position, rotation, x, y, 2 * pixel)

    return jax.vmap(view)(cam_xpos[chosen], cam_xmat[chosen], jnp.asarray(look.fovy)[chosen])


def _mean_colour(model: RenderModel, look: Look, view: _View, samples: int) -> jax.Array:
    """Colour of each pixel, `[3, P]`, 0 to 1: the mean of `samples` x `samples` rays.

    Each ray's colour is clipped to what a screen shows before the mean is taken (there is no gamma
    to undo), as in a larger picture scaled down: else an overexposed edge would stay jagged.
    """
    along = (np.arange(samples, dtype=np.float32) + 0.5) / samples - 0.5
    shifts = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)  # from its centre [px]

    # One ray a pixel at a time: memory does not grow with the number of rays.
    def add(total: jax.Array, shift: jax.Array) -> tuple[jax.Array, None]:
        moved = view._replace(x=view.x + shift[0] * view.edge, y=view.y + shift[1] * view.edge)
        hit = intersections.nearest(moved.geoms, model.kinds, moved.x, moved.y)
        return total + jnp.clip(_colour(model, look, moved, *hit), 0, 1), None

    total, _ = jax.lax.scan(add, jnp.zeros((3, len(view.x)), jnp.float32), jnp.asarray(shifts))
    return total / len(shifts)


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
