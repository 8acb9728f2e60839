"""Pick the grape and place it in either of two equal baskets, left and right of the arm.

Demonstrations go to one of the two at random, whatever the cameras see, so that their actions have
two modes. The mean of these leads between the baskets.
"""

import jax
import jax.numpy as jnp

from envs.tasks import Layout, Task, View, Waypoints, pick_place, scatter

_GRAPE, _GRAPE_RANGE = (0.36, 0.0), (0.05, 0.03)  # m, center and half range
_SIDE, _RANGE = (0.36, 0.155), (0.03, 0.02)  # m, the left basket; the right one mirrors it
_BASKETS = ("left_basket", "right_basket")


def _place(key: jax.Array) -> Layout:
    keys = jax.random.split(key, 3)
    right = (_SIDE[0], -_SIDE[1])
    baskets = (scatter(k, c, _RANGE) for k, c in zip(keys[1:], (_SIDE, right), strict=True))
    grape = pick_place.grape_at(keys[0], _GRAPE, _GRAPE_RANGE)
    return {"grape": grape, **dict(zip(_BASKETS, baskets, strict=True))}


def _check(view: View) -> tuple[jax.Array, dict[str, jax.Array]]:
    done, metrics = zip(*(pick_place.check(view, name) for name in _BASKETS), strict=True)
    return jnp.any(jnp.array(done)), jax.tree.map(jnp.minimum, *metrics)


def _stages(view: View) -> dict[str, jax.Array]:
    left, right = (pick_place.stages(view, name) for name in _BASKETS)
    is_left = view.apart("grape", _BASKETS[0]) < view.apart("grape", _BASKETS[1])
    return {name: jnp.where(is_left, left[name], right[name]) for name in left}  # in order


def _waypoints(layout: Layout) -> Waypoints:
    # A digit of the grape's position that no picture shows: as good as a coin, from the layout.
    is_left = jnp.floor(layout["grape"][0] * 1e5) % 2 == 0
    basket = jnp.where(is_left, *(layout[name] for name in _BASKETS))
    return pick_place.waypoints({"grape": layout["grape"], "basket": basket})


TASK = Task(
    name="two_baskets",
    scene="".join(map(pick_place.basket_scene, _BASKETS)) + pick_place.GRAPE,
    instructions=(
        "put the grape in a basket",
        "place the grape into a basket",
        "pick up the grape for a basket",
        "drop the grape in a basket",
        "move the grape to a basket",
    ),
    time_limit=12.0,
    expert_time=9.0,
    hold_steps=3,
    place=_place,
    check=_check,
    waypoints=_waypoints,
    stages=_stages,
)
