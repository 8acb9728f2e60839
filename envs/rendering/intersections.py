"""Intersect the rays of one camera with primitive geoms: nearest hit, shadows, surface normals.

Each geom is first scaled to a unit shape in its own frame:

- sphere, ellipsoid: the unit sphere
- cylinder: radius 1 and half-length 1
- box: the cube [-1, 1]^3
- plane: z = 0 with half-extents 1
- capsule: radius 1; the half-length `half` stays a parameter

Scaling does not change the ray parameter t.

Vectors are triples of component arrays, so that XLA fuses everything into one loop over pixels.
Components broadcast: camera rays share an origin, and shadow rays share a direction.
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
_TINY = 1e-12  # replaces zero in a denominator


class Geom(NamedTuple):
    """A geom, the camera and the light, in the geom's unit frame.

    Components are scalars, or `[P]` for one geom per pixel.
    """

    axes: Matrix  # the camera's axes in its columns
    eye: Vec  # the camera's position
    light: Vec  # direction to the light
    shrink: Vec  # 1 / half-extents before scaling [1/m]
    rgb: Vec
    half: jax.Array  # a capsule's half-length over its radius, else 0
    kind: jax.Array  # f32, PLANE .. BOX


Geoms = Callable[[jax.Array], Geom]
"""Look up a geom by its index, int32 scalar or `[P]`; geoms are sorted by kind."""


def dot(a: Vec, b: Vec) -> jax.Array:
    """Compute the dot product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def ray(axes: Matrix, x: jax.Array, y: jax.Array) -> Vec:
    """Compute axes @ (x, y, -1), `axes` given as rows."""
    return tuple(row[0] * x + row[1] * y - row[2] for row in axes)


def along(origin: Vec, t: jax.Array, direction: Vec) -> Vec:
    """Compute the point origin + t * direction."""
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
    """Return a, b, c of a t² + 2 b t + c = 0 for the infinite unit cylinder, and b² - a c."""
    a = d[0] * d[0] + d[1] * d[1]
    b = o[0] * d[0] + o[1] * d[1]
    c = o[0] * o[0] + o[1] * o[1] - 1
    return a, b, c, b * b - a * c


def _capsule(o: Vec, d: Vec, half: jax.Array) -> jax.Array:
    """Intersect the infinite cylinder, or an end's sphere if the ray enters beyond that end."""
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
"""By kind: (origin, direction, half) -> t > 0 where the ray enters from outside, or +inf."""


def nearest(
    geoms: Geoms, kinds: tuple[int, ...], x: jax.Array, y: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Find the first geom that each ray eye + depth * (x, y, -1) hits, in the camera's frame.

    Args:
        geoms: V geoms.
        kinds: V kinds, ascending.
        x: `[P]` rightward slope of each pixel's ray.
        y: `[P]` upward slope.

    Returns:
        Index `[P]` of that geom, int32, 0 for no hit. Depth `[P]`, +inf for no hit, rounded down
        because its lowest bits hold the index during the search.
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
    """Return whether no other geom blocks the way from a surface point to the light, bool `[P]`.

    Takes the arguments and results of `nearest`; depth must be finite. Planes cast no shadows. The
    caller handles self-shadowing: a convex geom is dark where its normal faces away from the light.
    """

    def still_lit(enter: Enter, other: jax.Array, lit: jax.Array) -> jax.Array:
        geom = geoms(other)
        point = along(geom.eye, depth, ray(geom.axes, x, y))
        t = enter(point, geom.light, geom.half)
        return lit & ((t == jnp.inf) | (other == number))

    return _over_kinds(still_lit, jnp.full(x.shape, True), kinds, first=SPHERE)


def _over_kinds(
    body: Callable[[Enter, jax.Array, jax.Array], jax.Array],
    carry: jax.Array,
    kinds: tuple[int, ...],
    *,
    first: int,
) -> jax.Array:
    """Run one loop per kind >= `first` over the geoms of that kind."""
    for kind in sorted(set(kinds)):
        if kind >= first:
            begin = kinds.index(kind)
            step = functools.partial(body, ENTER[kind])
            carry = jax.lax.fori_loop(begin, begin + kinds.count(kind), step, carry)
    return carry


def surface(
    geom: Geom, x: jax.Array, y: jax.Array, depth: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Compute the shading terms of surface points at finite `depth` `[P]` on each pixel's geom.

    Returns:
        Cosine `[P]` between the normal and the direction to the light. Cosine `[P]`, at least 0,
        between the normal and the reversed ray, multiplied by the length of (x, y, -1).
    """
    slope = ray(geom.axes, x, y)
    outward = _gradient(along(geom.eye, depth, slope), geom.kind, geom.half)
    world = tuple(g * s for g, s in zip(outward, geom.shrink, strict=True))
    inverse_length = jax.lax.rsqrt(jnp.maximum(dot(world, world), _TINY))
    to_light = dot(outward, geom.light) * inverse_length
    return to_light, jnp.maximum(-dot(outward, slope) * inverse_length, 0)


def _gradient(point: Vec, kind: jax.Array, half: jax.Array) -> Vec:
    """Compute an outward normal of any length at a surface point, in the unit frame."""
    x, y, z = point
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    flat_end = z * z > x * x + y * y  # on a cylinder's side, |z| < 1 = |(x, y)|
    face = jnp.maximum(jnp.maximum(ax, ay), az)
    box, cylinder, plane = kind == BOX, kind == CYLINDER, kind == PLANE
    keep_x = ~plane & ~(box & (ax < face)) & ~(cylinder & flat_end)
    keep_y = ~plane & ~(box & (ay < face)) & ~(cylinder & flat_end)
    keep_z = ~(box & (az < face)) & ~(cylinder & ~flat_end)
    up = jnp.where(plane, 1, z - jnp.clip(z, -half, half))
    return jnp.where(keep_x, x, 0), jnp.where(keep_y, y, 0), jnp.where(keep_z, up, 0)
