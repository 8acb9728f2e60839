"""The fake arm's scene: the same layout and pictures as the simulator's, other physics."""

import jax
import numpy as np

from lorasp_jax.extras.piper.fake import world as scenes
from lorasp_jax.extras.piper.fake.world import TIMESTEP


def test_pictures_equal_the_simulators(world):
    """Up to rounding: MuJoCo and the simulator compute the poses in different programs."""
    differences = {name: [] for name in world.env.cameras}
    for seed in range(4):
        world.reset(seed)
        expected = world.env.observe(world.state)["image"]
        for name, image in world.images().items():
            differences[name].append(image.astype(int) - np.asarray(expected[name][0], int))
    for each in differences.values():
        assert np.mean(np.abs(each) > 1) < 0.005  # rounding may move an edge by a pixel


def test_pictures_follow_the_arm(world):
    world.reset(1)
    before = world.images()
    world.command(world.pose + np.array([0.5, 0, 0, 0, 0, 0, 0]))
    world.advance(1.0)
    assert all((image != before[name]).mean() > 0.02 for name, image in world.images().items())


def test_physics_differ_from_training(world):
    world.reset(1)
    own, trained = world.model, world.env.model
    assert own.opt.timestep == TIMESTEP != trained.opt.timestep
    assert (own.actuator_gainprm[:6, 0] > trained.actuator_gainprm[:6, 0]).all()
    assert (own.dof_frictionloss[:6] > 0).all()
    assert (own.geom_friction[:, 0] < trained.geom_friction[:, 0]).all()


def test_the_tasks_own_test_judges(world):
    world.reset(1)
    assert not world.judge()
    tips = world.data.site_xpos[world.model.site("tcp").id]
    button = world.model.body("button").id
    world.model.body_pos[button] = tips - np.array([0, 0, 0.047])  # under the finger tips
    assert not world.judge()
    world.data.qpos[world.model.joint("button").qposadr[0]] = 0.011
    assert world.judge()


def test_seeds_give_layouts(world):
    world.reset(1)
    first = world.data.qpos.copy(), world.model.body_pos.copy()
    world.reset(2)
    assert (world.model.body_pos != first[1]).any()
    world.reset(1)
    np.testing.assert_array_equal(world.data.qpos, first[0])


def test_an_experts_noise_is_not_that_of_the_layout(world, monkeypatch):
    """A plan splits its key into one per world, as a reset does."""
    keys = []
    monkeypatch.setattr(scenes, "_actions", lambda _, __, key: keys.append(key))
    world.reset(3)
    world.demonstration(3)
    plan, layout = (jax.random.split(key, 1) for key in (*keys, jax.random.key(3)))
    assert (jax.random.key_data(plan) != jax.random.key_data(layout)).any()
