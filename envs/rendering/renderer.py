"""A ray caster over primitive geoms: pictures inside jit on any accelerator.

Geoms are sorted by kind when the model is built. One picture takes three steps:

1. one loop a kind over its geoms: how far is the geom along every pixel's ray? Distance and geom
   number share one int32 (the bits of a positive float sort like an integer; the lowest few hold
   the number), so the loop carries one array, which XLA makes one vectorised kernel a turn.
   Measured on two CPU cores, a table [geoms, pixels] with argmin is 3 to 5 times slower.
2. one gather of the winner's pose, size and colour per pixel, and one normal.
3. a second loop of the same shape for hard shadows: does another geom lie towards the light?

`samples` asks for several rays a pixel, for smooth edges; all steps then run once for each.
Light, colours, fields of view (`Look`) and sizes of geoms are traced: they can differ from world
to world. Cameras follow MuJoCo (looking along -z, y up); inside a geom they look through it.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs.rendering import intersections, shading
from envs.rendering.intersections import Geom, Geoms, Matrix, Vec, dot
from envs.rendering.model import Look, RenderModel, build, unit_shapes
from envs.rendering.shading import Raster, View

__all__ = [
    "Look",
    "RayRenderer",
    "RenderModel",
    "Renderer",
    "build",
    "cast",
    "render",
    "render_batch",
]

# Pixels rendered together. CPU: the few arrays in use stay in a core's cache (measured at 64 and
# 128 px). Accelerators: about 120 bytes a pixel are alive, measured, so this is about 1 GiB.
_PIXELS_ON_CPU, _PIXELS_ON_ACCELERATOR = 2**14, 2**23


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
    size: jax.Array | np.ndarray | None = None,
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
        size: `[G, 3]` replaces the model's own `geom_size` [m].
    """
    look = model.look if look is None else look
    size = model.size if size is None else size
    raster = Raster(height, width, samples)
    geoms, views = seen_by_cameras(
        model, look, size, (geom_xpos, geom_xmat, cam_xpos, cam_xmat), height
    )

    def picture(geoms: Geom, view: View) -> jax.Array:
        pixel = jnp.arange(height * width, dtype=jnp.int32)
        rgb = shading.colours(_table(geoms), model.kinds, view, raster, pixel)
        return jnp.stack(rgb, axis=-1).reshape(height, width, 3)

    return jax.vmap(picture)(geoms, views)


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
    size: jax.Array | np.ndarray | None = None,
) -> jax.Array:
    """`render` over a leading axis W of all arrays (`look`'s and `size` too), in bounded memory.

    Returns:
        uint8 `[W, K, height, width, 3]`.
    """
    pixels = _PIXELS_ON_CPU if jax.default_backend() == "cpu" else _PIXELS_ON_ACCELERATOR
    chunk = max(1, min(len(geom_xpos), pixels // (len(model.cameras) * height * width)))
    worlds = ((geom_xpos, geom_xmat, cam_xpos, cam_xmat), {"look": look, "size": size})
    return jax.lax.map(
        lambda world: render(
            model, *world[0], height=height, width=width, samples=samples, **world[1]
        ),
        worlds,
        batch_size=chunk,
    )


class Renderer(Protocol):
    """What draws the pictures of an environment; see `RayRenderer`."""

    @property
    def model(self) -> RenderModel: ...  # noqa: D102

    @property
    def image_size(self) -> int: ...  # noqa: D102

    @property
    def samples(self) -> int: ...  # noqa: D102

    def __call__(  # noqa: D102
        self, poses: Sequence[jax.Array], look: Look | None, size: jax.Array | None
    ) -> jax.Array: ...


@dataclasses.dataclass(frozen=True, eq=False)
class RayRenderer:
    """The ray caster for an environment: square pictures of N worlds a call.

    Attributes:
        model: from `build`.
        image_size: height and width [px].
        samples: n for n x n rays a pixel.
    """

    model: RenderModel
    image_size: int
    samples: int

    def __call__(
        self, poses: Sequence[jax.Array], look: Look | None, size: jax.Array | None
    ) -> jax.Array:
        """Pictures, uint8 `[N, K, height, width, 3]`; arguments as for `render_batch`."""
        side, samples = self.image_size, self.samples
        return render_batch(
            self.model, *poses, height=side, width=side, samples=samples, look=look, size=size
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
    size: jax.Array | np.ndarray | None = None,
) -> tuple[jax.Array, jax.Array]:
    """What each pixel of one world sees, with the model's own look; arguments as for `render`.

    Returns:
        Geom number in the MuJoCo model, int32 `[K, height, width]`, -1 for none; and depth along
        the camera's axis [m], f32 `[K, height, width]`, +inf for none. Depth is rounded down by
        less than 2^-16 of itself (up to 127 visible geoms): 15 micrometres at a metre. Single
        precision adds more where a geom is far for its size: measured, 0.1 mm on a sphere of
        radius 4 mm a metre away.
    """
    size = model.size if size is None else size
    raster = Raster(height, width, samples=1)

    def seen(geoms: Geom, view: View) -> tuple[jax.Array, jax.Array]:
        x, y = shading.slopes(view, raster, jnp.arange(height * width, dtype=jnp.int32))
        number, depth = intersections.nearest(_table(geoms), model.kinds, x, y)
        geom = jnp.where(jnp.isfinite(depth), jnp.array(model.geoms, jnp.int32)[number], -1)
        return geom.reshape(height, width), depth.reshape(height, width)

    poses = (geom_xpos, geom_xmat, cam_xpos, cam_xmat)
    return jax.vmap(seen)(*seen_by_cameras(model, model.look, size, poses, height))


def _table(geoms: Geom) -> Geoms:
    """Geoms by number, from leaves `[V]`: one gather for everything, pixels along the last axis."""
    table, tree = shading.pack(geoms), jax.tree.structure(geoms)
    return lambda number: jax.tree.unflatten(
        tree, list(table.at[:, number].get(mode="promise_in_bounds"))
    )


def seen_by_cameras(
    model: RenderModel,
    look: Look,
    size: jax.Array | np.ndarray,
    poses: tuple[jax.Array, ...],
    height: int,
) -> tuple[Geom, View]:
    """The visible geoms as each of the model's cameras sees them, leaves `[K, V]`; and the
    cameras, leaves `[K]`.
    """
    geom_xpos, geom_xmat, cam_xpos, cam_xmat = poses
    _check_shapes(look, geom_xpos=geom_xpos, cam_xpos=cam_xpos, size=size)
    visible, chosen = np.array(model.geoms), np.array(model.cameras)
    scale, half = unit_shapes(model, size)
    to_unit = _rows(jnp.swapaxes(geom_xmat[visible], -1, -2) / scale[:, :, None])
    light = _vec(jnp.asarray(look.light) / jnp.linalg.norm(look.light))
    rgb = jnp.asarray(look.rgba)[visible, :3]

    def view(position: jax.Array, rotation: jax.Array, fovy: jax.Array) -> tuple[Geom, View]:
        turned = [_product(to_unit, axis) for axis in _rows(rotation.T)]
        geoms = Geom(
            axes=tuple(zip(*turned, strict=True)),
            eye=_product(to_unit, _vec(position - geom_xpos[visible])),
            light=_product(to_unit, light),
            shrink=_vec(1 / scale),
            rgb=_vec(rgb),
            half=half,
            kind=jnp.array(model.kinds, jnp.float32),
        )
        return geoms, _camera(look, position, rotation, jnp.tan(jnp.deg2rad(fovy) / 2) / height)

    return jax.vmap(view)(cam_xpos[chosen], cam_xmat[chosen], jnp.asarray(look.fovy)[chosen])


def _camera(look: Look, position: jax.Array, rotation: jax.Array, pixel: jax.Array) -> View:
    return View(
        position=_vec(position),
        rotation=_rows(rotation),
        pixel=pixel,
        ambient=jnp.asarray(look.ambient),
        headlight=jnp.asarray(look.headlight),
        diffuse=jnp.asarray(look.diffuse),
        horizon=_vec(look.sky[0]),
        zenith=_vec(look.sky[1]),
        square=jnp.asarray(look.checker[0]),
        contrast=jnp.asarray(look.checker[1]),
    )


def _check_shapes(look: Look, **given: jax.Array | np.ndarray) -> None:
    for name, array in given.items():
        count = (look.fovy if name == "cam_xpos" else look.rgba).shape[0]
        if array.shape != (count, 3):
            raise ValueError(f"{name} must have shape {(count, 3)}, not {array.shape}")


def _vec(vectors: jax.Array) -> Vec:
    """Splits `[..., 3]` into a triple."""
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def _rows(matrices: jax.Array) -> Matrix:
    """Splits `[..., 3, 3]` into a triple of rows."""
    return _vec(matrices[..., 0, :]), _vec(matrices[..., 1, :]), _vec(matrices[..., 2, :])


def _product(rows: Matrix, vector: Vec) -> Vec:
    """Matrix times vector: in full single precision everywhere, which einsum is not."""
    return dot(rows[0], vector), dot(rows[1], vector), dot(rows[2], vector)
