"""A made-up arm for tests, as a user's MJCF.

Its links are 30 cm long. The joints of its fingers open along -y, 5 mm off where the fingers touch;
its gripper is on a tendon, its angles are in degrees, its upper arm is a mesh.
"""

import itertools
from pathlib import Path

HALF = (0.03, 0.02, 0.14)  # m, of the mesh
_VERTICES = " ".join(
    str(x) for corner in itertools.product(*((-h, h) for h in HALF)) for x in corner
)
_FINGER = """
<body name="{name}" pos="0 0 .1" gravcomp="1">
  <joint name="{name}" type="slide" axis="0 -1 0" range="{range}"/>
  <geom type="box" size=".01 .004 .025" pos="0 {y} .025" rgba=".2 .2 .2 1"/>
</body>"""
_ARM = f"""
<mujoco>
  <compiler angle="degree"/>
  <option timestep="0.001" cone="elliptic"/>
  <visual><headlight ambient=".9 .9 .9"/></visual>
  <default>
    <geom density="200"/>
    <joint armature=".01" damping=".1"/>
    <position kp="150" kv="8" ctrlrange="-3 3"/>
    <default class="robot"><geom contype="1"/></default>
  </default>
  <asset>
    <mesh name="shell" vertex="{_VERTICES}"/>
    <material name="blue" rgba=".1 .2 .9 1"/>
  </asset>
  <worldbody>
    <light pos="0 0 2"/>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="ball" pos="1 1 1"><freejoint/><geom size=".02"/></body>
    <frame pos="0 0 .02" euler="0 0 10">
      <body name="column" euler="0 0 -10" childclass="robot">
        <geom type="cylinder" size=".05 .04" pos="0 0 .04"/>
        <body name="turret" pos="0 0 .1" gravcomp="1">
          <joint name="yaw" axis="0 0 1" range="-150 150"/>
          <geom type="sphere" size=".04"/>
          <body name="upper" gravcomp="1">
            <joint name="shoulder" axis="0 1 0" range="-100 100"/>
            <geom type="mesh" mesh="shell" pos="0 0 .15" euler="0 0 30" material="blue"/>
            <body name="lower" pos="0 0 .3" gravcomp="1">
              <joint name="elbow" axis="0 1 0" range="0 160" ref="10"/>
              <geom type="capsule" size=".03" fromto="0 0 0 0 0 .2"/>
              <body name="forearm" pos="0 0 .1" gravcomp="1">
                <joint name="roll" axis="0 0 1" range="-170 170"/>
                <geom type="cylinder" size=".03 .02" pos="0 0 .1"/>
                <body name="wrist" pos="0 0 .17" gravcomp="1">
                  <joint name="pitch" axis="0 1 0" pos="0 0 .01" range="-30 130"/>
                  <geom type="sphere" size=".03"/>
                  <body name="flange" pos="0 0 .04" gravcomp="1">
                    <joint name="turn" axis="0 0 -1" range="-170 170"/>
                    <geom type="box" size=".02 .05 .02" pos="0 0 .07"/>
                    <site name="grip" pos="0 0 .1" euler="0 0 180"/>
                    <site name="askew" pos="0 0 .1" euler="0 0 60"/>
                    <site name="inwards" pos="0 0 .1" euler="180 0 0"/>
                    <site name="aside" pos=".02 0 .1"/>
                    {_FINGER.format(name="a", range="-.045 -.005", y=-0.001)}
                    {_FINGER.format(name="b", range=".005 .045", y=0.001)}
                  </body>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </frame>
  </worldbody>
  <tendon>
    <fixed name="grip"><joint joint="a" coef="-.5"/><joint joint="b" coef=".5"/></fixed>
  </tendon>
  <equality><joint joint1="a" joint2="b" polycoef="0 -1 0 0 0"/></equality>
  <actuator>
    <position name="grip" tendon="grip" kp="400" kv="20" ctrlrange="0 .05" forcerange="-15 15"/>
    <position name="yaw" joint="yaw"/>
    <position name="shoulder" joint="shoulder"/>
    <position name="elbow" joint="elbow"/>
    <position name="roll" joint="roll"/>
    <position name="pitch" joint="pitch"/>
    <position name="turn" joint="turn"/>
  </actuator>
  <sensor><jointpos joint="yaw"/></sensor>
  <keyframe><key name="home" qpos="1 1 1 1 0 0 0 0 .5 1.5 0 1 0 -.02 .02"/></keyframe>
</mujoco>
"""
JOINTS = ("yaw", "shoulder", "elbow", "roll", "pitch", "turn")


def write(folder: Path, *edits: tuple[str, str]) -> Path:
    """Write the arm's file, with some strings replaced."""
    text = _ARM
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    file = folder / "arm.xml"
    file.write_text(text)
    return file
