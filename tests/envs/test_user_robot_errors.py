"""Errors about a user's MJCF that lacks something."""

import re

import pytest

import envs
from envs import mjcf
from tests.envs.user_arm import write

_NO_BALL = (
    ('name="yaw" axis="0 0 1" range="-150 150"', 'name="yaw" type="ball" range="0 90"'),
    ('<position name="yaw" joint="yaw"/>', ""),
    ('<sensor><jointpos joint="yaw"/></sensor>', ""),
    ('qpos="1 1 1 1 0 0 0 0', 'qpos="1 1 1 1 0 0 0 1 0 0 0'),
)
_HINGE = '<joint axis="0 0 1" range="0 1"/>'
_KEY = '<key name="home" qpos="1 1 1 1 0 0 0 0 .5 1.5 0 1 0 -.02 .02"/>'
_MISSING = (
    (
        "the fingers need two slide joints; joints in the file: joint 0 (free), yaw (hinge)",
        [('<joint name="b" type="slide" axis="0 -1 0"', '<joint name="b" axis="0 -1 0"')],
    ),
    (
        "both fingers must be on the same body; they are on flange and wrist",
        [('<body name="b"', '</body><body name="b"'), ("      </body>\n    </frame>", "</frame>")],
    ),
    ("all joints from the base to the hand must be hinges; joints in the file:", _NO_BALL),
    (
        "the arm has 18 hinges; at most 16 are supported",
        [
            *(
                (f'<joint name="{joint}"', 4 * _HINGE + f'<joint name="{joint}"')
                for joint in ("shoulder", "elbow", "roll")
            ),
            (_KEY, ""),
        ],
    ),
    (
        "every joint must belong to the arm or a finger, got knob",
        [
            (
                '<site name="aside"',
                '<body><joint name="knob"/><geom size=".01"/></body><site name="aside"',
            )
        ],
    ),
    (
        "every joint needs a range; it is missing for pitch, b",
        [(' range="-30 130"', ""), (' range=".005 .045"', "")],
    ),
    (
        "joint elbow needs a position actuator of its own, whose control is the joint angle; ",
        [('<position name="elbow"', '<motor name="elbow"')],
    ),
    (
        "roll (position, on roll), pitch (position, on pitch)",
        [('joint="roll"/>', 'joint="roll" gear="2"/>')],
    ),
    ("joint turn needs a position actuator", [('<position name="turn" joint="turn"/>', "")]),
    (
        "the fingers need a position actuator; actuators in the file: grip (another kind, on a",
        [
            (
                '<position name="grip" tendon="grip" kp="400" kv="20"',
                '<motor name="grip" tendon="grip"',
            )
        ],
    ),
    (
        "finger a needs a geom that collides; its body a has none with contype or conaffinity",
        [('pos="0 -0.001 .025"', 'pos="0 -0.001 .025" contype="0" conaffinity="0"')],
    ),
    (
        "the fingers must slide along one line, got axes 90 deg apart",
        [('name="b" type="slide" axis="0 -1 0"', 'name="b" type="slide" axis="1 0 0"')],
    ),
    (
        "the fingers must open to at least 10 mm, got 8 mm",
        [("-.045 -.005", "-.009 -.005"), (".005 .045", ".005 .009")],
    ),
    (
        "add a site tcp whose z axis points out of the hand and along whose y axis",
        [('name="turn" axis="0 0 -1"', 'name="turn" axis="0 1 0"')],
    ),
    (
        "joint yaw needs a position actuator of its own",
        [
            (
                "</tendon>",
                '<fixed name="belt"><joint joint="yaw" coef="1"/>'
                '<joint joint="roll" coef="1"/></fixed></tendon>',
            ),
            ('<position name="yaw" joint="yaw"', '<position name="yaw" tendon="belt"'),
        ],
    ),
    (
        "pitch: range and the actuator's ctrlrange do not overlap",
        [('joint="pitch"/>', 'joint="pitch" ctrlrange="-3 -2"/>')],
    ),
    (
        "no hinge turns by more than 13 deg; if the file gives angles in radians, add <compiler",
        [
            ('range="-150 150"', 'range="-2.6 2.6"'),
            ('range="-100 100"', 'range="-1.7 1.7"'),
            ('range="0 160" ref="10"', 'range="0 2.8"'),
            ('range="-170 170"', 'range="-3 3"'),
            ('range="-30 130"', 'range="-.5 2.3"'),
        ],
    ),
    (
        "mocap body 'robot/column' is not a fixed child of world",
        [('childclass="robot"', 'childclass="robot" mocap="true"')],
    ),
    (
        "target body",
        [
            (
                '<site name="aside"',
                '<camera name="wrist" mode="targetbody" target="ball"/><site name="aside"',
            )
        ],
    ),
    ("MuJoCo cannot read it", [("</mujoco>", "")]),
    ("the hand must reach x 0.34 m, y 0 m, z 0.18 m", [('range="0 160"', 'range="0 5"')]),
)


@pytest.mark.parametrize(("message", "edits"), _MISSING)
def test_what_is_missing_is_named(tmp_path, message, edits):
    file = write(tmp_path, *edits)
    with pytest.raises(ValueError, match=re.escape(message)) as raised:
        mjcf.load(file)
    assert str(raised.value).startswith(f"robot {file}: ")
    assert "\n" not in str(raised.value)


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
def test_settotalmass_raises(tmp_path):
    file = write(tmp_path, ('angle="degree"', 'angle="degree" settotalmass="9"'))
    with pytest.raises(ValueError, match="settotalmass is not supported"):
        mjcf.load(file)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tcp": "hook"}, "unknown site hook; sites in the file: grip, askew, inwards, aside"),
        ({"tcp": "askew"}, "the y axis of site askew is 60 deg off the line along which"),
        ({"tcp": "inwards"}, "the z axis of site inwards must point out of the hand"),
        ({"tcp": "aside"}, "the z axis of site aside does not run between the fingers"),
        ({"speed": [1.0, 2.0]}, "speed must be a positive number or 6 of them, got [1.0, 2.0]"),
        ({"gripper_speed": 0.0}, "gripper_speed must be a positive number, got 0.0"),
    ],
)
def test_bad_options(tmp_path, options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        mjcf.load(write(tmp_path), **options)


def test_missing_file():
    with pytest.raises(ValueError, match=r"robot nowhere\.xml: no such file"):
        envs.make("press", "nowhere.xml")


@pytest.mark.slow
def test_short_reach_warns(tmp_path):
    file = write(tmp_path, ('range="-150 150"', 'range="-15 15"'))
    with pytest.warns(UserWarning, match="misses parts of the table by up to"):
        mjcf.load(file)
