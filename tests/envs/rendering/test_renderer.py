"""Compare the ray caster with MuJoCo's rays; light and colors change nothing else."""

import copy
import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.rendering import intersections, renderer, shading
from envs.rendering.model import build
from envs.state import Poses
from tests.envs.test_tasks import world

SCENE = """
<mujoco>
  <worldbody>
    <light dir="0 -.6 -1"/>
    <geom name="table" type="plane" size="0 0 1" rgba=".6 .6 .6 1"/>
    <geom name="shelf" type="plane" size=".1 .06 1" pos="-.2 .2 .2" euler="10 20 30"/>
    <geom name="ball" type="sphere" size=".06" pos="0 0 .1" rgba="1 0 0 1"/>
    <geom name="egg" type="ellipsoid" size=".03 .05 .08" pos=".2 .1 .1" euler="40 10 70"/>
    <geom name="rod" type="capsule" size=".02 .1" pos="-.2 -.1 .1" euler="50 20 0"/>
    <geom name="post" type="capsule" size=".03 .05" pos="-.1 .1 .08"/>
    <geom name="can" type="cylinder" size=".05 .04" pos=".15 -.15 .1" euler="30 40 0"/>
    <geom name="tin" type="cylinder" size=".04 .03" pos=".05 .2 .03"/>
    <geom name="brick" type="box" size=".03 .05 .04" pos="0 -.2 .1" euler="20 30 40"/>
    <geom name="block" type="box" size=".03 .04 .02" pos=".25 -.05 .02"/>
    <geom name="ghost" type="sphere" size=".1" pos="0 0 .3" rgba="1 1 1 0"/>
    <geom name="hidden" type="sphere" size=".1" pos="0 0 .3" group="3"/>
    <camera name="unused" pos="0 0 3"/>
    <camera name="front" pos="0 -.8 .35" xyaxes="1 0 0 0 .3 .95" fovy="55"/>
    <camera name="top" pos=".1 .05 .9" xyaxes=".9 .1 0 -.1 .9 .1" fovy="60"/>
  </worldbody>
</mujoco>
"""
CAMERAS = ("front", "top")
SIZE, EDGE = {"height": 48, "width": 64}, 48
FLAT = np.array([0.1, 0.0], np.float32)  # a checker without contrast
GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)  # drawn


def poses_of(data):
    """Return the poses of all geoms and cameras, for `render.render`."""
    arrays = Poses.of(data)
    ends = ((-1, 3), (-1, 3, 3)) * 2
    return Poses(
        *(jnp.asarray(x.reshape(s), jnp.float32) for x, s in zip(arrays, ends, strict=True))
    )


@pytest.fixture(scope="module")
def shapes():
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture(scope="module")
def built(shapes):
    return build(shapes[0], CAMERAS)


@pytest.fixture(scope="module")
def poses(shapes):
    return poses_of(shapes[1])


@pytest.fixture(scope="module")
def image(built, poses):
    return np.asarray(renderer.render(built, poses, appearance=built.appearance, **SIZE))


@functools.partial(jax.jit, static_argnames=("height", "width"))
def cast(model, poses, *, height, width):
    """Return the geom's id, -1 for none, and the depth [m] of each pixel, `[K, height, width]`."""
    raster = shading.Raster(height, width, samples=1)

    def first_hit(geoms, view):
        x, y = shading.slopes(view, raster, jnp.arange(height * width, dtype=jnp.int32))
        number, depth = intersections.nearest(renderer._table(geoms), model.kinds, x, y)
        geom = jnp.where(jnp.isfinite(depth), jnp.array(model.geoms, jnp.int32)[number], -1)
        return geom.reshape(height, width), depth.reshape(height, width)

    frames = renderer._in_camera_frames(model, model.appearance, model.size, poses, height)
    return jax.vmap(first_hit)(*frames)


def camera_rays(model, data, name, height, width):
    """Unit vectors [P, 3] in world axes, and the ray length per meter along the camera's axis."""
    camera = model.camera(name).id
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, height / 2 - np.arange(height) - 0.5)
    edge = 2 * np.tan(np.deg2rad(model.cam_fovy[camera]) / 2) / height
    rays = np.stack([x * edge, y * edge, -np.ones_like(x)], -1).reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    return rays / length[:, None] @ data.cam_xmat[camera].reshape(3, 3).T, length


