"""Distractors: objects on the table that the task does not use. All numbers are our choices."""

import jax
import jax.numpy as jnp

from envs.tasks import Layout

_SIZE = 0.016  # m, half the typical width of an object, and the height of its center
_SHAPES = (  # in colors that no task uses
    f'type="box" size="{_SIZE} {_SIZE} {_SIZE}" rgba=".15 .55 .30 1"',
    f'type="sphere" size="{_SIZE}" rgba=".95 .75 .15 1"',
    f'type="box" size="{_SIZE / 2} {1.5 * _SIZE} {_SIZE}" rgba=".90 .90 .86 1"',
    f'type="sphere" size="{_SIZE}" rgba=".20 .70 .75 1"',
)
MAX_COUNT = len(_SHAPES)

_LOW, _HIGH = (0.27, -0.21), (0.45, 0.21)  # m, part of the table that the side camera sees
_CLEARANCE = 0.10  # m between centers, where possible
_TRIES = 64  # random positions per distractor


def names(count: int) -> list[str]:
    """Return the body names of `count` distractors."""
    return [f"distractor{i}" for i in range(count)]


def mjcf(count: int) -> str:
    """Return MJCF of `count` fixed bodies, which collide with finger tips and loose objects."""
    return "".join(
        f'<body name="{name}"><geom {shape} conaffinity="3"/></body>'
        for name, shape in zip(names(count), _SHAPES[:count], strict=True)
    )


def place(key: jax.Array, layout: Layout, count: int) -> Layout:
    """Sample poses of `count` distractors, clear of the layout and of one another.

    Each distractor takes the first of `_TRIES` random positions that is clear enough, or else the
    clearest.
    """
    occupied = jnp.stack([pose[:2] for pose in layout.values()])
    placed: Layout = {}
    for name, own_key in zip(names(count), jax.random.split(key, count), strict=True):
        position_key, yaw_key = jax.random.split(own_key)
        candidates = jax.random.uniform(
            position_key, (_TRIES, 2), minval=jnp.array(_LOW), maxval=jnp.array(_HIGH)
        )
        gap = jnp.linalg.norm(candidates[:, None] - occupied, axis=-1).min(axis=1)
        best = candidates[jnp.argmax(jnp.minimum(gap, _CLEARANCE))]  # the first maximum
        yaw = jax.random.uniform(yaw_key, (), maxval=jnp.pi)
        placed[name] = jnp.stack([*best, jnp.float32(_SIZE), yaw])
        occupied = jnp.concatenate([occupied, best[None]])
    return placed
