"""Write videos and GIFs."""

import av
import numpy as np
import pytest
from PIL import Image

from envs.rendering import video

FRAMES = np.zeros((5, 32, 64, 3), np.uint8)
FRAMES[:, :16], FRAMES[..., 32:, 0] = 200, 255


def test_video(tmp_path):
    video.write_video(tmp_path / "v.tmp", FRAMES, fps=10)
    with av.open(str(tmp_path / "v.tmp")) as container:
        (stream,) = container.streams.video
        assert (stream.codec.name, stream.average_rate) == ("h264", 10)
        seen = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert np.abs(np.stack(seen).astype(int) - FRAMES).mean() < 10


@pytest.mark.parametrize("shape", [(5, 31, 64, 3), (5, 32, 63, 3)])
def test_odd_sizes_raise(tmp_path, shape):
    with pytest.raises(ValueError, match=f"even, got {shape[1]} x {shape[2]}"):
        video.write_video(tmp_path / "v.mp4", np.zeros(shape, np.uint8), fps=10)
    assert not list(tmp_path.iterdir())


def test_gif(tmp_path):
    moving = FRAMES.copy()
    moving[2:, :, :8] = 7
    video.write_gif(tmp_path / "v.tmp", moving, seconds=0.2)
    with Image.open(tmp_path / "v.tmp") as picture:
        assert (picture.size, picture.n_frames, picture.info["duration"]) == ((64, 32), 2, 400)
        np.testing.assert_array_equal(picture.convert("RGB"), moving[0])


def test_cameras_side_by_side():
    row = video.side_by_side({"side": FRAMES, "wrist": FRAMES[:, :, :2] + 1})
    assert row.shape == (5, 32, 66, 3)
    np.testing.assert_array_equal(row[:, :, 64:], FRAMES[:, :, :2] + 1)
