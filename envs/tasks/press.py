"""Press the red button down past 75 % of its stroke, with the fingers.

All numbers are our choices; both arms solve the task with them.
"""

import jax
import jax.numpy as jnp

from envs.robots import TIP_LENGTH
from envs.tasks import Layout, Task, View, Waypoints, gate, near, raised, route, scatter

_STROKE = 0.012  # m
_TOP = 0.040  # m, height of the cap at rest
_RADIUS = 0.024  # m, radius of the cap
_DEEP = 0.75 * _STROKE  # m, depth that counts as pressed
_CENTER, _RANGE = (0.36, 0.0), (0.04, 0.04)  # m, center and half range of the position

# The spring of 150 N/m resists with 1.8 N at full stroke.
_SCENE = f"""
<body name="button">
  <geom type="cylinder" size=".040 .012" pos="0 0 .012" rgba=".20 .22 .26 1"/>
  <body name="cap" gravcomp="1">
    <joint name="button" type="slide" axis="0 0 -1" range="0 {_STROKE}" stiffness="150"
      damping="2" armature=".01"/>
    <geom type="cylinder" size="{_RADIUS} .010" pos="0 0 {_TOP - 0.010}" mass=".02"
      rgba=".90 .10 .08 1"/>
    <geom class="collider" type="box" size=".02 .02 .010" pos="0 0 {_TOP - 0.010}"
      conaffinity="2"/>
  </body>
</body>
"""


def _place(key: jax.Array) -> Layout:
    return {"button": scatter(key, _CENTER, _RANGE)}


def _check(view: View) -> tuple[jax.Array, dict[str, jax.Array]]:
    depth = view.joint("button")
    return (depth > _DEEP) & _touching(view), {"button_depth": depth}


def _stages(view: View) -> dict[str, jax.Array]:
    depth = jnp.clip(view.joint("button") / _DEEP, 0.0, 1.0)
    return {
        "reach": near(jnp.linalg.norm(_offset(view)), within=0.01),
        "press": gate(_touching(view), depth),
    }


def _offset(view: View) -> jax.Array:
    """Return the vector [3] from the current top of the cap to the finger tips [m]."""
    down = view.joint("button") * jnp.array([0.0, 0.0, 1.0])
    return view.tip - view.above("button", _TOP) + down


def _touching(view: View) -> jax.Array:
    offset = _offset(view)
    return (jnp.linalg.norm(offset[:2]) < _RADIUS * view.size) & (jnp.abs(offset[2]) < 0.01)


def _waypoints(layout: Layout) -> Waypoints:
    top = raised(layout["button"], _TOP + TIP_LENGTH)
    return route(
        (top, (0.0, 0.0, 0.060), 0.0, 1.8, 0.008),
        (top, (0.0, 0.0, 0.012), 0.0, 0.9, 0.0),
        (top, (0.0, 0.0, -0.020), 0.0, 0.7, 0.0),
        (top, (0.0, 0.0, -0.020), 0.0, 0.6, 0.0),
    )


TASK = Task(
    name="press",
    scene=_SCENE,
    instructions=(
        "press the red button",
        "push the button down",
        "push down the red button",
        "hit the red button",
        "press the button on the table",
    ),
    time_limit=8.0,
    expert_time=5.0,
    hold_steps=1,
    place=_place,
    check=_check,
    waypoints=_waypoints,
    stages=_stages,
)
