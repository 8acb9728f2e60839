"""A user's own robot, from its MJCF file.

    env = envs.make("press", robot="my_arm.xml")
    env = envs.make("press", robot=envs.mjcf.load("my_arm.xml", tcp="pinch", speed=1.5))

The file describes an arm: up to 16 hinges from its base to a hand with two sliding fingers, which
are found by what they are, not by name, and a position actuator for each hinge and for the fingers.
Joints, masses, gains, meshes, names (after "robot/") and the pose of the base are kept; a hinge's
limits are both its range and its actuator's ctrlrange. What a scene has of its own is not kept:
floor, lights, options, keyframes, sensors, tendons, equalities. A camera "wrist" is the wrist
camera; an arm without one gets that of the robots of this package. Of the arm only the fingers
touch things, each with a box around the ends of its colliding geoms and a small sphere at the tip,
like the robots of this package: MJX is slow with meshes.
"""

import os
from collections.abc import Sequence

import mujoco
import numpy as np

from envs.mjcf import attaching, hands, posing, reading
from envs.robots import Robot
from envs.scene import scene

# Own choices: the speed lies between those of Panda (2.175 to 2.61) and PiPER (3).
_SPEED, _GRIPPER_SPEED = 2.5, 0.1


def load(
    path: str | os.PathLike[str],
    *,
    tcp: str | None = None,
    speed: float | Sequence[float] = _SPEED,
    gripper_speed: float = _GRIPPER_SPEED,
    folder: str | os.PathLike[str] | None = None,
) -> Robot:
    """A robot for `envs.make`.

    The arm stands where its file puts it; the tasks want its base at the origin and x in front.

    Args:
        path: the MJCF file.
        tcp: name of a site whose axes are the hand's: z out of the hand between the fingers, y
            along which they open. None: the site "tcp" if there is one, else the last joint's axis
            is the hand's. The tasks' own tcp is put on that z axis, `robots.TIP_LENGTH` before the
            fingers end.
        speed: joint speed limit, one for all or one each [rad/s]; MJCF has none.
        gripper_speed: largest change of the opening [m/s].
        folder: where all files must lie that the file names, such as meshes, links followed. None:
            the folder of the file.

    Raises:
        ValueError: if the file cannot be read, names files elsewhere, or lacks something that the
            tasks need: the message says what, and what there is instead.
    """
    try:
        robot = _found(path, tcp, speed, gripper_speed, folder)
        scene.build("", robot)  # what MuJoCo refuses is said here, not when a task is made
        return posing.posed(robot)
    except ValueError as error:
        raise ValueError(f"robot {path}: {' '.join(str(error).split())}") from None


def _found(
    path: str | os.PathLike[str],
    tcp: str | None,
    speed: float | Sequence[float],
    gripper: float,
    folder: str | os.PathLike[str] | None,
) -> Robot:
    """What the file says of a robot; its home is a guess, its lean and tilt side are unknown."""
    spec, model = reading.read(path, folder)
    arm = reading.find_arm(model)
    hand = hands.find(model, arm, tcp)
    lower, upper = reading.find_limits(model, arm)
    pull = reading.find_gripper(model, arm, hand.signs)
    return Robot(
        name=str(path),
        chain=hand.chain,
        tool=hand.tool,
        lower=lower,
        upper=upper,
        speed=_positive("speed", speed, len(lower)),
        home=_guess(model, arm, (lower + upper) / 2),
        lean=0.0,
        tilt_side=1,
        stroke=hand.stroke,
        gripper_speed=float(_positive("gripper_speed", gripper, 1)[0]),
        body=attaching.prepare(spec, model, arm, pull, hand),
    )


def _positive(name: str, given: float | Sequence[float], count: int) -> np.ndarray:
    numbers = np.asarray(given, float)
    if numbers.shape not in ((), (count,)) or not np.all(numbers > 0):
        raise ValueError(f"{name} must be positive, one number or {count}, got {given}")
    return np.broadcast_to(numbers, count).copy()


def _guess(model: mujoco.MjModel, arm: reading.Arm, middle: np.ndarray) -> np.ndarray:
    """Joint angles [J] near which to look for the start pose: the keyframe "home" or mid-range."""
    for i in range(model.nkey):
        if model.key(i).name == "home":
            return model.key_qpos[i, model.jnt_qposadr[arm.joints]]
    return middle
