"""Franka Emika Panda: seven joints and a parallel gripper with 80 mm stroke.

Kinematics, joint ranges, masses and servo gains are from MuJoCo Menagerie's `mjx_panda.xml`. Speed
limits are from Franka's data sheet. Shapes are primitives along the links.
"""

import numpy as np

from envs import robots

_QUARTER = np.pi / 2
# Joint frames: position in the previous link [m] and rotation about that link's x axis [rad].
_FRAMES = (
    ((0.0, 0.0, 0.333), 0.0),
    ((0.0, 0.0, 0.0), -_QUARTER),
    ((0.0, -0.316, 0.0), _QUARTER),
    ((0.0825, 0.0, 0.0), _QUARTER),
    ((-0.0825, 0.384, 0.0), -_QUARTER),
    ((0.0, 0.0, 0.0), _QUARTER),
    ((0.088, 0.0, 0.0), _QUARTER),
)
_CHAIN = np.stack([robots.translation(*p) @ robots.rotation("x", a) for p, a in _FRAMES])

# Shapes and colors are our choices, and masses [kg] are Menagerie's.
_WHITE, _LIGHT = 'rgba=".93 .93 .93 1"', 'rgba=".70 .72 .75 1"'
_DARK = 'rgba=".25 .25 .27 1"'
_LINKS = (
    f'<geom type="capsule" size=".06" fromto="0 0 -.13 0 0 -.02" mass="4.971" {_WHITE}/>',
    f'<geom type="capsule" size=".06" fromto="0 -.02 0 0 -.13 0" mass=".647" {_WHITE}/>',
    f'<geom type="capsule" size=".055" fromto="0 0 -.11 0 0 -.02" mass="3.229" {_WHITE}/>',
    f'<geom type="capsule" size=".055" fromto="-.06 .04 0 -.0825 .13 0" mass="3.588" {_LIGHT}/>',
    f'<geom type="capsule" size=".05" fromto="0 .01 -.22 0 .05 -.03" mass="1.226" {_WHITE}/>',
    f'<geom type="capsule" size=".048" fromto="0 0 0 .075 0 0" mass="1.667" {_WHITE}/>',
    f'<geom type="cylinder" size=".044 .02" pos="0 0 .08" mass=".736" {_LIGHT}/>',
)
# The hand sits 107 mm from joint 7, rotated by -45 degrees about z. The finger bodies start 58.4 mm
# further on, and their pads end 53.9 mm after that: .0584 + .0539 = .1123 m from the hand. The tcp
# is rotated by another 180 degrees, so that its x axis points back to the base when the tool points
# down, as on the other robots. The gripper is symmetric under this rotation.
_HAND = robots.translation(0, 0, 0.107) @ robots.rotation("z", np.pi - np.pi / 4)

ROBOT = robots.Robot(
    name="panda",
    chain=_CHAIN,
    tool=_HAND @ robots.translation(0, 0, 0.1123 - robots.TIP_LENGTH),
    lower=np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]),
    upper=np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]),
    speed=np.array([2.175] * 4 + [2.61] * 3),  # Franka data sheet [rad/s]
    home=np.array([0.0, -0.354, 0.0, -2.897, 0.0, 2.543, 0.785]),
    lean=0.0,
    tilt_side=-1,  # tilted outward, joint 6 would reach its limit before 90 degrees
    stroke=0.08,  # two fingers of 0.04 m
    gripper_speed=0.1,  # Franka hand data sheet: 50 mm/s per finger
    body=robots.Primitives(
        # Menagerie's gains; its passive joint damping (40, then 2) is added to kv, which has the
        # same effect.
        stiffness=np.array([1000.0, 1000.0, 750.0, 750.0, 300.0, 300.0, 300.0]),
        damping=np.array([60.0, 60.0, 44.0, 44.0, 4.0, 4.0, 4.0]),
        armature=0.1,
        base=f'<geom type="capsule" size=".07" fromto="-.05 0 .05 0 0 .13" mass=".63" {_LIGHT}/>',
        links=_LINKS,
        hand=f'<geom type="box" size=".022 .1 .028" pos="0 0 -.067" mass=".73" {_WHITE}/>',
        finger=f'<geom class="pad" size=".010 .005 .027" pos="0 .005 -.015" mass=".015" {_DARK}/>',
        tip_offset=0.005,
    ),
)
