"""A user's robot in a scene: joints, actuators and contacts as tasks and environment want them."""

import dataclasses
from typing import Any

import mujoco
import numpy as np

from envs import robots
from envs.mjcf import fitting
from envs.mjcf.hands import Hand, Pad
from envs.mjcf.reading import Arm, Gripper
from envs.rendering.model import STAND_IN_GROUP, is_visible
from envs.robots import Robot

_BASE = "base"
_PREFIX = "robot/"  # of all names in the user's file, which may be those of the scene or a task
_LEFT_OUT = ("keys", "sensors", "actuators", "tendons", "equalities", "pairs", "excludes", "lights")
_UNSET = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's colour of a geom; one that has it takes its material's
_SMALL = 0.01  # m, half the extent of a mesh below which it is not drawn
_HIDDEN_GROUP = 3


@dataclasses.dataclass(frozen=True, eq=False)
class UserBody:
    """The body of a robot from a user's file, see `robots.Body`.

    Attributes:
        spec: the user's description; the joints of its fingers measure half the opening.
        root: name of the base's body.
        fingers: names of the left and the right finger's joint.
        pads: what the left and the right finger touch things with.
        gripper: what pulls the fingers together.
        mount: [4, 4] pose of the body that carries the fingers in the last link.
    """

    spec: mujoco.MjSpec
    root: str
    fingers: list[str]
    pads: list[Pad]
    gripper: Gripper
    mount: np.ndarray

    def mjcf(self, _: Robot, /) -> tuple[str, str]:
        """A place for the bodies; no actuators."""
        return f'<body name="{_BASE}"/>', ""

    def attach(self, robot: Robot, scene: mujoco.MjSpec) -> None:
        """Puts the bodies into their place in a scene, and adds the actuators."""
        own = self.spec.copy()
        for name in dir(own.option):
            if not name.startswith("_"):
                setattr(own.option, name, getattr(scene.option, name))
        scene.body(_BASE).add_frame().attach_body(own.body(self.root), _PREFIX, "")
        for side, finger, pad in zip(("left", "right"), self.fingers, self.pads, strict=True):
            joint = scene.joint(_PREFIX + finger)
            joint.name = side
            _add_pad(scene, joint.parent, pad)
        tcp = np.linalg.solve(self.mount, robot.tool)
        carrier = scene.joint("left").parent.parent
        hand = carrier.add_body(name="hand", pos=tcp[:3, 3], quat=_quat(tcp[:3, :3]))
        hand.add_site(name="tcp")
        if camera := scene.camera(_PREFIX + "wrist"):
            camera.name = "wrist"
        else:
            _add_camera(hand)
        pull = scene.add_actuator(name="gripper", target="left")
        pull.trntype = mujoco.mjtTrn.mjTRN_JOINT
        pull.set_to_position(kp=self.gripper.stiffness, kv=self.gripper.damping)
        if np.isfinite(self.gripper.force):
            pull.forcerange = -self.gripper.force, self.gripper.force


def prepare(
    spec: mujoco.MjSpec, model: mujoco.MjModel, arm: Arm, gripper: Gripper, hand: Hand
) -> UserBody:
    """The body of a user's robot.

    Args:
        spec: what `model` was compiled from; changed in place.
        model: the user's model.
        arm, gripper, hand: what was found in it.

    Raises:
        ValueError: if the file sets the total mass, which a scene would lose.
    """
    if spec.compiler.settotalmass > 0:
        raise ValueError("settotalmass is not supported: give bodies and geoms their own masses")
    bodies, joints, geoms = (
        {element.id: element for element in elements}
        for elements in (spec.bodies, spec.joints, spec.geoms)
    )
    for kind in _LEFT_OUT:
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    root = bodies[arm.root]
    for element in (root, *joints.values()):
        element.name = element.name or f"number {element.id}"
    for joint, servo, gear in zip(arm.joints, arm.servos, arm.gears, strict=True):
        _add_servo(spec, model, joints[joint].name, servo, gear)
    fingers = [joints[joint] for joint in arm.fingers]
    for joint, sign, shift in zip(fingers, hand.signs, hand.shifts, strict=True):
        _redefine(joint, sign, shift)
    for number, geom in geoms.items():
        if model.body_rootid[model.geom_bodyid[number]] == arm.root:
            _clothe(model, number, geom)
    # Frames around it do not come along: what the compiler made of them does.
    root.pos, root.quat = model.body_pos[arm.root], model.body_quat[arm.root]
    root.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    names = [joint.name for joint in fingers]
    return UserBody(spec, root.name, names, hand.pads, gripper, hand.mount)