def assert_agrees_with_mujoco(model, data, name, geom, depth):
    """Compare what a camera sees with MuJoCo's own rays; returns the geoms that it sees.

    Both draw a plane as large as its size, without end where that is 0, and only from above.
    """
    rays, length = camera_rays(model, data, name, *geom.shape)
    eye, geom, depth = data.camera(name).xpos, np.asarray(geom).ravel(), np.asarray(depth).ravel()
    expected, distance = np.full(len(rays), -1, np.int32), np.full(len(rays), -1.0)
    mujoco.mj_multiRay(
        model, data, eye, rays.ravel(), GROUPS, 1, -1, expected, distance, None, len(rays),
        mujoco.mjMAXVAL,
    )  # fmt: skip
    same = geom == expected
    assert same.mean() >= 0.99
    hit = same & (geom >= 0)
    np.testing.assert_allclose(depth[hit], (distance / length)[hit], rtol=0, atol=1e-3)
    assert np.all(np.isinf(depth[same & (geom < 0)]))
    # mj_multiRay rules geoms out by bounds first and loses a few rays at the edges of boxes; mj_ray
    # tries every geom, and leaves only pixels where two surfaces meet.
    single = np.array([-1], np.int32)
    wrong = 0
    for i in np.flatnonzero(~same):
        mujoco.mj_ray(model, data, eye, rays[i], GROUPS, 1, -1, single)
        wrong += single[0] != geom[i]
    assert wrong <= 1e-4 * len(rays)
    return set(expected.tolist())


def test_rays_agree_with_mujoco(shapes, built, poses):
    geom, depth = cast(built, poses, height=128, width=128)
    assert geom.shape == depth.shape == (2, 128, 128)
    assert geom.dtype == jnp.int32
    assert depth.dtype == jnp.float32
    seen = set()
    for i, name in enumerate(CAMERAS):
        seen |= assert_agrees_with_mujoco(*shapes, name, geom[i], depth[i])
    assert seen == set(range(10)) | {-1}  # every visible geom and the sky are covered


def test_rays_agree_with_mujoco_in_every_task(scene):
    data = world(scene)
    geom, depth = cast(scene.render_model, poses_of(data), height=128, width=128)
    for i, name in enumerate(scene.cameras):
        seen = assert_agrees_with_mujoco(scene.model, data, name, geom[i], depth[i])
        assert len(seen) > 5  # the table, the gripper or the arm, and something to handle


def pixel(shapes, name, point):
    """Row and column of a world point in an image of SIZE."""
    model, data = shapes
    camera = model.camera(name).id
    x, y, z = data.cam_xmat[camera].reshape(3, 3).T @ (np.array(point) - data.cam_xpos[camera])
    edge = 2 * np.tan(np.deg2rad(model.cam_fovy[camera]) / 2) / SIZE["height"]
    return int(SIZE["height"] / 2 + y / z / edge), int(SIZE["width"] / 2 - x / z / edge)


def test_shadow_falls_opposite_the_light(shapes, built, poses):
    flat = dataclasses.replace(built.appearance, checker=FLAT)
    # The ball's center is 0.1 m above the table, so its shadow is centered 0.15 m to one side.
    left, right = (pixel(shapes, "top", (x, 0.0, 0.0)) for x in (-0.15, 0.15))
    for slope, dark, bright in ((1.5, left, right), (-1.5, right, left)):
        light = np.array([slope, 0.0, 1.0], np.float32)
        appearance = dataclasses.replace(flat, light=light)
        top = renderer.render(built, poses, appearance=appearance, **SIZE)[1].astype(int)
        assert top[bright].sum() > top[dark].sum() + 100


def test_headlight_and_ambient_cast_no_shadow(built, poses):
    dim = dataclasses.replace(
        built.appearance,
        diffuse=np.float32(0),
        headlight=np.float32(0),
        checker=FLAT,
    )
    geom, _ = cast(built, poses, **SIZE)
    pixels = np.asarray(renderer.render(built, poses, appearance=dim, **SIZE))[
        np.asarray(geom) == 0
    ]
    np.testing.assert_array_equal(pixels, np.broadcast_to(pixels[0], pixels.shape))
    assert pixels[0, 0] == round(0.6 * 0.35 * 255)


def test_color_changes_only_its_geom(built, poses, image):
    geom = np.asarray(cast(built, poses, **SIZE)[0])
    green = built.appearance.rgba.copy()
    green[2] = (0, 1, 0, 1)
    appearance = dataclasses.replace(built.appearance, rgba=green)
    changed = np.any(
        np.asarray(renderer.render(built, poses, appearance=appearance, **SIZE)) != image, -1
    )
    np.testing.assert_array_equal(changed, geom == 2)


def test_field_of_view_changes_only_its_camera(built, poses, image):
    appearance = dataclasses.replace(
        built.appearance, fovy=built.appearance.fovy + np.array([0, 10, 0], np.float32)
    )
    images = np.asarray(renderer.render(built, poses, appearance=appearance, **SIZE))
    assert np.any(images[0] != image[0])
    np.testing.assert_array_equal(images[1], image[1])


