"""Open the pot: grasp the lid by its knob, lift it off, put it down beside the pot.

All numbers are our choices; both arms solve the task with them.
"""

import jax
import jax.numpy as jnp

from envs.tasks import Layout, Task, View, Waypoints, gate, near, open_box, raised, route, scatter

# m, the pot: half its inner width, half the thickness of its walls, its height
_INSIDE, _WALL, _HEIGHT = 0.043, 0.005, 0.055
_FOOT = 0.005  # m, radius of the lid's feet, which stand on the middle of the walls
_KNOB, _KNOB_HEIGHT = 0.010, 0.030  # m, radius of the knob, height of its center above the feet
_LID = 0.055  # m, radius of the lid
_POT, _POT_RANGE = (0.36, 0.10), (0.04, 0.04)  # m, center and half range of the position
_BESIDE = 0.175  # m, how far to the right of the pot the expert puts the lid

_STEEL, _RED = 'rgba=".55 .57 .60 1"', 'rgba=".62 .20 .16 1"'
_RIM = _INSIDE + _WALL
_BARELY_BESIDE = _LID + _RIM + _WALL  # m, distance at which pot and lid just clear each other
_CLEAR = 0.020  # m, height of the lid above the pot that counts as lifted off
_FEET = "".join(
    f'<geom type="sphere" size="{_FOOT}" pos="{x} {y} {_FOOT}" contype="8" condim="4" mass=".005" '
    f'friction="1 .02 .001" solref=".01 1" {_STEEL}/>'
    for x, y in ((_RIM, 0), (-_RIM, 0), (0, _RIM), (0, -_RIM))
)
# With four spheres as feet, the lid's residual velocity is a hundredth of that with a flat face.
_SCENE = f"""
<body name="pot">
  {open_box(_INSIDE, _WALL, _HEIGHT, floor=_RED, walls=f'conaffinity="10" {_RED}')}
</body>
<body name="lid">
  <joint name="lid" type="free" damping="1e-4"/>
  {_FEET}
  <geom type="cylinder" size="{_LID} .003" pos="0 0 .011" mass=".03" {_STEEL}/>
  <geom type="cylinder" size=".005 .006" pos="0 0 .018" mass=".002" {_STEEL}/>
  <geom type="sphere" size="{_KNOB}" pos="0 0 {_KNOB_HEIGHT}" mass=".008" contype="4" condim="4"
    friction="1 .02 .001" solref=".01 1" rgba=".12 .12 .13 1"/>
</body>
"""


def _place(key: jax.Array) -> Layout:
    pot = scatter(key, _POT, _POT_RANGE)
    return {"pot": pot, "lid": raised(pot, _HEIGHT)}


def _check(view: View) -> tuple[jax.Array, dict[str, jax.Array]]:
    lid = view.position("lid")
    apart = view.apart("lid", "pot")
    on_table = (lid[2] < 0.01) & (view.upright("lid") > 0.97)
    beside = apart > _BARELY_BESIDE * view.size
    at_rest = view.speed("lid") < 0.05
    released = view.released(view.above("lid", _KNOB_HEIGHT), 2 * _KNOB)
    return on_table & beside & at_rest & released, {"lid_to_pot": apart}


def _stages(view: View) -> dict[str, jax.Array]:
    knob, lid = view.on("lid", _KNOB_HEIGHT), view.position("lid")
    grasped = view.grasping(knob, 2 * _KNOB)
    lifted = (lid[2] - _HEIGHT * view.size) / _CLEAR
    level = view.upright("lid") > 0.97
    missing = (_BARELY_BESIDE + 0.005) * view.size - view.apart("lid", "pot")
    beside = gate(level, near(missing))
    down = gate(beside >= 1, near(lid[2], within=0.008))
    return {
        "reach": view.reaching(knob),
        "grasp": grasped,
        "lift": gate(grasped >= 1, jnp.clip(lifted, 0.0, 1.0)),
        "carry": beside,
        "lower": down,
        "release": gate(down >= 1, view.releasing(knob, 2 * _KNOB)),
    }


def _waypoints(layout: Layout) -> Waypoints:
    knob = raised(layout["lid"], _KNOB_HEIGHT + 0.003)[:3]
    down = knob - jnp.array([0.0, _BESIDE, _HEIGHT - 0.002])
    wide, closed = 0.050, 0.0  # m
    return route(
        (knob, (0.0, 0.0, 0.070), wide, 1.5, 0.008),
        (knob, (0.0, 0.0, 0.000), wide, 1.0, 0.0),
        (knob, (0.0, 0.0, 0.000), closed, 0.7, 0.0),
        (knob, (0.0, 0.0, 0.070), closed, 0.9, 0.006),
        (down, (0.0, 0.0, 0.090), closed, 1.3, 0.006),
        (down, (0.0, 0.0, 0.000), closed, 1.0, 0.0),
        (down, (0.0, 0.0, 0.000), wide, 0.6, 0.0),
        (down, (0.0, 0.0, 0.080), wide, 0.8, 0.006),
    )


TASK = Task(
    name="open_pot",
    scene=_SCENE,
    instructions=(
        "open the pot",
        "take the lid off the pot",
        "lift the lid and put it down",
        "remove the lid from the pot",
        "uncover the pot",
    ),
    time_limit=13.0,
    expert_time=10.0,
    hold_steps=3,
    place=_place,
    check=_check,
    waypoints=_waypoints,
    stages=_stages,
)
