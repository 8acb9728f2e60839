"""Two PiPERs face each other over a table; the left one hands a stick over to the right one.

As in the tasks' scenes, only fingers collide with objects: the arms pass through each other.
"""

import math
import threading
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.experts import expert
from envs.rendering.model import build
from envs.rendering.renderer import RayRenderer
from envs.robots import BASE, multiply, rotation, turn
from envs.robots.piper import ROBOT
from envs.scene import scene
from envs.state import Poses
from lorasp_jax.extras.piper.fake.world import Limb, World, unlike_training

CAMERAS = {"cam_high": "side", "cam_left_wrist": "wrist", "cam_right_wrist": "right_wrist"}
"""ALOHA's name of each camera -> its name in the scene."""
DISTANCE = 0.80
"""Between the two bases along x [m]; this and what follows are our choices."""
_PREFIXES = {"left": "", "right": "right_"}  # of the parts of each arm
_LENGTH, _THICKNESS = 0.085, 0.012  # m, half of the stick's
_STICK = f"""
<body name="stick">
  <joint name="stick" type="free" damping="1e-5"/>
  <geom name="stick" type="box" size="{_LENGTH} {_THICKNESS} {_THICKNESS}" mass=".01" contype="12"
    condim="4" friction="1 .02 .001" solref=".01 1" rgba=".80 .14 .10 1"/>
</body>
"""
_CENTER, _SPREAD = np.array([0.36, 0.0, 0.0]), np.array([0.03, 0.04, 0.15])  # m, m, rad
_GRIP = 0.05  # m, from the stick's middle to where an arm grasps it
_MEETING, _RAISED = 0.22, 0.26  # m, heights of the hand-over, and above which it is done
_LIFTED = 0.15  # m, height of the stick above which an arm that holds it carries it
_SAG = 0.015  # m, by which the free end of the stick hangs lower
_HOLD_STEPS = 5  # control steps for which the right arm holds it
_EYE, _AXES = (0.4, -0.95, 0.6), (1.0, 0.0, 0.0, 0.0, 0.43, 0.90)  # m; the camera's x and y axes
_OPEN, _CLOSED = 0.06, 0.0  # m
_DURATION = 10.0  # s, of the demonstration
_HAND = np.diag([-1.0, 1.0, -1.0]) @ rotation("y", -ROBOT.lean)[:3, :3]
"""Rotation of a hand that points down, leaning outward, and grasps across a stick along x."""


class HandOverTask(NamedTuple):
    """What the commands need of a task; as in `envs.tasks.Task`."""

    name: str
    instructions: tuple[str, ...]
    time_limit: float


TASK = HandOverTask(
    "hand_over",
    (
        "hand the stick over to the right arm",
        "pass the red stick from left to right",
        "give the stick to the other arm",
        "take the stick and hand it over",
    ),
    time_limit=20.0,
)


