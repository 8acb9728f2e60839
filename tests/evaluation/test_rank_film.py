"""Tinted images and frames of a rank map."""

import numpy as np
from matplotlib.colors import Normalize

from lorasp_jax.evaluation import rank_film


def test_one_patch_changes_color_where_its_rank_changes():
    images = np.random.default_rng(0).integers(0, 255, (12, 12, 3), np.uint8)
    ranks, scale = np.full((4, 4), 3.0), Normalize(0, 10)
    before = rank_film.tint(images, ranks, scale)
    ranks[1, 2] = 9.0
    changed = (rank_film.tint(images, ranks, scale) != before).any(-1)
    expected = np.zeros((12, 12), bool)
    expected[3:6, 6:9] = True
    np.testing.assert_array_equal(changed, expected)


def test_patches_that_do_not_divide_the_image():
    images = np.zeros((7, 7, 3), np.uint8)
    tinted = rank_film.tint(images, np.arange(9.0).reshape(3, 3), Normalize(0, 8))
    assert len({tuple(pixel) for pixel in tinted.reshape(-1, 3)}) == 9


def test_images_stay_recognizable():
    images = np.zeros((8, 8, 3), np.uint8)
    images[:, 4:] = 255
    tinted = rank_film.tint(images, np.zeros((1, 1)), Normalize(0, 1)).astype(int)
    assert (tinted[:, 4:] - tinted[:, :4] > 100).all()


def test_frames():
    rng, steps = np.random.default_rng(0), 3
    images = {
        name: rng.integers(0, 255, (steps, 16, 16, 3), np.uint8) for name in ("side", "wrist")
    }
    ranks = {name: rng.uniform(2, 9, (steps, 4, 4)) for name in images}
    ranks["side"][1] = ranks["side"][0]
    images["side"][1] = images["side"][0]
    towers = {"action": np.array([4.0, 5, 6]), "vision": np.array([4.0, 4, 4])}
    frames = rank_film.draw(images, ranks, towers, title="press", control_dt=0.1)
    assert (frames.shape, frames.dtype) == ((steps, 480, 640, 3), np.uint8)
    first, second = (frames[0] != frames[1]).any(-1), (frames[1] != frames[2]).any(-1)
    pictures = slice(60, 300)
    assert not first[pictures, :270].any()  # only the wrist camera and the time mark moved
    assert first[pictures, 300:500].any()
    assert first[330:].any()
    assert second[pictures, :270].any()


def test_equal_ranks_have_a_scale():
    images = {"side": np.zeros((1, 8, 8, 3), np.uint8)}
    ranks = {"side": np.full((1, 2, 2), 5.0)}
    towers = {"vision": np.array([5.0])}
    frames = rank_film.draw(images, ranks, towers, title="press", control_dt=0.1)
    assert frames.std() > 0
