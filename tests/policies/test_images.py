"""Resizing against Pillow, which openpi's client uses, and against plain bilinear arithmetic."""

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from lorasp_jax.policies.images import resize_with_pad, to_unit

RNG = np.random.default_rng(0)


def bilinear(image, height, width):
    """`F.interpolate(mode="bilinear", align_corners=False)`, pixel by pixel."""
    rows, columns = image.shape[:2]
    found = np.zeros((height, width, 3))
    for y in range(height):
        for x in range(width):
            v = min(max((y + 0.5) * rows / height - 0.5, 0), rows - 1)
            u = min(max((x + 0.5) * columns / width - 0.5, 0), columns - 1)
            top, left = int(v), int(u)
            bottom, right = min(top + 1, rows - 1), min(left + 1, columns - 1)
            a, b = v - top, u - left
            upper = (1 - b) * image[top, left] + b * image[top, right]
            lower = (1 - b) * image[bottom, left] + b * image[bottom, right]
            found[y, x] = (1 - a) * upper + a * lower
    return found


@pytest.mark.parametrize("shape", [(20, 31), (9, 14), (30, 12)])
def test_smolvla_pads_left_and_top(shape):
    """As LeRobot: the picture in [0, 1], zeros around it, then 2 x - 1."""
    image, size = RNG.integers(0, 256, (*shape, 3), np.uint8), 16
    ratio = max(shape) / size
    inner = [int(length / ratio) for length in shape]
    expected = np.zeros((size, size, 3))
    expected[size - inner[0] :, size - inner[1] :] = bilinear(image / 255, *inner)
    found = resize_with_pad(to_unit("side", image[None]), size, centred=False, antialias=False)
    np.testing.assert_allclose(found[0], 2 * expected - 1, atol=2e-6)


@pytest.mark.parametrize("shape", [(60, 97), (96, 40), (9, 14)])
def test_pi0_is_smooth_and_centred(shape):
    """As openpi's client does with Pillow, which rounds twice to whole grey levels."""
    image, size = RNG.integers(0, 256, (*shape, 3), np.uint8), 28
    ratio = max(shape) / size
    height, width = (int(length / ratio) for length in shape)
    expected = Image.new("RGB", (size, size), 0)
    resized = Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR)
    expected.paste(resized, ((size - width) // 2, (size - height) // 2))
    found = resize_with_pad(to_unit("side", image[None]), size)
    np.testing.assert_allclose((found[0] + 1) * 127.5, np.asarray(expected), atol=1.1)
    rough = resize_with_pad(to_unit("side", image[None]), size, antialias=False)
    if max(shape) > size:
        assert np.abs(rough - found).max() > 0.1


def test_lengths_are_rounded_as_there():
    """int(116 / (116 / 224)) is 223, and a column stays black on the left only where it is even."""
    found = resize_with_pad(jnp.ones((1, 64, 116, 3)), 224)[0]
    inside = np.asarray(found[112, :, 0] > -1)
    assert inside.tolist() == [True] * 223 + [False]


def test_pictures_of_the_right_size_stay_as_they_are():
    image = to_unit("side", RNG.integers(0, 256, (2, 8, 8, 3), np.uint8))
    assert resize_with_pad(image, 8, centred=False, antialias=False) is image
