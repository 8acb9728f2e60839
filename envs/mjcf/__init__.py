"""Load a user's own robot from its MJCF file.

    env = envs.make("press", robot="my_arm.xml")
    env = envs.make("press", robot=envs.mjcf.load("my_arm.xml", tcp="pinch", speed=1.5))

The file must describe an arm: up to 16 hinges from its base to a hand with two sliding fingers, and
a position actuator for each hinge and for the fingers. Parts are recognized by type, not by name.
Angles are in degrees unless the file has `<compiler angle="radian"/>`, as always in MJCF.

Joints, masses, gains, meshes, names (prefixed with "robot/") and the pose of the base are kept.
Everything that belongs to a scene is dropped: floor, lights, options, keyframes, sensors, tendons,
equalities. A hinge's limits are the intersection of its range and its actuator's ctrlrange. A
camera "wrist" becomes the wrist camera; an arm without one gets that of the built-in robots.

As on the built-in robots, only the fingers collide, because MJX is slow with meshes. Each finger
gets a small sphere at its tip, and a box around those of its colliding geoms that reach near it;
if a mesh is thicker further up, only its end counts.
"""

import os
from collections.abc import Sequence

import mujoco
import numpy as np

from envs.mjcf import attaching, hands, posing, reading
from envs.robots import Robot
from envs.scene import scene

_SPEED = 2.5  # rad/s; our choice; Panda has 2.175 to 2.61, PiPER 3
_GRIPPER_SPEED = 0.1  # m/s; our choice, the same as for the built-in robots


def load(
    path: str | os.PathLike[str],
    *,
    tcp: str | None = None,
    speed: float | Sequence[float] = _SPEED,
    gripper_speed: float = _GRIPPER_SPEED,
    folder: str | os.PathLike[str] | None = None,
) -> Robot:
    """Load a robot for `envs.make`.

    The arm is placed as in its file; tasks expect its base at the origin, facing along x.

    Args:
        path: the MJCF file.
        tcp: name of a site in the hand, by default "tcp". Its z axis must point out between the
            fingers, which must open along its y axis. Without a site, z is the last joint's axis.
            The robot's tcp is midway between the fingers, `robots.TIP_LENGTH` before their ends.
        speed: speed limits [rad/s], one for all joints or one per joint; MJCF has none.
        gripper_speed: maximum speed of the opening [m/s].
        folder: folder that must contain all referenced files, such as meshes, once links are
            resolved; by default the folder of the file.

    Raises:
        ValueError: a speed is not positive, or the file cannot be read, refers to files outside of
            `folder` or lacks something that tasks need. The message says what is needed.
    """
    try:
        robot = _read(path, tcp, speed, gripper_speed, folder)
        scene.build("", robot)  # report MuJoCo's errors now, not when a task is made
        return posing.complete(robot)
    except ValueError as error:
        raise ValueError(f"robot {path}: {' '.join(str(error).split())}") from None


def _read(
    path: str | os.PathLike[str],
    tcp: str | None,
    speed: float | Sequence[float],
    gripper: float,
    folder: str | os.PathLike[str] | None,
) -> Robot:
    """Read the robot; `posing.complete` will replace its home, lean and tilt side."""
    spec, model = reading.read(path, folder)
    arm = reading.find_arm(model)
    hand = hands.find(model, arm, tcp)
    lower, upper = reading.find_limits(model, arm)
    pull = reading.find_gripper(model, arm, hand.signs)
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    keyframe = model.key_qpos[key, model.jnt_qposadr[arm.joints]] if key >= 0 else None
    return Robot(
        name=str(path),
        chain=hand.chain,
        tool=hand.tool,
        lower=lower,
        upper=upper,
        speed=_positive("speed", speed, len(lower)),
        home=(lower + upper) / 2 if keyframe is None else keyframe,
        lean=0.0,
        tilt_side=1,
        stroke=hand.stroke,
        gripper_speed=float(_positive("gripper_speed", gripper, 1)[0]),
        body=attaching.prepare(spec, model, arm, pull, hand),
    )


def _positive(name: str, value: float | Sequence[float], count: int) -> np.ndarray:
    numbers = np.asarray(value, float)
    if numbers.shape not in ((), (count,)) or not np.all(numbers > 0):
        several = f" or {count} of them" if count > 1 else ""
        raise ValueError(f"{name} must be a positive number{several}, got {value}")
    return np.broadcast_to(numbers, count).copy()
