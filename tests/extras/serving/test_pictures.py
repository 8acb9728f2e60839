"""Test that pictures are converted as in training, on the host."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.extras.serving.pictures import MAX_SIDE, to_square
from lorasp_jax.policies.images import resize_with_pad, to_unit


def smooth(height, width):
    """Return a picture without noise, in which two ways to resize differ little."""
    y, x = np.mgrid[:height, :width]
    waves = [np.sin(x / width * 7 + i) * np.cos(y / height * 5) for i in range(3)]
    return (np.stack(waves, -1) * 127 + 128).astype(np.uint8)


@pytest.mark.parametrize(
    ("shape", "centred", "antialias"),
    [
        ((48, 64), True, True),
        ((48, 64), True, False),
        ((48, 64), False, True),
        ((7, 31), True, True),
        ((20, 20), True, False),
        ((64, 1), True, False),
    ],
)
def test_pictures_equal_those_of_the_processor(shape, centred, antialias):
    picture, options = smooth(*shape), {"centred": centred, "antialias": antialias}
    found = to_square("x", picture, 32, **options)
    resize = jax.jit(lambda x: resize_with_pad(to_unit("x", x), 32, **options))
    unit = resize(jnp.asarray(picture[None]))
    expected = (np.asarray(unit[0]) + 1) * 127.5
    assert (found.dtype, found.shape) == (np.uint8, (32, 32, 3))
    assert np.abs(found - expected).max() <= 2


def test_layouts_and_types():
    picture = smooth(24, 32)
    expected = to_square("x", picture, 16)
    np.testing.assert_array_equal(to_square("x", picture.transpose(2, 0, 1), 16), expected)
    floats = (picture / np.float64(255)).astype(np.float32) + 1e-6
    np.testing.assert_array_equal(to_square("x", floats.clip(0, 1), 16), expected)
    assert to_square("x", expected, 16) is expected  # not copied
    # Three pixels high, which is not channels first.
    assert to_square("x", np.zeros((3, 40, 3), np.uint8), 16).shape == (16, 16, 3)


@pytest.mark.parametrize(
    ("picture", "refusal"),
    [
        (None, r"view must be a picture \[H, W, 3\] or \[3, H, W\], got NoneType"),
        (np.zeros((4, 4)), r"got shape \(4, 4\)"),
        (np.zeros((4, 3, 4), np.uint8), r"got shape \(4, 3, 4\)"),
        (np.zeros((0, 4, 3), np.uint8), "1 to 8192 pixels"),
        (np.zeros((1, MAX_SIDE + 1, 3), np.uint8), "1 to 8192 pixels"),
        (np.zeros((4, 4, 3), np.int32), "uint8, or float .* got int32"),
        (np.full((4, 4, 3), np.nan), "finite"),
        (np.full((4, 4, 3), 255.0), r"in \[0, 1\]"),
        (np.full((4, 4, 3), -0.1), r"in \[0, 1\]"),
    ],
)
def test_mistakes(picture, refusal):
    with pytest.raises(ValueError, match=refusal):
        to_square("view", picture, 16)
