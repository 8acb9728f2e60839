"""Moving pictures as files, and those of several cameras as one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image

_COLOURS = 256  # of a GIF


def write_video(path: Path, frames: np.ndarray, fps: float) -> None:
    """Writes `[T, H, W, 3]` uint8 frames as H.264 in MP4 (yuv420p, which browsers play).

    Raises:
        ValueError: if H or W is odd, which yuv420p cannot hold.
    """
    height, width = frames.shape[1:3]
    if height % 2 or width % 2:
        raise ValueError(f"a video needs even height and width, not {height} x {width}")
    options = {"movflags": "+faststart"}  # plays while it loads
    with av.open(str(path), "w", format="mp4", options=options) as container:
        stream: Any = container.add_stream("libx264", rate=round(fps))
        stream.height, stream.width = height, width
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "23"}
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def side_by_side(images: Mapping[str, np.ndarray]) -> np.ndarray:
    """Camera pictures `[..., H, W, 3]` in one row."""
    return np.concatenate(list(images.values()), axis=-2)


def write_gif(path: Path, frames: np.ndarray, seconds: float) -> None:
    """Writes `[T, H, W, 3]` uint8 frames as an endless GIF, each shown for so many seconds."""
    # One palette for all of it: colours do not flicker, and the file is half the size.
    method = Image.Quantize.MAXCOVERAGE  # small things keep their colour
    palette = Image.fromarray(np.concatenate(frames)).quantize(_COLOURS, method)
    none = Image.Dither.NONE
    first, *rest = (Image.fromarray(f).quantize(palette=palette, dither=none) for f in frames)
    first.save(
        path,
        format="gif",
        save_all=True,
        append_images=rest,
        duration=round(1000 * seconds),
        loop=0,
    )
