"""MuJoCo scene of a task: table, cameras and light, shared by all robots and tasks."""

import contextlib
import warnings
from collections.abc import Iterator

import mujoco
import numpy as np

from envs import robots
from envs.rendering.model import AMBIENT, CONTRAST, DIFFUSE, HEADLIGHT, SKY, SQUARE
from envs.robots import Robot

CAMERAS = ("side", "wrist")
PHYSICS_DT = 0.005  # s, our choice: half of solref (.01 s), the largest stable step

# Solver settings are our choices from grasping experiments. With fewer than 2 iterations nothing is
# grasped, and elliptic cones take six times as long. Only spheres, boxes and the table collide.
_SCENE = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{timestep}" integrator="implicitfast" solver="Newton" iterations="4"
    ls_iterations="8" cone="pyramidal"><flag eulerdamp="disable"/></option>
  <default>
    <geom contype="0" conaffinity="0" condim="3"/>
    <default class="collider"><geom group="3" rgba="0 0 0 0"/></default>
    <default class="tip">
      <geom type="sphere" mass="0" group="3" rgba="0 0 0 0" contype="2" condim="1" priority="1"/>
    </default>
    <default class="pad">
      <geom type="box" conaffinity="5" condim="4" friction="1.5 .02 .001" solref=".01 1"
        solimp=".95 .99 .001"/>
    </default>
    <default class="finger">
      <joint type="slide" axis="0 1 0" armature=".05" damping="5"/>
    </default>
  </default>
  {visuals}
  <worldbody>
    <light directional="true" pos=".6 -.5 1.2" dir="-.5 .2 -1" ambient="0 0 0" specular="0 0 0"
      diffuse="{diffuse} {diffuse} {diffuse}"/>
    <light name="lamp" type="point" active="false" castshadow="false" ambient="0 0 0"
      specular="0 0 0" diffuse="{headlight} {headlight} {headlight}"/>
    <camera name="side" {side} fovy="32"/>
    <geom name="table" type="plane" size="{size} {size} .1" conaffinity="11" material="table"
      rgba="{table}"/>
    {robot}{task}
  </worldbody>
  <actuator>{actuators}</actuator>
  <equality>
    <joint joint1="right" joint2="left" polycoef="0 1 0 0 0" solref=".01 1"/>
  </equality>
</mujoco>
"""
# Make the images of MuJoCo's own renderers resemble the ray caster's. MuJoCo's headlight shines
# along the camera's axis, the ray caster's shines from the camera's position. A renderer that can
# move lights puts the lamp at the camera and turns the headlight off.
_VISUALS = """
  <visual>
    <headlight ambient="{ambient} {ambient} {ambient}" specular="0 0 0"
      diffuse="{headlight} {headlight} {headlight}"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="{up}" rgb2="{horizon}" width="64"
      height="384"/>
    <texture name="squares" type="2d" builtin="checker" rgb1="{dark} {dark} {dark}" rgb2="1 1 1"
      width="64" height="64"/>
    <material name="table" texture="squares" texrepeat="{repeat} {repeat}" specular="0"
      rgba="{table}"/>
  </asset>
"""
_TABLE, _TABLE_SIZE = ".62 .66 .68 1", 2.0  # color; half the edge [m]
_SIDE_EYE, _SIDE_TARGET = (0.76, -0.49, 0.42), (0.34, 0.0, 0.065)  # m; our choices


def build(objects: str, robot: Robot) -> mujoco.MjModel:
    """Compile a model of a task's objects on a table (z = 0) and a robot, base at the origin."""
    with as_python_warnings():
        spec = mujoco.MjSpec.from_string(mjcf(objects, robot))
        robot.body.attach(robot, spec)
        return spec.compile()


@contextlib.contextmanager
def as_python_warnings() -> Iterator[None]:
    """Turn MuJoCo's warnings, which it would write to a log file, into Python warnings."""
    before, messages = mujoco.get_mju_user_warning(), []
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
    for text in messages:
        warnings.warn(f"MuJoCo: {' '.join(text.split())}", stacklevel=3)


def mjcf(objects: str, robot: Robot) -> str:
    """Return the scene's MJCF, except for elements that only `Robot.body.attach` can add."""
    bodies, actuators = robot.body.mjcf(robot)
    return _SCENE.format(
        timestep=PHYSICS_DT,
        side=robots.pose(_look_at(np.array(_SIDE_EYE), np.array(_SIDE_TARGET))),
        robot=bodies,
        task=objects,
        actuators=actuators,
        visuals=_visuals(),
        headlight=HEADLIGHT,
        diffuse=DIFFUSE,
        table=_TABLE,
        size=_TABLE_SIZE,
    )


def _visuals() -> str:
    horizon, up = (" ".join(map(str, color)) for color in SKY)
    return _VISUALS.format(
        ambient=AMBIENT,
        headlight=HEADLIGHT,
        horizon=horizon,
        up=up,
        dark=1 - CONTRAST,
        repeat=_TABLE_SIZE / SQUARE,  # the texture is two squares wide
        table=_TABLE,
    )


def _look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the [4, 4] pose of a camera at `eye` that looks at `target` along -z, y up."""
    z = (eye - target) / np.linalg.norm(eye - target)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    camera = robots.translation(*eye)
    camera[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return camera
