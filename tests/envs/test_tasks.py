"""Contracts of tasks, and their success checks in MuJoCo's own engine."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs import robots
from envs.experts import expert
from envs.tasks import route
from tests.envs.expert_in_c import measure, world


def succeeds(scene, data) -> bool:
    mujoco.mj_forward(scene.model, data)
    return measure(scene, data)[0]


def reach(scene, data, position, opening: float) -> None:
    """Move the tool, pointing down, to a position."""
    data.qpos[: scene.num_joints] = _solve(scene.robot, np.float32(position))
    data.qpos[scene.num_joints : scene.num_joints + 2] = opening / 2


@functools.partial(jax.jit, static_argnums=0)
def _solve(robot, goal):
    (rotation,) = expert.tool_rotations(robot, route((goal, (0.0, 0.0, 0.0), 0.0, 1.0, 0.0)))
    return robots.inverse_kinematics(robot, goal, rotation, jnp.float32(robot.home))


def test_instructions_are_short_and_several(scene):
    assert len(set(scene.instructions)) >= 4
    assert all(0 < len(text.split()) <= 8 for text in scene.instructions)


RANGES = {  # body -> lowest and highest x, y [m]
    "open_pot": {"pot": ((0.32, 0.06), (0.40, 0.14)), "lid": ((0.32, 0.06), (0.40, 0.14))},
    "pour": {
        "cup": ((0.30, -0.14), (0.36, -0.04)),
        "block": ((0.30, -0.14), (0.36, -0.04)),
        "basket": ((0.34, 0.09), (0.40, 0.15)),
    },
    "press": {"button": ((0.32, -0.04), (0.40, 0.04))},
    "pick_place": {
        "grape": ((0.30, -0.18), (0.42, 0.02)),
        "basket": ((0.325, 0.12), (0.395, 0.19)),
    },
    "two_baskets": {
        "grape": ((0.31, -0.03), (0.41, 0.03)),
        "left_basket": ((0.33, 0.135), (0.39, 0.175)),
        "right_basket": ((0.33, -0.175), (0.39, -0.135)),
    },
}


def test_layouts_fill_their_range(scene, task_name):
    layouts = jax.jit(jax.vmap(scene.task.place))(jax.random.split(jax.random.key(1), 2048))
    assert layouts.keys() == RANGES[task_name].keys()
    for body, (low, high) in RANGES[task_name].items():
        place = np.asarray(layouts[body])[:, :2]
        np.testing.assert_allclose(place.min(axis=0), low, atol=1e-3)
        np.testing.assert_allclose(place.max(axis=0), high, atol=1e-3)
        np.testing.assert_allclose(place.mean(axis=0), np.mean([low, high], axis=0), atol=4e-3)
        assert np.ptp(np.asarray(layouts[body])[:, 2]) == 0


def test_every_layout_is_visible_to_the_side_camera(scene):
    camera = world(scene).camera("side")
    edge = np.tan(np.deg2rad(scene.model.camera("side").fovy[0]) / 2)
    layouts = jax.jit(jax.vmap(scene.task.place))(jax.random.split(jax.random.key(2), 256))
    for place in layouts.values():
        x, y, z = camera.xmat.reshape(3, 3).T @ (np.asarray(place)[:, :3] - camera.xpos).T
        assert np.all(z < 0)
        assert np.abs(np.stack([x, y]) / z / edge).max() < 0.95  # 1 is the picture's border


def test_nothing_moves_or_succeeds_by_itself(scene):
    data = world(scene)
    before = data.xpos.copy()
    data.ctrl[: scene.num_joints] = scene.robot.home
    for _ in range(400):
        mujoco.mj_step(scene.model, data)
        assert not measure(scene, data)[0]
    np.testing.assert_allclose(data.xpos, before, atol=3e-3)


def test_few_contacts_are_computed(scene):
    """Every admitted pair costs time at every step, so only necessary ones are admitted."""
    geoms = scene.model.ngeom
    con = scene.model.geom_contype, scene.model.geom_conaffinity
    pairs = sum(
        bool((con[0][i] & con[1][j]) | (con[0][j] & con[1][i]))
        for i in range(geoms)
        for j in range(i)
    )
    assert 0 < pairs <= 36
    colliding = (con[0] > 0) | (con[1] > 0)
    kinds = {mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_SPHERE}
    kinds |= {mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE}
    assert set(scene.model.geom_type[colliding]) <= {int(kind) for kind in kinds}


@pytest.mark.parametrize("task_name", ["press"])
class TestPress:
    def press(self, scene, depth: float, height: float = 0.0, aside: float = 0.0) -> bool:
        """Press the button (.040 m high) by `depth`, with the tips `height` above and `aside`."""
        data = world(scene)
        button = data.body("button").xpos
        reach(scene, data, button + np.array([aside, 0, 0.0515 - depth + height]), 0.0)
        data.joint("button").qpos[0] = depth
        return succeeds(scene, data)

    def test_pressed_by_the_robot(self, scene):
        assert self.press(scene, 0.0095)

    def test_not_far_enough(self, scene):
        assert not self.press(scene, 0.0085)

    def test_not_by_the_robot(self, scene):
        assert not self.press(scene, 0.0095, height=0.03)
        assert not self.press(scene, 0.0095, aside=0.05)


@pytest.mark.parametrize("task_name", ["pick_place"])
class TestPickPlace:
    def drop(self, scene, offset=(0, 0, 0.019), speed: float = 0.0) -> mujoco.MjData:
        """Place the grape at an offset [m] from the basket, the robot at home."""
        data = world(scene)
        data.joint("grape").qpos[:3] = data.body("basket").xpos + offset
        data.joint("grape").qvel[0] = speed
        return data

    def test_at_rest_inside(self, scene):
        assert succeeds(scene, self.drop(scene))
        assert succeeds(scene, self.drop(scene, (0.03, -0.03, 0.019)))

    @pytest.mark.parametrize("offset", [(0.08, 0, 0.015), (0, -0.08, 0.015), (0, 0, 0.1)])
    def test_outside(self, scene, offset):
        assert not succeeds(scene, self.drop(scene, offset))

    def test_moving(self, scene):
        assert not succeeds(scene, self.drop(scene, speed=0.1))

    @pytest.mark.parametrize(("opening", "done"), [(0.029, False), (0.05, True)])
    def test_released(self, scene, opening, done):
        """A grape in the basket but between the fingers counts only once released."""
        data = self.drop(scene)
        reach(scene, data, data.joint("grape").qpos[:3], opening)
        assert succeeds(scene, data) is done

    def test_retracted_hand_may_close(self, scene):
        data = self.drop(scene)
        reach(scene, data, data.joint("grape").qpos[:3] + np.array([0, 0, 0.08]), 0.0)
        assert succeeds(scene, data)


@pytest.mark.parametrize("task_name", ["open_pot"])
class TestOpenPot:
    def put(self, scene, offset, *, speed: float = 0.0, turn=(1, 0, 0, 0)) -> mujoco.MjData:
        """Place the lid at an offset [m] from the pot, the robot at home."""
        data = world(scene)
        data.joint("lid").qpos[:3] = data.body("pot").xpos + offset
        data.joint("lid").qpos[3:] = turn
        data.joint("lid").qvel[1] = speed
        return data

    def test_beside_the_pot(self, scene):
        assert succeeds(scene, self.put(scene, (0, -0.17, 0)))
        assert succeeds(scene, self.put(scene, (0, -0.14, 0)))

    @pytest.mark.parametrize("offset", [(0, 0, 0.055), (0, -0.1, 0), (0, -0.17, 0.05)])
    def test_on_the_pot_or_leaning_or_held(self, scene, offset):
        assert not succeeds(scene, self.put(scene, offset))

    def test_not_if_knocked_off(self, scene):
        """Upside down, or on its edge, or still sliding."""
        assert not succeeds(scene, self.put(scene, (0, -0.17, 0), turn=(0, 1, 0, 0)))
        assert not succeeds(scene, self.put(scene, (0, -0.17, 0), turn=(0.9, 0.436, 0, 0)))
        assert not succeeds(scene, self.put(scene, (0, -0.17, 0), speed=0.1))

    @pytest.mark.parametrize(("opening", "done"), [(0.019, False), (0.05, True)])
    def test_released(self, scene, opening, done):
        data = self.put(scene, (0, -0.17, 0))
        reach(scene, data, data.joint("lid").qpos[:3] + np.array([0, 0, 0.03]), opening)
        assert succeeds(scene, data) is done


@pytest.mark.parametrize("task_name", ["pour"])
class TestPour:
    def poured(self, scene, block=(0, 0, 0.014), cup=(0, 0, 0), turn=(1, 0, 0, 0)):
        """Place the block at an offset [m] from the basket; move and rotate the cup."""
        data = world(scene)
        data.joint("block").qpos[:3] = data.body("basket").xpos + block
        data.joint("cup").qpos[:3] += cup
        data.joint("cup").qpos[3:] = turn
        return data

    def test_block_in_the_basket_and_cup_upright(self, scene):
        assert succeeds(scene, self.poured(scene))
        assert succeeds(scene, self.poured(scene, (-0.035, 0.035, 0.014), (0.05, 0.02, 0)))

    @pytest.mark.parametrize("offset", [(0.09, 0, 0.01), (0, 0, 0.1)])
    def test_block_elsewhere(self, scene, offset):
        assert not succeeds(scene, self.poured(scene, offset))

    def test_cup_has_to_stand(self, scene):
        lying = (0.7071, 0, 0.7071, 0)
        assert not succeeds(scene, self.poured(scene, cup=(0, 0, 0.02), turn=lying))
        assert not succeeds(scene, self.poured(scene, cup=(0, 0, 0.05)))

    @pytest.mark.parametrize(("opening", "done"), [(0.047, False), (0.066, True)])
    def test_released(self, scene, opening, done):
        data = self.poured(scene)
        reach(scene, data, data.joint("cup").qpos[:3] + np.array([0, 0, 0.033]), opening)
        assert succeeds(scene, data) is done
