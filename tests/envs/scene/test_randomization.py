"""Domain randomization: every range changes the outcome it should, and nothing else."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax import monitoring

import envs
from envs import actions, robots
from envs.experts import collection, expert
from envs.scene import randomization, scene
from envs.scene.ranges import Randomization
from tests.envs.demonstrations import expert_success

WORLDS, STEPS = 2, 50  # the expert lifts the grape at about step 35
FIELDS = [field.name for field in dataclasses.fields(Randomization)]
# Outcomes that each range may change: layout, motion, images.
PLACES, MOTION, LOOKS = {"position", "turn"}, {"mass", "friction", "gains", "latency"}, {
    "camera_position", "camera_turn", "field_of_view", "light_turn", "brightness", "colour",
}  # fmt: skip
FIXED = {
    "position": 0.01, "turn": 0.3, "size": 1.1, "mass": 3.0, "friction": 0.5, "gains": 0.6,
    "camera_position": 0.02, "camera_turn": 0.1, "field_of_view": 5.0, "light_turn": 0.5,
    "brightness": 0.5, "colour": 0.2, "latency": 0.04, "table_height": 0.03,
}  # fmt: skip


@pytest.fixture(scope="module")
def env():
    return envs.make("pick_place", "piper", num_envs=WORLDS, image_size=24, backend="jax")


@pytest.fixture(scope="module")
def episode(env):
    """Return a function: ranges -> start, its images, the state after some expert steps."""

    @jax.jit
    def run(key, ranges):
        start = env.reset(key, ranges)
        plan = expert.plan(env, start, key)

        def body(state, _):
            return env.step(state, expert.act(env, plan, state)), None

        return start, env.observe(start), jax.lax.scan(body, start, length=STEPS)[0]

    return lambda **ranges: run(jax.random.key(5), Randomization(**ranges))


@pytest.fixture(scope="module")
def neutral(episode):
    return episode()


def exactly(name):
    return {name: (FIXED[name], FIXED[name])}


def equal(a, b):
    return all(map(np.array_equal, jax.tree.leaves(a), jax.tree.leaves(b)))


@pytest.mark.slow
def test_defaults_change_nothing(env, neutral):
    start, seen, _ = neutral
    plain = env.reset(jax.random.key(5))
    np.testing.assert_allclose(start.data.qpos, plain.data.qpos, atol=1e-7)
    np.testing.assert_allclose(start.data.cam_xmat, plain.data.cam_xmat, atol=1e-6)
    for name, image in env.observe(plain)["image"].items():
        assert np.mean(image != seen["image"][name]) < 0.002  # rounding at edges


@pytest.mark.slow
@pytest.mark.parametrize("name", FIELDS)
def test_a_range_changes_only_its_own_outcome(episode, neutral, name):
    (start, seen, end), (start0, seen0, end0) = episode(**exactly(name)), neutral
    assert not equal(end.data.qpos, end0.data.qpos) or name in LOOKS
    assert equal(start.info["command"], start0.info["command"])
    assert equal(start.info["instruction"], start0.info["instruction"])
    if name in LOOKS:
        assert equal(end.data.qpos, end0.data.qpos)
    if name in LOOKS | PLACES | {"size", "table_height"}:
        assert not equal(seen["image"]["side"], seen0["image"]["side"])
    if name in MOTION:
        assert equal(seen, seen0)
        assert equal(start.data, start0.data)
    drawn, drawn0 = start.info["draw"], start0.info["draw"]
    for field in dataclasses.fields(drawn):
        same = equal(getattr(drawn, field.name), getattr(drawn0, field.name))
        assert same == (field.name != name)
    assert not bool(end.info["broken"].any())


@pytest.mark.slow
def test_objects_are_moved_rotated_and_scaled(episode, neutral):
    layout0 = neutral[0].info["layout"]
    for name, change in (
        ("position", lambda p: p + np.array([0.01, 0.01, 0, 0])),
        ("turn", lambda p: p + np.array([0, 0, 0, 0.3])),
        ("size", lambda p: p * np.array([1, 1, 1.1, 1])),
    ):
        layout = episode(**exactly(name))[0].info["layout"]
        for body, place in layout.items():
            np.testing.assert_allclose(place, change(np.asarray(layout0[body])), atol=1e-6)


@pytest.mark.slow
def test_cameras_move_along_and_about_their_axes(env, episode, neutral):
    data0 = neutral[0].data
    data = episode(**exactly("camera_position"))[0].data
    shift = np.einsum("wnij,j->wni", data0.cam_xmat, np.full(3, 0.02))
    np.testing.assert_allclose(data.cam_xpos, data0.cam_xpos + shift, atol=1e-6)
    data = episode(**exactly("camera_turn"))[0].data
    relative = np.einsum("wnji,wnjk->wnik", data0.cam_xmat, data.cam_xmat)
    angle = np.arccos((np.trace(relative, axis1=-2, axis2=-1) - 1) / 2)
    np.testing.assert_allclose(angle, 0.1 * np.sqrt(3), atol=1e-4)


def test_a_higher_table_is_a_lower_robot(env):
    """Objects and the side camera stay; the robot moves with its wrist camera."""
    layout = env.task.place(jax.random.key(0))

    @jax.jit
    def start(height):
        ranges = Randomization(table_height=(height, height))
        draw, placed = randomization.draw(jax.random.key(1), ranges, env.model, layout)
        return env._start(draw, placed, jnp.append(jnp.asarray(env.robot.home), 0.04)), placed

    poses, placed = zip(start(0.0), start(0.03), strict=True)
    assert all(equal(found, layout) for found in placed)
    moved = {name: np.asarray(getattr(poses[1], name) - getattr(poses[0], name)) for name in (
        "geom_xpos", "cam_xpos", "cam_xmat", "geom_xmat"
    )}  # fmt: skip
    robot = randomization.in_subtrees(env.model, [robots.BASE])
    lowered = np.where(robot[env.model.geom_bodyid][:, None], [0, 0, -0.03], 0)
    np.testing.assert_allclose(moved["geom_xpos"], lowered, atol=1e-6)
    np.testing.assert_allclose(moved["cam_xpos"], [[0, 0, 0], [0, 0, -0.03]], atol=1e-6)
    assert not moved["geom_xmat"].any()
    assert not moved["cam_xmat"].any()


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("height", [-0.04, 0.04])
def test_experts_succeed_at_other_table_heights(task_name, robot_name, height):
    ranges = Randomization(table_height=(height, height))
    success = expert_success(task_name, robot_name, num_episodes=32, num_envs=32, ranges=ranges)
    assert success.mean() >= 0.95


@pytest.mark.slow
def test_brightness_scales_the_images(episode, neutral):
    bright, dark = (e[1]["image"]["side"].mean() for e in (neutral, episode(brightness=(0.5, 0.5))))
    assert dark / bright == pytest.approx(0.5, abs=0.03)


def test_latency_delays_targets():
    commands = jnp.array([[0.0, 0.02], [0.1, 0.04], [0.3, 0.0]])
    now, late = (np.asarray(actions.interpolate(commands, 0.1, x)) for x in (0.0, 0.04))
    np.testing.assert_array_equal(late[8:], now[:-8])  # 8 physics steps of 5 ms
    np.testing.assert_allclose(now[[0, -1]], [[0.14, 0.016], [0.3, 0.0]], atol=1e-6)
    np.testing.assert_allclose(late[0], [0.08, 0.018], atol=1e-6)
    last = np.asarray(actions.interpolate(commands, 0.1, 0.1))
    np.testing.assert_allclose(last[-1], [0.1, 0.02], atol=1e-6)


@pytest.mark.slow  # a scene of its own to compile
def test_recorded_images_match_each_world(env):
    ranges, key = Randomization.typical(), jax.random.key(3)
    recorded, _ = collection.record_expert(env, key, 0.0, ranges)
    start = env.reset(jax.random.split(key, 3)[0], ranges)
    for name, image in env.observe(start)["image"].items():
        np.testing.assert_allclose(recorded["image"][name][:, 0], image, atol=1)


@pytest.mark.slow
def test_worlds_draw_independently(episode):
    draw = episode(mass=(0.5, 2.0), brightness=(0.5, 1.5))[0].info["draw"]
    assert draw.brightness[0] != draw.brightness[1]
    assert np.all((draw.mass >= 0.5) & (draw.mass <= 2.0))
    assert len(np.unique(draw.mass)) == draw.mass.size


@pytest.mark.slow
def test_other_ranges_do_not_recompile(env):
    events = []
    listen = lambda event, *_, **__: events.append(event)  # noqa: E731
    env.reset(jax.random.key(0), Randomization())
    monitoring.register_event_duration_secs_listener(listen)
    env.reset(jax.random.key(1), Randomization(mass=(0.5, 2), latency=(0, 0.1)))
    monitoring.unregister_event_duration_listener(listen)
    assert not [event for event in events if "compile" in event]


@pytest.mark.slow
def test_the_model_matches_one_compiled_by_mujoco(env):
    """Scaled and heavier bodies against a model that MuJoCo compiled with the same changes."""
    draw = jax.tree.map(
        lambda x: x[0], env.reset(jax.random.key(0), Randomization(mass=(2, 2), size=(1.1, 1.1)))
    ).info["draw"]
    found = randomization.changes(draw, env.model, env._objects)
    model = mujoco.MjModel.from_xml_string(scene.mjcf(env.task.scene, env.robot))
    for name in ("geom_size", "geom_pos", "body_pos", "body_ipos", "body_mass", "body_inertia"):
        getattr(model, name)[:] = np.asarray(found[name], np.float64)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    grape = model.body("grape").id
    np.testing.assert_allclose(
        found["body_invweight0"][grape], model.body_invweight0[grape], rtol=1e-4
    )
    assert model.body_mass[grape] == pytest.approx(2 * env.model.body_mass[grape])


def test_changed_ranges():
    assert Randomization().changed() == Randomization(size=(1, 1)).changed() == {}
    changed = {"turn": (0.0, 0.1), "size": (0.9, 1.0)}
    assert Randomization(**changed).changed() == changed


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("mass", bad) for bad in ((2.0, 1.0), 2.0)],
        *[("friction", (0.0, 1.0)), ("position", (-np.inf, 0.0)), ("size", (1.0, 1.5))],
        *[("field_of_view", (-90.0, 0.0)), ("latency", (0.0, 0.2))],
    ],
)
def test_invalid_ranges_raise(env, name, value):
    ranges = Randomization(**{name: value})
    with pytest.raises(ValueError, match=name):
        env.reset(jax.random.key(0), ranges)
    with pytest.raises(ValueError, match=name):
        envs.collect("press", num_episodes=1, key=jax.random.key(0), ranges=ranges)


@pytest.mark.slow
def test_reset_done_needs_the_ranges_of_reset(env):
    key, ranges = jax.random.key(0), Randomization()
    for first, second in ((None, ranges), (ranges, None)):
        with pytest.raises(ValueError, match="ranges"):
            env.reset_done(env.reset(key, first), key, second)
