"""Pour the block out of the cup into the basket, and set the cup upright again.

All numbers are our choices; both arms solve the task with them.
"""

import math

import jax
import jax.numpy as jnp

from envs.tasks import (
    Layout,
    Task,
    View,
    Waypoints,
    azimuth,
    gate,
    near,
    open_box,
    raised,
    route,
    scatter,
)

_BLOCK = 0.010  # m, radius of the sphere that collides in place of the block
_BOTTOM = 0.014  # m, half the inner width of the cup at its bottom
_FLARE = math.radians(20.0)  # slant of the two walls over which the block can leave
# m, the cup: its height, half the thickness of its walls, radius of its feet
_HEIGHT, _THICK, _FOOT = 0.050, 0.002, 0.004
_SIDE = 0.022  # m from the cup's middle to its upright walls
_WIDTH = 2 * (_SIDE + 0.003)  # m, width of the cup where it is grasped
_CLEAR = 0.060  # m, height of the cup above the table that counts as lifted
_GRIP = 0.033  # m, height at which the cup is grasped
# The hand pivots about a point above the cup's mouth, so that the block falls straight down there.
_REACH = _HEIGHT - _GRIP + 0.03  # m from the grip
_CUP, _CUP_RANGE = (0.33, -0.09), (0.03, 0.05)  # m, center and half range
_INSIDE, _WALL, _BASKET_HEIGHT = 0.050, 0.003, 0.045  # m, basket; named as in pick_place
_BASKET, _BASKET_RANGE = (0.37, 0.12), (0.03, 0.03)  # m

_BLUE, _BASKET_GEOM = 'rgba=".16 .38 .72 1"', 'conaffinity="1" rgba=".85 .65 .30 1"'
_RISE = (_HEIGHT - 2 * _FOOT) / 2  # m, half the height of the walls
_CENTER = 2 * _FOOT + _RISE
_OUT = _BOTTOM + _THICK + math.tan(_FLARE) * _RISE
_TOP = _BOTTOM + math.tan(_FLARE) * 2 * _RISE


def _cup() -> str:
    feet = "".join(
        f'<geom type="sphere" contype="8" size="{_FOOT}" pos="{x} {y} {_FOOT}" mass=".002" '
        f"{_BLUE}/>"
        for x in (-_BOTTOM, _BOTTOM)
        for y in (-_BOTTOM, _BOTTOM)
    )
    wall = f'type="box" conaffinity="1" mass=".005" {_BLUE}'
    flared = "".join(
        f'<geom {wall} size="{_THICK} {_SIDE} {_RISE / math.cos(_FLARE)}" '
        f'pos="{sign * _OUT} 0 {_CENTER}" euler="0 {sign * _FLARE} 0"/>'
        for sign in (-1, 1)
    )
    sides = "".join(
        f'<geom {wall} size="{_TOP} {_THICK} {_RISE}" pos="0 {sign * _SIDE} {_CENTER}" contype="4" '
        'condim="4" friction="1 .02 .001" solref=".01 1"/>'
        for sign in (-1, 1)
    )
    floor = f'<geom {wall} size="{_BOTTOM} {_SIDE} .002" pos="0 0 {2 * _FOOT - 0.002}"/>'
    return feet + flared + sides + floor


_SCENE = f"""
<body name="basket">
  {open_box(_INSIDE, _WALL, _BASKET_HEIGHT, floor=_BASKET_GEOM, walls=_BASKET_GEOM)}
</body>
<body name="cup"><joint name="cup" type="free" damping="1e-4"/>{_cup()}</body>
<body name="block">
  <joint name="block" type="free" damping="1e-5"/>
  <geom type="sphere" class="collider" size="{_BLOCK}" mass=".01" contype="1" condim="4"
    friction="1 .02 .001" solref=".01 1"/>
  <geom type="box" size=".0085 .0085 .0085" mass="0" rgba=".80 .14 .10 1"/>
</body>
"""


def _place(key: jax.Array) -> Layout:
    cup_key, basket_key = jax.random.split(key)
    cup = scatter(cup_key, _CUP, _CUP_RANGE)
    cup = cup.at[3].set(azimuth(cup))  # its upright walls face the fingers
    return {
        "cup": cup,
        "block": raised(cup, 2 * _FOOT + _BLOCK),
        "basket": scatter(basket_key, _BASKET, _BASKET_RANGE),
    }