def test_batch_equals_single_worlds(built, poses):
    worlds = 5
    batch = Poses(*(np.repeat(np.asarray(x)[None], worlds, axis=0) for x in poses))
    batch.geom_xpos[:, 2, 0] += 0.01 * np.arange(worlds, dtype=np.float32)
    looks = jax.tree.map(lambda x: np.stack([x * 0.8, *[x] * (worlds - 1)]), built.appearance)
    images = np.asarray(jax.jit(renderer.RayRenderer(built, EDGE, 1))(batch, looks, None))
    assert images.shape == (worlds, 2, EDGE, EDGE, 3)
    assert images.dtype == np.uint8
    for i in range(worlds):
        appearance = jax.tree.map(lambda x, i=i: x[i], looks)
        own = Poses(*(x[i] for x in batch))
        single = renderer.render(built, own, appearance=appearance, height=EDGE, width=EDGE)
        difference = np.abs(images[i].astype(int) - single.astype(int))
        assert np.mean(difference > 1) < 1e-3  # rounding may move an edge by a pixel


@pytest.mark.slow
def test_sizes_differ_from_world_to_world(shapes, built, poses):
    size = np.stack([built.size, built.size * 1.5, built.size])
    size[2, :, 1] *= 0.5  # half the length of capsules and cylinders, other boxes and ellipsoids
    batch = Poses(*(jnp.tile(x, (len(size), *[1] * x.ndim)) for x in poses))
    images = renderer.RayRenderer(built, EDGE, 1)(batch, None, size)
    for own, found in zip(size, images, strict=True):
        model = copy.copy(shapes[0])
        model.geom_size[:] = own
        expected = renderer.render(build(model, CAMERAS), poses, height=EDGE, width=EDGE)
        difference = np.abs(found.astype(int) - expected.astype(int))
        assert np.mean(difference > 1) < 1e-3  # rounding may move an edge by a pixel
    assert np.mean(images[0] != images[1]) > 0.05
    assert np.mean(images[0] != images[2]) > 0.02


@pytest.mark.parametrize("diffuse", [0.5, 1.5])  # 1.5 overexposes a third of the image
def test_samples_equal_a_larger_image_scaled_down(built, poses, diffuse):
    appearance = dataclasses.replace(built.appearance, diffuse=np.float32(diffuse))
    height, width = SIZE.values()
    fine = renderer.render(built, poses, appearance=appearance, height=2 * height, width=2 * width)
    expected = np.asarray(fine, float).reshape(2, height, 2, width, 2, 3).mean(axis=(2, 4))
    smooth = renderer.render(built, poses, appearance=appearance, samples=2, **SIZE)
    assert smooth.shape == expected.shape
    assert smooth.dtype == jnp.uint8
    # Both are rounded; where two geoms meet, rounding may turn a ray from one to the other.
    assert np.mean(np.abs(smooth.astype(float) - expected) > 1) < 1e-3


def test_memory_does_not_grow_with_the_samples():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom size=".1"/><camera name="c" pos="0 0 1"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def memory(samples):
        options = {"height": 64, "width": 64, "samples": samples}
        lowered = renderer.render.lower(build(model, ["c"]), poses_of(data), **options)
        return lowered.compile().memory_analysis().temp_size_in_bytes

    assert memory(8) < 1.5 * memory(2)


@pytest.mark.slow
def test_environments_pass_antialias_on():
    plain, smooth = (envs.make("press", image_size=12, antialias=n) for n in (1, 3))
    batch = Poses(*(x[None] for x in poses_of(world(plain))))
    for env in (plain, smooth):
        expected = renderer.RayRenderer(env.render_model, 12, env.antialias)(batch, None, None)
        np.testing.assert_array_equal(env.render(batch)["wrist"], expected[:, 1])
    assert np.any(smooth.render(batch)["wrist"] != plain.render(batch)["wrist"])
    with pytest.raises(ValueError, match="antialias"):
        envs.make("press", antialias=0)


def test_the_models_appearance_is_the_default(built, poses, image):
    np.testing.assert_array_equal(renderer.render(built, poses, **SIZE), image)


def test_lowers_inside_scan_and_vmap(built, poses):
    def run(shifts):
        def body(carry, shift):
            geoms = poses[0] + shift
            return carry, jax.vmap(
                lambda x: renderer.render(built, poses._replace(geom_xpos=x), height=8, width=8)
            )(geoms[None])

        return jax.lax.scan(body, None, shifts)[1]

    lowered = jax.jit(run).trace(jnp.zeros(3)).lower(lowering_platforms=("cpu", "cuda", "tpu"))
    assert "3x1x2x8x8x3xui8" in lowered.as_text()


def test_geoms_that_cannot_be_drawn():
    field = """<mujoco><asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset><worldbody>
      <geom name="hill" type="hfield" hfield="h"/></worldbody></mujoco>"""
    with pytest.raises(ValueError, match="geom hill"):
        build(mujoco.MjModel.from_xml_string(field), ())
    with pytest.raises(ValueError, match="no visible geom"):
        build(mujoco.MjModel.from_xml_string("<mujoco/>"), ())
