"""Finding an arm, its hand and its actuators in a MuJoCo model, and saying what is missing."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from envs.mjcf import sources
from envs.scene import scene

_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_KINDS = ("free", "ball", "slide", "hinge")
_MOST_JOINTS = 16  # of an arm; whoever simulates one compiles each
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


class Arm(NamedTuple):
    """Numbers in the user's model."""

    root: int  # the base's body
    joints: list[int]  # hinges from the base to the hand
    fingers: list[int]  # the two fingers' slides
    servos: list[int]  # actuators of the hinges
    gears: list[float]  # how fast their lengths grow with the hinges


class Gripper(NamedTuple):
    """What pulls both fingers together, as a position servo of half the opening."""

    stiffness: float  # N/m
    damping: float  # N s/m
    force: float  # N, infinite where there is no limit


def read(
    path: str | os.PathLike[str], folder: str | os.PathLike[str] | None = None
) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """An MJCF file, also compiled.

    Args:
        path: the file.
        folder: where all files must lie that it names; None: where the file is.

    Raises:
        ValueError: if there is none, MuJoCo does not take it, or it names files elsewhere.
    """
    path = Path(path).absolute()
    if not os.path.isfile(path):  # Path.is_file raises where a name is too long
        raise ValueError("there is no such file")
    try:
        sources.check(path, Path(folder or path.parent))
    except (SyntaxError, RecursionError, OSError) as error:  # the first: of XML
        raise ValueError(f"MuJoCo cannot read it: {error}") from error
    try:
        with scene.warnings_of_python():
            spec = mujoco.MjSpec.from_file(str(path))
            spec.memory = -1  # as MuJoCo likes: nothing of the file itself is ever simulated
            # Bodies and geoms keep their numbers.
            spec.compiler.fusestatic = spec.compiler.discardvisual = False
            return spec, spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read it: {error}") from error


def find_arm(model: mujoco.MjModel) -> Arm:
    """The joints and their servos, each where the tasks need it.

    Raises:
        ValueError: if one is missing or too many.
    """
    fingers = np.flatnonzero(model.jnt_type == _SLIDE).tolist()
    if len(fingers) != 2:
        raise ValueError(f"two slide joints are needed for the fingers; {_joints(model)}")
    hand, other = model.body_parentid[model.jnt_bodyid[fingers]]
    if hand != other:
        names = f"{model.body(hand).name} and {model.body(other).name}"
        raise ValueError(f"both fingers must be on the same body; they are on {names}")
    root, joints = int(hand), []
    while root:
        first = model.body_jntadr[root]
        joints = [*range(first, first + model.body_jntnum[root]), *joints]
        base, root = root, int(model.body_parentid[root])
    if not joints or any(model.jnt_type[joints] != _HINGE):
        raise ValueError(f"hinges alone must lead from the base to the hand; {_joints(model)}")
    if len(joints) > _MOST_JOINTS:
        raise ValueError(f"the arm has {len(joints)} hinges; at most are {_MOST_JOINTS}")
    own = np.flatnonzero(model.body_rootid[model.jnt_bodyid] == base)
    if others := set(own.tolist()) - {*joints, *fingers}:
        raise ValueError(f"{_names(model, others)}: neither part of the arm nor one of its fingers")
    if free := [joint for joint in (*joints, *fingers) if not model.jnt_limited[joint]]:
        raise ValueError(f"every joint needs a range; {_names(model, free)} have none")
    servos, gears = zip(*(_servo(model, joint) for joint in joints), strict=True)
    return Arm(base, joints, fingers, list(servos), list(gears))


