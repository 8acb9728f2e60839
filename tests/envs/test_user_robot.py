"""Robots from a user's own MJCF, and their scenes."""

import dataclasses
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import mjcf, robots
from envs.rendering.model import build
from envs.scene import scene
from envs.tasks import press
from tests.cases import mostly_slow
from tests.envs.user_arm import HALF, JOINTS, write


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("robot"))


@pytest.fixture(scope="module")
def robot(file) -> robots.Robot:
    return mjcf.load(file, tcp="grip", speed=[1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


@pytest.fixture(scope="module")
def model(robot) -> mujoco.MjModel:
    return scene.build(press.TASK.scene, robot)


def at(model: mujoco.MjModel, q: np.ndarray, opening: float = 0.0) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:6], data.qpos[6:8] = q, opening / 2
    mujoco.mj_forward(model, data)
    return data


def test_kinematics_match_the_file(file, robot, model):
    own = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(own)
    tool_pose = jax.jit(lambda q: robots.tool_pose(robot, q))
    for q in np.random.default_rng(0).uniform(robot.lower, robot.upper, (20, 6)):
        for name, angle in zip(JOINTS, q, strict=True):
            data.joint(name).qpos = angle
        mujoco.mj_kinematics(own, data)
        site, z = data.site("grip"), data.site("grip").xmat.reshape(3, 3)[:, 2]
        position, rotation, _ = tool_pose(jnp.asarray(q, jnp.float32))
        # The fingers end .05 m from the site, the tcp is 12 mm before that.
        np.testing.assert_allclose(position, site.xpos + 0.038 * z, atol=2e-6)
        np.testing.assert_allclose(rotation[:, 2], z, atol=5e-6)
        ours = at(model, q)
        np.testing.assert_allclose(position, ours.site("tcp").xpos, atol=2e-6)
        np.testing.assert_allclose(rotation, ours.site("tcp").xmat.reshape(3, 3), atol=5e-6)
        np.testing.assert_allclose(data.body("wrist").xpos, ours.body("robot/wrist").xpos)


def test_limits_match_the_file(robot):
    np.testing.assert_allclose(robot.lower, np.deg2rad([-150, -100, 0, -170, -30, -170]))
    np.testing.assert_allclose(robot.upper, np.deg2rad([150, 100, 160, 170, 130, 170]))
    np.testing.assert_allclose(robot.speed, [1, 1, 1, 2, 2, 2])
    assert robot.stroke == pytest.approx(0.08)
    assert robot.action_low.shape == (7,)


def test_start_pose_is_the_common_one(robot, model):
    data = at(model, robot.home)
    np.testing.assert_allclose(data.site("tcp").xpos, [0.34, 0, 0.18], atol=1e-3)
    x, y, z = data.site("tcp").xmat.reshape(3, 3).T
    assert abs(y[1]) > 0.999
    assert np.arccos(-z[2]) == pytest.approx(robot.lean, abs=0.01)
    assert x[0] < 0
    assert robot.home[2] > 0.5  # as in the keyframe


@pytest.mark.parametrize("name", mostly_slow(["piper", "panda"], ["piper"]))
def test_lean_and_tilt_of_our_robots_are_recovered(name):
    known = getattr(robots, name).ROBOT
    turned = known.tool @ robots.rotation("z", np.pi)
    found = mjcf.posing.complete(dataclasses.replace(known, tool=turned, lean=0.5, tilt_side=0))
    assert found.lean == pytest.approx(known.lean, abs=0.1)
    assert found.tilt_side == known.tilt_side
    np.testing.assert_allclose(found.tool, known.tool, atol=1e-6)


def test_scene_keeps_only_the_arm(model):
    names = [model.body(i).name for i in range(model.nbody)]
    assert names[1:3] == ["base", "robot/column"]
    assert "button" in names
    assert not any("ball" in name for name in names)
    assert (model.nlight, model.opt.timestep, model.opt.cone) == (2, scene.PHYSICS_DT, 0)
    assert (model.nkey, model.nsensor, model.ntendon, model.neq) == (0, 0, 0, 1)
    joints = [model.joint(i).name for i in range(8)]
    assert joints == [*(f"robot/{name}" for name in JOINTS), "left", "right"]
    np.testing.assert_allclose(model.jnt_range[6:8], [[0, 0.04]] * 2, atol=1e-9)
    assert model.body("robot/lower").mass == pytest.approx(
        200 * np.pi * 0.03**2 * (0.2 + 0.04), rel=1e-6
    )


def test_only_fingers_collide(model):
    touching = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    robot = [i for i in touching if model.body(model.geom_bodyid[i]).name in ("robot/a", "robot/b")]
    masks = [(model.geom_contype[i], model.geom_conaffinity[i]) for i in robot]
    assert masks == [(0, 5), (2, 0)] * 2  # a pad and a tip each
    others = {model.body(model.geom_bodyid[i]).name for i in touching} - {"robot/a", "robot/b"}
    assert others == {"world", "cap"}


@pytest.mark.parametrize("opening", [0.0, 0.03, 0.08])
def test_opening_is_the_gap_between_the_pads(robot, model, opening):
    data = at(model, robot.home, opening)
    tcp, axes = data.site("tcp").xpos, data.site("tcp").xmat.reshape(3, 3)
    kinds = model.geom_conaffinity == 5, model.geom_contype == 2
    pads, tips = ((data.geom_xpos[kind] - tcp) @ axes for kind in kinds)
    size = model.geom_size[kinds[0]]
    np.testing.assert_allclose(np.sort(size, axis=0), [[0.01, 0.005, 0.025]] * 2, atol=1e-6)
    np.testing.assert_allclose(np.abs(pads[:, 1]) - size[:, 1], opening / 2, atol=1e-6)
    np.testing.assert_allclose((pads + size)[:, 2], robots.TIP_LENGTH, atol=1e-6)
    assert pads[0, 1] * pads[1, 1] <= 0
    np.testing.assert_allclose(tips[:, 2], robots.TIP_LENGTH - robots.TIP_RADIUS, atol=1e-6)


def test_actuators_reach_their_targets(robot, model):
    data = at(model, robot.home)
    data.ctrl[:] = np.append(robot.home, robot.stroke / 2)
    for _ in range(300):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos[:6], robot.home, atol=2e-3)
    np.testing.assert_allclose(data.qpos[6:8], robot.stroke / 2, atol=1e-3)
    gripper = model.actuator("gripper")
    # Half the opening moves the tendon by as much: coefficients .5 and -.5, opposite joints.
    np.testing.assert_allclose(gripper.gainprm[0], 400)
    np.testing.assert_allclose(gripper.biasprm[:3], [0, -400, -20])
    np.testing.assert_allclose(gripper.forcerange, [-15, 15])
    np.testing.assert_allclose(model.actuator("robot/yaw").gainprm[0], 150)


