"""Training images change as in openpi and LeRobot, and in the same way on every resume."""

import dataclasses
import functools

import augmax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.config import AugmentConfig
from lorasp_jax.data import augmentation
from lorasp_jax.data.augmentation import augment, recipe
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.random_streams import StepKeys
from tests import GOLDEN
from tests.runs import make_run

OPENPI, LEROBOT = AugmentConfig("openpi"), AugmentConfig("lerobot")
KINDS = ("brightness", "contrast", "saturation", "hue", "sharpness", "affine")


def images(count, size=16):
    return jax.random.uniform(jax.random.key(0), (count, size, size, 3))


@pytest.mark.parametrize("wrist", [False, True])
def test_openpi_is_its_own_chain(wrist):
    """The chain of openpi's models/model.py, on pictures of 40 pixels."""
    moves = [augmax.RandomCrop(38, 38), augmax.Resize(40, 40), augmax.Rotate((-5, 5))]
    jitter = augmax.ColorJitter(brightness=0.3, contrast=0.4, saturation=0.5)
    chain = augmax.Chain(*([] if wrist else moves), jitter)
    keys, pictures = jax.random.split(jax.random.key(1), 16), images(16, 40)
    expected = jax.jit(jax.vmap(chain))(keys, pictures)
    found = jax.jit(jax.vmap(recipe(OPENPI, wrist=wrist)))(keys, pictures)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert (jnp.abs(found - pictures).max((1, 2, 3)) > 0.05).mean() > (0.3 if wrist else 0.99)


@pytest.fixture(scope="module")
def lerobot():
    """Mean and variance of what LeRobot's transforms make of 10,000 random pictures."""
    with np.load(GOLDEN / "lerobot_augmentation.npz") as file:
        return dict(file)


@pytest.mark.parametrize("kind", KINDS)
def test_lerobot_kinds_have_its_distribution(kind, lerobot):
    pictures = jnp.asarray(lerobot["pictures"]) / 255
    transform, numbers = augmentation._LEROBOT[kind], LEROBOT.numbers

    def moments(picture, keys):
        changed = jnp.clip(jax.vmap(lambda key: transform(numbers, key, picture))(keys), 0, 1)
        return changed.mean((0, 3)), changed.var((0, 3))

    keys = jax.random.split(jax.random.key(2), (len(pictures), 10_000 // len(pictures)))
    mean, variance = jax.jit(jax.vmap(moments))(pictures, keys)
    assert abs((mean - lerobot[f"{kind}/mean"]).mean(0)).max() < 0.008  # three standard errors
    np.testing.assert_allclose(variance.mean(), lerobot[f"{kind}/variance"].mean(), rtol=0.02)


@pytest.mark.parametrize("at_most", [0, 1, 3])
def test_lerobot_applies_at_most_n_kinds(at_most, monkeypatch):
    """Each kind adds its own power of ten to a picture of zeros."""
    powers = {kind: 10.0**-number for number, kind in enumerate(KINDS, 1)}
    fakes = {kind: lambda _, key, x, power=power: x + power for kind, power in powers.items()}
    monkeypatch.setattr(augmentation, "_LEROBOT", fakes)
    change = recipe(dataclasses.replace(LEROBOT, at_most=at_most))
    found = jax.vmap(change, (0, None))(jax.random.split(jax.random.key(3), 64), jnp.zeros(1))
    digits = [f"{x:.6f}".count("1") for x in np.asarray(found, np.float64)[:, 0]]
    assert set(digits) == {at_most}
    assert len(np.unique(found)) > 1 or not at_most


def test_each_camera_and_row_has_its_own_changes(tmp_path):
    """A step gives the same pictures again, also on four devices; another step does not."""
    run = make_run(tmp_path / "run")
    processor, size = run.policy.processor, run.policy.processor.image_size
    picture = jnp.broadcast_to(2 * images(1, size)[0] - 1, (4, size, size, 3))
    rows = jnp.zeros(4, jnp.int32)
    raw = {"image": {n: jnp.zeros((4, 8, 8, 3), jnp.uint8) for n in ("side", "wrist")}}
    observation = processor.encode(raw | {"state": jnp.zeros((4, 7))}, rows)
    present = {name: picture for name in observation.images}
    observation = dataclasses.replace(observation, images=present)
    change = jax.jit(lambda key, seen: augment(key, seen, processor, OPENPI).images)
    key, several = jax.random.key(0), meshes.make_mesh(1, jax.devices()[:4])
    spread = jax.device_put(observation, meshes.batch_sharding(several))
    first, later = (change(StepKeys.of(key, n).images, observation) for n in (5, 6))
    side, wrist = first["side"], first["wrist"]
    again = change(jax.device_put(StepKeys.of(key, 5).images, meshes.replicated(several)), spread)
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-6), first, again)
    assert (side != later["side"]).any()
    assert len({np.asarray(row).tobytes() for row in side}) == 4
    assert (side != wrist).any()
    assert ((side >= -1.001) & (side <= 1.001)).all()


def test_cameras_on_the_wrist():
    named = ("wrist", "left_wrist_0_rgb", "gripper_cam", "hand", "overhead", "side", "base_0_rgb")
    assert [augmentation.on_wrist(name) for name in named] == 4 * [True] + 3 * [False]


def test_recordings_change_in_color_alone():
    still = AugmentConfig(brightness=0.0, contrast=0.0, hue=0.0).chosen(simulated=False)
    image = jnp.asarray(np.random.default_rng(0).random((16, 16, 3), np.float32))
    assert still is not None
    for seed in range(4):
        changed = recipe(still)(jax.random.key(seed), image)
        np.testing.assert_allclose(changed, image, atol=1e-6)  # hue and back


def test_default_recipe():
    assert AugmentConfig().chosen(simulated=True) is None
    colors = AugmentConfig("openpi", crop=1.0, rotation=0.0)
    assert AugmentConfig().chosen(simulated=False) == colors
    assert AugmentConfig(crop=0.9).chosen(simulated=False) == dataclasses.replace(colors, crop=0.9)
    assert AugmentConfig("openpi").numbers["crop"] == 0.95
    assert AugmentConfig("lerobot").chosen(simulated=True).numbers["at_most"] == 3
    assert AugmentConfig(hue=0.0).chosen(simulated=False).numbers["hue"] == 0


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"preset": "openpi", "sharpness": 0.5}, "sharpness.*openpi.*crop"),
        ({"preset": "none", "crop": 0.9}, "crop.*none"),
        ({"crop": 1.5}, r"crop.*1\.5"),
        ({"crop": 0.0}, "crop.*0"),
        ({"hue": -0.1}, r"hue.*-0\.1"),
        ({"preset": "fast"}, "preset.*openpi.*lerobot"),
    ],
)
def test_impossible_settings(settings, named):
    with pytest.raises(ValueError, match=named):
        AugmentConfig(**settings)
