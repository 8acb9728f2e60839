"""MuJoCo Warp's physics and renderer against MJX-JAX and the ray caster; slow on CPU."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.physics import physics
from envs.scene.ranges import Randomization
from envs.state import Poses
from tests.envs.demonstrations import demonstration

pytest.importorskip("warp")
WORLDS, SIZE = 3, 48
RANGES = Randomization(
    size=(0.9, 1.1),
    mass=(0.5, 2.0),
    gains=(0.8, 1.2),
    latency=(0.0, 0.1),
    table_height=(-0.04, 0.04),
)


def make(task, **options):
    return envs.make(task, "piper", num_envs=WORLDS, image_size=SIZE, **options)


@pytest.fixture(scope="module")
def pair():
    """The same worlds in both engines."""
    return [make("open_pot", backend=backend) for backend in ("jax", "warp")]


def run(env, ranges, steps):
    """Run the expert for some control steps."""
    walk = demonstration(env, env.reset(jax.random.key(2), ranges))
    return next(itertools.islice(walk, steps - 1, None))[2]


def test_default_backend_depends_on_the_device(pair, monkeypatch):
    assert physics.default_backend() == "jax"  # no NVIDIA GPU here
    assert make("press").physics.backend == "jax"
    assert pair[1].physics.backend == "warp"
    gpu = type("Device", (), {"client": type("Client", (), {"platform_version": "cuda 13000"})})
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "devices", lambda: [gpu])
    assert physics.default_backend() == "jax"  # eight devices here
    with pytest.raises(ValueError, match="single GPU"):
        make("press", backend="warp")
    monkeypatch.setattr(jax, "device_count", lambda: 1)
    assert physics.default_backend() == "warp"
    monkeypatch.setattr(physics.importlib.util, "find_spec", lambda name: None)
    assert physics.default_backend() == "jax"


def test_missing_warp(monkeypatch):
    monkeypatch.setattr(physics.importlib.util, "find_spec", lambda name: None)
    for option in ("backend", "renderer"):
        with pytest.raises(ValueError, match=rf"{option} .*warp-lang"):
            make("press", **{option: "warp"})


@pytest.mark.slow  # compiles both engines: a minute and a half
def test_both_engines_agree(pair):
    """40 control steps: the lid rests on the pot, most worlds have lifted it at the end."""
    ours, theirs = (run(env, RANGES, 40) for env in pair)
    lid = pair[0].model.body("lid").id
    assert np.all(ours.data.xpos[:, lid, 2] > 0.05)
    np.testing.assert_allclose(ours.data.qpos[:, :8], theirs.data.qpos[:, :8], atol=2e-3)
    np.testing.assert_allclose(ours.data.xpos[:, lid], theirs.data.xpos[:, lid], atol=3e-3)
    assert not bool(theirs.info["broken"].any())


@pytest.mark.slow
def test_nested_vmap(pair):
    """An outer vmap, such as Brax's, gives the same as one batch."""
    env = pair[1]
    state = env.reset(jax.random.key(0), RANGES)
    action = state.info["command"] + 0.02
    batch = env.step(state, action)
    nested = jax.tree.map(lambda x: jnp.stack([x, x]), (state, action))
    twice = jax.vmap(env._batched_step)(*nested)
    np.testing.assert_allclose(twice.data.qpos[1], batch.data.qpos, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ranges", "antialias"),
    [(None, 2), (Randomization.typical(), 1)],
)
def test_images_match_the_ray_caster(ranges, antialias):
    """The mean difference is below one level of 255; single pixels at edges differ."""
    ours, theirs = (
        make("pour", backend="jax", renderer=r, antialias=antialias) for r in ("rays", "warp")
    )
    state = ours.reset(jax.random.key(1), ranges)
    for name, picture in ours.observe(state)["image"].items():
        other = theirs.observe(state)["image"][name]
        difference = np.abs(np.asarray(picture, int) - np.asarray(other, int))
        assert difference.mean(axis=(1, 2, 3)).max() < 1.5
        assert np.mean(difference.max(axis=-1) > 16) < 0.03
    # Chunks of the context's size, the last one padded.
    poses = Poses.of(state.data)
    many = jax.tree.map(lambda x: jnp.concatenate([x, x[:1]]), (poses, state.info["draw"]))
    pictures = theirs.render(many[0], draw=many[1])
    seen = theirs.observe(state)["image"]
    for name, picture in pictures.items():
        np.testing.assert_array_equal(picture, jnp.concatenate([seen[name], seen[name][:1]]))
    # Another vmap multiplies the number of worlds.
    twice = jax.vmap(theirs.observe)(jax.tree.map(lambda x: jnp.stack([x, x]), state))["image"]
    for name, picture in twice.items():
        np.testing.assert_array_equal(picture[1], seen[name])