@pytest.mark.slow
def test_hand_is_found_without_a_site(file, robot):
    found = mjcf.load(str(file))
    assert (found.name, found.lean, found.tilt_side) == (str(file), robot.lean, robot.tilt_side)
    for name in ("chain", "tool", "home"):
        np.testing.assert_allclose(getattr(found, name), getattr(robot, name), atol=1e-5)


def test_own_wrist_camera_is_kept(tmp_path):
    camera = '<camera name="wrist" pos=".05 0 .1" fovy="33"/><site name="grip"'
    robot = mjcf.load(write(tmp_path, ('<site name="grip"', camera)))
    model = scene.build(press.TASK.scene, robot)
    assert model.camera("wrist").fovy[0] == 33
    assert model.body(model.camera("wrist").bodyid[0]).name == "robot/flange"


def built(folder: Path, *edits: tuple[str, str]) -> mujoco.MjModel:
    return scene.build(press.TASK.scene, mjcf.load(write(folder, *edits)))


def test_names_of_the_scene_may_be_used(tmp_path):
    edits = [(f'"{old}"', f'"{new}"') for old, new in zip("ab", ("right", "left"), strict=True)]
    edits += [('"upper"', '"base"'), ('"lower"', '"button"'), ('"yaw"', '"gripper"')]
    edits += [('"column"', '"hand"'), ('"blue"', '"table"'), ('"shell"', '"squares"')]
    edits += [('name="elbow" axis', 'name="tcp" axis'), ('"elbow"', '"tcp"')]
    camera = '<camera name="side" mode="targetbody" target="hand"/><site name="askew"'
    model = built(tmp_path, *edits, ('<site name="askew"', camera))
    names = [model.joint(i).name for i in range(8)]
    assert names[:3] == ["robot/gripper", "robot/shoulder", "robot/tcp"]
    assert names[6:] == ["left", "right"]
    target = model.cam_targetbodyid[model.camera("robot/side").id]
    assert model.body(target).name == "robot/hand"


def test_a_hinge_named_left_and_unnamed_parts(tmp_path):
    edits = [('<body name="column"', "<body"), ('"shoulder"', '"left"')]
    edits += [('joint name="b"', 'joint name="number 8"'), ('joint="b"', 'joint="number 8"')]
    model = built(tmp_path, *edits, ('joint2="b"', 'joint2="number 8"'))
    assert model.joint("robot/left").id == 1
    assert model.actuator("robot/left").trnid[0] == 1
    assert model.actuator("gripper").trnid[0] == model.joint("left").id == 6


def test_small_meshes_are_not_drawn(tmp_path):
    model = built(tmp_path, ('name="shell"', 'name="shell" scale=".05 .05 .05"'))
    assert np.sum(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) == 1
    drawn = build(model, ["side"]).geoms
    assert not np.any(model.geom_type[list(drawn)] == mujoco.mjtGeom.mjGEOM_MESH)