def _add_servo(
    spec: mujoco.MjSpec, model: mujoco.MjModel, joint: str, servo: int, gear: float
) -> None:
    """An actuator like the user's, on the joint itself."""
    new = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    new.gear[0] = gear
    for name in (
        *("gaintype", "gainprm", "biastype", "biasprm"),
        *("ctrllimited", "ctrlrange", "forcelimited", "forcerange"),
    ):
        setattr(new, name, getattr(model, f"actuator_{name}")[servo])


def _redefine(joint: Any, sign: float, shift: float) -> None:
    """Makes the joint of a finger measure half the opening."""
    low, high = sorted(sign * joint.range + shift)
    joint.axis = sign * joint.axis
    joint.ref = sign * joint.ref + shift
    joint.springref = sign * joint.springref + shift
    joint.range = max(low, 0.0), high  # boxes can overlap where the fingers themselves do not
    joint.actfrcrange = sorted(sign * joint.actfrcrange)


def _clothe(model: mujoco.MjModel, number: int, geom: Any) -> None:
    """Makes a geom touch nothing, and adds shapes in its place if it is a mesh to be seen.

    Its colour is its own, not its material's, which MuJoCo Warp would draw instead and which does
    not change with `Look`; only a material with a texture stays.
    """
    geom.contype = geom.conaffinity = 0
    geom.group = min(geom.group, STAND_IN_GROUP - 1)
    rgba, material = model.geom_rgba[number], model.geom_matid[number]
    if material >= 0 and np.allclose(rgba, _UNSET):
        rgba = geom.rgba = model.mat_rgba[material]
    if material >= 0 and np.all(model.mat_texid[material] < 0):
        geom.material = ""
    is_mesh = model.geom_type[number] == mujoco.mjtGeom.mjGEOM_MESH
    if not is_mesh or not is_visible(model)[number]:
        return
    if model.geom_aabb[number, 3:].max() < _SMALL:
        geom.group = _HIDDEN_GROUP
        return
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[number])
    rotation = rotation.reshape(3, 3)
    for shape in fitting.fit(model, number):
        place = {
            "pos": model.geom_pos[number] + rotation @ shape.position,
            "quat": _quat(rotation @ shape.rotation),
        }
        look = {"type": shape.kind, "size": shape.size, "rgba": rgba, "group": STAND_IN_GROUP}
        geom.parent.add_geom(**place, **look, material="", contype=0, conaffinity=0, mass=0)


def _add_pad(scene: mujoco.MjSpec, finger: Any, pad: Pad) -> None:
    hidden = {"mass": 0, "group": _HIDDEN_GROUP, "rgba": (0, 0, 0, 0)}
    box = {"size": pad.size, "pos": pad.position, "quat": _quat(pad.rotation)}
    finger.add_geom(scene.find_default("pad"), **box, **hidden)
    tip = {"size": (robots.TIP_RADIUS, 0, 0), "pos": pad.tip}
    finger.add_geom(scene.find_default("tip"), **tip, **hidden)


def _add_camera(hand: Any) -> None:
    x, y = np.reshape(robots.WRIST_AXES, (2, 3))
    quat = _quat(np.stack([x, y, np.cross(x, y)], axis=1))
    hand.add_camera(name="wrist", pos=robots.WRIST_POSITION, quat=quat, fovy=robots.WRIST_FOVY)


def _quat(rotation: np.ndarray) -> np.ndarray:
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, rotation.ravel())
    return quat
