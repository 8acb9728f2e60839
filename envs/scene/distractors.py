"""Things on the table that have nothing to do with the task."""

import jax
import jax.numpy as jnp

from envs.tasks import Layout

_SIZE = 0.016  # m, half the width of each, and its height above the table
_SHAPES = (  # own choices, in colours that no task uses
    f'type="box" size="{_SIZE} {_SIZE} {_SIZE}" rgba=".15 .55 .30 1"',
    f'type="sphere" size="{_SIZE}" rgba=".95 .75 .15 1"',
    f'type="box" size="{_SIZE / 2} {1.5 * _SIZE} {_SIZE}" rgba=".90 .90 .86 1"',
    f'type="sphere" size="{_SIZE}" rgba=".20 .70 .75 1"',
)
MOST = len(_SHAPES)

_LOW, _HIGH = (0.27, -0.21), (0.45, 0.21)  # m, where the side camera sees the table
_CLEARANCE = 0.10  # m to the middle of everything else, wherever there is room for it
_TRIES = 64


def names(count: int) -> list[str]:
    """Names of the bodies of `count` of them."""
    return [f"distractor{i}" for i in range(count)]


def mjcf(count: int) -> str:
    """MJCF of bodies distractor0, distractor1 ...: fixed, solid for tips and loose objects."""
    return "".join(
        f'<body name="{name}"><geom {shape} conaffinity="3"/></body>'
        for name, shape in zip(names(count), _SHAPES[:count], strict=True)
    )


def place(key: jax.Array, layout: Layout, count: int) -> Layout:
    """Random places for `count` of them, clear of the layout and of one another.

    Each takes the first of some random places that has the clearance, or else the clearest.
    """
    taken = jnp.stack([where[:2] for where in layout.values()])
    found: Layout = {}
    for name, one in zip(names(count), jax.random.split(key, count), strict=True):
        place_key, turn_key = jax.random.split(one)
        spots = jax.random.uniform(
            place_key, (_TRIES, 2), minval=jnp.array(_LOW), maxval=jnp.array(_HIGH)
        )
        gap = jnp.linalg.norm(spots[:, None] - taken, axis=-1).min(axis=1)
        chosen = spots[jnp.argmax(jnp.minimum(gap, _CLEARANCE))]  # argmax: the first of equals
        turn = jax.random.uniform(turn_key, (), maxval=jnp.pi)
        found[name] = jnp.stack([*chosen, jnp.float32(_SIZE), turn])
        taken = jnp.concatenate([taken, chosen[None]])
    return found
