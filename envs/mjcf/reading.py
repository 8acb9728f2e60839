"""Find the arm, its limits and its actuators in a user's MuJoCo model, or say what is missing."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from envs.mjcf import sources
from envs.scene import scene
from lorasp_jax.base.files import as_value_error

_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_KINDS = ("free", "ball", "slide", "hinge")
_MAX_JOINTS = 16  # our choice: compile time grows with every joint
_NUMBERS = ("body_pos", "body_quat", "geom_pos", "geom_size", "jnt_pos", "jnt_axis")
_RADIANS_AS_DEGREES = np.deg2rad(4 * np.pi)  # width of +-2 pi, read as degrees
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


class ArmIds(NamedTuple):
    """Ids in the user's model."""

    root: int  # body of the base
    joints: list[int]  # hinges from the base to the hand
    fingers: list[int]  # slides of the two fingers
    servos: list[int]  # actuators of the hinges
    gears: list[float]  # derivative of each actuator's length with respect to its hinge


class Gripper(NamedTuple):
    """The fingers' actuators combined into one position servo, which controls half the opening."""

    stiffness: float  # N/m
    damping: float  # N s/m
    force: float  # limit in N, infinite if there is none


def read(
    path: str | os.PathLike[str], folder: str | os.PathLike[str] | None = None
) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Read and compile an MJCF file.

    All files that it refers to must be in `folder`, by default its own.

    Raises:
        ValueError: the file does not exist, MuJoCo rejects it, it refers to files outside of
            `folder`, or something in it is too large.
    """
    path = Path(path).absolute()
    with as_value_error(path):
        sources.check(path, Path(folder or path.parent))
    with scene.as_python_warnings():
        spec = mujoco.MjSpec.from_file(str(path))
        spec.memory = -1  # automatic, whatever the file asks for
        # Merge no bodies and drop no geoms: both would change the ids in the model.
        spec.compiler.fusestatic = spec.compiler.discardvisual = False
        model = spec.compile()
    if not all(np.isfinite(getattr(model, name)).all() for name in _NUMBERS):
        raise ValueError("the numbers in the file must be finite")
    return spec, model


def find_arm(model: mujoco.MjModel) -> ArmIds:
    """Find the arm's joints and their servos.

    Raises:
        ValueError: the model has too few, too many or unsuitable joints or actuators.
    """
    fingers = np.flatnonzero(model.jnt_type == _SLIDE).tolist()
    if len(fingers) != 2:
        raise ValueError(f"the fingers need two slide joints; {_joints(model)}")
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
        raise ValueError(f"all joints from the base to the hand must be hinges; {_joints(model)}")
    if len(joints) > _MAX_JOINTS:
        raise ValueError(f"the arm has {len(joints)} hinges; at most {_MAX_JOINTS} are supported")
    own = np.flatnonzero(model.body_rootid[model.jnt_bodyid] == base)
    if others := set(own.tolist()) - {*joints, *fingers}:
        names = _names(model, others)
        raise ValueError(f"every joint must belong to the arm or a finger, got {names}")
    if unlimited := [joint for joint in (*joints, *fingers) if not model.jnt_limited[joint]]:
        raise ValueError(f"every joint needs a range; it is missing for {_names(model, unlimited)}")
    servos, gears = zip(*(_servo(model, joint) for joint in joints), strict=True)
    return ArmIds(base, joints, fingers, list(servos), list(gears))


def find_limits(model: mujoco.MjModel, arm: ArmIds) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest angles `[J]` allowed by both hinges and servos [rad].

    Raises:
        ValueError: the two ranges of a joint do not overlap, or all seem to be in the wrong unit.
    """
    lower, upper = model.jnt_range[arm.joints].T
    control = np.where(
        model.actuator_ctrllimited[arm.servos, None],
        model.actuator_ctrlrange[arm.servos],
        (-np.inf, np.inf),
    )
    lower, upper = np.maximum(lower, control[:, 0]), np.minimum(upper, control[:, 1])
    if empty := [joint for joint, span in zip(arm.joints, upper - lower, strict=True) if span <= 0]:
        raise ValueError(f"{_names(model, empty)}: range and ctrlrange do not overlap")
    if (upper - lower).max() < _RADIANS_AS_DEGREES:
        raise ValueError(
            "no hinge turns by more than 13 deg; if the file's angles are in radians, add "
            '<compiler angle="radian"/>'
        )
    return lower, upper


def find_gripper(model: mujoco.MjModel, arm: ArmIds, signs: np.ndarray) -> Gripper:
    """Combine the fingers' actuators, which may act on one finger, on both, or on a tendon.

    `signs` `[2]` is 1 for a finger joint whose positive direction opens the hand, else -1.

    Raises:
        ValueError: the fingers have no actuator, or one that is not a position actuator.
    """
    rates = np.zeros(model.nu)  # d(actuator length) / d(half the opening)
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
    """Find the actuator that moves only this joint, and its rate as in `_rates`."""
    rates = _rates(model, joint)
    others = np.any([_rates(model, j) for j in range(model.njnt) if j != joint], axis=0)
    gains = model.actuator_gainprm[:, 0]
    # At control = angle, the force must be 0: gain * control and bias * rate * angle cancel.
    balanced = np.isclose(gains, -model.actuator_biasprm[:, 1] * rates)
    own = np.flatnonzero(rates * ~others * balanced).tolist()
    servos = [i for i in own if _is_servo(model, i)]
    if len(servos) == 1:
        return servos[0], float(rates[servos[0]])
    name, count = _names(model, [joint]), "only one" if servos else "a"
    raise ValueError(
        f"joint {name} needs {count} position actuator of its own; {_actuators(model)}"
    )


def _rates(model: mujoco.MjModel, joint: int) -> np.ndarray:
    """Compute the derivatives [nu] of the actuators' lengths with respect to a joint."""
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
    return f"joints in the file: {', '.join(names) or 'none'}"


def _actuators(model: mujoco.MjModel) -> str:
    names = []
    for i in range(model.nu):
        moved = [model.joint(j).name for j in range(model.njnt) if _rates(model, j)[i]]
        kind = "position" if _is_servo(model, i) else "another kind"
        names.append(
            f"{model.actuator(i).name or i} ({kind}, on {' and '.join(moved) or 'no joint'})"
        )
    return f"actuators in the file: {', '.join(names) or 'none'}"