class HandOver(World):
    """The scene; attributes are those of `World`, but for `env` and `state`."""

    instructions, control_dt, _hold_steps = TASK.instructions, 0.1, _HOLD_STEPS

    def __init__(self, task: str = TASK.name, *, image_size: int = 64) -> None:  # noqa: ARG002
        """Build the scene; call `reset` before anything else."""
        self.model = _model()
        unlike_training(self.model)
        self.data = mujoco.MjData(self.model)
        self._arms = {name: Limb(self.model, self.data, p) for name, p in _PREFIXES.items()}
        renderer = RayRenderer(build(self.model, [*CAMERAS.values()]), image_size, 1)

        @jax.jit
        def render(poses: Poses) -> dict[str, jax.Array]:
            images = renderer(poses, None, None)
            return {name: images[:, i] for i, name in enumerate(CAMERAS)}

        self._render, self._check = render, lambda _: self._is_done()
        self._lock = threading.Lock()

    @property
    def limbs(self) -> dict[str, Limb]:
        """The arms by name."""
        return self._arms

    @property
    def height(self) -> float:
        """Height of the stick's middle [m]."""
        return float(self.data.joint("stick").qpos[2])

    def demonstration(self, seed: int) -> np.ndarray:  # noqa: ARG002
        """Return the scripted expert's actions [T, 14] from the start of this layout."""
        return np.asarray(_path(*map(jnp.float32, _waypoints(*self._layout))))

    def _reset(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        x, y, yaw = self._layout = _CENTER + random.uniform(-1, 1, 3) * _SPREAD
        mujoco.mj_resetData(self.model, self.data)
        stick = [x, y, _THICKNESS, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
        self.data.joint("stick").qpos[:] = stick
        for prefix, limb in zip(_PREFIXES.values(), self._arms.values(), strict=True):
            for number, angle in enumerate(ROBOT.home):
                self.data.joint(f"{prefix}joint{number + 1}").qpos[:] = angle
            for finger in ("left", "right"):
                self.data.joint(prefix + finger).qpos[:] = ROBOT.stroke / 2
            limb.command(limb.pose)
        mujoco.mj_forward(self.model, self.data)
        self.instruction = self.instructions[seed % len(self.instructions)]
        self.success, self._held, self._carried = False, 0, False

    def holders(self) -> set[str]:
        """Return the arms that carry the stick: between both fingers, above the table."""
        stick, touching = self.model.geom("stick").id, set()
        with self._lock:
            for one, other in self.data.contact.geom:
                if stick in (one, other):
                    geom = other if one == stick else one
                    touching.add(self.model.body(self.model.geom_bodyid[geom]).name)
            lifted = self.height > _LIFTED
        fingers = {name: {f"{p}left", f"{p}right"} for name, p in _PREFIXES.items()}
        return {name for name, both in fingers.items() if lifted and both <= touching}

    def _is_done(self) -> bool:
        """Return whether the right arm alone has raised what the left arm alone has carried."""
        holders = self.holders()
        self._carried |= holders == {"left"}
        return self._carried and holders == {"right"} and self.height > _RAISED


def _model() -> mujoco.MjModel:
    """Compile the scene of one arm, and a second arm that faces it."""
    with scene.as_python_warnings():
        spec, other = (mujoco.MjSpec.from_string(scene.mjcf(x, ROBOT)) for x in (_STICK, ""))
        frame = spec.worldbody.add_frame(pos=[DISTANCE, 0, 0], quat=[0, 0, 0, 1])
        frame.attach_body(other.body(BASE), _PREFIXES["right"], "")
        camera = spec.camera("side")  # now sees both arms
        camera.pos, camera.alt.xyaxes, camera.fovy = _EYE, _AXES, 48.0
        return spec.compile()


def _waypoints(x: float, y: float, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the expert's waypoints for a stick at x, y, yaw.

    Returns:
        [2, P, 5] x, y, z of the tcp [m], yaw [rad] and opening [m] of each arm, in its own base
        frame; and [P] the time from waypoint to waypoint [s].
    """
    on, near = (x - _GRIP * math.cos(yaw), y - _GRIP * math.sin(yaw)), DISTANCE / 2 - _GRIP
    give, take = (near, 0.0, _MEETING, 0.0), (near, 0.0, _MEETING - _SAG, 0.0)
    above, home = (near, 0.0, _MEETING + 0.08, 0.0, _OPEN), (0.34, 0.0, 0.30, 0.0, _OPEN)
    away = (0.30, 0.0, 0.30, 0.0)
    rows = (  # left, right, seconds
        ((*on, 0.12, yaw, _OPEN), home, 1.5),
        ((*on, _THICKNESS, yaw, _OPEN), home, 1.0),
        ((*on, _THICKNESS, yaw, _CLOSED), home, 0.6),
        ((*give, _CLOSED), above, 2.0),
        ((*give, _CLOSED), (*take, _OPEN), 1.0),
        ((*give, _CLOSED), (*take, _CLOSED), 0.6),
        ((*give, _OPEN), (*take, _CLOSED), 0.5),
        (above, (*take, _CLOSED), 0.8),
        ((*away, _OPEN), (*away, _CLOSED), 1.5),
    )
    left, right, seconds = zip(*rows, strict=True)
    return np.array([left, right]), np.array(seconds)


@jax.jit
def _path(arms: jax.Array, seconds: jax.Array) -> jax.Array:
    """Return actions [T, 14] through the waypoints of both arms."""
    start = jnp.append(jnp.array(ROBOT.home, jnp.float32), ROBOT.stroke)

    def knots(rows: jax.Array) -> jax.Array:
        turns = jax.vmap(lambda yaw: turn(jnp.array([0.0, 0.0, 1.0]) * yaw))(rows[:, 3])
        joints = expert.solve(ROBOT, rows[:, :3], multiply(turns, jnp.array(_HAND)), start[:6])
        return jnp.concatenate([start[None], jnp.concatenate([joints, rows[:, 4:]], axis=1)])

    path = jnp.concatenate([knots(rows) for rows in arms], axis=1)
    times = jnp.concatenate([jnp.zeros(1), jnp.cumsum(seconds)])
    steps = HandOver.control_dt * (1 + jnp.arange(round(_DURATION / HandOver.control_dt)))
    return jax.vmap(lambda time: expert.interpolate(path, times, time))(steps)
