"""Compute the colors of pixels, which form one axis of any length."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.rendering import intersections
from envs.rendering.intersections import PLANE, Geoms, Matrix, Vec, along, dot, ray


class RayCamera(NamedTuple):
    """One camera and its light; every leaf is a scalar.

    Shares and colors are as in `Appearance`.
    """

    position: Vec
    rotation: Matrix
    pixel: jax.Array  # half a pixel's edge at a depth of one meter [m]
    ambient: jax.Array
    headlight: jax.Array
    diffuse: jax.Array
    horizon: Vec  # color of the sky
    zenith: Vec
    square: jax.Array  # edge of the checker on planes [m]
    contrast: jax.Array


class Raster(NamedTuple):
    """Size of an image [px], and rays per pixel along each axis."""

    height: int
    width: int
    samples: int


def pack(tree: Any) -> jax.Array:
    """Stack the leaves of a tree, all of one shape, along a new first axis."""
    return jnp.stack([jnp.asarray(leaf, jnp.float32) for leaf in jax.tree.leaves(tree)])


def colors(
    geoms: Geoms, kinds: tuple[int, ...], view: RayCamera, raster: Raster, pixel: jax.Array
) -> Vec:
    """Compute pixel colors, a triple of uint8 `[P]`: the mean of `samples` x `samples` rays.

    Each ray's color is clipped to [0, 1] before averaging; otherwise overexposed edges would stay
    jagged.

    Args:
        geoms: V geoms, as seen by `view`.
        kinds: V kinds, ascending.
        view, raster: camera and image size.
        pixel: int32 `[P]` pixel indices in row-major order.
    """
    x, y = slopes(view, raster, pixel)
    n = raster.samples

    # One ray per pixel at a time, so that memory does not grow with the number of rays.
    def add(i: jax.Array, total: Vec) -> Vec:
        shifts = (
            ((j + 0.5) / n - 0.5) * 2 * view.pixel for j in (jax.lax.rem(i, n), jax.lax.div(i, n))
        )
        color = _color(geoms, kinds, view, *(z + s for z, s in zip((x, y), shifts, strict=True)))
        return tuple(t + jnp.clip(c, 0, 1) for t, c in zip(total, color, strict=True))

    zero = jnp.zeros(pixel.shape, jnp.float32)
    total = jax.lax.fori_loop(0, n * n, add, (zero, zero, zero))
    return tuple((t * (255 / n**2) + 0.5).astype(jnp.uint8) for t in total)


def slopes(view: RayCamera, raster: Raster, pixel: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute the rightward and upward slopes of each pixel's ray, both `[P]`."""
    row = jax.lax.div(pixel, jnp.int32(raster.width))
    column = pixel - raster.width * row
    x = (2 * column + 1 - raster.width).astype(jnp.float32)
    y = (raster.height - 1 - 2 * row).astype(jnp.float32)
    return view.pixel * x, view.pixel * y


def _color(
    geoms: Geoms, kinds: tuple[int, ...], view: RayCamera, x: jax.Array, y: jax.Array
) -> Vec:
    """Compute the color that each ray sees, a triple of `[P]`."""
    number, depth = intersections.nearest(geoms, kinds, x, y)
    hit = depth < jnp.inf
    depth = jnp.where(hit, depth, 0)
    geom = geoms(number)
    to_light, to_eye = intersections.surface(geom, x, y, depth)
    lit = (to_light > 0) & intersections.unshadowed(geoms, kinds, x, y, number, depth)
    direction = ray(view.rotation, x, y)
    length = jnp.sqrt(dot(direction, direction))
    point = along(view.position, depth, direction)
    squares = jnp.floor(point[0] / view.square) + jnp.floor(point[1] / view.square)
    odd = squares - 2 * jnp.floor(squares / 2) == 1
    square = jnp.where((geom.kind == PLANE) & odd, 1 - view.contrast, 1)
    light = view.ambient + jnp.where(lit, view.diffuse * to_light, 0)
    # Divide last: XLA would recompute a cheaper last operation for each of the three channels.
    shade = square * (light * length + view.headlight * to_eye) / length
    up = jnp.clip(direction[2] / length, 0, 1)
    sky = along(
        view.horizon, up, tuple(z - h for z, h in zip(view.zenith, view.horizon, strict=True))
    )
    return tuple(jnp.where(hit, c * shade, s) for c, s in zip(geom.rgb, sky, strict=True))
