"""Pictures and videos of recorded episodes."""

from pathlib import Path

import av
import numpy as np
from PIL import Image

FILM_SIZE = 192
"""Height and width of each camera in a video [pixels]."""


def write_video(path: Path, frames: np.ndarray, fps: float) -> None:
    """Write `[T, H, W, 3]` uint8 frames as H.264 (yuv420p, which browsers play); H and W even."""
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=round(fps))
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "23"}
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def write_picture(path: Path, image: np.ndarray) -> None:
    """Write a `[H, W, 3]` uint8 picture."""
    Image.fromarray(image).save(path)


def side_by_side(images: dict[str, np.ndarray]) -> np.ndarray:
    """Camera pictures `[..., H, W, 3]` in one row."""
    return np.concatenate(list(images.values()), axis=-2)