def test_a_carriage_that_reaches_over_the_middle_is_no_finger(tmp_path, robot):
    """The fingers open as far as their ends do; the pads are at the ends."""

    def mesh(name, y, over):
        pad = itertools.product((-0.01, 0.01), (y - 0.004, y + 0.004), (0.012, 0.05))
        carriage = itertools.product((-0.01, 0.01), (y, over), (0, 0.012))
        vertices = " ".join(f"{x:g}" for point in (*pad, *carriage) for x in point)
        return f'<mesh name="{name}" vertex="{vertices}"/>'

    meshes = mesh("hook_a", -0.001, -0.06) + mesh("hook_b", 0.001, 0.06)
    box = 'type="box" size=".01 .004 .025" pos="0 {} .025"'
    edits = [
        (box.format(y), f'type="mesh" mesh="hook_{n}"') for n, y in (("a", -0.001), ("b", 0.001))
    ]
    found = mjcf.load(write(tmp_path, *edits, ("<asset>", f"<asset>{meshes}")), tcp="grip")
    assert found.stroke == pytest.approx(robot.stroke, abs=1e-6)
    np.testing.assert_allclose(found.tool, robot.tool, atol=1e-6)
    model = scene.build(press.TASK.scene, found)
    data = at(model, found.home, opening=0.03)
    tcp, axes = data.site("tcp").xpos, data.site("tcp").xmat.reshape(3, 3)
    kind = model.geom_conaffinity == 5
    pads, size = (data.geom_xpos[kind] - tcp) @ axes, model.geom_size[kind]
    np.testing.assert_allclose(np.abs(pads[:, 1]) - size[:, 1], 0.015, atol=1e-6)
    np.testing.assert_allclose(np.abs(pads[:, 2]) + size.max(axis=1), robots.TIP_LENGTH, atol=1e-6)


@pytest.mark.slow
def test_limits_include_those_of_the_actuators(tmp_path):
    edit = ('<position name="yaw" joint="yaw"', '<position name="yaw" joint="yaw" ctrlrange="-1 9"')
    robot = mjcf.load(write(tmp_path, edit))
    assert (robot.lower[0], robot.upper[0]) == pytest.approx((-1, np.deg2rad(150)))


def test_a_tendon_may_drive_a_hinge(tmp_path):
    edits = (
        ("</tendon>", '<fixed name="belt"><joint joint="yaw" coef="2"/></fixed></tendon>'),
        (
            '<position name="yaw" joint="yaw"/>',
            '<general tendon="belt" ctrlrange="-3 3" biastype="affine" gainprm="100"'
            ' biasprm="0 -50 -4"/>',
        ),
    )
    model = built(tmp_path, *edits)
    assert model.actuator("robot/yaw").gear[0] == 2
    np.testing.assert_allclose(model.actuator("robot/yaw").biasprm[:3], [0, -50, -4])


def test_colors_move_to_the_geoms(tmp_path):
    geoms = '<default class="robot"><geom contype="1"'
    model = built(tmp_path, (geoms, f'{geoms} material="blue"'))
    arm = model.body_rootid[model.geom_bodyid] == model.body("base").id
    assert np.all(model.geom_matid[arm] < 0)
    drawn = arm & (model.geom_rgba[:, 3] > 0)
    assert np.sum(np.all(np.isclose(model.geom_rgba[drawn], [0.1, 0.2, 0.9, 1]), axis=1)) == 8


def test_ray_caster_draws_primitives_in_place_of_a_mesh(robot, model):
    mesh = next(i for i in range(model.ngeom) if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH)
    drawn = build(model, ["side", "wrist"])
    assert mesh not in drawn.geoms
    (stand_in,) = np.flatnonzero(model.geom_group == 5)
    assert stand_in in drawn.geoms
    np.testing.assert_allclose(drawn.appearance.rgba[stand_in], [0.1, 0.2, 0.9, 1])
    data = at(model, np.array([0.0, 0.9, 1.2, 0, 0.6, 0]))
    points = np.random.default_rng(0).uniform(-1.3, 1.3, (4000, 3)) * HALF
    inside = np.abs(points) < HALF
    world = data.geom_xpos[mesh] + points @ _mesh_axes(model, data, mesh).T
    local = (world - data.geom_xpos[stand_in]) @ data.geom_xmat[stand_in].reshape(3, 3)
    same = np.all(np.abs(local) < model.geom_size[stand_in], axis=1) == inside.all(axis=1)
    assert same.mean() > 0.97


def _mesh_axes(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Return the axes, in the world, of the coordinates in the mesh file."""
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[model.geom_dataid[geom]])
    return data.geom_xmat[geom].reshape(3, 3) @ turn.reshape(3, 3).T


@pytest.mark.slow
def test_steps_and_images(robot):
    env = envs.make("press", robot, num_envs=2, image_size=48)
    start = env.reset(jax.random.key(0))
    state = env.step(start, start.info["command"].at[:, 0].add(0.05))
    assert not np.any(state.info["broken"])
    np.testing.assert_allclose(env.proprio(state)[:, 0] - env.proprio(start)[:, 0], 0.05, atol=0.03)
    image = env.observe(state)["image"]["side"]
    blue = (image[..., 2] > 90) & (image[..., 0] < 60)
    assert 5 < blue[0].sum() < 1000
