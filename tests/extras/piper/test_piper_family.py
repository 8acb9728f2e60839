"""The arms of the PiPER family: geometry and limits."""

import can
import numpy as np
import pytest

from envs.robots.piper import SDK_OFFSET
from lorasp_jax.extras.piper.arm import NoArm, PiperArm
from lorasp_jax.extras.piper.fake import frames
from lorasp_jax.extras.piper.family import MODELS, PIPER, _joint
from lorasp_jax.extras.piper.safety import Limits, finger_tips
from tests.extras.piper.benches import channel

# Origins of the joints in agx_arm_urdf's piper/urdf/piper_description.urdf: x, y, z, roll, pitch,
# yaw.
URDF = (
    (0, 0, 0.123, 0, 0, 0),
    (0, 0, 0, np.pi / 2, -0.1357866, -np.pi),
    (0.28503, 0, 0, 0, 0, -1.7938494),
    (-0.02198, -0.25075, 0, np.pi / 2, 0, 0),
    (0, 0, 0, -np.pi / 2, 0, 0),
    (0, -0.091, 0, np.pi / 2, 0, 0),
)


def tips(chain, angles, length):
    pose = np.eye(4)
    for fixed, angle in zip(chain, angles, strict=True):
        pose = pose @ fixed @ _joint(0, 0, 0, 0, 0, angle)
    return pose[:3, 3] + length * pose[:3, 2]


def test_the_urdfs_have_the_zeros_of_piper_sdk():
    """As their PiPER is piper_sdk's, with its default zeros, so are the others."""
    chain = [_joint(*row) for row in URDF]
    for angles in np.random.default_rng(0).uniform(PIPER.lower, PIPER.upper, (20, 6)):
        expected = finger_tips(angles)
        np.testing.assert_allclose(tips(chain, angles - SDK_OFFSET, 0.135), expected, atol=2e-4)


def test_a_piper_h_is_a_longer_piper():
    """By 5 mm in the forearm and 5.3 mm in the wrist."""
    longer = [_joint(*row) for row in URDF]
    longer[3][:3, 3] = -0.02198, -0.25575, 0
    longer[5][:3, 3] = 0, -0.0963, 0
    model = MODELS["piper-h"]
    for angles in np.random.default_rng(0).uniform(model.lower, model.upper, (20, 6)):
        expected = tips(longer, angles, 0.1425)
        np.testing.assert_allclose(finger_tips(angles, model), expected, atol=1e-6)


@pytest.mark.parametrize(("name", "bend"), [("piper-x", 3), ("piper-h", 4)])
def test_the_hand_lies_and_points_as_that_of_a_piper(name, bend):
    model = MODELS[name]
    for own, other in ((model.home, PIPER.home), (model.rest[:6], PIPER.rest[:6])):
        np.testing.assert_allclose(finger_tips(own, model), finger_tips(other), atol=0.05)
        assert own[bend] == other[4] > 0
    limits = Limits.of(model)
    for pose in (NoArm(model).read().pose, model.rest):
        assert ((limits.lower <= pose) & (pose <= limits.upper)).all()


@pytest.mark.parametrize(
    ("name", "wrist"), [("piper", (100, 70)), ("piper-x", (89, 89)), ("piper-h", (135, 89.5))]
)
def test_limits(name, wrist):
    limits = Limits.of(MODELS[name], zeros="sdk")
    np.testing.assert_allclose(np.rad2deg(limits.upper[3:5]), wrist, atol=0.1)
    np.testing.assert_allclose(limits.lower[3:6], -limits.upper[3:6])


@pytest.mark.parametrize("name", MODELS)
def test_targets_reach_the_bus_in_the_firmwares_zeros(name):
    model, bus = MODELS[name], channel()
    arm = PiperArm(bus, model, bus="virtual")
    receiver = can.Bus(bus, interface="virtual")
    arm.command(np.append(model.home, 0.05))
    sent = {}
    while (message := receiver.recv(0.2)) is not None:
        sent[message.arbitration_id] = bytes(message.data)
    counts = [x for kind in frames.TARGETS for x in frames.unpack_pair(sent[kind])]
    np.testing.assert_allclose(
        np.deg2rad(np.array(counts) / 1000), model.home - model.offset, atol=1e-5
    )
    receiver.shutdown()
    arm.close()
