"""Write videos and GIFs, and join the images of several cameras."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image

_COLORS = 256  # in a GIF's largest palette


def write_video(path: Path, frames: np.ndarray, fps: float, *, times: int = 1) -> None:
    """Write `[T, H, W, 3]` uint8 frames as H.264 in MP4 (yuv420p, which browsers play).

    Args:
        path: file to write.
        frames: the pictures.
        fps: pictures per second.
        times: factor by which pictures are enlarged, by repeating their pixels.

    Raises:
        ValueError: H or W is odd, which yuv420p does not allow.
    """
    height, width = (times * side for side in frames.shape[1:3])
    if height % 2 or width % 2:
        raise ValueError(f"a video's height and width must be even, got {height} x {width}")
    options = {"movflags": "+faststart"}  # browsers can play it while it loads
    with av.open(str(path), "w", format="mp4", options=options) as container:
        stream: Any = container.add_stream("libx264", rate=round(fps))
        stream.height, stream.width = height, width
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "23"}  # x264's default quality
        for frame in frames:
            large = frame.repeat(times, axis=0).repeat(times, axis=1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(large, format="rgb24")))
        container.mux(stream.encode())


def side_by_side(images: Mapping[str, np.ndarray]) -> np.ndarray:
    """Join camera images `[..., H, W, 3]` along their width."""
    return np.concatenate(list(images.values()), axis=-2)


def write_gif(path: Path, frames: np.ndarray, seconds: float) -> None:
    """Write `[T, H, W, 3]` uint8 frames as a looping GIF, `seconds` per frame."""
    # With one palette for all frames, colors do not flicker and the file is half the size.
    method = Image.Quantize.MAXCOVERAGE  # small objects keep their color
    palette = Image.fromarray(np.concatenate(frames)).quantize(_COLORS, method)
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
