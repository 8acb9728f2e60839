"""Attach a user's robot to a scene, with the joints, actuators and contacts that tasks expect."""

import dataclasses
from typing import Any

import mujoco
import numpy as np

from envs import robots
from envs.mjcf import fitting
from envs.mjcf.hands import Hand, Pad
from envs.mjcf.reading import ArmIds, Gripper
from envs.rendering.model import STAND_IN_GROUP, is_visible
from envs.robots import Robot

_PREFIX = "robot/"  # for all names in the user's file, to avoid clashes with the scene and tasks
_DROPPED = ("keys", "sensors", "actuators", "tendons", "equalities", "pairs", "excludes", "lights")
_UNSET = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default color; such a geom has that of its material
_SMALL = 0.01  # m, half-extent below which a mesh is not drawn; our choice
_HIDDEN_GROUP = 3


@dataclasses.dataclass(frozen=True, eq=False)
class UserBody:
    """Body of a robot from a user's file; see `robots.Body`.

    Attributes:
        spec: the user's model; the joints of its fingers measure half the opening.
        root: name of the base's body.
        fingers: names of the left and the right finger's joint.
        pads: collision shapes of the left and the right finger.
        gripper: servo of the fingers.
        mount: [4, 4] pose of the body that carries the fingers, in the frame of the last link.
    """

    spec: mujoco.MjSpec
    root: str
    fingers: list[str]
    pads: list[Pad]
    gripper: Gripper
    mount: np.ndarray

    def mjcf(self, _: Robot, /) -> tuple[str, str]:
        """Return an empty base body, which `attach` fills, and no actuators."""
        return f'<body name="{robots.BASE}"/>', ""

    def attach(self, robot: Robot, scene: mujoco.MjSpec) -> None:
        """Attach the robot to the base body of the scene, and add the actuators."""
        own = self.spec.copy()
        for name in dir(own.option):
            if not name.startswith("_"):
                setattr(own.option, name, getattr(scene.option, name))
        scene.body(robots.BASE).add_frame().attach_body(own.body(self.root), _PREFIX, "")
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
    spec: mujoco.MjSpec, model: mujoco.MjModel, arm: ArmIds, gripper: Gripper, hand: Hand
) -> UserBody:
    """Prepare the body of a user's robot, modifying `spec`, the source of `model`, in place.

    Raises:
        ValueError: the file uses settotalmass, which would be lost in a scene.
    """
    if spec.compiler.settotalmass > 0:
        raise ValueError("settotalmass is not supported: give bodies and geoms their own masses")
    bodies, joints, geoms = (
        {element.id: element for element in elements}
        for elements in (spec.bodies, spec.joints, spec.geoms)
    )
    for kind in _DROPPED:
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
    for geom_id, geom in geoms.items():
        if model.body_rootid[model.geom_bodyid[geom_id]] == arm.root:
            _make_visual(model, geom_id, geom)
    # Frames around the root are not attached with it, so use the pose that the compiler computed.
    root.pos, root.quat = model.body_pos[arm.root], model.body_quat[arm.root]
    root.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    names = [joint.name for joint in fingers]
    return UserBody(spec, root.name, names, hand.pads, gripper, hand.mount)


def _add_servo(
    spec: mujoco.MjSpec, model: mujoco.MjModel, joint: str, servo: int, gear: float
) -> None:
    """Copy the user's actuator; the copy always acts on the joint, never through a tendon."""
    new = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    new.gear[0] = gear
    for name in (
        *("gaintype", "gainprm", "biastype", "biasprm"),
        *("ctrllimited", "ctrlrange", "forcelimited", "forcerange"),
    ):
        setattr(new, name, getattr(model, f"actuator_{name}")[servo])


def _redefine(joint: Any, sign: float, shift: float) -> None:
    """Redefine the joint of a finger to measure half the opening."""
    low, high = sorted(sign * joint.range + shift)
    joint.axis = sign * joint.axis
    joint.ref = sign * joint.ref + shift
    joint.springref = sign * joint.springref + shift
    joint.range = max(low, 0.0), high  # low < 0: the boxes overlap where the fingers do not
    joint.actfrcrange = sorted(sign * joint.actfrcrange)


def _make_visual(model: mujoco.MjModel, geom_id: int, geom: Any) -> None:
    """Disable a geom's collisions; if it is a visible mesh, add primitives to draw in its place.

    A geom keeps only a textured material; other materials are replaced by their color. Otherwise,
    MuJoCo Warp would use the material's color, which `Appearance` does not change.
    """
    geom.contype = geom.conaffinity = 0
    geom.group = min(geom.group, STAND_IN_GROUP - 1)
    rgba, material = model.geom_rgba[geom_id], model.geom_matid[geom_id]
    if material >= 0 and np.allclose(rgba, _UNSET):
        rgba = geom.rgba = model.mat_rgba[material]
    if material >= 0 and np.all(model.mat_texid[material] < 0):
        geom.material = ""
    is_mesh = model.geom_type[geom_id] == mujoco.mjtGeom.mjGEOM_MESH
    if not is_mesh or not is_visible(model)[geom_id]:
        return
    if model.geom_aabb[geom_id, 3:].max() < _SMALL:
        geom.group = _HIDDEN_GROUP
        return
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom_id])
    rotation = rotation.reshape(3, 3)
    for shape in fitting.fit(model, geom_id):
        pose = {
            "pos": model.geom_pos[geom_id] + rotation @ shape.position,
            "quat": _quat(rotation @ shape.rotation),
        }
        visual = {"type": shape.kind, "size": shape.size, "rgba": rgba, "group": STAND_IN_GROUP}
        geom.parent.add_geom(**pose, **visual, material="", contype=0, conaffinity=0, mass=0)


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
