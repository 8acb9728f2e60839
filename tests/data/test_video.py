"""Videos: frames match PyAV's own, in any reading order."""

import av
import numpy as np
import pytest
from PIL import Image

from lorasp_jax.data.video import VideoReader

FPS, LENGTH, HEIGHT, WIDTH = 10, 23, 66, 90


@pytest.fixture(scope="module", params=["libsvtav1", "libx264"])
def film(request, tmp_path_factory):
    """Path of a video of noise: all frames differ, and the width needs padding in the decoder."""
    path, rng = tmp_path_factory.mktemp("film") / "film.mp4", np.random.default_rng(0)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(request.param, rate=FPS)
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        stream.options = {"g": "2", "crf": "30"}
        for _ in range(LENGTH):
            coarse = rng.integers(0, 255, (HEIGHT // 6, WIDTH // 6, 3), np.uint8)
            picture = coarse.repeat(6, 0).repeat(6, 1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path


@pytest.fixture(scope="module")
def frames(film):
    with av.open(str(film)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_all_frames(film, frames):
    found = VideoReader(film).read(0.0, LENGTH, FPS)
    np.testing.assert_array_equal(found, frames)
    assert np.abs(np.diff(found.astype(int), axis=0)).mean((1, 2, 3)).min() > 20


def test_downscaling_matches_pillow(film, frames):
    found = VideoReader(film).read(0.0, LENGTH, FPS, every=3, image_size=32)
    size = 32, 32 * HEIGHT // WIDTH
    reduced = [Image.fromarray(f).resize(size, Image.Resampling.BILINEAR) for f in frames[::3]]
    np.testing.assert_array_equal(found, reduced)


def test_ranges_in_any_order(film, frames):
    reader = VideoReader(film)
    for first, length in ((5, 4), (9, 6), (0, 3), (20, 3), (1, 20)):
        found = reader.read(first / FPS, length, FPS)
        np.testing.assert_array_equal(found, frames[first : first + length])
    with pytest.raises(ValueError, match="frames"):
        reader.read(0.0, LENGTH + 1, FPS)
    np.testing.assert_array_equal(reader.read(0.0, 2, FPS), frames[:2])
    reader.close()


def test_depth_is_refused(tmp_path):
    path = tmp_path / "depth.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=FPS)
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "gray16le"
        depth = np.full((HEIGHT, WIDTH), 900, np.uint16)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(depth, format="gray16le")))
        container.mux(stream.encode())
    with pytest.raises(ValueError, match=r"depth\.mkv has one channel"):
        VideoReader(path)