def _check(view: View) -> tuple[jax.Array, dict[str, jax.Array]]:
    cup = view.position("cup")
    inside = view.inside("block", "basket", _INSIDE, _BASKET_HEIGHT)
    standing = (view.upright("cup") > 0.97) & (cup[2] < 0.01)
    at_rest = (view.speed("block") < 0.05) & (view.speed("cup") < 0.05)
    released = view.released(view.above("cup", _GRIP), _WIDTH, away=0.08)
    done = inside & standing & at_rest & released
    return done, {"block_to_basket": view.apart("block", "basket")}


def _stages(view: View) -> dict[str, jax.Array]:
    grip, cup = view.on("cup", _GRIP), view.position("cup")
    grasped = view.grasping(grip, _WIDTH)
    mouth = view.on("cup", _GRIP + _REACH)
    loaded = jnp.linalg.norm(view.position("block") - view.on("cup", _CENTER)) < _HEIGHT
    carried = gate(
        loaded, near(jnp.linalg.norm(mouth[:2] - view.position("basket")[:2]), within=0.04)
    )
    over = jnp.maximum(carried, near(view.apart("block", "basket"), within=0.04))
    inside = view.inside("block", "basket", _INSIDE, _BASKET_HEIGHT)
    tilted = jnp.clip((1 - view.upright("cup")) / 2, 0.0, 0.9)
    level = jnp.clip(view.upright("cup") / 0.9, 0.0, 1.0)  # the cup may lean while grasped
    standing = gate(inside, level * near(cup[2], within=0.009))
    return {
        "reach": view.reaching(grip),
        "grasp": grasped,
        "lift": gate(grasped >= 1, jnp.clip(cup[2] / _CLEAR, 0.0, 1.0)),
        "carry": over,
        "pour": jnp.where(inside, 1.0, gate(over >= 1, tilted)),
        "put_back": standing,
        "release": gate(standing >= 1, view.releasing(grip, _WIDTH, away=0.08)),
    }


def _waypoints(layout: Layout) -> Waypoints:
    cup, basket = (raised(layout[name], _GRIP + _REACH) for name in ("cup", "basket"))
    wide, closed = 0.066, 0.030  # m
    # Some arms cannot point straight down high above the table: tilt the hand while carrying.
    carry, level = math.radians(25.0), math.radians(94.0)
    return route(
        (cup, (0.0, 0.0, 0.070), wide, 1.5, 0.003),
        (cup, (0.0, 0.0, 0.000), wide, 1.0, 0.0),
        (cup, (0.0, 0.0, 0.000), closed, 0.7, 0.0),
        (cup, (0.0, 0.0, 0.025), closed, 0.5, 0.0),
        (cup, (0.0, 0.0, 0.080), closed, 0.7, 0.006),
        (basket, (0.0, 0.0, 0.125), closed, 1.3, 0.006),
        (basket, (0.0, 0.0, 0.125), closed, 1.0, 0.0),
        (basket, (0.0, 0.0, 0.125), closed, 0.9, 0.0),
        (basket, (0.0, 0.0, 0.125), closed, 1.0, 0.0),
        (cup, (0.0, 0.0, 0.080), closed, 1.3, 0.006),
        (cup, (0.0, 0.0, 0.001), closed, 1.0, 0.0),
        (cup, (0.0, 0.0, 0.001), wide, 0.6, 0.0),
        (cup, (0.0, 0.0, 0.080), wide, 0.8, 0.006),
        lean=0.0,
        reach=_REACH,
        tilt=(carry, 0, 0, 0, carry, carry, level, level, carry, carry, 0, 0, carry),
    )


TASK = Task(
    name="pour",
    scene=_SCENE,
    instructions=(
        "pour the block into the basket",
        "tip the block into the basket",
        "empty the cup into the basket",
        "pour the cup over the basket",
        "tilt the cup above the basket",
    ),
    time_limit=20.0,
    expert_time=17.0,
    hold_steps=3,
    place=_place,
    check=_check,
    waypoints=_waypoints,
    stages=_stages,
)