def find_limits(model: mujoco.MjModel, arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest angles [J] that the hinges have and their servos can be told [rad].

    Raises:
        ValueError: if there are none.
    """
    lower, upper = model.jnt_range[arm.joints].T
    told = np.where(
        model.actuator_ctrllimited[arm.servos, None],
        model.actuator_ctrlrange[arm.servos],
        (-np.inf, np.inf),
    )
    lower, upper = np.maximum(lower, told[:, 0]), np.minimum(upper, told[:, 1])
    if none := [joint for joint, room in zip(arm.joints, upper - lower, strict=True) if room <= 0]:
        raise ValueError(
            f"{_names(model, none)}: range and the actuator's ctrlrange do not overlap"
        )
    return lower, upper


def find_gripper(model: mujoco.MjModel, arm: Arm, signs: np.ndarray) -> Gripper:
    """The fingers' actuators taken together; they may act on one finger, on both or on a tendon.

    Args:
        model: the user's model.
        arm: from `find_arm`.
        signs: [2] 1 for a finger joint that opens the hand as it grows, else -1.

    Raises:
        ValueError: if there is none, or it is not a position actuator.
    """
    rates = np.zeros(model.nu)  # of each actuator's length, as half the opening grows
    for joint, sign in zip(arm.fingers, signs, strict=True):
        rates += sign * _rates(model, joint)
    acting = np.flatnonzero(rates).tolist()
    if not acting or not all(_is_servo(model, i) for i in acting):
        raise ValueError(f"the fingers need a position actuator; {_actuators(model)}")
    limits = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], np.inf)
    return Gripper(
        stiffness=float(-model.actuator_biasprm[acting, 1] @ rates[acting] ** 2),
        damping=float(-model.actuator_biasprm[acting, 2] @ rates[acting] ** 2),
        force=float(limits[acting] @ np.abs(rates[acting])),
    )


def _servo(model: mujoco.MjModel, joint: int) -> tuple[int, float]:
    """The actuator that moves this joint alone, and its rate."""
    rates = _rates(model, joint)
    others = np.any([_rates(model, j) for j in range(model.njnt) if j != joint], axis=0)
    for i in np.flatnonzero(rates * ~others).tolist():
        gain = model.actuator_gainprm[i, 0]
        # Without force where length, rate times angle, makes up for the control: there they agree.
        if _is_servo(model, i) and np.isclose(gain, -model.actuator_biasprm[i, 1] * rates[i]):
            return i, float(rates[i])
    raise ValueError(
        f"joint {_names(model, [joint])} needs a position actuator of its own, whose control "
        f"is its angle; {_actuators(model)}"
    )


def _rates(model: mujoco.MjModel, joint: int) -> np.ndarray:
    """How fast the length [nu] of every actuator grows with a joint."""
    rates = np.zeros(model.nu)
    for i in range(model.nu):
        target, gear = model.actuator_trnid[i, 0], model.actuator_gear[i, 0]
        if model.actuator_trntype[i] in _ON_JOINT:
            rates[i] = gear * (target == joint)
        elif model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON:
            first = model.tendon_adr[target]
            wraps = slice(first, first + model.tendon_num[target])
            on_joint = model.wrap_type[wraps] == mujoco.mjtWrap.mjWRAP_JOINT
            on_joint &= model.wrap_objid[wraps] == joint
            rates[i] = gear * np.sum(model.wrap_prm[wraps] * on_joint)
    return rates


def _is_servo(model: mujoco.MjModel, actuator: int) -> bool:
    return bool(
        model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
        and model.actuator_biasprm[actuator, 1] < 0
    )


def _names(model: mujoco.MjModel, joints: Iterable[int]) -> str:
    return ", ".join(model.joint(joint).name or f"joint {joint}" for joint in sorted(joints))


def _joints(model: mujoco.MjModel) -> str:
    names = (f"{_names(model, [i])} ({_KINDS[model.jnt_type[i]]})" for i in range(model.njnt))
    return f"the joints are {', '.join(names) or 'none'}"


def _actuators(model: mujoco.MjModel) -> str:
    names = []
    for i in range(model.nu):
        moved = [model.joint(j).name for j in range(model.njnt) if _rates(model, j)[i]]
        kind = "position" if _is_servo(model, i) else "another kind"
        names.append(
            f"{model.actuator(i).name or i} ({kind}, on {' and '.join(moved) or 'no joint'})"
        )
    return f"the actuators are {', '.join(names) or 'none'}"
