"""Rays of one camera against primitive geoms: the nearest geom, shadows, surface normals.

Every geom is scaled to a unit shape in its own frame before it is intersected: a sphere or
ellipsoid to the unit sphere, a cylinder to radius 1 and half-length 1, a box to the cube
[-1, 1]^3, a plane to z = 0 with half-extents 1, a capsule to radius 1 (its half-length `half`
stays a parameter). Scaling leaves the ray parameter t as it is.

Vectors are triples of arrays, one per component, so that XLA fuses everything into one loop over
pixels. Components broadcast: a camera ray has one origin and many directions, a shadow ray many
origins and one direction.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

Vec = tuple[jax.Array, ...]  # x, y, z
Matrix = tuple[Vec, ...]  # three rows

PLANE, SPHERE, CAPSULE, CYLINDER, BOX = range(5)
_MISS = 0x7F800000  # the bits of float32 +inf
_TINY = 1e-12  # stands in for a zero direction component or squared length in a denominator


class Geom(NamedTuple):
    """A geom as one camera sees it, in its unit frame.

    Components are scalars; or arrays `[P]`, where each pixel has a geom of its own.
    """

    axes: Matrix  # rows of the matrix with the camera's axes as columns
    eye: Vec  # the camera's position
    light: Vec  # direction towards the light
    shrink: Vec  # 1 / the half-extents that were scaled to 1 [1/m]
    rgb: Vec
    half: jax.Array  # a capsule's half-length over its radius, else 0
    kind: jax.Array  # f32, PLANE .. BOX


Geoms = Callable[[jax.Array], Geom]
"""int32 number, or numbers `[P]` -> that geom, or the geom of each pixel; sorted by kind."""


def dot(a: Vec, b: Vec) -> jax.Array:
    """Scalar product of two component triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def ray(axes: Matrix, x: jax.Array, y: jax.Array) -> Vec:
    """Components of axes @ (x, y, -1); `axes` are rows."""
    return tuple(row[0] * x + row[1] * y - row[2] for row in axes)


def along(origin: Vec, t: jax.Array, direction: Vec) -> Vec:
    """The point origin + t * direction."""
    return tuple(o + t * d for o, d in zip(origin, direction, strict=True))


def _enter(hit: jax.Array, t: jax.Array) -> jax.Array:
    return jnp.where(hit & (t > 0), t, jnp.inf)


def _plane(o: Vec, d: Vec, half: jax.Array) -> jax.Array:
    del half
    t = -o[2] / d[2]
    inside = (jnp.abs(o[0] + t * d[0]) <= 1) & (jnp.abs(o[1] + t * d[1]) <= 1)
    return _enter(inside & (d[2] < 0), t)


def _sphere(o: Vec, d: Vec, half: jax.Array) -> jax.Array:
    del half
    a, b, c = dot(d, d), dot(o, d), dot(o, o) - 1
    root = b * b - a * c
    return _enter(root > 0, (-b - jnp.sqrt(jnp.maximum(root, 0))) / a)


