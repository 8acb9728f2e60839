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
_ONE_EDIT = (
    (
        "two slide joints; joints in the file: joint 0 (free), yaw (hinge)",
        '<joint name="b" type="slide" axis="0 -1 0"',
        '<joint name="b" axis="0 -1 0"',
    ),
    (
        "knob",
        '<site name="aside"',
        '<body><joint name="knob"/><geom size=".01"/></body><site name="aside"',
    ),
    ("joint elbow needs a position actuator", '<position name="elbow"', '<motor name="elbow"'),
    (
        "roll (position, on roll), pitch (position, on pitch)",
        'joint="roll"/>',
        'joint="roll" gear="2"/>',
    ),
    ("joint turn needs a position actuator", '<position name="turn" joint="turn"/>', ""),
    (
        "joint turn needs only one position actuator",
        '<position name="turn" joint="turn"/>',
        '<position name="turn" joint="turn"/><position joint="turn" kp="9"/>',
    ),
    (
        "grip (another kind, on a",
        '<position name="grip" tendon="grip" kp="400" kv="20"',
        '<motor name="grip" tendon="grip"',
    ),
    (
        "finger a needs a geom",
        'pos="0 -0.001 .025"',
        'pos="0 -0.001 .025" contype="0" conaffinity="0"',
    ),
    ("90 deg apart", 'name="b" type="slide" axis="0 -1 0"', 'name="b" type="slide" axis="1 0 0"'),
    ("add a site tcp", 'name="turn" axis="0 0 -1"', 'name="turn" axis="0 1 0"'),
    ("pitch: range and ctrlrange", 'joint="pitch"/>', 'joint="pitch" ctrlrange="-3 -2"/>'),
    ("mocap body", 'childclass="robot"', 'childclass="robot" mocap="true"'),
    (
        "target body",
        '<site name="aside"',
        '<camera name="wrist" mode="targetbody" target="ball"/><site name="aside"',
    ),
    ("arm.xml is damaged", "</mujoco>", ""),
    ("reach x 0.34 m", 'range="0 160"', 'range="0 5"'),
    ("first hinge is at x 0.5 m, y 0.9 m: place the base at the origin", "0 0 .02", ".5 .9 .02"),
)
_SEVERAL_EDITS = (
    (
        "flange and wrist",
        [('<body name="b"', '</body><body name="b"'), ("      </body>\n    </frame>", "</frame>")],
    ),
    ("must be hinges", _NO_BALL),
    (
        "18 hinges",
        [
            *(
                (f'<joint name="{n}"', 4 * _HINGE + f'<joint name="{n}"')
                for n in ("shoulder", "elbow", "roll")
            ),
            (_KEY, ""),
        ],
    ),
    ("pitch, b", [(' range="-30 130"', ""), (' range=".005 .045"', "")]),
    ("8 mm", [("-.045 -.005", "-.009 -.005"), (".005 .045", ".005 .009")]),
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
        "add <compiler",
        [
            ('range="-150 150"', 'range="-2.6 2.6"'),
            ('range="-100 100"', 'range="-1.7 1.7"'),
            ('range="0 160" ref="10"', 'range="0 2.8"'),
            ('range="-170 170"', 'range="-3 3"'),
            ('range="-30 130"', 'range="-.5 2.3"'),
        ],
    ),
)


def assert_names(folder, message, edits):
    file = write(folder, *edits)
    with pytest.raises(ValueError, match=re.escape(message)) as raised:
        mjcf.load(file)
    assert str(raised.value).startswith(f"robot {file}: ")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("message", "old", "new"), _ONE_EDIT)
def test_what_is_missing_is_named(tmp_path, message, old, new):
    assert_names(tmp_path, message, [(old, new)])


@pytest.mark.parametrize(("message", "edits"), _SEVERAL_EDITS)
def test_what_several_edits_remove_is_named(tmp_path, message, edits):
    assert_names(tmp_path, message, edits)


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
def test_settotalmass_raises(tmp_path):
    file = write(tmp_path, ('angle="degree"', 'angle="degree" settotalmass="9"'))
    with pytest.raises(ValueError, match="settotalmass"):
        mjcf.load(file)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"tcp": "hook"}, "hook.* grip, askew, inwards, aside"),
        *[({"tcp": name}, f"site {name}") for name in ("askew", "inwards", "aside")],
        ({"speed": [1.0, 2.0]}, "speed .* 6 of them"),
        ({"gripper_speed": 0.0}, "gripper_speed"),
    ],
)
def test_bad_options(tmp_path, options, words):
    with pytest.raises(ValueError, match=words):
        mjcf.load(write(tmp_path), **options)


def test_missing_file():
    with pytest.raises(ValueError, match=r"nowhere\.xml is missing"):
        envs.make("press", "nowhere.xml")


@pytest.mark.slow
def test_short_reach_warns(tmp_path):
    file = write(tmp_path, ('range="-150 150"', 'range="-15 15"'))
    with pytest.warns(UserWarning, match="misses parts"):
        mjcf.load(file)
