"""Compare resizing with Pillow, which openpi's client uses, and with explicit bilinear sums."""

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from lorasp_jax.policies.images import resize_with_pad, to_unit

RNG = np.random.default_rng(0)


def bilinear(image, height, width):
    """Reference for `F.interpolate(mode="bilinear", align_corners=False)`, pixel by pixel."""
    rows, columns = image.shape[:2]
    resized = np.zeros((height, width, 3))
    for y in range(height):
        for x in range(width):
            v = min(max((y + 0.5) * rows / height - 0.5, 0), rows - 1)
            u = min(max((x + 0.5) * columns / width - 0.5, 0), columns - 1)
            top, left = int(v), int(u)
            bottom, right = min(top + 1, rows - 1), min(left + 1, columns - 1)
            a, b = v - top, u - left
            upper = (1 - b) * image[top, left] + b * image[top, right]
            lower = (1 - b) * image[bottom, left] + b * image[bottom, right]
            resized[y, x] = (1 - a) * upper + a * lower
    return resized


@pytest.mark.parametrize("shape", [(20, 31), (9, 14), (30, 12)])
def test_smolvla_pads_left_and_top(shape):
    """LeRobot pads the image in [0, 1] with zeros, then maps it to 2 x - 1."""
    image, size = RNG.integers(0, 256, (*shape, 3), np.uint8), 16
    ratio = max(shape) / size
    inner = [int(length / ratio) for length in shape]
    expected = np.zeros((size, size, 3))
    expected[size - inner[0] :, size - inner[1] :] = bilinear(image / 255, *inner)
    actual = resize_with_pad(to_unit("side", image[None]), size, centred=False, antialias=False)
    np.testing.assert_allclose(actual[0], 2 * expected - 1, atol=2e-6)


@pytest.mark.parametrize("shape", [(60, 97), (96, 40), (9, 14)])
def test_pi0_is_antialiased_and_centered(shape):
    """openpi's client uses Pillow, which rounds to whole gray levels twice."""
    image, size = RNG.integers(0, 256, (*shape, 3), np.uint8), 28
    ratio = max(shape) / size
    height, width = (int(length / ratio) for length in shape)
    expected = Image.new("RGB", (size, size), 0)
    resized = Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR)
    expected.paste(resized, ((size - width) // 2, (size - height) // 2))
    actual = resize_with_pad(to_unit("side", image[None]), size)
    np.testing.assert_allclose((actual[0] + 1) * 127.5, np.asarray(expected), atol=1.1)
    aliased = resize_with_pad(to_unit("side", image[None]), size, antialias=False)
    if max(shape) > size:
        assert np.abs(aliased - actual).max() > 0.1


def test_side_lengths_are_rounded_down():
    """int(116 / (116 / 224)) is 223; the odd column of padding is on the right."""
    actual = resize_with_pad(jnp.ones((1, 64, 116, 3)), 224)[0]
    inside = np.asarray(actual[112, :, 0] > -1)
    assert inside.tolist() == [True] * 223 + [False]


def test_images_of_the_right_size_are_unchanged():
    image = to_unit("side", RNG.integers(0, 256, (2, 8, 8, 3), np.uint8))
    assert resize_with_pad(image, 8, centred=False, antialias=False) is image