def _round_side(o: Vec, d: Vec) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Coefficients a t^2 + 2 b t + c = 0 of the infinite unit cylinder, and b^2 - a c."""
    a = d[0] * d[0] + d[1] * d[1]
    b = o[0] * d[0] + o[1] * d[1]
    c = o[0] * o[0] + o[1] * o[1] - 1
    return a, b, c, b * b - a * c


def _capsule(o: Vec, d: Vec, half: jax.Array) -> jax.Array:
    """The infinite cylinder; where it is entered beyond an end, the sphere at that end instead."""
    a, b, c, root = _round_side(o, d)
    t = (-b - jnp.sqrt(jnp.maximum(root, 0))) / jnp.maximum(a, _TINY)
    z = o[2] + t * d[2]
    body = jnp.abs(z) <= half
    end = o[2] - jnp.where(z > 0, half, -half)
    a, b, c = a + d[2] * d[2], b + end * d[2], c + end * end
    end_root = b * b - a * c
    t = jnp.where(body, t, (-b - jnp.sqrt(jnp.maximum(end_root, 0))) / a)
    return _enter((root > 0) & (body | (end_root > 0)), t)


def _slab(o: jax.Array, d: jax.Array) -> tuple[jax.Array, jax.Array]:
    inverse = 1 / jnp.where(jnp.abs(d) < _TINY, _TINY, d)
    middle, reach = -o * inverse, jnp.abs(inverse)
    return middle - reach, middle + reach


def _cylinder(o: Vec, d: Vec, half: jax.Array) -> jax.Array:
    del half
    a, b, _, root = _round_side(o, d)
    reach, inverse = jnp.sqrt(jnp.maximum(root, 0)), 1 / jnp.maximum(a, _TINY)
    near, far = _slab(o[2], d[2])
    near = jnp.maximum(near, (-b - reach) * inverse)
    far = jnp.minimum(far, (-b + reach) * inverse)
    return _enter((root > 0) & (near < far), near)


def _box(o: Vec, d: Vec, half: jax.Array) -> jax.Array:
    del half
    (x0, x1), (y0, y1), (z0, z1) = (_slab(*axis) for axis in zip(o, d, strict=True))
    near = jnp.maximum(jnp.maximum(x0, y0), z0)
    far = jnp.minimum(jnp.minimum(x1, y1), z1)
    return _enter(near < far, near)


Enter = Callable[[Vec, Vec, jax.Array], jax.Array]
ENTER: tuple[Enter, ...] = (_plane, _sphere, _capsule, _cylinder, _box)
"""By kind: (origin, direction, half) -> the t > 0 where the ray enters from outside, or +inf."""


def nearest(
    geoms: Geoms, kinds: tuple[int, ...], x: jax.Array, y: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """First geom along the rays eye + depth * (x, y, -1) in the camera's frame.

    Args:
        geoms: V geoms.
        kinds: V kinds, ascending.
        x: `[P]` slope of each pixel's ray to the right.
        y: `[P]` slope upwards.

    Returns:
        Its number `[P]` (int32, 0 where nothing is hit) and depth `[P]` (+inf where nothing is
        hit), which is rounded down to leave the number's bits free.
    """
    low = (1 << len(kinds).bit_length()) - 1

    def closer(enter: Enter, number: jax.Array, best: jax.Array) -> jax.Array:
        geom = geoms(number)
        t = enter(geom.eye, ray(geom.axes, x, y), geom.half)
        bits = jax.lax.bitcast_convert_type(t, jnp.int32)
        return jnp.minimum(best, (bits & ~low) | number)

    best = _over_kinds(closer, jnp.full(x.shape, _MISS, jnp.int32), kinds, first=PLANE)
    return best & low, jax.lax.bitcast_convert_type(best & ~low, jnp.float32)


def unshadowed(
    geoms: Geoms,
    kinds: tuple[int, ...],
    x: jax.Array,
    y: jax.Array,
    number: jax.Array,
    depth: jax.Array,
) -> jax.Array:
    """Whether no other geom lies between a surface point and the light, bool `[P]`.

    Arguments are those and the results of `nearest`, depth finite. A convex geom shades itself
    where its normal points away from the light, which is the caller's to see; planes cast no
    shadows.
    """

    def blocked(enter: Enter, other: jax.Array, lit: jax.Array) -> jax.Array:
        geom = geoms(other)
        point = along(geom.eye, depth, ray(geom.axes, x, y))
        t = enter(point, geom.light, geom.half)
        return lit & ((t == jnp.inf) | (other == number))

    return _over_kinds(blocked, jnp.full(x.shape, True), kinds, first=SPHERE)


def _over_kinds(
    body: Callable[[Enter, jax.Array, jax.Array], jax.Array],
    carry: jax.Array,
    kinds: tuple[int, ...],
    *,
    first: int,
) -> jax.Array:
    """One loop over the geoms of each kind from `first` on."""
    for kind in sorted(set(kinds)):
        if kind >= first:
            begin = kinds.index(kind)
            turn = functools.partial(body, ENTER[kind])
            carry = jax.lax.fori_loop(begin, begin + kinds.count(kind), turn, carry)
    return carry


def surface(
    geom: Geom, x: jax.Array, y: jax.Array, depth: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """What shading needs of the surface points at finite `depth` `[P]` on each pixel's geom.

    Returns:
        Cosine `[P]` between normal and direction to the light; cosine `[P]`, at least 0, between
        normal and the ray reversed, times the ray's length.
    """
    slope = ray(geom.axes, x, y)
    outward = _gradient(along(geom.eye, depth, slope), geom.kind, geom.half)
    world = tuple(g * s for g, s in zip(outward, geom.shrink, strict=True))
    inverse_length = jax.lax.rsqrt(jnp.maximum(dot(world, world), _TINY))
    to_light = dot(outward, geom.light) * inverse_length
    return to_light, jnp.maximum(-dot(outward, slope) * inverse_length, 0)


def _gradient(point: Vec, kind: jax.Array, half: jax.Array) -> Vec:
    """The outward normal at a surface point, in the unit frame and of any length."""
    x, y, z = point
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    flat_end = z * z > x * x + y * y  # a cylinder has |z| < 1 = |(x, y)| on its side
    face = jnp.maximum(jnp.maximum(ax, ay), az)
    box, cylinder, plane = kind == BOX, kind == CYLINDER, kind == PLANE
    keep_x = ~plane & ~(box & (ax < face)) & ~(cylinder & flat_end)
    keep_y = ~plane & ~(box & (ay < face)) & ~(cylinder & flat_end)
    keep_z = ~(box & (az < face)) & ~(cylinder & ~flat_end)
    up = jnp.where(plane, 1, z - jnp.clip(z, -half, half))
    return jnp.where(keep_x, x, 0), jnp.where(keep_y, y, 0), jnp.where(keep_z, up, 0)
