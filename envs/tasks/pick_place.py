"""Pick the grape and place it in the basket: at rest inside, and released.

All numbers are our choices; both arms solve the task with them.
"""

import jax
import jax.numpy as jnp

from envs.tasks import Layout, Task, View, Waypoints, gate, near, open_box, raised, route, scatter

_RADIUS = 0.015  # m, a large table grape (12 g)
_INSIDE = 0.046  # m, half the inner width of the basket
_WALL = 0.003  # m, half the thickness of its walls
_HEIGHT = 0.045  # m, height of its walls
_CLEAR = 0.080  # m, height of the grape above the table that clears the basket's walls
_GRAPE, _GRAPE_RANGE = (0.36, -0.08), (0.06, 0.10)  # m, center and half range
_BASKET, _BASKET_RANGE = (0.36, 0.155), (0.035, 0.035)  # m

_BASKET_GEOM = 'conaffinity="3" rgba=".85 .65 .30 1"'
# The free joint's damping stops a rolling grape. For mass m and radius r, the time constant is
# 1.4 m r² / damping = 0.38 s.
GRAPE = f"""
<body name="grape">
  <joint name="grape" type="free" damping="1e-5"/>
  <geom type="sphere" size="{_RADIUS}" mass=".012" contype="1" condim="4" friction="1 .02 .001"
    solref=".01 1" rgba=".45 .10 .60 1"/>
</body>
"""


def basket_scene(name: str) -> str:
    """Return the MJCF of a basket."""
    box = open_box(_INSIDE, _WALL, _HEIGHT, floor=_BASKET_GEOM, walls=_BASKET_GEOM)
    return f'<body name="{name}">\n  {box}\n</body>'


def grape_at(key: jax.Array, center: tuple[float, ...], spread: tuple[float, ...]) -> jax.Array:
    """Sample a pose of the grape, with the arguments of `scatter`."""
    return raised(scatter(key, center, spread), _RADIUS)


def _place(key: jax.Array) -> Layout:
    grape_key, basket_key = jax.random.split(key)
    return {
        "grape": grape_at(grape_key, _GRAPE, _GRAPE_RANGE),
        "basket": scatter(basket_key, _BASKET, _BASKET_RANGE),
    }


def check(view: View, basket: str = "basket") -> tuple[jax.Array, dict[str, jax.Array]]:
    """Check whether the grape lies in a basket."""
    inside = view.inside("grape", basket, _INSIDE, _HEIGHT)
    at_rest = view.speed("grape") < 0.05
    released = view.released(view.position("grape"), 2 * _RADIUS)
    return inside & at_rest & released, {"grape_to_basket": view.apart("grape", basket)}


def stages(view: View, basket: str = "basket") -> dict[str, jax.Array]:
    """Return the progress towards a basket."""
    grape = view.position("grape")
    height = grape[2] - _RADIUS * view.size
    grasped = view.grasping(grape, 2 * _RADIUS)
    over = near(view.apart("grape", basket), within=0.03)
    low = gate(over >= 1, near(height, within=_HEIGHT, scale=0.05))
    return {
        "reach": view.reaching(grape),
        "grasp": grasped,
        "lift": gate(grasped >= 1, jnp.clip(height / _CLEAR, 0.0, 1.0)),
        "carry": over,
        "lower": low,
        "release": gate(low >= 1, view.releasing(grape, 2 * _RADIUS)),
    }


def waypoints(layout: Layout) -> Waypoints:
    """Return a way from the "grape" of the layout to its "basket"."""
    grape, basket = layout["grape"], layout["basket"]
    wide, closed = 0.052, 0.008  # m
    return route(
        (grape, (0.0, 0.0, 0.080), wide, 1.5, 0.008),
        (grape, (0.0, 0.0, 0.001), wide, 1.0, 0.0),
        (grape, (0.0, 0.0, 0.001), closed, 0.7, 0.0),
        (grape, (0.0, 0.0, 0.100), closed, 0.9, 0.006),
        (basket, (0.0, 0.0, 0.115), closed, 1.3, 0.006),
        (basket, (0.0, 0.0, 0.055), closed, 0.7, 0.0),
        (basket, (0.0, 0.0, 0.055), wide, 0.6, 0.0),
        (basket, (0.0, 0.0, 0.130), wide, 0.8, 0.006),
    )


TASK = Task(
    name="pick_place",
    scene=basket_scene("basket") + GRAPE,
    instructions=(
        "put the grape in the basket",
        "place the grape into the basket",
        "pick up the grape for the basket",
        "drop the grape in the basket",
        "move the grape to the basket",
    ),
    time_limit=12.0,
    expert_time=9.0,
    hold_steps=3,
    place=_place,
    check=check,
    waypoints=waypoints,
    stages=stages,
)
