"""Cameras: newest picture, missing and silent sources."""

import time
from contextlib import ExitStack

import numpy as np
import pytest

from envs.rendering.video import write_video
from lorasp_jax.extras.piper import cameras
from lorasp_jax.extras.piper.cameras import Camera, NoPicture, open_cameras


@pytest.fixture
def film(tmp_path):
    """A file of 20 pictures that become brighter; it is decoded at once."""
    frames = np.repeat(np.arange(0, 200, 10, np.uint8), 64 * 48 * 3).reshape(-1, 48, 64, 3)
    write_video(tmp_path / "film.mp4", frames, 30)
    return str(tmp_path / "film.mp4")


def test_the_newest_picture_counts(film, monkeypatch):
    monkeypatch.setattr(cameras, "MAX_AGE", 60.0)
    with ExitStack() as stack:
        look, deadline = open_cameras({"side": film, "wrist": film}, stack), time.monotonic() + 60
        while look()["side"].mean() < 187 and time.monotonic() < deadline:
            time.sleep(0.01)  # until the last picture
        images = look()
    assert {name: (x.shape, x.dtype) for name, x in images.items()} == {
        "side": ((48, 64, 3), np.uint8),
        "wrist": ((48, 64, 3), np.uint8),
    }
    assert images["side"].mean() == pytest.approx(190, abs=3)


def test_a_source_that_stops_is_stale(film, monkeypatch):
    monkeypatch.setattr(cameras, "MAX_AGE", 0.1)
    camera = Camera("wrist", film)
    camera._thread.join(60)  # until the last picture
    time.sleep(0.2)
    with pytest.raises(NoPicture, match="camera wrist shows nothing new"):
        camera.read()
    camera.close()


@pytest.mark.parametrize("source", ["/dev/video_nowhere", "nowhere.mp4"])
def test_a_missing_source_is_one_sentence(source):
    with pytest.raises(ConnectionError, match=f"cannot open camera side at {source}: "):
        open_cameras({"side": source}, ExitStack())


def test_a_source_without_pictures(tmp_path):
    (tmp_path / "empty.mp4").write_bytes(b"")
    with pytest.raises(ConnectionError, match="cannot open camera side"):
        Camera("side", str(tmp_path / "empty.mp4"))
